"""Limits that a person sets on what a report measures: `td.sigma=0.1ms`, read, matched to the rig's numbers and checked.

A name is a signal's key (`reprojection_rms`) or a parameter's name with `.sigma` or `.value` (`T.p.sigma`); docs/ci.md lists them.
"""

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from calibkit.data.rig import TRANSFORM_PARAMETERS
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.errors import BadInputError, one_line
from calibkit.report.parameters import Row
from calibkit.report.probe import Signal
from calibkit.report.signals import PROBES

_SCALES = {  # of each kind of quantity: its units, the rig file's or a signal's among them
    "pixels": {"px": 1.0},
    "share": {"%": 1.0},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295},
    "rate": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": 0.017453292519943295},
    "acceleration": {"m/s^2": 1.0, "mm/s^2": 1e-3},
}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_VALUE = re.compile(rf"(?:(?P<low>{_NUMBER})\s*\.\.\s*)?(?P<high>{_NUMBER})\s*(?P<unit>\D.*)?")
_GROUPS = {"td": "time offset", "T": "transform"}  # what stands for all of them
_KINDS = ("sigma", "value")
_SIGMA = " sigma"
_RELATIVE = "%"  # of a sigma: of the parameter's value


@dataclass(frozen=True)
class Limit:
    """What a person asked for: at most `high`, or from `low` to `high`, in `unit`; `source` says where, for messages."""

    name: str
    low: float | None
    high: float
    unit: str
    source: str


@dataclass(frozen=True)
class Check:
    """One number against a limit, both in the limit's unit."""

    name: str  # the limit's
    part: str  # cam0, T_cam0_imu0, ...
    stage: str  # of a signal; "" of a parameter
    what: str  # reprojection rms, fx sigma, ...
    value: float | None  # None: not known, which breaks the limit
    low: float | None
    high: float | None
    unit: str
    note: str = ""  # why the value is not known, or what is behind it

    @property
    def holds(self) -> bool:
        return self.value is not None and self._keeps(self.value)

    def _keeps(self, value: float) -> bool:
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)

    @property
    def measured(self) -> str:
        """The value to three digits, or to as many as show on which side of its limit it is."""
        if self.value is None:
            return self.note
        texts = (f"{self.value:.{digits}g}" for digits in range(3, 18))
        return _with(next(text for text in texts if self._keeps(float(text)) is self.holds), self.unit)

    @property
    def limit(self) -> str:
        if self.low is not None and self.high is not None:
            return _with(f"{self.low:.9g} to {self.high:.9g}", self.unit)
        return _with(f"≤ {self.high:.9g}" if self.low is None else f"≥ {self.low:.9g}", self.unit)

    @property
    def reason(self) -> Reason:
        """The check as a sentence of a verdict."""
        said = f"is {self.note}" if self.value is None else self.measured + (f" ({self.note})" if self.note else "")
        text = f"{self.part}: {self.what} {said}, {'within' if self.holds else 'beyond'} the limit {self.limit} ({self.name})"
        return Reason(Verdict.PASS if self.holds else Verdict.FAIL, text)


@dataclass(frozen=True)
class _Number:
    """A number of the report that a limit may be set on."""

    part: str
    stage: str
    what: str
    value: float | None
    unit: str
    why: str = ""
    at_least: bool = False
    size: bool = False  # one limit is on the size, whatever its sign
    relative: float | None = None  # in %


def read(name: str, text: str, source: str) -> Limit:
    """Return the limit `name` of a text such as `0.3px`, `1 mm` or `455..465 px`; BadInputError where it is none."""
    found = _VALUE.fullmatch(text.strip())
    if found is None or not name.strip():
        raise BadInputError(f"{source}: is no limit; write a name, a number and its unit, such as reprojection_rms=0.3px")
    low, high = (None if found[key] is None else float(found[key]) for key in ("low", "high"))
    assert high is not None
    if not (abs(high) < 1e100 and (high >= 0 if low is None else -1e100 < low < high)):
        raise BadInputError(f"{source}: nothing can keep this limit; write a number from 0 up, or LOW..HIGH")
    return Limit(name.strip(), low, high, (found["unit"] or "").strip(), source)


def check(limits: Iterable[Limit], rows: Sequence[Row], signals: Sequence[Signal]) -> tuple[Check, ...]:
    """Return every number that a limit names against it; BadInputError for a name or unit that fits none of the rig's."""
    known: dict[str, list[_Number]] = {}
    for names, found in [*map(_of_signal, signals), *(pair for row in rows for pair in _of_row(row))]:
        for name in names:
            known.setdefault(name, []).append(found)
    return tuple(_check(limit, found) for limit in limits for found in _named(limit, known))


