"""Pose files in YAML and JSON: lists of matrices, numbers or {position, orientation}, or image names with a pose each."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calibkit.errors import one_line
from calibkit.io.pose_names import ABC, POSITIONS, QUATERNIONS, R9, ROTVEC, RPY, RXYZ, WPR, PoseRows, name_of
from calibkit.io.text_table import XYZ, Q
from calibkit.io.yaml_file import Document, load_yaml

_MAX_BYTES = 16_000_000
_POSE = re.compile(r".*pose|transform|t_\w+|tcp|flange")  # keys around a pose that say nothing of its parts
_POSES = re.compile(r".*(poses|transforms|frames|views)")
_ANGLES = (*ABC, *WPR, *RPY, *ROTVEC, *RXYZ)
_ORDER = (*XYZ, *Q, *R9, *_ANGLES)
_WHOLE = (6, 7, 8, 12, 16)  # numbers of a pose in one list
_UNITS = {"unit": XYZ, "units": XYZ, "length_unit": XYZ, "pose_unit": XYZ, "angle_unit": _ANGLES}
_UNKNOWN = ("?",)  # the order, or the convention, is not said
# What a list of so many numbers under such a key holds.
_LISTS: dict[tuple[str, int], tuple[str, ...]] = {
    **{(key, 3): XYZ for key in POSITIONS},
    **{(key, 4): _UNKNOWN for key in QUATERNIONS},
    **{(f"{key}_xyzw", 4): Q for key in QUATERNIONS},
    **{(f"{key}_wxyz", 4): (Q[3], *Q[:3]) for key in QUATERNIONS},
    **{(key, 3): _UNKNOWN for key in ("orientation", "rotation", "euler", "angles")},
    **{(key, 9): R9 for key in ("orientation", "rotation", "rotation_matrix", "rot", "r", "matrix")},
    ("rpy", 3): RPY,
    **{(key, 3): ROTVEC for key in ("rotvec", "rvec", "rotation_vector", "axis_angle")},
}

Keys = tuple[str | int, ...]


class _Entry(NamedTuple):
    keys: Keys
    label: str | None
    value: Any


class _Pose(NamedTuple):
    columns: tuple[str, ...] | None
    numbers: list[float | int]
    label: str | None
    stamp: str | None


def read_document(path: Path, side: int | None = None) -> PoseRows:
    """Return the poses of a YAML or JSON file, of pairs of poses those of one side (0 or 1); BadInputError where it holds none."""
    document = load_yaml(path, _MAX_BYTES)
    entries = _entries(document, side)
    poses = [_pose(document, entry) for entry in entries]
    if not poses or not poses[0].numbers:
        raise document.error((), "holds no poses: wanted is a list of 4x4 matrices, of {position, orientation}, or image names with poses")
    first = poses[0]
    for entry, pose in zip(entries, poses, strict=True):
        if (pose.columns, len(pose.numbers)) != (first.columns, len(first.numbers)):
            raise document.error(entry.keys, f"{_held(pose)}, and the first pose {_held(first)}: every pose must have the same")
    labels = tuple(pose.label for pose in poses if pose.label is not None)
    stamps = tuple(pose.stamp for pose in poses if pose.stamp is not None)
    return PoseRows(
        path,
        np.array([pose.numbers for pose in poses], np.float64),
        tuple(_place(document, entry.keys) for entry in entries),
        tuple(str(pose.numbers[0]) for pose in poses),
        first.columns,
        _units(document.data),
        labels if len(labels) == len(poses) else None,
        stamps if len(stamps) == len(poses) else None,
    )


def _place(document: Document, keys: Keys) -> str:
    where = one_line(".".join(map(str, keys)), 60)
    return f"line {document.line_of(keys)}" + (f", {where}" if where else "")


def _held(pose: _Pose) -> str:
    return f"has {len(pose.numbers)} numbers" if pose.columns is None else f"names {' '.join(pose.columns)}"


def _units(data: Any) -> dict[str, str]:
    if not isinstance(data, dict):
        return {}
    stated = {str(key).lower(): value for key, value in data.items() if isinstance(value, str)}
    return {name: stated[key].lower() for key, names in _UNITS.items() if key in stated for name in names}


def _count(value: Any) -> int:
    return sum(map(_count, value)) if isinstance(value, list) else 1


def _is_list_of_poses(value: Any) -> bool:
    return (
        isinstance(value, list)
        and bool(value)
        and all(isinstance(item, dict) or (isinstance(item, list) and _count(item) > 5) for item in value)
    )


def _entries(document: Document, side: int | None) -> list[_Entry]:
    """Return the poses of a document with their names, in its order."""
    data = document.data
    keys: Keys = ()
    if isinstance(data, dict):
        lists = [key for key, value in data.items() if _is_list_of_poses(value)]
        if side is not None and len(lists) == 2 and sorted(map(str.lower, lists)) == ["a", "b"]:
            key = sorted(lists, key=str.lower)[side]
            return [_Entry((key, i), None, value) for i, value in enumerate(data[key])]
        if len(lists) > 1:
            raise document.error((lists[1],), f"a second list of poses beside {one_line(lists[0], 40)}: keep one in a file")
        if len(lists) == 1:
            keys, data = (lists[0],), data[lists[0]]
        else:
            inner = [key for key, value in data.items() if isinstance(value, dict) and _POSES.fullmatch(key.lower())]
            keys, data = ((inner[0],), data[inner[0]]) if len(inner) == 1 else ((), data)
    elif not (_is_list_of_poses(data) or (isinstance(data, list) and any(isinstance(item, dict) for item in data))):
        data = [data]  # one pose alone
    if isinstance(data, list):
        entries = [_Entry((*keys, i), None, value) for i, value in enumerate(data)]
    elif any(key.lower() in (*POSITIONS, "x") or _POSE.fullmatch(key.lower()) for key in data):
        entries = [_Entry(keys, None, data)]
    else:
        entries = [_Entry((*keys, key), key, value) for key, value in data.items() if isinstance(value, (list, dict))]
    return entries if side is None else [_half(document, entry, side) for entry in entries]


def _half(document: Document, entry: _Entry, side: int) -> _Entry:
    """Return one pose of a pair: [pose, pose], {a: pose, b: pose}, or twice as many numbers in one list."""
    value = entry.value
    if isinstance(value, dict) and sorted(map(str.lower, value)) == ["a", "b"]:
        key = sorted(value, key=str.lower)[side]
        return _Entry((*entry.keys, key), entry.label, value[key])
    if isinstance(value, list) and len(value) == 2 and all(isinstance(half, (list, dict)) for half in value):
        return _Entry((*entry.keys, side), entry.label, value[side])
    if isinstance(value, list) and value and not len(value) % 2 and not any(isinstance(item, (list, dict)) for item in value):
        return _Entry(entry.keys, entry.label, value[side * len(value) // 2 : (side + 1) * len(value) // 2])
    raise document.error(entry.keys, "is no pair of poses: write [pose, pose] or {a: pose, b: pose}, or give two files")


def _numbers(document: Document, keys: Keys, value: Any) -> list[float | int]:
    if isinstance(value, list):
        return [number for item in value for number in _numbers(document, keys, item)]
    if type(value) not in (int, float):
        raise document.error(keys, f"'{one_line(value, 40)}' is not a number: write it like 0.05")
    number: float | int = value
    return [number]


def _leaves(keys: Keys, title: str, value: dict[str, Any]) -> Iterator[tuple[Keys, str, Any]]:
    """Yield what a pose's mapping holds: keys, the name as one word, and a number, text or list."""
    for key, inner in value.items():
        word = key.strip().lower()
        if isinstance(inner, dict):
            yield from _leaves((*keys, key), title if _POSE.fullmatch(word) else f"{title}{word}_", inner)
        else:
            yield (*keys, key), title + word, inner


