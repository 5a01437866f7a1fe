"""Maximum likelihood of a Gaussian noise model whose covariance is linear in its coefficients' squares, none of them negative."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from calibkit.estimation.noise_spectrum import Spectrum, flicker_covariance, markov_shape, ramp_modes, shapes

Array = NDArray[np.float64]

_FLICKER = 1  # its place in TERMS
_STEPS = 60
_CONVERGED = 1e-5  # of the deviance


@dataclass(frozen=True)
class Problem:
    """The modes of one axis: deviance = sum_b w (ln lambda + p / lambda) + sum_pieces (ln det C + e^T C^-1 e).

    lambda = sum_i theta_i shape_i, C = sum_i theta_i covariance_i, e = low modes - R ramp.
    """

    shape: Array  # (p, b)
    power: Array  # (b,)
    weight: Array  # (b,) modes that the band counts as
    covariance: Array  # (r, p, m, m)
    low: Array  # (r, m)
    ramp: Array  # (r, m)
    with_ramp: bool = False


@dataclass(frozen=True)
class Fit:
    """theta at the maximum, the ramp R (0 where not asked for), its variance, and the information about theta."""

    theta: Array
    ramp: float
    ramp_variance: float
    deviance: float
    information: Array  # (p, p)


def problem(s: Spectrum, weight: Array, terms: Sequence[int], markov_s: float | None = None, with_ramp: bool = False) -> Problem:
    """Return the problem of fitting the terms (indices into TERMS, and a Gauss-Markov process of that time) to the spectrum."""

    def basis(f: Array) -> Array:
        rows = shapes(f, s.rate_hz)[list(terms)]
        return rows if markov_s is None else np.concatenate([rows, markov_shape(f, s.rate_hz, markov_s)[None]])

    m = s.low.shape[1]
    covariance = np.moveaxis(basis(s.low_f), 0, 1)[..., None] * np.eye(m)
    if _FLICKER in terms:
        covariance[:, list(terms).index(_FLICKER)] = flicker_covariance(m) * s.durations_s[:, None, None]
    ramp = ramp_modes(m) * s.durations_s[:, None] ** 1.5
    return Problem(basis(s.f), s.power, weight, covariance, s.low, ramp, with_ramp)


def whitened(p: Problem, fit: Fit) -> Array:
    """Return the low modes (r, m) made independent, of unit variance if the model is right, in order of frequency."""
    L = np.linalg.cholesky(np.tensordot(p.covariance, fit.theta, (1, 0)))
    white: Array = np.linalg.solve(L, (p.low - fit.ramp * p.ramp)[..., None])[..., 0]
    return white


def _low_modes(p: Problem, theta: Array, ramp: float | None) -> tuple[float, Array, Array, float, float]:
    """Return deviance, score, information, R and its variance of the low modes; R is estimated unless given."""
    W = np.linalg.inv(np.tensordot(p.covariance, theta, (1, 0)))
    W_ramp = (W @ p.ramp[..., None])[..., 0]
    precision = float(np.sum(W_ramp * p.ramp))
    R = float(np.sum(W_ramp * p.low)) / precision if ramp is None else ramp
    e = p.low - R * p.ramp
    We = (W @ e[..., None])[..., 0]
    WC = W[:, None] @ p.covariance
    flat = WC.swapaxes(0, 1).reshape(len(theta), -1)
    flat_t = WC.swapaxes(2, 3).swapaxes(0, 1).reshape(len(theta), -1)
    score = 0.5 * (
        ((p.covariance @ We[:, None, :, None])[..., 0] * We[:, None]).sum(axis=(0, 2)) - np.trace(WC, axis1=2, axis2=3).sum(axis=0)
    )
    deviance = float(np.sum(e * We)) - float(np.sum(np.linalg.slogdet(W)[1]))
    return deviance, score, 0.5 * flat @ flat_t.T, R, 1 / precision


def _evaluate(p: Problem, theta: Array, ramp: float | None) -> tuple[float, Array, Array, float, float]:
    level = theta @ p.shape
    if not np.all(level > 0):
        return np.inf, np.zeros(len(theta)), np.zeros((len(theta), len(theta))), 0.0, 0.0
    if len(p.low):
        deviance, score, information, R, variance = _low_modes(p, theta, ramp)
    else:
        deviance, score, information, R, variance = 0.0, np.zeros(len(theta)), np.zeros((len(theta), len(theta))), 0.0, 0.0
    relative = p.shape / level
    ratio = p.power / level
    deviance += float(p.weight @ (np.log(level) + ratio))
    score += 0.5 * relative @ (p.weight * (ratio - 1))
    information += 0.5 * (relative * p.weight) @ relative.T
    return deviance, score, information, R, variance


def start(p: Problem) -> Array:
    """Return a first theta: each term as large as the least power over an octave or so allows."""
    groups = [g for g in np.array_split(np.arange(len(p.power)), max(1, len(p.power) // 40)) if p.weight[g].sum() > 0]
    power = [float(np.average(p.power[g], weights=p.weight[g])) for g in groups]
    shape = [np.average(p.shape[:, g], axis=1, weights=p.weight[g]) for g in groups]
    if len(p.low):
        power.append(float(np.mean(p.low**2)))
        shape.append(np.diagonal(p.covariance, axis1=2, axis2=3).mean(axis=(0, 2)))
    envelope: Array = np.min(np.array(power)[:, None] / np.array(shape), axis=0)
    return envelope


def maximise(p: Problem, first: Array | None = None, fixed: tuple[int, float] | None = None, ramp: float | None = None) -> Fit:
    """Return the maximum likelihood by Fisher scoring, each step a non-negative least squares problem; `fixed` holds one theta."""
    R_given = ramp if ramp is not None else (None if p.with_ramp else 0.0)
    theta = (start(p) if first is None else first).copy()
    free = np.ones(len(theta), dtype=bool)
    if fixed is not None:
        if fixed[1] == 0:  # the others may all stand at zero
            theta = np.maximum(theta, 1e-3 * start(p))
        theta[fixed[0]], free[fixed[0]] = fixed[1], False
    deviance, score, information, R, variance = _evaluate(p, theta, R_given)
    for _ in range(_STEPS):
        I_free = information[np.ix_(free, free)]
        scale = 1 / np.sqrt(np.diag(I_free))
        L = np.linalg.cholesky(I_free * scale[:, None] * scale + 1e-12 * np.eye(len(scale)))
        target, _ = nnls(L.T, L.T @ (theta[free] / scale) + solve_triangular(L, scale * score[free], lower=True))
        goal = theta.copy()
        goal[free] = target * scale
        length = 1.0
        while True:
            new = theta + length * (goal - theta)
            trial = _evaluate(p, new, R_given)
            if trial[0] <= deviance or length < 1e-4:
                break
            length /= 2
        gain = deviance - trial[0]
        if gain < 0:
            break
        theta, (deviance, score, information, R, variance) = new, trial
        if gain < _CONVERGED:
            break
    return Fit(theta, R, variance if p.with_ramp else 0.0, deviance, information)
