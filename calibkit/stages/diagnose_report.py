"""The report of a diagnosis or a validation: the page of every stage, and what was found of the suspects before it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import InputFile, Rig, StageRun
from calibkit.data.verdict import Reason, Verdict
from calibkit.errors import one_line
from calibkit.estimation.diagnosis import Alone, Cause
from calibkit.estimation.diagnosis_signature import Course, Signature, courses, signatures
from calibkit.estimation.diagnosis_words import About, base_of, bending, named, number, unit_of
from calibkit.estimation.intrinsics import corner_set
from calibkit.estimation.joint_residuals import residual_sets
from calibkit.geometry.so3 import Array
from calibkit.report.parameters import rows
from calibkit.report.summary import Summary, look_at
from calibkit.stages.diagnose import Diagnosed, Examined, sensors_of
from calibkit.stages.diagnose_cameras import CamerasExamined
from calibkit.stages.report import write_pages
from calibkit.version import __version__

if TYPE_CHECKING:
    from calibkit.report.diagnosis_figures import Cloud, Line
    from calibkit.report.figures import Chapter, Plate

_BARS = 14
_WORTH_A_PANEL = 0.02  # of what a cause predicts in all
_LENS = ("focal", "focal lengths", "centre", "distortion")


def write_diagnosis(found: Examined, folder: Path, command: str) -> None:
    """Write the report of `calibkit diagnose`."""
    summary = summary_of(found, "diagnose", command, reasons_of(found.diagnosed), found.diagnosed.as_json())
    write_pages(summary, folder, chapters=chapters_of(found))


def reasons_of(diagnosed: Diagnosed) -> list[Reason]:
    """Return what was found as sentences of a verdict."""
    reasons = [Reason(Verdict.FAIL, diagnosed.misfit)] if diagnosed.misfit else []
    for cause, told in zip(diagnosed.diagnosis.causes, diagnosed.told, strict=True):
        alike = f"; this motion does not tell it from {', '.join(told.alike)}" if told.alike else ""
        reasons.append(Reason(Verdict.FAIL, f"{told.text} ({100 * cause.share:.0f} % of the excess): {told.mend}{alike}"))
    if not reasons:
        verdict, _, text = diagnosed.verdict.partition(": ")
        reasons.append(Reason(Verdict(verdict), text))
    return [*reasons, *(Reason(Verdict.PASS, noise.text) for noise in diagnosed.noise if not noise.no_fit)]


def write_cameras(found: CamerasExamined, folder: Path, command: str) -> None:
    """Write the report of `calibkit diagnose` on a recording without an IMU."""
    sets = [corner_set(fit, i) for fit in found.held for i in range(len(fit.views))]
    labels = {views_.camera: list(views_.labels) for fit in found.held for views_ in fit.views}
    page = _Page("diagnose", command, found.rig, found.read.recording.inputs(), tuple(sets), {"frame_labels": labels})
    summary = page.summary(found.diagnosed, reasons_of(found.diagnosed), found.diagnosed.as_json())
    write_pages(summary, folder, chapters=[_suspects(found.diagnosed, found.about)])


def summary_of(
    found: Examined, stage: str, command: str, reasons: Sequence[Reason], told: dict[str, object], tables: Sequence[object] = ()
) -> Summary:
    """Return what the report of cameras and an IMU says before it is drawn."""
    read, joint = found.read, found.joint
    under_test = replace(joint, fit=replace(joint.fit, x=found.held))
    sets = tuple(_with_temperature(found, each) for each in residual_sets(under_test, read.views, [read.imu.name]))
    labels = {name: [views_.labels[i] for i in some] for name, views_, some in zip(read.names, read.views, joint.frames, strict=True)}
    facts = {"frame_labels": labels, "t_zero_ns": dict.fromkeys((each.sensor for each in sets), joint.origin_ns)}
    return _Page(stage, command, found.rig, read.inputs, sets, facts).summary(found.diagnosed, reasons, told, tables)


@dataclass(frozen=True)
class _Page:
    """What a report of a diagnosis is made from."""

    stage: str
    command: str
    rig: Rig
    inputs: Sequence[tuple[str, str | None]]
    sets: tuple[ResidualSet, ...]  # under the calibration under test
    facts: dict[str, object]

    def summary(self, diagnosed: Diagnosed, reasons: Sequence[Reason], told: dict[str, object], tables: Sequence[object] = ()) -> Summary:
        """Return what it says: its verdict is that of the reasons alone, the signals are to be looked at."""
        inputs = [InputFile(name=one_line(name), sha256=digest) for name, digest in self.inputs]
        run = StageRun(stage=self.stage, command=one_line(self.command, 2000), calibkit=__version__, inputs=inputs)
        rig = self.rig.model_copy(update={"provenance": [run]})
        rms = [["residuals, rms", "by the rig file", "at best", "unit"]]
        rms += [[each.sensor, f"{each.held:.3g}", f"{each.best:.3g}", each.unit] for each in diagnosed.rms]
        lines = [f"under test, on {diagnosed.what}", *diagnosed.not_tested]
        result = Result(self.stage, rig, tuple(reasons), self.sets, {**self.facts, "lines": lines, "tables": [rms, *tables], "found": told})
        look = look_at([result])
        return Summary(rig, (result,), tuple(reasons), tuple(rows(rig)), look.views, look.signals)


def _with_temperature(found: Examined, residuals: ResidualSet) -> ResidualSet:
    t = (residuals.t_ns - found.joint.origin_ns) * 1e-9
    celsius = {"temperature": np.interp(t, *found.temperature)} if found.temperature is not None else {}
    return replace(residuals, context={**residuals.context, **celsius})


def chapters_of(found: Examined) -> list["Chapter"]:
    """Return the pictures of the suspects, and of each that is named."""
    from calibkit.report.figures import Chapter

    out = [_suspects(found.diagnosed, found.about)]
    for k, cause in enumerate(found.causes):
        out.append(Chapter(f"Cause {k + 1}: {named(cause.key, found.about)}", tuple(_of_cause(found, cause)), found.diagnosed.told[k].text))
    return out


def _suspects(diagnosed: Diagnosed, about: About) -> "Chapter":
    from calibkit.report.diagnosis_figures import Bar, suspects
    from calibkit.report.figures import Chapter, Plate

    diagnosis = diagnosed.diagnosis
    shares = {cause.key: cause.share for cause in diagnosis.causes}
    order = sorted(diagnosis.alone, key=lambda key: (key not in shares, -diagnosis.alone[key].share))[:_BARS]
    bars = [Bar(named(key, about), _size(key, diagnosis.alone[key], about), diagnosis.alone[key].share, shares.get(key)) for key in order]
    caption = (
        "The excess is what the residuals have more under this calibration than at the recording's own best. One long bar that is named is "
        "good: one thing to mend. Long bars that are not named are explained by those that are; if none is, all of it is within chance."
    )
    return Chapter("Causes", (Plate("suspects", "Suspected causes", caption, 1.0 + 0.24 * len(bars), partial(suspects, bars=bars)),))


def _size(key: str, alone: Alone, about: About) -> str:
    unit, scale = unit_of(key)
    if key.startswith("distortion "):
        return f"{np.sqrt(np.mean(np.sum(bending(alone.theta, about, int(key[-1]))[1] ** 2, axis=1))):.2g} px rms"
    if len(alone.theta) > 1:
        return f"{len(alone.theta)} numbers"
    text = f"{number(float(alone.theta[0]) * scale, float(np.sqrt(alone.cov[0, 0])) * scale)} {unit}"
    return text.replace("+-", "±").replace(" us", " µs")


def _of_cause(found: Examined, cause: Cause) -> list["Plate"]:
    from calibkit.report.diagnosis_figures import clouds, fields
    from calibkit.report.diagnosis_figures import courses as draw_courses
    from calibkit.report.figures import Plate

    plates = []
    if base_of(cause.key) == cause.key:  # what drifts has no one size
        suspect = next(each for each in found.suspects if each.key == cause.key)
        by_sensor = signatures(found.joint.fit, found.held, found.drifts, suspect.columns @ cause.theta)
        drawn = _clouds(found, cause, by_sensor)
        caption = (
            "Points on the line are good evidence: the residuals grow just where this cause makes them grow. Points that stay level are "
            "something else. What the trajectory takes along is not in the line."
        )
        plates.append(Plate("signature", "Its signature in the residuals", caption, 3.4, partial(clouds, drawn=drawn)))
        name, _, c = cause.key.rpartition(" ")
        of_camera = by_sensor.get(f"camera {c}")
        if name in _LENS and of_camera is not None and of_camera.uv is not None:
            pairs = [("mean residual under this calibration", of_camera.left), ("what the cause predicts", of_camera.predicted)]
            size = found.read.views[int(c)].image_size
            caption = "The same pattern in both, arrow by arrow, is good evidence; what only the left one has is something else."
            draw = partial(fields, uv=of_camera.uv, fields_of=pairs, size=size)
            plates.append(Plate("field", "Its field over the image", caption, 3.6, draw))
    lines = _course(found, cause)
    if lines:
        what = f"{named(base_of(cause.key), found.about)},\nbeside the rig file's ({unit_of(base_of(cause.key))[0]})"
        caption = (
            "Windows on the line, within their bars, are good; a level line is a cause that was there all along, a slope one that grows."
        )
        plates.append(Plate("course", "How large it is, window by window", caption, 3.2, partial(draw_courses, lines=lines, what=what)))
    return plates


def _clouds(found: Examined, cause: Cause, by_sensor: dict[str, Signature]) -> list["Cloud"]:
    """Return a panel for each sensor that the cause shows in: along what it predicts, for a clock along the measurement's change."""
    from calibkit.report.diagnosis_figures import Cloud

    names, whole = sensors_of(found.read), sum(each.weight for each in by_sensor.values())
    out = []
    for kind, each in sorted(by_sensor.items(), key=lambda pair: -pair[1].weight):
        if each.weight < _WORTH_A_PANEL * whole:
            continue
        name, unit = names[kind]
        unit = unit.replace("^2", "²")
        clock = cause.key.startswith("dt ")
        along = each.moving if clock else each.predicted
        length = np.linalg.norm(along, axis=1)
        way = along / np.maximum(length, 1e-300)[:, None]
        x_label = f"{_MOVING.get(kind.split(' ')[0], 'change')} ({unit}/s)" if clock else f"size of what the cause predicts ({unit})"
        y, predicted = np.sum(each.left * way, axis=1), np.sum(each.predicted * way, axis=1)
        out.append(Cloud(name, x_label.replace("s/s", "s²"), f"residual along it ({unit})", length, y, predicted))
    return out


