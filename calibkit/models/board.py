"""Calibration boards: where their corners lie, in the board's own frame (x along columns, y along rows, z = 0), in metres.

Corner ids are the row numbers of `points`; every detector and corners file speaks in them.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Board(Protocol):
    """A flat target with numbered corners."""

    kind: ClassVar[str]  # Kalibr's target_type

    @property
    def points(self) -> Array:
        """Corner positions (n, 3) in m."""
        ...

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns as a person counts them on this board."""
        ...

    def key(self) -> str:
        """A text that is equal for equal boards: part of the cache key."""
        ...


def _grid(columns: int, rows: int, column_step: float, row_step: float) -> Array:
    x, y = np.meshgrid(np.arange(columns) * column_step, np.arange(rows) * row_step)
    points: Array = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    return points


@dataclass(frozen=True)
class AprilGrid:
    """Kalibr's AprilGrid: tag36h11 with a two-bit border; gap between tags = spacing * tag_size.

    Tag t = row * columns + column, row 0 at y = 0; corner id = 4 t + c, c counted from the tag's corner at smallest x, y
    along x first: (0, 0), (s, 0), (s, s), (0, s). Seen upright, tag 0 is at the lower left and y points up.
    """

    kind: ClassVar[str] = "aprilgrid"
    columns: int
    rows: int
    tag_size: float  # m, edge of the black square
    spacing: float  # gap / tag_size

    @property
    def points(self) -> Array:
        step = self.tag_size * (1 + self.spacing)
        origins = _grid(self.columns, self.rows, step, step)
        corners = self.tag_size * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
        points: Array = (origins[:, None] + corners).reshape(-1, 3)
        return points

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    def key(self) -> str:
        return f"aprilgrid {self.columns} {self.rows} {self.tag_size!r} {self.spacing!r}"


@dataclass(frozen=True)
class Checkerboard:
    """Inner corners of a checkerboard, corner id = row * columns + column."""

    kind: ClassVar[str] = "checkerboard"
    columns: int  # inner corners
    rows: int
    column_spacing: float  # m
    row_spacing: float

    @property
    def points(self) -> Array:
        return _grid(self.columns, self.rows, self.column_spacing, self.row_spacing)

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    def key(self) -> str:
        return f"checkerboard {self.columns} {self.rows} {self.column_spacing!r} {self.row_spacing!r}"


@dataclass(frozen=True)
class Charuco:
    """Inner corners of a ChArUco board with `columns` x `rows` squares; corner id = row * (columns - 1) + column, as OpenCV's."""

    kind: ClassVar[str] = "charuco"
    columns: int  # squares
    rows: int
    square_size: float  # m
    marker_size: float
    dictionary: str = "DICT_4X4_50"
    legacy: bool = False  # the pattern of OpenCV before 4.6, for even row counts

    @property
    def points(self) -> Array:
        s = self.square_size
        points: Array = _grid(self.columns - 1, self.rows - 1, s, s) + np.array([s, s, 0.0])
        return points

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    def key(self) -> str:
        return f"charuco {self.columns} {self.rows} {self.square_size!r} {self.marker_size!r} {self.dictionary} {self.legacy}"


@dataclass(frozen=True)
class CircleGrid:
    """Centres of a circle grid, id = row * columns + column; asymmetric rows are shifted by half a column (OpenCV's layout)."""

    kind: ClassVar[str] = "circlegrid"
    columns: int
    rows: int
    spacing: float  # m; asymmetric: half the distance of two neighbours in a row
    asymmetric: bool = False

    @property
    def points(self) -> Array:
        if not self.asymmetric:
            return _grid(self.columns, self.rows, self.spacing, self.spacing)
        points = _grid(self.columns, self.rows, 2 * self.spacing, self.spacing)
        points[:, 0] += self.spacing * (np.arange(len(points)) // self.columns % 2)
        return points

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    def key(self) -> str:
        return f"circlegrid {self.columns} {self.rows} {self.spacing!r} {self.asymmetric}"
