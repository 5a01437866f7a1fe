"""What `calibkit diff` says: every parameter, every entry as a whole, the pixel shifts, and in a sentence each what changed."""

from collections.abc import Callable, Iterator, Mapping
from math import degrees, isfinite

import numpy as np

from calibkit.data.plural import counted, plain
from calibkit.data.transforms import frames_of
from calibkit.data.verdict import Status
from calibkit.errors import one_line
from calibkit.estimation.pixel_shift import Shift
from calibkit.estimation.rig_difference import FALSE_ALARM, Change, Difference, EntryChange
from calibkit.estimation.time_offset_result import smear
from calibkit.estimation.view_advice import region_of
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array
from calibkit.report.columns import columns, range_text, sized
from calibkit.report.parameters import Row, decimals, number

_PARAMETERS = ("parameter", "old", "new", "change", "sigma", "z", "unit", "")
_ENTRIES = ("entry", "chi-squared", "of", "chance", "z", "", "")
_ALL_THE_SAME = "nothing changed: all that both have is the same to the last digit"
_ALONG = np.cos(np.radians(10))
_NOTHING = 1e-7  # m, rad: rounding
_NAMED = 4  # numbers that differ and cannot be judged
_SHIFTS = ("pixel shift", "", "range", "worst", "where", "rms")


def text(found: Difference, shifts: Mapping[str, list[Shift]]) -> str:
    """Return the tables, then the verdict."""
    if not found.only_old and not found.only_new and all(entry.same for entry in found.entries):
        return _ALL_THE_SAME
    rows = [_parameter(entry, each) for entry in found.entries for each in entry.parameters if each.change != 0]
    left = sum(len(entry.parameters) for entry in found.entries) - len(rows)
    moved = [_shift(name, shift) for name, each in shifts.items() for shift in each]
    tables = [columns([_PARAMETERS, *rows])] if rows else []
    tables += [f"{counted(left, 'parameter is', 'parameters are')} the same in both and left out"] if left else []
    tables.append(columns([_ENTRIES, *(_entry(entry) for entry in found.entries)]))
    tables += [columns([_SHIFTS, *moved])] if moved else []
    return "\n".join("\n\n".join([*tables, "\n".join(_verdict(found, shifts))]).splitlines())


def _parameter(entry: EntryChange, each: Change) -> tuple[str, ...]:
    values = (Row(entry.name, each.name, value, each.sigma, None, each.unit, Status.GIVEN) for value in (each.old, each.new))
    old, new = (row.value_text if row.value is not None else "" for row in values)
    change = "" if each.change is None else _signed(each.change, each.sigma)
    sigma, z = "" if each.sigma is None else number(each.sigma), "" if each.z is None else f"{each.z:+.1f}"
    return f"{entry.name} {each.name}", old, new, change, sigma, z, each.unit, each.note


def _signed(change: float, sigma: float | None) -> str:
    """Return a change with its sign, to two digits of its sigma, else of its own."""
    return f"{change:+.2g}" if sigma is None else f"{change:+.{decimals(sigma)}f}"


def _entry(entry: EntryChange) -> tuple[str, ...]:
    name, notes = f"{entry.name} {entry.what}", "; ".join(entry.notes)
    if entry.chi2 is None or entry.p is None or entry.z is None:
        return name, "", "", "", "", "changed" if entry.changed else "", notes
    chance = f"{entry.p:.2g}" if entry.p > 1e-99 else "< 1e-99"
    return name, f"{entry.chi2:.1f}", str(entry.freedom), chance, f"{entry.z:.1f}", "changed" if entry.changed else "within chance", notes


def _shift(name: str, shift: Shift) -> tuple[str, ...]:
    worst, at = shift.worst
    if not isfinite(worst):
        return name, shift.what, range_text(shift.range_m), "no pixel in common", "", ""
    lost = f" ({shift.lost:.0%} of the image is seen by one alone)" if shift.lost else ""
    return name, shift.what, range_text(shift.range_m), sized(worst, "px"), region_of(at, shift.size), sized(shift.rms, "px") + lost


def _verdict(found: Difference, shifts: Mapping[str, list[Shift]]) -> Iterator[str]:
    for where, names in (("OLD", found.only_old), ("NEW", found.only_new)):
        if names:
            yield f"only in {where}: {', '.join(names)}"
    yield from (f"note: {note}" for note in found.notes)
    for entry in found.entries:
        if entry.changed:
            yield f"{entry.name}: {_SAID[entry.what](entry, shifts.get(entry.name, []), found)}{_as_a_whole(entry)}"
    yield from (line for entry in found.entries for line in _unjudged(entry))
    if found.changed:
        return
    judged = sum(entry.chi2 is not None for entry in found.entries)
    if all(entry.same for entry in found.entries):
        yield _ALL_THE_SAME
    elif judged:
        alarms = f"a false alarm in any of them: {FALSE_ALARM:.0%}"
        yield f"nothing changed beyond chance: {counted(judged, 'entry', 'entries')} judged ({alarms})"
    else:
        yield "nothing could be judged"


