"""The rig file: `data.rig.Rig` as YAML for people, refused with file, line and remedy where it is wrong, merged by name."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from calibkit.data.rig import VERSION, Imu, Rig, StageRun
from calibkit.data.transforms import frames_of
from calibkit.errors import BadInputError, one_line
from calibkit.io.atomic import write_atomic
from calibkit.io.ros2_folder import is_bag_file
from calibkit.io.yaml_file import Document, dump_yaml, load_yaml

_COMMENTS = {
    "format": "A rig as calibkit knows it: read docs/rig_file.md for the fields. Angles in radians, lengths in metres, times in seconds.",
    "cameras": "uv = model(p_cam; parameters). sigma is corrected for correlated residuals, sigma_plain is not.",
    "imus": "Noise densities are continuous-time: white sigma = density * sqrt(rate), a walk's step = density / sqrt(rate).",
    "transforms": "T_a_b maps a point given in frame b to frame a; inverse_matrix is T_b_a.",
    "time_offsets": "dt_a_b is added to b's stamps to give a's.",
    "provenance": "How this file was made, oldest first.",
}
_SECTIONS = ("cameras", "imus", "transforms", "time_offsets")
V = TypeVar("V")


def load_rig(path: Path) -> Rig:
    """Read a rig file; what is unknown, newer, contradictory or not finite is a BadInputError with its line."""
    if is_bag_file(path):
        raise BadInputError(f"{one_line(path)}: is a recording and no rig file; where a command takes both, RIG.yaml comes first")
    document = load_yaml(path)
    data = document.data
    if not isinstance(data, dict) or data.get("format") != "calibkit-rig":
        raise document.error((), "is not a calibkit rig file (no format: calibkit-rig); other tools' files go through 'calibkit import'")
    version = data.get("version")
    if type(version) is int and version > VERSION:
        raise document.error(("version",), f"is {one_line(version)}, newer than this calibkit's {VERSION}; upgrade calibkit")
    try:
        return Rig.model_validate(data)
    except ValidationError as error:
        raise _as_bad_input(document, error) from None


def _as_bad_input(document: Document, error: ValidationError) -> BadInputError:
    faults = error.errors(include_url=False, include_context=False)
    first = faults[0]
    keys = [key for key in first["loc"] if key != "[key]"]
    text = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        text = "is no key of a rig file; remove it"
    more = f" ({len(faults) - 1} more)" if len(faults) > 1 else ""
    return document.error(keys, one_line(text[:1].lower() + text[1:]) + more)


def dump_rig(rig: Rig) -> str:
    """Return the rig file's text: stable order, numbers exact, a comment at each section."""
    data = rig.model_dump(mode="json")
    Rig.model_validate(data)  # a copy with changed fields was never checked, and garbage must not be written
    parts = []
    for key, value in data.items():
        if value in ({}, []):
            continue
        if key in _COMMENTS:
            parts.append(f"# {_COMMENTS[key]}\n")
        parts.append(dump_yaml({key: _without_blanks(value)}))
    return "".join(parts)


def _without_blanks(value: Any) -> Any:
    """Leave out what is None or empty, for readers' sake, but an estimate's null value (it says 'not observable') and the options."""
    if isinstance(value, dict):
        kept = {k: v if k == "options" else _without_blanks(v) for k, v in value.items()}
        return {k: v for k, v in kept.items() if k == "value" or v not in (None, [], {}, "")}
    return [_without_blanks(item) for item in value] if isinstance(value, list) else value


def save_rig(rig: Rig, path: Path, force: bool = False) -> None:
    """Write the rig file atomically; an existing file is refused unless `force`."""
    write_atomic(path, dump_rig(rig), overwrite=force)


def merge_rigs(rigs: Sequence[tuple[Path, Rig]]) -> Rig:
    """Return all entries of several rigs; an entry that two files give differently is refused by name."""
    merged: dict[str, dict[str, Any]] = {section: {} for section in _SECTIONS}
    origin: dict[tuple[str, str], Path] = {}
    runs: list[StageRun] = []
    for path, rig in rigs:
        for section in _SECTIONS:
            for name, entry in getattr(rig, section).items():
                _refuse_reverse(section, name, merged[section], path, origin)
                present = merged[section].get(name)
                both = entry if present is None else _merge_entries(present, entry)
                if both is None:
                    files = f"{one_line(origin[section, name])} and {one_line(path)}"
                    raise BadInputError(f"{section}.{name} differs between {files}; remove it from one of them, or give only one")
                merged[section][name] = both
                origin.setdefault((section, name), path)
        runs += [run for run in rig.provenance if run not in runs]
    return Rig.model_validate({**merged, "provenance": runs})


def _merge_entries(present: Any, entry: Any) -> Any:
    """Return what both say, None where they contradict; an IMU's fields may come from several files."""
    if not isinstance(entry, Imu):
        return entry if entry == present else None
    old, new = dict(present), dict(entry)
    if any(old[k] is not None and new[k] is not None and old[k] != new[k] for k in new):
        return None
    return Imu(**{k: new[k] if old[k] is None else old[k] for k in new})


def _refuse_reverse(section: str, name: str, present: Mapping[str, object], path: Path, origin: Mapping[tuple[str, str], Path]) -> None:
    reverse = _reverse(name)
    if reverse is not None and reverse in present:
        files = f"{one_line(origin[section, reverse])} and {one_line(path)}"
        raise BadInputError(f"{section}: {reverse} and {name} come from {files}; remove one of them")


def _reverse(name: str) -> str | None:
    if "_" not in name:
        return None
    a, b = frames_of(name)
    return f"{name.split('_')[0]}_{b}_{a}"


def updated(base: Rig, new: Rig) -> Rig:
    """Return `base` with the entries of `new` in place of its own, in either direction, and the provenance of both."""
    sections = {section: _replaced(getattr(base, section), getattr(new, section)) for section in _SECTIONS}
    runs = [*base.provenance, *(run for run in new.provenance if run not in base.provenance)]
    return Rig.model_validate({**sections, "provenance": runs})


def _replaced(old: Mapping[str, V], new: Mapping[str, V]) -> dict[str, V]:
    reverses = {_reverse(name) for name in new}
    return {**{name: entry for name, entry in old.items() if name not in reverses}, **new}
