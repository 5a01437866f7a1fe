"""Allan deviation and its relatives of rates, at many averaging times and several channels at once.

Every kind is a p-th difference at lag m of cumulative sums. With y the rates less their mean, X[i] = y[0] + .. + y[i-1] and W the
cumulative sum of X (NIST SP1065, Riley 2008, section 5.2):

    Allan     sigma^2(m tau0) = < (X[i+2m] - 2 X[i+m] + X[i])^2 > / (2 m^2)
    Hadamard  sigma^2(m tau0) = < (X[i+3m] - 3 X[i+2m] + 3 X[i+m] - X[i])^2 > / (6 m^2)
    modified  sigma^2(m tau0) = < (W[i+3m] - 3 W[i+2m] + 3 W[i+m] - W[i])^2 > / (2 m^4);  time deviation = tau modified / sqrt 3
    total     Allan's, over every i of X continued by point reflection at both of its ends
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from calibkit.errors import BadInputError
from calibkit.estimation.allan_confidence import interval, noise_exponents
from calibkit.estimation.allan_squares import SPAN, short_squares, squares, thinned_mean_squares

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

CONFIDENCE = 0.95
_FINEST = 16  # the decimated mode's stride is at most tau / 16
_ERROR = 2e-4  # the decimated mode's relative error where white noise dominates, one sigma
_KEPT = 1 << 14  # terms that are kept: a short recording is not thinned, it is cheap as it is
_ABSURD = 1e100  # a power of the rates that no sensor has, and whose cumulative sums overflow


@dataclass(frozen=True)
class Deviation:
    """Deviations by averaging time and channel, in the unit of the rates (time deviation: times s), with their 95 % interval."""

    kind: str
    tau: Array  # (k,) s, a whole number of samples each
    dev: Array  # (k, c)
    edf: Array  # (k, c) equivalent degrees of freedom
    lower: Array  # (k, c) chi-squared, 95 % two-sided
    upper: Array  # (k, c)
    n: Ints  # (k,) terms that the mean is over; the decimated mode takes some of them
    alpha: Ints  # (k, c) noise found there, the spectrum of the rates being f^alpha: 0 white, -1 flicker, -2 random walk


@dataclass(frozen=True)
class _Kind:
    order: int  # p of the p-th difference
    modified: bool  # of W, not of X
    divisor: float
    overlapped: bool = True
    reflected: bool = False
    time: bool = False


KINDS = {
    "overlapping": _Kind(2, False, 2.0),
    "modified": _Kind(3, True, 2.0),
    "hadamard": _Kind(3, False, 6.0),
    "adev": _Kind(2, False, 2.0, overlapped=False),
    "hdev": _Kind(3, False, 6.0, overlapped=False),
    "tdev": _Kind(3, True, 2.0, time=True),
    "totdev": _Kind(2, False, 2.0, reflected=True),
}


def octaves(n: int, rate_hz: float) -> Array:
    """Return the averaging times of 1, 2, 4 .. samples up to a quarter of n samples, in s."""
    return np.asarray(2.0 ** np.arange(max(n // 4, 1).bit_length()) / rate_hz)


def log_spaced(n: int, rate_hz: float, count: int = 100) -> Array:
    """Return at most `count` averaging times of one sample to a quarter of n samples, evenly spaced in log tau, in s."""
    return np.asarray(np.unique(np.round(np.geomspace(1, max(n // 4, 1), count))) / rate_hz)


def deviation(
    x: ArrayLike, rate_hz: float, tau: ArrayLike | None = None, kind: str = "overlapping", exact: bool = False, workers: int | None = None
) -> Deviation:
    """Return the deviation of rates x (n, c) or (n,) at the averaging times tau (s; `log_spaced` ones when None).

    exact takes every overlapping term. Otherwise long averaging times take every s-th term only, s <= tau / 16 and a power of two: within
    1e-3 of exact. Averaging times are rounded to whole samples (to multiples of s), and those longer than the recording allows are left
    out: the result says which. The interval is chi-squared, with the equivalent degrees of freedom of the noise found at each averaging
    time (`allan_confidence`).
    BadInputError: values that are not finite, too few samples, a rate or averaging time that is not positive, none short enough.
    ValueError: kind, shape.
    """
    if kind not in KINDS:
        raise ValueError(f"no deviation is named {kind!r}: choose one of {', '.join(KINDS)}")
    of, x = KINDS[kind], np.asarray(x, np.float64)
    x = x[:, None] if x.ndim == 1 else x
    _check(x, rate_hz)
    n = len(x)
    m = _lags(log_spaced(n, rate_hz) if tau is None else np.atleast_1d(np.asarray(tau, np.float64)), rate_hz, n, of)
    strides = np.ones_like(m)
    thin = not exact and of.overlapped and not of.reflected
    if thin:
        strides = _strides(m, _terms(m, n, of), of)
        grid = np.where(strides > 1, 2 * strides, 1)
        m = np.round(m / grid).astype(np.int64) * grid
        keep = (_terms(m, n, of) > 0) & (np.diff(m, prepend=0) > 0)
        m, strides = m[keep], strides[keep]

    # The channels are the threads; BLAS's own would only fight with them.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        found = list(pool.map(lambda rates: _channel(rates, m, strides, of, thin), x.T))
    seconds, alpha = m / rate_hz, np.stack([a for _, a in found], axis=1)
    dev = np.sqrt(np.stack([s for s, _ in found], axis=1) / of.divisor) / (m**2 if of.modified else m)[:, None]
    if of.time:
        dev *= seconds[:, None] / np.sqrt(3)
    edf, low, high = interval(of.order - of.modified, of.modified, of.overlapped, of.reflected, m, n + 1, alpha, CONFIDENCE)
    return Deviation(kind, seconds, dev, edf, dev * low, dev * high, _terms(m, n, of), alpha)


def _check(x: Array, rate_hz: float) -> None:
    if x.ndim != 2 or x.shape[1] == 0:
        raise ValueError(f"rates have shape {x.shape}, expected (n, channels)")
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise BadInputError(f"a sampling rate of {rate_hz} Hz is none: give a positive one")
    if len(x) < 8:
        raise BadInputError(f"{len(x)} samples are too few for an Allan deviation: record hours, not moments")


def _lags(tau: Array, rate_hz: float, n: int, of: _Kind) -> Ints:
    """Return the averaging times as numbers of samples, ascending, each once."""
    if tau.ndim != 1 or not (np.isfinite(tau).all() and np.all(tau > 0)):
        raise BadInputError("averaging times are positive numbers of seconds, in one list")
    # Bounded before it becomes an integer: 1e300 s is longer than any recording.
    m = np.unique(np.maximum(np.round(np.minimum(tau * rate_hz, 2.0 * n)), 1).astype(np.int64))
    m = m[_terms(m, n, of) > 0]
    if len(m) == 0:
        raise BadInputError(f"every averaging time is too long for {n} samples at {rate_hz:g} Hz ({n / rate_hz:g} s)")
    return m


def _terms(m: Ints, n: int, of: _Kind) -> Ints:
    """Return how many terms the mean of n samples is over at each lag; 0 or less where there is none."""
    if of.reflected:
        return np.where(m < n, n - 1, 0)
    every = n + 1 + of.modified - of.order * m
    return every if of.overlapped else -(-every // m)


def _strides(m: Ints, terms: Ints, of: _Kind) -> Ints:
    """Return the power of two by which the terms at each lag may be thinned.

    White rates make X a random walk; the mean over every s-th of its squared second differences then has a relative error of
    s / sqrt(m terms), half of that in the deviation.
    """
    most = np.minimum(np.minimum(m / _FINEST, terms / _KEPT), 2 * _ERROR * np.sqrt(m * terms))
    most = np.where((m * of.order <= SPAN) & (not of.modified), 1.0, most)
    return np.asarray(2 ** np.floor(np.log2(np.maximum(most, 1))).astype(np.int64))


def _centred(rates: Array) -> Array:
    """Return 0 and then the rates less their mean, which would grow in a cumulative sum and cost digits; BadInputError: not finite."""
    phase = np.zeros(len(rates) + 1)
    y = phase[1:]
    y[:] = rates
    with np.errstate(over="ignore", invalid="ignore"):
        y -= y.mean()
        power = y @ y
    if not power < _ABSURD:
        raise BadInputError("the rates hold values that are not finite, or absurdly large: remove those samples from the recording")
    return phase


def _channel(rates: Array, m: Ints, strides: Ints, of: _Kind, thin: bool) -> tuple[Array, Ints]:
    """Return the mean squares of one channel's p-th differences at each lag, and the noise found there."""
    phase = _centred(rates)
    result = np.full(len(m), np.nan)
    if thin and not of.modified:
        short = m * of.order <= SPAN
        result[short] = short_squares(phase[1:], m[short], of.order) / (len(phase) - of.order * m[short])
    np.cumsum(phase, out=phase)
    alpha = noise_exponents(phase, m, of.order - of.modified)
    series = np.cumsum(np.concatenate([[0.0], phase - phase.mean()])) if of.modified else phase
    if of.reflected:
        return _reflected_mean_squares(series, m), alpha
    if not of.overlapped:
        return np.array([np.mean(np.diff(series[::lag], of.order) ** 2) for lag in m.tolist()]), alpha
    left = np.isnan(result)
    # Terms of phase noise are alike at whole lags only: each that is left out is information lost.
    result[left] = thinned_mean_squares(series, m[left], np.where(alpha > 0, 1, strides)[left], of.order)
    return result, alpha


def _reflected_mean_squares(phase: Array, m: Ints) -> Array:
    """Return the mean squares of second differences about every inner point of the phase, which is continued by reflection at its ends."""
    inner = len(phase) - 2
    longer = np.concatenate([2 * phase[0] - phase[-2:0:-1], phase, 2 * phase[-1] - phase[-2:0:-1]])
    return np.array([squares(longer[inner + 1 - lag : 2 * inner + 1 + lag], np.array([lag]), 2)[0] / inner for lag in m.tolist()])
