"""What a report says, before it is drawn: the verdict with its reasons, the parameters and the signals; and as JSON."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

from calibkit.data.result import Result
from calibkit.data.rig import Rig
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.report.limits import Check, Limit, check, require_observable
from calibkit.report.parameters import Row, parts, rig_reasons, rows
from calibkit.report.probe import Signal
from calibkit.report.signals import measure, not_good
from calibkit.report.view import View, views

SCHEMA = "calibkit-report/1"


@dataclass(frozen=True)
class Summary:
    """The words and numbers of a report of one rig."""

    rig: Rig
    results: tuple[Result, ...]
    reasons: tuple[Reason, ...]  # gravest first
    parameters: tuple[Row, ...]
    views: tuple[View, ...]
    signals: tuple[Signal, ...]
    earlier: tuple[View, ...] = ()  # of entries that a later stage has made anew without residuals of its own: to be looked at
    limits: tuple[Check, ...] = ()  # what a person asked for

    @property
    def verdict(self) -> Verdict:
        return worst(self.reasons)

    @property
    def has_plain(self) -> bool:
        """Whether the parameters' columns plain and factor hold anything."""
        return any(row.sigma_plain is not None for row in self.parameters)


@dataclass(frozen=True)
class Demands:
    """What a person asks of a rig beyond calibkit's own verdict."""

    limits: tuple[Limit, ...] = ()
    require_observable: bool = False


NOTHING = Demands()


@dataclass(frozen=True)
class Look:
    """Results made ready to be read, and what is measured on them."""

    views: tuple[View, ...]
    signals: tuple[Signal, ...]


def look_at(results: Sequence[Result]) -> Look:
    """Return what there is to see in the results' residuals."""
    seen = tuple(view for result in results for view in views(result))
    return Look(seen, tuple(signal for view in seen for signal in measure(view)))


def summarise(
    rig: Rig, results: Sequence[Result], earlier: Sequence[Result] = (), demands: Demands = NOTHING, look: Look | None = None
) -> Summary:
    """Return what the results and the rig file say of the rig: the gravest of all their verdicts, each reason once.

    What `earlier` ones leave is looked at, not judged, but limits may be set on it where no later one measures it. BadInputError for a
    limit on what the rig does not have. `look` is that at the results, where it was taken before.
    """
    look = look or look_at(results)
    seen, signals = look.views, look.signals
    said = tuple(reason for result in results for reason in result.reasons)
    said += rig_reasons(rig, said)
    gone = [name for result in results for name in result.not_observable]
    unsaid = [name for name in gone if not any(_says(reason, name) for reason in said)]
    said += tuple(Reason(Verdict.FAIL, f"not observable in this recording: {name}") for name in unsaid)
    said += not_good(signals)
    parameters = tuple(rows(rig))
    asked = check(demands.limits, parameters, (*signals, *_untold(earlier, signals)))
    asked += (require_observable(parameters),) if demands.require_observable else ()
    said += tuple(one.reason for one in asked if not one.holds)
    lost = [f"{row.part} {row.name}" for row in parameters if row.status is Status.NOT_OBSERVABLE]
    if lost and worst(said) is not Verdict.FAIL:  # whatever its stage made of it
        said += (Reason(Verdict.FAIL, f"not observable in this recording: {', '.join(lost)}"),)
    if not said:
        judged = any(entry.verdict for _, entry in parts(rig))
        text = "nothing speaks against it" if judged else "no stage of calibkit has judged this rig: its numbers were given, not estimated"
        said = (Reason(Verdict.PASS if judged else Verdict.CHECK, text),)
    order = list(Verdict)
    unique = sorted(dict.fromkeys(said), key=lambda reason: -order.index(reason.verdict))
    drawn = {view.sensor for view in seen}
    old = tuple(view for result in earlier for view in views(result) if view.sensor not in drawn)
    return Summary(rig, tuple(results), tuple(unique), parameters, seen, signals, old, asked)


def _untold(earlier: Sequence[Result], signals: Sequence[Signal]) -> tuple[Signal, ...]:
    """Return what earlier stages measured and no later one did of the same sensor, as the held-out error of a lens that joint refined."""
    told = {(signal.sensor, signal.probe.key) for signal in signals}
    found = {(s.sensor, s.probe.key): s for s in look_at(earlier).signals}
    return tuple(signal for key, signal in found.items() if key not in told)


def _says(reason: Reason, name: str) -> bool:
    """Whether a reason names this parameter (`cam0.fx`, `T_cam1_cam0`) as not observable."""
    words = name.removesuffix(".offset").split(".")  # a time offset's only parameter
    return "not observable" in reason.text and all(re.search(rf"\b{re.escape(word)}\b", reason.text) for word in words)


def as_json(summary: Summary, pictures: Sequence[dict[str, str]] = ()) -> dict[str, object]:
    """Return the report for machines, schema calibkit-report/1: SI units and px (limits: as asked), null where nothing is known.

    Keys are added, never renamed, within a version.
    """
    return {
        "schema": SCHEMA,
        "verdict": summary.verdict.value,
        "reasons": [{"verdict": reason.verdict.value, "text": reason.text} for reason in summary.reasons],
        "limits": [
            {
                "name": one.name,
                "part": one.part,
                "stage": one.stage or None,
                "what": one.what,
                "value": one.value,
                "low": one.low,
                "high": one.high,
                "unit": one.unit,
                "holds": one.holds,
                "note": one.note,
            }
            for one in summary.limits
        ],
        "not_observable": [f"{row.part}.{row.name}" for row in summary.parameters if row.value is None],
        "parameters": [
            {
                "part": row.part,
                "name": row.name,
                "value": row.value,
                "sigma": row.sigma,
                "sigma_plain": row.sigma_plain,
                "sigma_factor": row.factor,
                "unit": row.unit,
                "status": row.status.value,
            }
            for row in summary.parameters
        ],
        "signals": [
            {
                "sensor": signal.sensor,
                "stage": signal.stage,
                "key": signal.probe.key,
                "title": signal.probe.title,
                "value": signal.value,
                "unit": signal.probe.unit,
                "good": signal.probe.good,
                "fail": signal.probe.bad if isfinite(signal.probe.bad) else None,
                "smaller_is_better": signal.probe.bad >= signal.probe.good,
                "verdict": signal.verdict.value,
                "mark": signal.mark,
                "note": signal.note,
            }
            for signal in summary.signals
        ],
        "frames": [
            {"sensor": view.sensor, "stage": view.stage, "unit": view.unit, "label": label, "rms": float(rms) if isfinite(rms) else None}
            for view in summary.views
            if view.frame is not None
            for label, rms in zip(view.labels, view.frame_rms, strict=True)
        ],
        "facts": {result.stage: result.facts for result in summary.results},
        "pictures": list(pictures),
        "provenance": [run.model_dump(mode="json") for run in summary.rig.provenance],
    }