def require_observable(rows: Sequence[Row]) -> Check:
    """Return the share of parameters that are neither weak nor not observable, which is to be 100 %."""
    bad = [row for row in rows if row.status in (Status.WEAK, Status.NOT_OBSERVABLE)]
    note = ", ".join(f"{row.part} {row.name} {row.status.value}" for row in bad)
    share = 100 * (1 - len(bad) / len(rows)) if rows else 100.0
    return Check("require_observable", "rig", "", "parameters that are well observable", share, 100.0, None, "%", note)


def _of_signal(signal: Signal) -> tuple[list[str], _Number]:
    probe = signal.probe
    found = _Number(signal.sensor, signal.stage, probe.title, signal.value, probe.unit, at_least=probe.bad < probe.good)
    return [probe.key, f"{signal.sensor}.{probe.key}"], found


def _of_row(row: Row) -> list[tuple[list[str], _Number]]:
    """Return the names of a parameter's sigma and value (td.sigma, T.p.sigma, fx.value, cam0.fx.value, ...), and both."""
    kind = row.part.split("_")[0]
    name = row.name.replace(" ", ".")  # gyro_x white
    parameters = [name, *([name[0]] if kind == "T" and name in TRANSFORM_PARAMETERS else [])]
    parts = [row.part, *{"dt": ["td"], "T": ["T"]}.get(kind, [])]
    names = [f"{part}.{parameter}" for part in parts for parameter in parameters]
    names += parts if kind == "dt" else parameters
    lost = row.status.value if row.status is Status.NOT_OBSERVABLE else "not known" + (" (given)" if row.status is Status.GIVEN else "")
    relative = 100 * row.sigma / abs(row.value) if row.sigma is not None and row.value else None
    known = None if row.value is None else row.sigma
    sigma = _Number(row.part, "", f"{row.name}{_SIGMA}", known, row.unit, lost, relative=relative)
    value = _Number(row.part, "", row.name, row.value, row.unit, lost, size=True)
    return [([f"{name}.{kind}" for name in names], found) for kind, found in zip(_KINDS, (sigma, value), strict=True)]


def _named(limit: Limit, known: dict[str, list[_Number]]) -> list[_Number]:
    if limit.name in known:
        return known[limit.name]
    name = one_line(limit.name, 80)
    if limit.name in {probe.key for probe in PROBES}:
        raise BadInputError(f"{limit.source}: this rig's residuals do not tell {name}; leave this limit out")
    group = _GROUPS.get(limit.name.split(".")[0])
    if group and not any(other.startswith(limit.name.split(".")[0] + ".") for other in known):
        raise BadInputError(f"{limit.source}: this rig has no {group}; leave this limit out")
    words = sorted(re.split(r"[._]", limit.name))
    near = [other for other in known if sorted(re.split(r"[._]", other)) == words or other.startswith(f"{limit.name}.")]
    alike = [other for other in known if _kind(other) == _kind(limit.name)]  # another transform before a lens's p2
    near = sorted(near, key=len) or difflib.get_close_matches(limit.name, alike, 1, 0.4) or difflib.get_close_matches(limit.name, known, 1)
    hint = f"did you mean {one_line(near[0], 80)}?" if near else "docs/ci.md lists the names"
    raise BadInputError(f"{limit.source}: nothing in this rig is called {name}; {hint}")


def _kind(name: str) -> str:
    """Return T of T_cam0_imu0.p.sigma, cam of cam0.fx.sigma."""
    return re.split(r"[._0-9]", name, maxsplit=1)[0]


def _check(limit: Limit, found: _Number) -> Check:
    low, value = limit.low, found.value
    high: float | None = limit.high
    if limit.unit == _RELATIVE and found.unit != _RELATIVE and found.what.endswith(_SIGMA):
        value, unit = found.relative, "% of the value"
    else:
        scale, unit = _scale(limit, found), limit.unit
        value = None if value is None else value * scale
    if low is None and found.at_least:
        low, high = high, None
    elif low is None and found.size:
        low = -limit.high
    return Check(limit.name, found.part, found.stage, found.what, value, low, high, unit, found.why if value is None else "")


def _scale(limit: Limit, found: _Number) -> float:
    """Return how many of the limit's units one of the number's is."""
    units = next((units for units in _SCALES.values() if found.unit in units), {found.unit: 1.0})
    if limit.unit not in units:
        said = f"has the unit {one_line(limit.unit, 20)}" if limit.unit else "has no unit"
        asked = " or ".join(one_line(unit, 40) for unit in units) if found.unit else "none"
        asked += " or %" if found.unit and found.what.endswith(_SIGMA) else ""
        raise BadInputError(f"{limit.source}: {said}; {one_line(found.what, 60)} of {one_line(found.part, 60)} has {asked}")
    return units[found.unit] / units[limit.unit]


def _with(text: str, unit: str) -> str:
    return f"{text} {unit}" if unit else text
