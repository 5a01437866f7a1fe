"""The noise of turns: what neighbours share, what is their own, what the jitter of stamps adds, and how much of each there is.

r_k = G_k e_last - G_k^T e_first + n_k, G = J_r(angle)^-1: turns that share a stamp have cov(r_k, r_k+1) = -G_k P G_k+1, so their covariance
is block-tridiagonal (a white model's sigma of a time offset is 8 times too small or too large). P = end * end_cov + jitter * omega omega^T.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.optimize import minimize_scalar

from calibkit.estimation.turns import Turns
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

_DECADES = range(-5, 4)  # what one kind's share may be of another's
_ROUNDS, _SETTLED = 6, 0.1  # decades
_WORTH_IT = 10.0  # ln likelihood that jitter must add
_ENOUGH = 3000  # turns that tell the noise well enough


@dataclass(frozen=True)
class NoiseLevels:
    """How much there is of each kind."""

    end: float  # rad^2 of an orientation's error, or a factor of the given end_cov
    own: float  # rad^2/s, or a factor of the given own_cov
    jitter: float = 0.0  # s^2 of the stamps


@dataclass(frozen=True)
class TurnNoise:
    """Bands (lower LAPACK storage, scalar rows 3 k + axis) of the unit covariance of each kind."""

    end: Array
    own: Array
    jitter: Array

    def band(self, levels: NoiseLevels) -> Array:
        """Return the band of the whole covariance."""
        return levels.end * self.end + levels.own * self.own + levels.jitter * self.jitter

    def blocks(self, levels: NoiseLevels, axes: int) -> Array:
        """Return each turn's own covariance (n, axes, axes)."""
        band = self.band(levels)
        out = np.empty((band.shape[1] // axes, axes, axes))
        for c in range(axes):
            for r in range(c, axes):
                out[:, r, c] = out[:, c, r] = band[r - c, c::axes]
        return out

    def whitener(self, levels: NoiseLevels) -> "Whitener":
        """Return what makes the noise white."""
        return Whitener(np.asarray(cholesky_banded(self.band(levels), lower=True, check_finite=False), np.float64))


@dataclass(frozen=True)
class Whitener:
    """L with L L^T the covariance."""

    factor: Array  # band of L

    def __call__(self, x: Array) -> Array:
        """Return L^-1 x for x (rows, columns)."""
        if not x.size:  # LAPACK's wrapper writes out of bounds
            return x
        out, _ = dtbtrs(self.factor, np.asfortranarray(x), uplo="L")
        return np.asarray(out, np.float64)

    @property
    def log_determinant(self) -> float:
        return 2 * float(np.sum(np.log(self.factor[0])))


def turn_noise(turns: Turns, omega: Array, shape: Array) -> TurnNoise:
    """Return the bands for turns whose sensor turns at omega (m, 3) rad/s at the stamps.

    `shape` (3,) has the variances of the axes relative to each other, for turns that do not say it.
    """
    axes = np.flatnonzero(turns.axes)
    G = so3.right_jacobian_inverse(turns.angle)
    own: Array = (
        turns.duration[:, None, None] * (np.diag(shape) if turns.end_cov is None else np.eye(3)) if turns.own_cov is None else turns.own_cov
    )
    P: Array = np.tile(np.diag(shape), (len(turns.t_ns), 1, 1)) if turns.end_cov is None else turns.end_cov
    late: Array = omega[:, :, None] * omega[:, None, :]
    bands = [_band(*_shared(turns, G, shape), axes) for shape in (P, late)]
    return TurnNoise(bands[0], _band(own, np.zeros((max(len(own) - 1, 0), 3, 3)), axes), bands[1])


def _shared(turns: Turns, G: Array, P: Array) -> tuple[Array, Array]:
    """Return diagonal blocks (n, 3, 3) and cov(r_k+1, r_k) (n - 1, 3, 3) of errors P (m, 3, 3) at the stamps."""
    Gt = np.swapaxes(G, 1, 2)
    diagonal = G @ P[turns.last] @ Gt + Gt @ P[turns.first] @ G
    below = -np.swapaxes(G[:-1] @ P[turns.last[:-1]] @ G[1:], 1, 2)
    return diagonal, np.where(turns.joined[1:, None, None], below, 0.0)


def _band(diagonal: Array, below: Array, axes: NDArray[np.intp]) -> Array:
    """Return the lower band of a block-tridiagonal matrix, of some of the axes."""
    diagonal, below = diagonal[:, axes[:, None], axes], below[:, axes[:, None], axes]
    n, d = len(diagonal), len(axes)
    band = np.zeros((2 * d, n * d))
    for c in range(d):
        for r in range(c, d):
            band[r - c, c::d] = diagonal[:, r, c]
        for r in range(d):
            band[d + r - c, c : (n - 1) * d : d] = below[:, r, c]
    return band


def estimate_levels(noises: Sequence[TurnNoise], residuals: Sequence[Array], biases: Sequence[Array], jitter: bool = True) -> NoiseLevels:
    """Return the most likely levels for the residuals (rows,) of independent stretches, at most some thousands of turns of them.

    The likelihood is that of what the bias columns (rows, p) cannot explain (Patterson and Thompson 1971): they take the slowest noise
    with them, which is where a turn's own is told from that of its ends, and without it `own` comes out a third too small. The common
    factor is r^T V^-1 r / (n - p); the ratios are searched one after the other. Jitter is taken in when it raises the likelihood by 10
    (odds of 20 000 to 1).
    """
    step = max(1, -(-sum(len(r) for r in residuals) // (3 * _ENOUGH)))
    noises, residuals, biases = noises[::step], residuals[::step], biases[::step]
    n = sum(len(r) - columns.shape[1] for r, columns in zip(residuals, biases, strict=True))
    mean = [float(np.mean(np.concatenate([getattr(noise, kind)[0] for noise in noises]))) for kind in ("end", "own", "jitter")]
    unit = [1 / each if each > 0 else 0.0 for each in mean]

    def likelihood(ratios: tuple[float, float]) -> tuple[float, NoiseLevels]:
        levels = NoiseLevels(unit[0], 10 ** ratios[0] * unit[1], 10 ** ratios[1] * unit[2])
        square, log_determinant = 0.0, 0.0
        try:
            for noise, r, columns in zip(noises, residuals, biases, strict=True):
                whiten = noise.whitener(levels)
                white = whiten(np.column_stack([columns, r]))
                gram = white.T @ white
                taken = np.linalg.solve(gram[:-1, :-1], gram[:-1, -1])
                square += float(gram[-1, -1] - taken @ gram[:-1, -1])
                log_determinant += whiten.log_determinant + float(np.linalg.slogdet(gram[:-1, :-1])[1])
        except LinAlgError:
            return np.inf, levels
        factor = max(square / n, 1e-300)
        scaled = replace(levels, end=factor * levels.end, own=factor * levels.own, jitter=factor * levels.jitter)
        return 0.5 * (n * np.log(factor) + log_determinant), scaled

    def best(fixed: float, first: bool) -> float:
        """Return the ratio that is most likely while the other one is held: by decades, then between their neighbours."""

        def cost(ratio: float) -> float:
            return likelihood((ratio, fixed) if first else (fixed, ratio))[0]

        at = float(min(_DECADES, key=cost))
        return float(minimize_scalar(cost, bounds=(at - 1, at + 1), method="bounded", options={"xatol": 0.1}).x)

    none = -np.inf
    own = best(none, True)
    cost, levels = likelihood((own, none))
    if not jitter or min(likelihood((own, late))[0] for late in _DECADES) > cost - _WORTH_IT / 2:
        return levels
    late = none
    for _ in range(_ROUNDS):
        before, late = (own, late), best(own, False)
        own = best(late, True)
        if max(abs(own - before[0]), abs(late - before[1])) < _SETTLED:
            break
    cost_late, levels_late = likelihood((own, late))
    return levels_late if cost_late < cost - _WORTH_IT else levels
