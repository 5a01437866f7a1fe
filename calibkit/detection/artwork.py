"""What is printed for each board: black shapes, white ones over them, and discs, in the board's own frame in metres."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibkit.detection import april_tags
from calibkit.detection.checkerboard import charuco_board
from calibkit.errors import BadInputError
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid
from calibkit.opencv import cv2

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Artwork:
    """Shapes of a board; rectangles are rows x0 y0 x1 y1, drawn in the order of the fields."""

    black: Array  # (n, 4)
    white: Array  # (m, 4) over the black ones
    discs: Array  # (k, 3) x, y, radius, black
    y_up: bool  # whether the board's y points up the page; it is printed as it is seen, never mirrored

    @property
    def box(self) -> tuple[float, float, float, float]:
        """The smallest x, y and the largest."""
        low = np.concatenate([self.black[:, :2], self.discs[:, :2] - self.discs[:, 2:]]).min(0)
        high = np.concatenate([self.black[:, 2:], self.discs[:, :2] + self.discs[:, 2:]]).max(0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _squares(corner: NDArray[np.floating], width: float, height: float) -> Array:
    corner = np.reshape(corner, (-1, 2)).astype(float)
    return np.concatenate([corner, corner + np.array([width, height])], axis=1)


def _white_cells(cells: NDArray[np.uint8], origin: Array, size: float) -> Array:
    """Return the white cells [i, j] (y, x) as runs along x and again along y: overlapping, so that no viewer shows seams between them."""
    runs = []
    for across, matrix in ((True, cells), (False, cells.T)):
        for i, line in enumerate(matrix):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], line, [0]]).astype(int)))
            for a, b in edges.reshape(-1, 2):
                runs.append((a, i, b, i + 1) if across else (i, a, i + 1, b))
    return np.reshape(runs, (-1, 4)) * size + np.tile(origin, 2)


def _aprilgrid(board: AprilGrid) -> Artwork:
    n = board.columns * board.rows
    if n > april_tags.N_TAGS:
        raise BadInputError(
            f"an AprilGrid of {board.columns} x {board.rows} needs {n} tags of {april_tags.N_TAGS}: take fewer --columns or --rows"
        )
    tag, gap = board.tag_size, board.tag_size * board.spacing
    origins = board.points[::4, :2]
    cell = tag / april_tags.CELLS
    white = [_white_cells(april_tags.code(t), origins[t] + april_tags.BORDER * cell, cell) for t in range(n)]
    between = np.stack(np.meshgrid(np.arange(board.columns + 1), np.arange(board.rows + 1)), axis=-1) * (tag + gap) - gap
    return Artwork(
        np.concatenate([_squares(origins, tag, tag), _squares(between, gap, gap)]), np.concatenate(white), np.zeros((0, 3)), y_up=True
    )


def _checkerboard(board: Checkerboard) -> Artwork:
    i, j = np.mgrid[-1 : board.rows, -1 : board.columns]
    dark = (i + j) % 2 == 0
    corner = np.stack([j[dark] * board.column_spacing, i[dark] * board.row_spacing], axis=-1)
    return Artwork(_squares(corner, board.column_spacing, board.row_spacing), np.zeros((0, 4)), np.zeros((0, 3)), y_up=False)


def _charuco(board: Charuco) -> Artwork:
    made = charuco_board(board)
    corners = np.array(made.getObjPoints(), float)[:, :, :2]  # of each marker, (0, 0) first, clockwise
    holder = np.floor(corners.mean(1) / board.square_size).astype(int)
    dark = np.ones((board.rows, board.columns), bool)
    dark[holder[:, 1], holder[:, 0]] = False  # markers sit in the white squares
    i, j = np.nonzero(dark)
    black = [_squares(np.stack([j, i], axis=-1) * board.square_size, board.square_size, board.square_size)]
    black.append(_squares(corners[:, 0], board.marker_size, board.marker_size))
    dictionary = made.getDictionary()
    bits = int(dictionary.markerSize)
    cell = board.marker_size / (bits + 2)
    white = []
    for marker, corner in zip(np.asarray(made.getIds()).ravel(), corners[:, 0], strict=True):
        code = np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(dictionary.bytesList[marker : marker + 1], bits), np.uint8)
        white.append(_white_cells(code, corner + cell, cell))
    return Artwork(np.concatenate(black), np.concatenate(white), np.zeros((0, 3)), y_up=False)


def _circlegrid(board: CircleGrid) -> Artwork:
    centres = board.points[:, :2]
    radius = board.spacing * (np.sqrt(2) if board.asymmetric else 1) / 4
    discs = np.concatenate([centres, np.full((len(centres), 1), radius)], axis=1)
    return Artwork(np.zeros((0, 4)), np.zeros((0, 4)), discs, y_up=False)


_DRAWN: dict[str, Callable[[Any], Artwork]] = {
    AprilGrid.kind: _aprilgrid,
    Checkerboard.kind: _checkerboard,
    Charuco.kind: _charuco,
    CircleGrid.kind: _circlegrid,
}


def artwork(board: Board) -> Artwork:
    """Return the shapes to print for a board."""
    return _DRAWN[board.kind](board)
