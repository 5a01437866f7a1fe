"""The work on a time offset in rounds: Gauss-Newton on offset, drift and rotation, then the noise's levels, then what is no turn at all."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.progress import Progress, silent
from calibkit.errors import BadInputError
from calibkit.estimation.clock import Clock
from calibkit.estimation.orientation_track import OrientationTrack
from calibkit.estimation.turn_comparison import (
    LEAST_TURNS,
    TILT,
    Stretch,
    Weighed,
    linearised,
    moved,
    raw_residuals,
    residuals,
    weigh,
)
from calibkit.estimation.turn_noise import NoiseLevels, estimate_levels
from calibkit.geometry.so3 import Array

Mask = NDArray[np.bool_]

_ROUNDS = 6
_OUTLIER = 8.0  # chi-squared a degree of freedom: beyond chance in 100 000 turns of three axes
_MEDIAN = {1: 0.455, 2: 1.386, 3: 2.366}  # of chi-squared
_STEPS = 15
_CLOSE = 1e-6  # chi-squared that a step still gains
_SETTLED = 0.03  # sigmas of tau: the rotation that turns about one axis leave open may creep on
PRIOR = np.array([TILT**-2, TILT**-2, TILT**-2, 0.0])
_LONGEST_STEP_S = 0.05
_DRAWS = 8
_SLAB = 2_000_000  # numbers held at once


@dataclass(frozen=True)
class Alignment:
    """Turns laid against a track with all that may still change."""

    track: OrientationTrack
    stretches: tuple[Stretch, ...]
    keep: tuple[Mask, ...]  # of each stretch's turns
    parts: tuple[Weighed, ...]  # what is kept, weighed
    levels: NoiseLevels
    shape: Array  # (3,) variances of the axes relative to each other, where the turns do not say it
    R: Array  # (d, 3)
    free_rotation: bool
    tau: float  # s, the offset where the clock is constant, else at its reference time
    clock: Clock | None = None
    converged: bool = False

    def shift(self, t: Array) -> Array:
        """Return the offset (m,) at the turns' times t (m,): tau, and how the clock departs from it."""
        drift = 0.0 if self.clock is None else self.clock.at(t) - self.clock.offset_s
        return np.asarray(np.full_like(t, self.tau) + drift, np.float64)

    @property
    def free(self) -> NDArray[np.intp]:
        """Return the columns that are estimated: rotation (3) where it is free, and tau."""
        return np.arange(0 if self.free_rotation else 3, 4)

    @property
    def turns(self) -> int:
        return sum(len(part.stretch.turns.first) for part in self.parts)


def weighed(a: Alignment) -> Alignment:
    """Return the alignment with what it keeps weighed by its levels of noise."""
    parts = []
    for stretch, keep in zip(a.stretches, a.keep, strict=True):
        if keep.sum() >= LEAST_TURNS:
            kept = Stretch(stretch.turns.select(keep), stretch.origin_ns, stretch.free_bias)
            parts.append(weigh(kept, kept.noise(a.track, a.R, a.shift(kept.t), a.shape), a.levels))
    if not parts:
        raise BadInputError("hardly any of their turns agree: too many poses are wrong, or they come too rarely; record longer and faster")
    return replace(a, parts=tuple(parts))


def settle(a: Alignment, levels: NoiseLevels | None, progress: Progress = silent) -> Alignment:
    """Return the optimum with noise levels of its own (unless given) and without turns that are none."""
    first = True
    for _ in progress(range(_ROUNDS), "laying turns side by side"):
        if not first:
            a = newton(a)
        kept = _without_outliers(a, robust=first)
        same = not first and all(np.array_equal(x, y) for x, y in zip(kept, a.keep, strict=True))
        a = weighed(replace(a, keep=kept))
        if levels is None:
            a = weighed(with_levels(a, jitter=not first))
        if same:
            break
        first = False
    return newton(a)


def with_levels(a: Alignment, jitter: bool) -> Alignment:
    """Return the alignment with the axes' relative variances (by medians) and the noise's levels as its residuals have them."""
    left = [raw_residuals(part, a.track, a.R, a.shift(part.stretch.t))[0] for part in a.parts]
    axes = a.parts[0].stretch.axes
    median = np.maximum(np.median(np.abs(np.concatenate(left)), axis=0), 1e-12)
    shape = np.ones(3)
    shape[axes] = median**2 / np.mean(median**2)
    noises = [part.stretch.noise(a.track, a.R, a.shift(part.stretch.t), shape) for part in a.parts]
    drifts = [part.stretch.drift for part in a.parts]
    return replace(a, shape=shape, levels=estimate_levels(noises, [each.reshape(-1) for each in left], drifts, jitter))


def _without_outliers(a: Alignment, robust: bool) -> tuple[Mask, ...]:
    """Return which turns of each stretch are within chance of the fit; before the noise is known, by their median alone.

    Chance is by the median of the recording or of the stretch, whichever is larger: poses are more exact at rest, and lively turns
    measured by quiet ones would be kept by how well they fit the offset of the moment, which biases it.
    """
    d = len(a.R)
    biases = iter([raw_residuals(part, a.track, a.R, a.shift(part.stretch.t))[1] for part in a.parts])
    squares = []
    for stretch, keep in zip(a.stretches, a.keep, strict=True):
        shift = a.shift(stretch.t)
        left = stretch.left(a.track, a.R, shift[:, None])[:, 0]
        bias = next(biases) if a.parts and keep.sum() >= LEAST_TURNS else np.median(left / stretch.turns.duration[:, None], axis=0)
        left = left - stretch.turns.duration[:, None] * bias
        D = np.tile(np.eye(d), (len(left), 1, 1)) if robust else stretch.noise(a.track, a.R, shift, a.shape).blocks(a.levels, d)
        squares.append(np.sum(left * np.linalg.solve(D, left[..., None])[..., 0], axis=1))
    typical = float(np.median(np.concatenate(squares)))
    limit = _OUTLIER * d / _MEDIAN[d]
    return tuple(np.asarray(square <= limit * max(typical, float(np.median(square))), np.bool_) for square in squares)