def _pose(document: Document, entry: _Entry) -> _Pose:
    """Return the columns and numbers of one pose; no columns where its order is not said."""
    keys, label, value = entry
    if not isinstance(value, dict):
        return _Pose(None, _numbers(document, keys, value), label, None)
    held: dict[str, float | int] = {}
    lists: list[tuple[Keys, list[float | int]]] = []  # that could be a whole pose
    unsaid: list[list[float | int]] = []
    stamp: str | None = None
    for at, title, leaf in _leaves(keys, "", value):
        if isinstance(leaf, list):
            size = _count(leaf)
            names = _LISTS.get((title, size), ())
            numbers = _numbers(document, at, leaf) if names or size in _WHOLE else []
            if names == _UNKNOWN:
                unsaid.append(numbers)
            elif not names and numbers:
                lists.append((at, numbers))
            pairs = list(zip(names, numbers, strict=False)) if names != _UNKNOWN else []
        else:
            name, _ = name_of(title)
            if name == "label" and label is None and isinstance(leaf, (str, int)):
                label = str(leaf)
            elif name == "t" and type(leaf) in (int, float):
                stamp = str(leaf)
            pairs = [(name, _numbers(document, at, leaf)[0])] if name in _ORDER else []
        for name, number in pairs:
            if name in held:
                raise document.error(at, f"a pose that names {name} twice: keep one pose an entry")
            held[name] = number
    return _Pose(*_joined(document, keys, held, unsaid, lists), label, stamp)


def _joined(
    document: Document,
    keys: Keys,
    held: dict[str, float | int],
    unsaid: list[list[float | int]],
    lists: list[tuple[Keys, list[float | int]]],
) -> tuple[tuple[str, ...] | None, list[float | int]]:
    """Return a mapping's columns and numbers: by name, or position and unnamed rotation, or one list that is the whole pose."""
    columns = tuple(name for name in _ORDER if name in held)
    if columns == XYZ and len(unsaid) == 1:
        return None, [*(held[name] for name in XYZ), *unsaid[0]]
    if len(columns) > 3:
        return columns, [held[name] for name in columns]
    if not columns and len(lists) == 1:
        return None, lists[0][1]
    if len(lists) > 1:
        raise document.error(lists[1][0], f"a second pose beside {one_line(lists[0][0][-1], 40)}: keep one pose an entry")
    raise document.error(
        keys, "holds no pose: wanted are {position: [3], orientation: [4]}, {translation, rotation}, or a list of 16 numbers"
    )
