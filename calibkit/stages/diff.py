"""Two rig files compared: the entries by their covariances, the pixels over image and range; as text, JSON and pictures."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from calibkit.data.rig import Rig
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.pixel_shift import Shift, known_lens, lens_shifts, transform_shifts
from calibkit.estimation.rig_difference import Change, Difference, EntryChange, difference
from calibkit.estimation.view_advice import region_of
from calibkit.io.atomic import make_folder, refuse_existing, refuse_unwritable, write_atomic, write_json
from calibkit.io.rig_file import load_rig

SCHEMA = "calibkit-diff/1"
Shifts = Mapping[str, list[Shift]]  # by entry


@dataclass(frozen=True)
class Outcome:
    """What differs, and the files written."""

    difference: Difference
    shifts: Shifts
    files: tuple[Path, ...]


def compare(old_path: Path, new_path: Path, report: Path | None = None, json_path: Path | None = None, force: bool = False) -> Outcome:
    """Compare two rig files; BadInputError, with nothing written, where they have nothing in common or an output is in the way."""
    if json_path is not None:
        refuse_unwritable(json_path, force)
    old, new = load_rig(old_path), load_rig(new_path)
    found = difference(old, new)
    if not found.entries:
        raise BadInputError(f"{one_line(old_path)} and {one_line(new_path)}: have no entry in common; give two calibrations of one rig")
    shifts = _shifts(old, found)
    files = {} if report is None else {report / f"{name}-shift.png": lens for name, lens in shifts.items() if name in old.cameras}
    for path in files:
        refuse_existing(path, force)
    if report is not None and files:
        _draw(report, files)
    if json_path is not None:
        write_json(json_path, _as_json(found, shifts), force)
    return Outcome(found, shifts, (*files, *([] if json_path is None else [json_path])))


def _shifts(old: Rig, found: Difference) -> Shifts:
    """Return the pixel shifts of every lens and transform that both know and that is not the same in both."""
    out: dict[str, list[Shift]] = {}
    moved = {entry.name: entry.what for entry in found.entries if not entry.same}
    for name, what in moved.items():
        if what == "transform":
            out[name] = list(transform_shifts(name, old, found.new))
        elif name in old.cameras and old.cameras[name].resolution == found.new.cameras[name].resolution:
            before, after = known_lens(name, old.cameras[name]), known_lens(name, found.new.cameras[name])
            out[name] = [] if before is None or after is None else lens_shifts(before, after)
    return {name: shifts for name, shifts in out.items() if shifts}


def _draw(folder: Path, files: Mapping[Path, list[Shift]]) -> None:
    from calibkit.report.shift_figures import pixel_shift  # matplotlib: only where pictures are asked for

    make_folder(folder)
    for path, shifts in files.items():
        shown = [shift for shift in shifts if not isfinite(shift.range_m)][:2]
        write_atomic(path, pixel_shift([(shift.what, shift.uv, shift.moved) for shift in shown], shown[0].size), overwrite=True)


def _as_json(found: Difference, shifts: Shifts) -> dict[str, object]:
    return {
        "schema": SCHEMA,
        "changed": [f"{entry.name}.{entry.what}" for entry in found.entries if entry.changed],
        "entries": [_entry(entry) for entry in found.entries],
        "pixel_shifts": {name: [_shift(shift) for shift in each] for name, each in shifts.items()},
        "only_old": found.only_old,
        "only_new": found.only_new,
        "notes": found.notes,
    }


def _entry(entry: EntryChange) -> dict[str, object]:
    judged = {"chi2": entry.chi2, "freedom": entry.freedom, "p": entry.p, "z": entry.z, "changed": entry.changed, "notes": entry.notes}
    return {"entry": entry.name, "what": entry.what, **judged, "parameters": [_parameter(each) for each in entry.parameters]}


def _parameter(each: Change) -> dict[str, object]:
    keys = ("name", "unit", "old", "new", "change", "sigma", "z", "note")
    return {key: getattr(each, key) for key in keys}


def _shift(shift: Shift) -> dict[str, object]:
    worst, at = shift.worst
    seen = isfinite(worst)
    return {
        "what": shift.what,
        "range_m": shift.range_m if isfinite(shift.range_m) else None,
        "worst_px": worst if seen else None,
        "rms_px": shift.rms if seen else None,
        "at_px": at.tolist() if seen else None,
        "where": region_of(at, shift.size) if seen else None,
        "lost": shift.lost,
    }
