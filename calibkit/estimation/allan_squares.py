"""Mean squares of p-th differences of a long series at many lags: in blocks that stay in the cache, thinned, or from an autocorrelation."""

from collections.abc import Callable
from math import comb

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SPAN = 128  # samples that a difference may reach over for its squares to be taken from the autocorrelation
_ROWS = 512  # of SPAN samples, multiplied at once
_ROUNDING = 1e-9  # share of the power below which differences of autocorrelations have lost digits
_BLOCK = 16384  # samples worked on at once
_HALVES = 5e-4  # where the two halves of the terms disagree by more in the deviation, the stride is halved


def squares(p: Array, lags: Ints, order: int) -> Array:
    """Return the sums of squares of the differences of p at ascending lags, one a lag."""
    sums, scaled, scratch = np.zeros(len(lags)), order * p, np.empty(_BLOCK)
    difference = _DIFFERENCES[order]
    ends = [(k, m, len(p) - order * m) for k, m in enumerate(lags.tolist())]
    for start in range(0, max((end for *_, end in ends), default=0), _BLOCK):
        for k, m, end in ends:
            if end <= start:
                break
            d = difference(p, scaled, start, m, scratch[: end - start])
            sums[k] += d @ d
    return sums


def _second(p: Array, scaled: Array, i: int, m: int, d: Array) -> Array:
    """Fill d with p[i + 2m] - 2 p[i + m] + p[i], scaled being 2 p."""
    np.subtract(p[i + 2 * m : i + 2 * m + len(d)], scaled[i + m : i + m + len(d)], out=d)
    d += p[i : i + len(d)]
    return d


def _third(p: Array, scaled: Array, i: int, m: int, d: Array) -> Array:
    """Fill d with p[i + 3m] - 3 p[i + 2m] + 3 p[i + m] - p[i], scaled being 3 p."""
    np.subtract(p[i + 3 * m : i + 3 * m + len(d)], scaled[i + 2 * m : i + 2 * m + len(d)], out=d)
    d += scaled[i + m : i + m + len(d)]
    d -= p[i : i + len(d)]
    return d


_DIFFERENCES: dict[int, Callable[[Array, Array, int, int, Array], Array]] = {2: _second, 3: _third}


def thinned_mean_squares(p: Array, lags: Ints, strides: Ints, order: int) -> Array:
    """Return the mean squares of the differences of p at ascending lags over every s-th start, s the stride of each (2^k) or finer.

    The starts are taken as two interleaved halves, of period t = 2 s of which the lag is a multiple. Halves that disagree tell that the
    terms vary too much to be thinned so far (phase noise, or a vibration in step with them): they become one half of the next finer ones.
    """
    mean, even = np.empty(len(lags)), np.zeros(len(lags))
    full = np.flatnonzero(strides == 1)
    mean[full] = squares(p, lags[full], order) / (len(p) - order * lags[full])
    active = np.zeros(len(lags), bool)
    s = int(strides.max(initial=1))
    every = {1: p}  # period: p at its multiples, each halved from the one before, since strided copies of the whole cost as much as sums
    while s > 1 and max(every) <= s:
        every[2 * max(every)] = every[max(every)][::2].copy()
    while s > 1 or active.any():
        t = 2 * s
        fresh = np.flatnonzero((strides == s) & (s > 1))
        even[fresh] = squares(every[t], lags[fresh] // t, order)
        active[fresh] = True
        now = np.flatnonzero(active)
        odd = squares(every[s][1::2].copy(), lags[now] // t, order)
        n_even, n_odd = (-(-(len(p) - offset) // t) - order * lags[now] // t for offset in (0, s))
        halves = even[now] / n_even, odd / np.maximum(n_odd, 1)
        even[now] += odd
        mean[now] = even[now] / (n_even + n_odd)
        active[now] = np.abs(halves[0] - halves[1]) > 4 * _HALVES * mean[now]
        if s == 1:
            break
        s //= 2
    return mean


def short_squares(y: Array, lags: Ints, order: int) -> Array:
    """Return the sums of squares of the differences of X, the cumulative sum of y, at short lags; NaN where digits were lost.

    With y continued by zeros and R its autocorrelation sum, G(k) = sum_i (X[i+k] - X[i])^2 = sum_|l|<k (k - |l|) R(l), and the sum of
    squares is 4 G(m) - G(2m) for second differences, 15 G(m) - 6 G(2m) + G(3m) for third; the terms that reach into the zeros are then
    taken off. The lags reach over SPAN samples at most: m order <= SPAN.
    """
    sums = np.empty(len(lags))
    if len(lags) == 0:
        return sums
    R = _autocorrelation(y)
    structure = np.concatenate([[0.0], np.cumsum(2 * np.cumsum(R) - R[0])])
    weights = [(-1) ** (k + 1) * comb(2 * order, order + k) for k in range(1, order + 1)]
    for k, m in enumerate(lags.tolist()):
        reach = order * m - 1
        ends = np.zeros((2, 2 * reach + 1))
        ends[0, reach + 1 :], ends[1, 1 : reach + 1] = y[:reach], y[-reach:]
        beyond = np.cumsum(ends, axis=1)
        for _ in range(order):
            beyond = beyond[:, m:] - beyond[:, :-m]
        sums[k] = sum(w * structure[i * m] for i, w in enumerate(weights, 1)) - np.sum(beyond**2)
    return np.where(sums < _ROUNDING * lags**2 * R[0], np.nan, sums)


def _autocorrelation(y: Array) -> Array:
    """Return R(l) = sum_i y[i] y[i + l], l < SPAN: diagonals of Gram matrices of rows of SPAN samples, and of each row with the next."""
    whole = len(y) // SPAN * SPAN
    rows, last = y[:whole].reshape(-1, SPAN), np.zeros((1, SPAN))
    last[0, : len(y) - whole] = y[whole:]
    within, across = last.T @ last, rows[-1:].T @ last if whole else np.zeros((SPAN, SPAN))
    for start in range(0, len(rows), _ROWS):
        a, b = rows[start : start + _ROWS], rows[start + 1 : start + 1 + _ROWS]
        within += a.T @ a
        across += a[: len(b)].T @ b
    return np.array([np.trace(within, lag) + np.trace(across, lag - SPAN) for lag in range(SPAN)])
