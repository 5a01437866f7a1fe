"""Instants at equal steps over the pieces of a recording: their number goes with the samples, not with the time that they span."""

from dataclasses import dataclass

import numpy as np

from calibkit.errors import BadInputError
from calibkit.estimation.turns import Index
from calibkit.geometry.so3 import Array

_REST_S = 0.25  # of a pause stays, so that nothing that looks a little further looks over it
_MOST_POINTS = 40_000_000  # 100 bytes each in a track


@dataclass(frozen=True)
class TimeGrid:
    """Points at equal steps in each piece."""

    step: float  # s
    start: Array  # (p,) s of the origin, where each piece begins; start[0] = 0
    first: Index  # (p + 1,) points before each piece, and of all

    def place(self, t: Array) -> Array:
        """Return where seconds from the origin lie, in points; in a pause, half-way between the piece before it and that after."""
        if len(self.start) == 1:
            return np.asarray(t / self.step, np.float64)
        piece = np.maximum(np.searchsorted(self.start, t, side="right") - 1, 0)
        room = np.append(np.diff(self.first[:-1]) - 0.5, np.inf)[piece]
        return np.asarray(self.first[piece] + np.minimum((t - self.start[piece]) / self.step, room), np.float64)

    @property
    def t(self) -> Array:
        """Return the seconds of all points."""
        size = np.diff(self.first)
        out: Array = np.repeat(self.start, size) + self.step * (np.arange(self.first[-1]) - np.repeat(self.first[:-1], size))
        return out

    @property
    def duration(self) -> float:
        """Return the seconds of the last point."""
        return float(self.start[-1] + self.step * (self.first[-1] - 1 - self.first[-2]))


def grid_over(t: Array, step: float, pause: float) -> TimeGrid:
    """Return the grid over increasing t (n,) s with t[0] = 0; of longer pauses it has no more than their beginning."""
    last = np.append(np.flatnonzero(np.diff(t) > pause), len(t) - 1)
    start = t[np.concatenate([[0], last[:-1] + 1])]
    rest = np.append(np.full(len(last) - 1, min(_REST_S, pause)), 0.0)
    size = ((t[last] - start + rest) / step).astype(np.intp) + 1
    if size.sum() > _MOST_POINTS:
        raise BadInputError(f"its {len(t)} stamps are spread over {size.sum() * step / 3600:.0f} h: cut it into parts")
    return TimeGrid(step, start, np.concatenate([[0], np.cumsum(size)]))
