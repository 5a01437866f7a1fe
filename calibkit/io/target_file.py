"""Board descriptions: Kalibr's target YAML read as it is (github.com/ethz-asl/kalibr/wiki/calibration-targets), and a ChArUco beside it."""

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibkit.errors import one_line
from calibkit.io.yaml_file import Document, dump_yaml, load_yaml
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid

_MAX_BYTES = 100_000
_MAX_CORNERS = 10_000
_MAX_EXTENT = 30.0  # m; a larger board was written in millimetres
_MIN_EXTENT = 1e-3  # m
_APRILTAGS = 587  # in the family 36h11
_DICTIONARIES = {
    **{f"DICT_{bits}_{n}": n for bits in ("4X4", "5X5", "6X6", "7X7") for n in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": _APRILTAGS,
}  # OpenCV's names, and how many markers each has


@dataclass(frozen=True)
class _Key:
    """One key of a target file: the board's field and its type, which values make sense, and what to write instead."""

    field: str
    type: type
    accepts: Callable[[Any], bool]
    remedy: str
    default: object = None  # None: required

    def read(self, value: Any) -> Any:
        """Return the field's value, None where the file's value will not do; a whole number is a length, a bool never is."""
        if self.type is float and type(value) is int:
            value = float(value)
        return value if type(value) is self.type and self.accepts(value) else None


def _count(field: str, what: str, least: int) -> _Key:
    return _Key(field, int, lambda v: least <= v <= 1000, f"give the number of {what}, a whole number from {least} to 1000")


def _length(field: str, what: str) -> _Key:
    return _Key(field, float, lambda v: 1e-4 <= v <= 100, f"give {what} in metres, such as 0.05")


def _flag(field: str) -> _Key:
    return _Key(field, bool, lambda v: True, "write true or false", default=False)


_TARGETS: dict[str, tuple[Callable[..., Board], dict[str, _Key]]] = {
    AprilGrid.kind: (
        AprilGrid,
        {
            "tagCols": _count("columns", "tags along x", 1),
            "tagRows": _count("rows", "tags along y", 1),
            "tagSize": _length("tag_size", "the edge of a tag's black square"),
            "tagSpacing": _Key("spacing", float, lambda v: 0.01 <= v <= 10, "give the gap between tags divided by tagSize, such as 0.3"),
        },
    ),
    Checkerboard.kind: (
        Checkerboard,
        {
            "targetCols": _count("columns", "inner corners along x (one less than squares)", 3),
            "targetRows": _count("rows", "inner corners along y (one less than squares)", 3),
            "rowSpacingMeters": _length("row_spacing", "the height of a square"),
            "colSpacingMeters": _length("column_spacing", "the width of a square"),
        },
    ),
    CircleGrid.kind: (
        CircleGrid,
        {
            "targetCols": _count("columns", "circles along x", 2),
            "targetRows": _count("rows", "circles along y", 2),
            "spacingMeters": _length("spacing", "the distance of the circles (asymmetric: half of it within a row)"),
            "asymmetricGrid": _flag("asymmetric"),
        },
    ),
    Charuco.kind: (
        Charuco,
        {
            "targetCols": _count("columns", "squares along x", 3),
            "targetRows": _count("rows", "squares along y", 3),
            "squareSize": _length("square_size", "the edge of a square"),
            "markerSize": _length("marker_size", "the edge of a marker's black square"),
            "dictionary": _Key("dictionary", str, lambda v: v in _DICTIONARIES, "give OpenCV's name, such as DICT_4X4_50", "DICT_4X4_50"),
            "legacy": _flag("legacy"),
        },
    ),
}
# What other tools write beside an AprilGrid's keys, with the values that agree with Kalibr's board.
_TOLERATED: dict[str, tuple[object, ...]] = {
    "tagFamily": ("t36h11", "tag36h11", "36h11"),
    "lowId": (0,),
    "startId": (0,),
    "codeOffset": (0,),
}


def load_target(path: Path) -> Board:
    """Read a board from a target YAML; every missing, unknown or absurd key is a BadInputError with its line and the fix."""
    document = load_yaml(path, max_bytes=_MAX_BYTES, opencv=True)
    data, kinds = document.data, ", ".join(_TARGETS)
    if not isinstance(data, dict) or "target_type" not in data:
        raise document.error((), f"is not a target file: target_type is missing; give one of {kinds}")
    kind = data["target_type"]
    if not isinstance(kind, str) or kind not in _TARGETS:
        raise document.error(("target_type",), f"{_quote(kind)} is not known; give one of {kinds}")
    make, keys = _TARGETS[kind]
    unknown = _unknown_keys(document, keys)
    values = {}
    for name, key in keys.items():
        if name not in data and key.default is None:
            guess = difflib.get_close_matches(name, unknown, n=1)
            hint = f" (is {_quote(guess[0])} in line {document.line_of(guess)} meant?)" if guess else ""
            raise document.error((), f"{name} is missing{hint}; {key.remedy}")
        values[key.field] = key.read(data.get(name, key.default))
        if values[key.field] is None:
            raise document.error((name,), f"{_quote(data[name])} will not do; {key.remedy}")
    if unknown:
        raise document.error(unknown[:1], f"is no key of target_type {kind}; remove it (known: {', '.join(keys)})")
    board = make(**values)
    _refuse_absurd(document, board)
    return board


def _unknown_keys(document: Document, keys: dict[str, _Key]) -> list[str]:
    unknown = []
    for name, value in document.data.items():
        if name in _TOLERATED and "tagSize" in keys:
            if not any(type(value) is type(good) and value == good for good in _TOLERATED[name]):
                raise document.error((name,), f"{_quote(value)} is not supported; print the board with {name} {_TOLERATED[name][0]}")
        elif name not in keys and name != "target_type":
            unknown.append(name)
    return unknown


def _refuse_absurd(document: Document, board: Board) -> None:
    rows, columns = board.shape
    if rows * columns > _MAX_CORNERS // 4:
        raise document.error((), f"{columns} x {rows} is too many; a board has at most {_MAX_CORNERS} corners")
    extent = float(np.ptp(board.points[:, :2], axis=0).max())
    if not _MIN_EXTENT <= extent <= _MAX_EXTENT:
        raise document.error((), f"the board would be {extent:.4g} m wide; lengths are in metres, not millimetres")
    if isinstance(board, AprilGrid) and rows * columns > _APRILTAGS:
        raise document.error(("tagCols",), f"{rows * columns} tags, but the family 36h11 has {_APRILTAGS}; give fewer columns or rows")
    if isinstance(board, Charuco):
        if board.marker_size >= board.square_size:
            raise document.error(
                ("markerSize",), f"{board.marker_size} m does not fit into squareSize {board.square_size}; give the marker's edge"
            )
        if rows * columns // 2 > _DICTIONARIES[board.dictionary]:
            raise document.error(
                ("dictionary",),
                f"{board.dictionary} has too few markers for {columns} x {rows} squares; give the dictionary that was printed",
            )


def _quote(value: object) -> str:
    return one_line(repr(value), 60)


def dump_target(board: Board) -> str:
    """Return the target YAML that `load_target` reads back as an equal board, and Kalibr too, but for a ChArUco."""
    _, keys = _TARGETS[board.kind]
    return dump_yaml({"target_type": board.kind, **{name: getattr(board, key.field) for name, key in keys.items()}})
