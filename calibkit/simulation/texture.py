"""Printed patterns as rasters: shapes painted with exact area coverage, so that an edge lies where it should within a texel."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]


@dataclass(frozen=True)
class Texture:
    """Reflectance of a board, 0 black to 255 white, as rasters of texels `size`, 2 `size`, 4 `size`, ... m wide."""

    levels: tuple[Gray, ...]
    low: tuple[float, float]  # m, lower x, y edge of the raster in the board's frame
    size: float  # m, of the finest level's texels

    @property
    def outline(self) -> Array:
        """The corners (4, 2) in m of the painted area, in order around it."""
        (x, y), (rows, columns) = self.low, self.levels[0].shape
        far_x, far_y = x + columns * self.size, y + rows * self.size
        return np.array([[x, y], [far_x, y], [far_x, far_y], [x, far_y]])

    def texel_of_board(self, level: int) -> Array:
        """Return the affine map (2, 3) from board x, y in m to texel centres of a level."""
        size = self.size * 2**level
        return np.array([[1 / size, 0, -self.low[0] / size - 0.5], [0, 1 / size, -self.low[1] / size - 0.5]])


class Canvas:
    """A white sheet from `low` to `high` in m, on which shapes of ink are laid side by side (ink adds up)."""

    def __init__(self, low: tuple[float, float], high: tuple[float, float], texels: int = 2816) -> None:
        self.low = low
        self.size = max(high[0] - low[0], high[1] - low[1]) / texels
        self.ink = np.zeros((round((high[1] - low[1]) / self.size), round((high[0] - low[0]) / self.size)), np.float32)

    def rectangles(self, boxes: Iterable[tuple[float, float, float, float]], ink: float = 1.0) -> None:
        """Add ink to boxes (x0, y0, x1, y1) in m; -1 takes it away."""
        for x0, y0, x1, y1 in boxes:
            columns, across = self._covered(x0, x1, 0)
            rows, along = self._covered(y0, y1, 1)
            self.ink[rows, columns] += ink * along[:, None] * across

    def _covered(self, start: float, end: float, axis: int) -> tuple[slice, NDArray[np.float32]]:
        """Return the texels that an interval touches and how much of each it covers."""
        a, b = (start - self.low[axis]) / self.size, (end - self.low[axis]) / self.size
        first, last = max(int(np.floor(a)), 0), min(int(np.ceil(b)), self.ink.shape[1 - axis])
        edge = np.arange(first, last)
        return slice(first, last), np.clip(np.minimum(edge + 1, b) - np.maximum(edge, a), 0, 1).astype(np.float32)

    def discs(self, centres: Array, radius: float) -> None:
        """Add ink to discs around centres (n, 2) in m; an edge texel's coverage is taken from its distance to the circle."""
        for x, y in centres:
            columns, _ = self._covered(x - radius - self.size, x + radius + self.size, 0)
            rows, _ = self._covered(y - radius - self.size, y + radius + self.size, 1)
            dx = self.low[0] + (np.arange(columns.start, columns.stop) + 0.5) * self.size - x
            dy = self.low[1] + (np.arange(rows.start, rows.stop) + 0.5) * self.size - y
            self.ink[rows, columns] += np.clip(0.5 + (radius - np.hypot(dx, dy[:, None])) / self.size, 0, 1)

    def texture(self, levels: int = 5) -> Texture:
        """Return what was painted, with its coarser levels (each texel the mean of four), cut to whole texels of the coarsest."""
        step = 2 ** (levels - 1)
        rows, columns = (n // step * step for n in self.ink.shape)
        pyramid = [np.round(255 * (1 - np.clip(self.ink[:rows, :columns], 0, 1))).astype(np.uint8)]
        for _ in range(levels - 1):
            fine = pyramid[-1].astype(np.uint16)
            pyramid.append(((fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2] + 2) // 4).astype(np.uint8))
        return Texture(tuple(pyramid), self.low, self.size)