def newton(a: Alignment) -> Alignment:
    """Return the alignment at the bottom near it, by Gauss-Newton."""
    settled = False
    for _ in range(_STEPS):
        H = gram(columns(a))
        step, sigma = _step(a, H)
        far = abs(step[3]) / _LONGEST_STEP_S
        step /= max(1.0, far)
        a = replace(a, R=moved(a.R, step[:3]), tau=a.tau + float(step[3]))
        settled = far < 1 and abs(step[3]) < _SETTLED * sigma
        if far < 1 and step @ (H[:4, :4] @ step) < _CLOSE:
            break
    return replace(a, converged=bool(settled))


def _step(a: Alignment, H: Array) -> tuple[Array, float]:
    """Return Gauss-Newton's step of rotation and tau (4,) for the columns' Gram matrix, and tau's sigma."""
    free = a.free
    A = (H[:4, :4] + np.diag(PRIOR))[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    inverse = np.linalg.pinv(A * scale[:, None] * scale, rcond=1e-13, hermitian=True)
    step = np.zeros(4)
    step[free] = scale * (inverse @ (H[free, 4] * scale))
    return step, float(scale[-1] * np.sqrt(inverse[-1, -1]))


def stepped(a: Alignment, parts: Sequence[Array]) -> tuple[float, list[Array]]:
    """Return by how much tau moves in one step of Gauss-Newton, and the columns of every part with the residuals that it leaves."""
    step = _step(a, gram(parts))[0]
    return float(step[3]), [np.column_stack([X[:, :4], X[:, 4] - X[:, :4] @ step]) for X in parts]


def columns(a: Alignment) -> list[Array]:
    """Return the whitened columns (rows, 5) of every part: rotation (3), tau, residuals."""
    return [linearised(part, a.track, a.R, a.shift(part.stretch.t)) for part in a.parts]


def gram(parts: Sequence[Array]) -> Array:
    """Return the sum of X^T X over the columns of every part."""
    return np.asarray(sum((X.T @ X for X in parts), np.zeros((5, 5))), np.float64)


def sweep(a: Alignment, tau: Array, progress: Progress = silent) -> Array:
    """Return the V (k,): chi-squared with tau in place of the alignment's, the clock's drift kept, the best rotation and biases at each.

    The rotation is eliminated as it acts at the alignment's own tau: y.y - (X^T y).(X^T X)^-1 (X^T y).
    """
    square, pull, H = np.zeros(len(tau)), np.zeros((3, len(tau))), np.diag(PRIOR[:3])
    for part in progress(a.parts, "the V", len(a.parts)):
        t = part.stretch.t
        shift = a.shift(t)
        X = linearised(part, a.track, a.R, shift)[:, :3] * a.free_rotation
        H += X.T @ X
        many = max(1, _SLAB // (16 * len(t)))
        for i in range(0, len(tau), many):
            here = slice(i, i + many)
            y = residuals(part, a.track, a.R, (shift - a.tau)[:, None] + tau[here])
            square[here] += np.sum(y**2, axis=0)
            pull[:, here] += X.T @ y
    return np.asarray(square - np.sum(pull * np.linalg.solve(H, pull), axis=0), np.float64)


def turned_alike(a: Alignment, parts: Sequence[Array]) -> float:
    """Return by how much chi-squared is lower with the track's turns than without: below nothing where the track has noise alone."""
    without = sum(float(np.sum(part.own**2)) for part in a.parts)
    return without - sum(float(np.sum(X[:, -1] ** 2)) for X in parts)


def noise_information(a: Alignment) -> float:
    """Return the information on tau that noise of the track's rates would pretend, in mean over draws, if they did not change at all.

    Smoothed noise is alike within the track's reach: it is drawn at nodes that far apart and joined by straight lines, which leave it
    2/3 of its variance in the mean.
    """
    rng, reach = np.random.default_rng(0), a.track.reach
    total = 0.0
    for part in a.parts:
        place = (part.stretch.t - part.stretch.t[0]) / reach
        node = place.astype(np.int64)
        f = (place - node)[:, None]
        drawn = a.track.rate_sigma * np.sqrt(1.5) * rng.standard_normal((_DRAWS, node[-1] + 2, 3)) @ a.R.T
        noise = (1 - f) * drawn[:, node] + f * drawn[:, node + 1]
        change = noise[:, part.stretch.turns.last] - noise[:, part.stretch.turns.first]
        total += float(np.sum(part.clean(np.moveaxis(change, 0, 2)) ** 2)) / _DRAWS
    return total


def epochs(a: Alignment, parts: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Return each stretch's information (w, 1, 1) and score (w, 1) of tau with all else eliminated, and its time (w,) s.

    With h = H^-1 e: X h / h_tau is tau's column without what the others explain. A shorter piece would not do: the stretch's bias is
    fitted, so that its pieces scatter less than they are worth.
    """
    H = gram(parts)[:4, :4] + np.diag(PRIOR)
    free = a.free
    h = np.zeros(4)
    h[free] = np.linalg.pinv(H[np.ix_(free, free)], hermitian=True)[:, -1]
    columns = [X[:, :4] @ h / h[3] for X in parts]
    information = np.array([u @ u for u in columns])
    score = np.array([u @ X[:, 4] for u, X in zip(columns, parts, strict=True)])
    return information[:, None, None], score[:, None], np.array([part.stretch.middle.mean() for part in a.parts])
