"""Maximum likelihood of a Gaussian noise model whose covariance is linear in its coefficients' squares, none of them negative."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from calibkit.estimation.noise_spectrum import Spectrum, flicker_covariance, markov_shape, ramp_modes, shapes

Array = NDArray[np.float64]

_STEPS = 60
_CONVERGED = 1e-5  # of the deviance


@dataclass(frozen=True)
class Problem:
    """The modes of one axis, all its records: deviance = sum_b w (ln lambda + p / lambda) + sum (ln det C + d^T C^-1 d).

    lambda = sum_i theta_i shape_i, C = sum_i theta_i covariance_i, d = low modes - R ramp.
    """

    shape: Array  # (p, b)
    power: Array  # (b,)
    weight: Array  # (b,) modes that the band counts as
    covariances: Sequence[Array]  # per record (p, m, m)
    low: Sequence[Array]  # per record (m,)
    ramps: Sequence[Array]  # per record (m,)
    with_ramp: bool = False


@dataclass(frozen=True)
class Fit:
    """theta at the maximum, the ramp R (0 where not asked for), its variance, and the information about theta."""

    theta: Array
    ramp: float
    ramp_variance: float
    deviance: float
    information: Array  # (p, p)


def problem(
    records: Sequence[Spectrum],
    weights: Sequence[Array],
    terms: Sequence[int],
    markov_s: float | None = None,
    with_ramp: bool = False,
) -> Problem:
    """Return the problem of fitting the terms (indices into TERMS, and a Gauss-Markov process of that time) to the records."""

    def basis(f: Array, rate_hz: float) -> Array:
        rows = shapes(f, rate_hz)[list(terms)]
        return rows if markov_s is None else np.vstack([rows, markov_shape(f, rate_hz, markov_s)])

    covariances = []
    for record in records:
        C = np.stack([np.diag(row) for row in basis(record.low_f, record.rate_hz)])
        if 1 in terms:
            C[list(terms).index(1)] = flicker_covariance(len(record.low), record.duration_s)
        covariances.append(C)
    return Problem(
        np.concatenate([basis(record.f, record.rate_hz) for record in records], axis=1),
        np.concatenate([record.power for record in records]),
        np.concatenate(list(weights)),
        covariances,
        [record.low for record in records],
        [ramp_modes(len(record.low), record.duration_s) for record in records],
        with_ramp,
    )


def whitened(p: Problem, theta: Array, ramp: float) -> list[Array]:
    """Return each record's low modes made independent, of unit variance if the model is right, in order of frequency."""
    out = []
    for C, d, v in zip(p.covariances, p.low, p.ramps, strict=True):
        L = np.linalg.cholesky(np.tensordot(theta, C, 1))
        out.append(solve_triangular(L, d - ramp * v, lower=True))
    return out


def _low_modes(p: Problem, theta: Array, ramp: float | None) -> tuple[float, Array, Array, float, float]:
    """Return deviance, score, information, R and its variance of the low modes; R is estimated unless given."""
    deviance, score, information = 0.0, np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
    inverses = [np.linalg.inv(np.tensordot(theta, C, 1)) for C in p.covariances]
    precision = sum(float(v @ W @ v) for v, W in zip(p.ramps, inverses, strict=True))
    R = ramp
    if R is None:
        R = sum(float(v @ W @ d) for v, W, d in zip(p.ramps, inverses, p.low, strict=True)) / precision
    for C, W, d, v in zip(p.covariances, inverses, p.low, p.ramps, strict=True):
        e = W @ (d - R * v)
        deviance += float((d - R * v) @ e) - float(np.linalg.slogdet(W)[1])
        WC = W @ C
        score += 0.5 * (np.einsum("i,pij,j->p", e, C, e) - np.trace(WC, axis1=1, axis2=2))
        information += 0.5 * np.einsum("pij,qji->pq", WC, WC, optimize=True)
    return deviance, score, information, R, 1 / precision if precision else 0.0


def _evaluate(p: Problem, theta: Array, ramp: float | None) -> tuple[float, Array, Array, float, float]:
    level = theta @ p.shape
    if not np.all(level > 0):
        return np.inf, np.zeros(len(theta)), np.zeros((len(theta), len(theta))), 0.0, 0.0
    deviance, score, information, R, variance = _low_modes(p, theta, ramp)
    relative = p.shape / level
    ratio = p.power / level
    deviance += float(p.weight @ (np.log(level) + ratio))
    score += 0.5 * relative @ (p.weight * (ratio - 1))
    information += 0.5 * (relative * p.weight) @ relative.T
    return deviance, score, information, R, variance


def start(p: Problem) -> Array:
    """Return a first theta: each term as large as the smallest excess over an octave or so allows."""
    groups = np.array_split(np.arange(len(p.power)), max(1, len(p.power) // 40))
    mean = np.array([np.average(p.power[g], weights=p.weight[g]) for g in groups if p.weight[g].sum() > 0])
    shape = np.array([np.average(p.shape[:, g], axis=1, weights=p.weight[g]) for g in groups if p.weight[g].sum() > 0])
    envelope = (mean[:, None] / shape).min(axis=0) if len(mean) else np.full(len(p.shape), np.inf)
    if p.low:
        low = np.concatenate([d * d for d in p.low]).mean()
        low_shape = np.concatenate([np.diagonal(C, axis1=1, axis2=2) for C in p.covariances], axis=1).mean(axis=1)
        envelope = np.minimum(envelope, low / low_shape)
    first: Array = envelope
    return first


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