def _unjudged(entry: EntryChange) -> Iterator[str]:
    """Yield the numbers that differ and have no sigma in either file; lenses of two models have no number in common."""
    differ = [each for each in entry.parameters if each.change and each.sigma is None and not each.note.endswith("not judged")]
    if not differ:
        return
    texts = [f"{each.name} {_times(entry, each)}" for each in differ[:_NAMED]]
    more = f" and {len(differ) - _NAMED} more" if len(differ) > _NAMED else ""
    yield f"{entry.name}'s {', '.join(texts)}{more}: no sigma to judge {'it' if len(differ) == 1 else 'them'} by"


def _times(entry: EntryChange, each: Change) -> str:
    """Return how much a number differs: a noise by its ratio."""
    if entry.what == "noise" and each.old and each.new:
        return f"{each.new / each.old:.3g} times"
    return f"{_signed(each.change or 0.0, None)} {one_line(each.unit)}".rstrip()


def _as_a_whole(entry: EntryChange) -> str:
    return "" if entry.z is None else f" (z {plain(entry.z)}{' of all parameters together' if entry.freedom > 1 else ''})"


def _lens(entry: EntryChange, shifts: list[Shift], found: Difference) -> str:
    turned = next((shift for shift in shifts if shift.what == "turned along"), None)
    if turned is None or not isfinite(turned.worst[0]):
        return f"the lens changed: {'; '.join(entry.notes)}" if entry.notes else "the lens changed"
    worst, at = turned.worst
    return f"the lens changed: up to {sized(worst, 'px')} at the {region_of(at, turned.size)}, {sized(turned.rms, 'px')} rms"


def _transform(entry: EntryChange, shifts: list[Shift], found: Difference) -> str:
    a, b = frames_of(entry.name)
    body, other = (b, a) if b in found.new.cameras and a not in found.new.cameras else (a, b)
    parts = _motion(entry, of_b=body == b)
    said = f"{body} {' and '.join(parts)} as {other} sees it" if parts else "changed"
    cost = [
        f"{sized(shift.worst[0], 'px')} {'at ' if isfinite(shift.range_m) else ''}{range_text(shift.range_m)}"
        for shift in shifts
        if shift.what.endswith("alone")
    ]
    return said + (f": pixels move by up to {', '.join(cost)}" if cost else "")


def _motion(entry: EntryChange, of_b: bool) -> list[str]:
    """Return how b of T_a_b (or a) turned, in its own axes, and how far its origin moved in the other's; what is known of it."""
    then, now = (np.array([np.nan if (x := getattr(each, when)) is None else x for each in entry.parameters]) for when in ("old", "new"))
    R_then, R_now = (so3.exp(x[3:]) if of_b else so3.exp(-x[3:]) for x in (then, now))  # R_other_body
    shift = now[:3] - then[:3] if of_b else R_then @ then[:3] - R_now @ now[:3]  # p_b_a = -R^T p_a_b
    parts = []
    if np.isfinite(then[3:]).all() and np.isfinite(now[3:]).all():
        turn = so3.log(R_then.T @ R_now)
        angle = float(np.linalg.norm(turn))
        parts.append(f"turned by {degrees(angle):.2g} deg about its {_axis(turn / angle)}" if angle > _NOTHING else "did not turn")
    if np.isfinite(shift).all():
        length = float(np.linalg.norm(shift))
        parts.append(f"moved by {sized(length, 'm')}" if length > _NOTHING else "did not move")
    return parts


def _axis(axis: Array) -> str:
    """Return a unit vector in words: the nearest of x, y, z within 10 degrees, else its numbers."""
    i = int(np.argmax(np.abs(axis)))
    if abs(axis[i]) > _ALONG:
        return f"{'-' if axis[i] < 0 else ''}{'xyz'[i]} axis"
    return f"axis ({', '.join(f'{x:.2f}' for x in axis)})"


def _time(entry: EntryChange, shifts: list[Shift], found: Difference) -> str:
    change = entry.parameters[0].change or 0.0
    cameras = [name for name in entry.name.split("_")[1:] if name in found.new.cameras]
    focal = found.new.cameras[cameras[0]].parameters["fx"].value if cameras else None
    return f"changed by {change * 1e3:+.3f} ms, {smear(1.0, change, focal)} at 1 rad/s"


def _largest(entry: EntryChange, shifts: list[Shift], found: Difference) -> str:
    most = max((each for each in entry.parameters if each.z is not None), key=lambda each: abs(each.z or 0.0))
    return f"{entry.what} changed, {most.name} most: {most.old:.4g} to {most.new:.4g} {one_line(most.unit)}".rstrip()


_SAID: dict[str, Callable[[EntryChange, list[Shift], Difference], str]] = {
    "lens": _lens,
    "transform": _transform,
    "time offset": _time,
    "line delay": _largest,
    "noise": _largest,
    "scale and axes": _largest,
}
