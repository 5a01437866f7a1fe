"""The offset of each stretch by itself: what a clock's drift and jumps are seen in."""

from dataclasses import dataclass

import numpy as np

from calibkit.estimation.alignment import Alignment
from calibkit.estimation.turn_comparison import LEAST_TURNS, Stretch, Weighed, linearised, residuals, weigh
from calibkit.geometry.so3 import Array

_STEP_S = 0.002
_DEPTH = 12.0  # chi-squared of a stretch's own bottom below its rim; one that is flatter tells nothing
_FURTHEST_S = 0.8  # that it is looked for


@dataclass(frozen=True)
class Windows:
    """The offset of each stretch that tells it alone, the rotation as in the whole."""

    start: Array  # (w,) s of the track's time
    stop: Array
    tau: Array  # (w,) s
    sigma: Array  # (w,) s


def window_offsets(a: Alignment, reach: float, halved: bool = False) -> Windows:
    """Return the offset of each part by itself: the bottom of its own V, where it has one, then Gauss-Newton.

    It is looked for within `reach`, and further where it lies at the edge: a clock that jumps leaves whole stretches far from the others.
    A part with a jump inside has an offset on each side of it; `halved`, on each side of its middle.
    """
    jumps = [jump.t_s for jump in a.clock.jumps] if a.clock else []
    cuts = [[float(part.stretch.t[[0, -1]].mean())] if halved else jumps for part in a.parts]
    found = [_window(a, piece, reach) for part, at in zip(a.parts, cuts, strict=True) for piece in _cut(a, part, at)]
    rows = np.array([row for row in found if row is not None], float).reshape(-1, 4)
    return Windows(*(rows[:, k] for k in range(4)))


def _cut(a: Alignment, part: Weighed, at: list[float]) -> list[Weighed]:
    """Return the part, or what it has of turns on each side of some times."""
    stretch = part.stretch
    inside = [t for t in at if stretch.t[0] < t < stretch.t[-1]]
    if not inside:
        return [part]
    first, last = (np.searchsorted(inside, stretch.t[end]) for end in (stretch.turns.first, stretch.turns.last))
    between = [(first == k) & (last == k) for k in range(len(inside) + 1)]
    cut = [Stretch(stretch.turns.select(keep), stretch.origin_ns, stretch.free_bias) for keep in between if keep.sum() >= LEAST_TURNS]
    return [weigh(piece, piece.noise(a.track, a.R, a.shift(piece.t), a.shape), a.levels) for piece in cut]


def _window(a: Alignment, part: Weighed, reach: float) -> tuple[float, float, float, float] | None:
    stretch = part.stretch
    base = a.shift(stretch.t)
    grid = np.arange(-reach, reach + _STEP_S / 2, _STEP_S)
    grid = grid[(stretch.t[0] + base[0] + grid >= 0) & (stretch.t[-1] + base[-1] + grid <= a.track.duration)]
    if len(grid) < 3:
        return None
    cost = np.sum(residuals(part, a.track, a.R, base[:, None] + grid) ** 2, axis=0)
    k = int(np.argmin(cost))
    if not 0 < k < len(grid) - 1:
        further = min(2 * reach, _FURTHEST_S)
        return _window(a, part, further) if further > reach and np.ptp(cost) > _DEPTH else None
    if min(cost[:k].max(), cost[k + 1 :].max()) - cost[k] < _DEPTH:
        return None
    extra, information = float(grid[k]), 0.0
    for _ in range(3):
        X = linearised(part, a.track, a.R, base + extra)[:, 3:]
        information = float(X[:, 0] @ X[:, 0])
        extra += float(np.clip(X[:, 0] @ X[:, 1] / max(information, 1e-300), -_STEP_S, _STEP_S))
    middle = float(stretch.middle.mean())
    at = float(a.shift(np.array([middle]))[0])
    return float(stretch.t[0]), float(stretch.t[-1]), at + extra, information**-0.5