_MOVING = {"camera": "speed of the corner in the image", "gyro": "angular acceleration", "accel": "change of the acceleration"}


def _course(found: Examined, cause: Cause) -> list["Line"]:
    """Return how large a cause of one number is over time and, where it was measured, over temperature."""
    from calibkit.report.diagnosis_figures import Line

    base, scale = base_of(cause.key), unit_of(base_of(cause.key))[1]
    if len(cause.theta) > 1:
        return []
    suspect = next(each for each in found.suspects if each.key == base)
    whole = {base: float(found.diagnosed.diagnosis.alone[base].theta[0])}
    course = courses(found.joint.fit, found.drifts, {base: suspect.columns[:, 0]}, whole)[base]
    first = found.joint.fit.problem.imu.t[0]
    line = _named_at(found, base, course)
    out = [Line("s from the start", course.t, scale * course.theta, scale * course.sigma, scale * line)]
    if found.temperature is not None:
        celsius = np.interp(first + course.t, *found.temperature)
        out.append(Line("temperature (°C)", celsius, scale * course.theta, scale * course.sigma, scale * line))
    return out


def _named_at(found: Examined, base: str, course: Course) -> Array:
    """Return the size that the named causes give a suspect at the windows."""
    t = found.joint.fit.problem.imu.t[0] + course.t
    drifts = {f"{base} with {drift.name}": drift.at(t) for drift in found.drifts}
    sizes = [float(cause.theta[0]) * drifts.get(cause.key, np.ones(len(t))) for cause in found.causes if base_of(cause.key) == base]
    return np.asarray(np.sum(sizes, axis=0), np.float64)
