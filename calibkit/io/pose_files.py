"""Pose files of robots and trackers, and ready-made pairs of poses, in the layouts that people keep them in.

A layout that fits two conventions is asked for and never guessed: see `pose_formats` for the table of them.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.errors import BadInputError, one_line
from calibkit.io.pose_documents import read_document
from calibkit.io.pose_formats import FORMATS, to_poses
from calibkit.io.pose_layouts import name_columns, without_lead
from calibkit.io.pose_names import Array, PoseRows
from calibkit.io.pose_rows import read_rows
from calibkit.io.text_table import time_unit, times_ns
from calibkit.io.yaml_file import read_capped

_MAX_BYTES = 16_000_000  # 80 000 poses
_DOCUMENTS = (".yaml", ".yml", ".json")
_TIME_UNITS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "sec": 10**9}


@dataclass(frozen=True)
class PoseTable:
    """Poses T_parent_child of a file, in its order."""

    path: Path
    parent: str
    child: str
    poses: Array  # (n, 4, 4) m
    places: tuple[str, ...]  # (n,) "line 3"
    format: str  # key of FORMATS
    labels: tuple[str, ...] | None = None  # (n,) image names, or a counter
    t_ns: NDArray[np.int64] | None = None  # (n,)
    notes: tuple[str, ...] = ()  # how the file was understood, where a person should know

    def named(self, row: int) -> str:
        """Return what to call a pose."""
        return one_line(self.labels[row], 100) if self.labels else self.places[row]


def load_poses(
    path: Path,
    fmt: str | None = None,
    length_unit: str | None = None,
    angle_unit: str | None = None,
    parent: str = "base",
    child: str = "gripper",
) -> PoseTable:
    """Return the poses of a file; BadInputError in one line names file, row and remedy where one is none or the layout is not clear.

    `fmt`, `length_unit` and `angle_unit` are the command line's --pose-format, --pose-unit and --angle-unit.
    """
    _check_format(fmt)
    content = _content(path)
    rows = read_document(path) if content is None else read_rows(path, content)
    return _finish(rows, fmt, length_unit, angle_unit, parent, child)


def load_pose_pairs(
    path: Path, second: Path | None = None, fmt: str | None = None, length_unit: str | None = None, angle_unit: str | None = None
) -> tuple[PoseTable, PoseTable]:
    """Return two tables of as many poses that belong together row by row, from two files or from one with two poses a row."""
    if second is not None:
        tables = (load_poses(file, fmt, length_unit, angle_unit, "a", "b") for file in (path, second))
        return join_tables(*tables)
    _check_format(fmt)
    content = _content(path)
    if content is None:
        sides = [read_document(path, side) for side in (0, 1)]
    else:
        rows = read_rows(path, content, with_header=False)
        sides = [_half(rows, fmt, side) for side in (0, 1)]
    finish = partial(_finish, fmt=fmt, length_unit=length_unit, angle_unit=angle_unit, parent="a", child="b")
    return finish(sides[0]), finish(sides[1])


def join_tables(first: PoseTable, second: PoseTable) -> tuple[PoseTable, PoseTable]:
    """Return two files' poses as pairs: by order; BadInputError where their counts or names differ."""
    names = [one_line(table.path) for table in (first, second)]
    if len(first.poses) != len(second.poses):
        raise BadInputError(f"{names[0]} has {len(first.poses)} poses and {names[1]} {len(second.poses)}: give files of the same pairs")
    if first.labels and second.labels:
        for row, (a, b) in enumerate(zip(first.labels, second.labels, strict=True)):
            if a != b:
                what = f"pair {row + 1} is {one_line(a, 60)} in {names[0]} and {one_line(b, 60)} in {names[1]}"
                raise BadInputError(f"{what}: bring both files into the same order")
    return first, second


def _check_format(fmt: str | None) -> None:
    if fmt is not None and fmt not in FORMATS:
        raise BadInputError(f"--pose-format {one_line(fmt, 40)}: is not known; use one of {', '.join(FORMATS)}")


def _content(path: Path) -> str | None:
    """Return the text of a file of rows, None where it is YAML or JSON."""
    if path.suffix.lower() in _DOCUMENTS:
        return None
    content = read_capped(path, _MAX_BYTES, "the file of poses")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise BadInputError(f"{one_line(path)}: is not UTF-8 text; save the poses as text (.txt, .csv, .yaml or .json)")
    return None if text.lstrip().startswith("{") else text


def _half(rows: PoseRows, fmt: str | None, side: int) -> PoseRows:
    """Return one pose of each row of two; an odd number before them is a time or counter of both."""
    width = rows.numbers.shape[1]
    lead, k = width % 2, width // 2
    form = FORMATS[fmt] if fmt else None
    if k < 6 or (width - lead in (12, 16) and form is None) or (form and k not in map(len, form.layouts)):
        wanted = "two 4x4 matrices (32 numbers), or two poses of a --pose-format"
        raise BadInputError(f"{one_line(rows.path)}: {width} numbers a row are not {wanted}: give two files, or two poses a row")
    if lead:
        rows = without_lead(rows)
    return replace(rows, numbers=rows.numbers[:, side * k : (side + 1) * k])


def _finish(rows: PoseRows, fmt: str | None, length_unit: str | None, angle_unit: str | None, parent: str, child: str) -> PoseTable:
    rows, name, notes = name_columns(rows, fmt)
    poses = to_poses(rows, name, length_unit, angle_unit)
    return PoseTable(rows.path, parent, child, poses, rows.places, name, rows.labels, _times(rows), notes)


def _times(rows: PoseRows) -> NDArray[np.int64] | None:
    if rows.stamps is None:
        return None
    try:
        stated = rows.units.get("t")
        unit = _TIME_UNITS[stated] if stated else time_unit(rows.stamps[0])
        return times_ns(list(rows.stamps), unit)
    except (ArithmeticError, ValueError, KeyError) as error:
        what = one_line(error, 80)
        raise BadInputError(f"{one_line(rows.path)}: its time column must hold numbers of ns, us, ms or s ({what})") from None
