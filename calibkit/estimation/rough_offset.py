"""Where two clocks may stand to each other, without any hint: the correlation of how fast two sensors turn, at every lag at once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

from calibkit.estimation.orientation_track import OrientationTrack
from calibkit.estimation.turns import Turns
from calibkit.geometry.so3 import Array

_STEP_S = (0.02, 0.1)  # of the resampled rates
_MOST_BINS = 1_000_000  # over pauses of hours the rates are compared more coarsely
_MEMORY_S = 0.5  # rates are alike for so long: a second of overlap counts as two independent looks
_LEAST_OVERLAP_S = 5.0
_LEAST_SHARE = 0.1  # of the shorter recording
_CLIP = 99.5  # percentile: what is faster counts as much as that, no more
_MOST = 6
_HOPEFUL = 0.6  # of the best candidate's significance

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Candidate:
    """A lag at which two sensors turn alike."""

    lag: float  # s, added to the times of the turns (from their first stamp) to give times of the track (from its origin)
    correlation: float
    significance: float  # Fisher's z in sigmas of chance
    uncertainty: float  # s


def rough_offsets(turns: Turns, track: OrientationTrack) -> list[Candidate]:
    """Return the lags where |omega| of both correlate, the most significant first; none where nothing stands out.

    At each lag Pearson's correlation over the samples that both have (Padfield, Masked object registration in the Fourier domain, 2012):
    the mean is that of the overlap, so that neither gaps nor a part that the other lacks pull the lag.
    """
    typical = float(np.median(turns.duration))
    span = max(track.duration, float(turns.t_ns[-1] - turns.t_ns[0]) * 1e-9)
    h = max(float(np.clip(typical, *_STEP_S)), span / _MOST_BINS)
    fast, has_fast = _rate_of_track(track, h)
    slow, has_slow = _rate_of_turns(turns, h)
    if not (has_fast.any() and has_slow.any()):
        return []
    rho, n = masked_correlation(fast, has_fast, slow, has_slow)
    lags = (np.arange(len(rho)) - (len(slow) - 1)) * h
    least = max(_LEAST_OVERLAP_S, _LEAST_SHARE * h * min(has_fast.sum(), has_slow.sum()))
    independent = np.maximum(n * h / _MEMORY_S - 3, 1.0)
    z = np.where(n * h >= min(least, 0.5 * h * n.max()), np.arctanh(np.clip(rho, -0.999999, 0.999999)) * np.sqrt(independent), -np.inf)
    peak = np.flatnonzero((z > 0) & (z >= np.concatenate([[-np.inf], z[:-1]])) & (z > np.concatenate([z[1:], [-np.inf]])))
    peak = peak[np.argsort(-z[peak])][:_MOST]
    return [Candidate(float(lags[k]), float(rho[k]), float(z[k]), 1.5 * h) for k in peak if z[k] >= _HOPEFUL * z[peak[0]]]


def masked_correlation(a: Array, has_a: Mask, b: Array, has_b: Mask) -> tuple[Array, Array]:
    """Return Pearson's correlation of a[k + l] and b[k] where both are there, and how many there are; l = 1 - len(b) ... len(a) - 1."""
    size = len(a) + len(b) - 1
    fast = next_fast_len(size, real=True)
    a, b = np.where(has_a, a - a[has_a].mean(), 0.0), np.where(has_b, b - b[has_b].mean(), 0.0)

    def spectrum(x: Array) -> NDArray[np.complex128]:
        return np.asarray(rfft(x, fast), np.complex128)

    fa, fa2, fma = spectrum(a), spectrum(a * a), spectrum(has_a.astype(float))
    fb, fb2, fmb = (np.conj(spectrum(x)) for x in (b, b * b, has_b.astype(float)))

    def sums(x: NDArray[np.complex128], y: NDArray[np.complex128]) -> Array:
        out = np.asarray(irfft(x * y, fast), np.float64)
        return np.concatenate([out[fast - (len(b) - 1) :], out[: len(a)]]) if len(b) > 1 else out[: len(a)]

    n = np.rint(sums(fma, fmb))
    many = np.maximum(n, 1)
    of_a, of_b = sums(fa, fmb), sums(fma, fb)
    var_a, var_b = sums(fa2, fmb) - of_a**2 / many, sums(fma, fb2) - of_b**2 / many
    floor_a, floor_b = (1e-9 * many * float(np.mean(x**2)) for x in (a, b))
    scale = np.sqrt(np.maximum(var_a, floor_a) * np.maximum(var_b, floor_b))
    rho = (sums(fa, fb) - of_a * of_b / many) / np.maximum(scale, 1e-300)
    return np.where(n > 0, rho, 0.0), n


def _clipped(rate: Array, has: Mask) -> Array:
    return np.minimum(rate, np.percentile(rate[has], _CLIP)) if has.any() else rate


def _rate_of_track(track: OrientationTrack, h: float) -> tuple[Array, Mask]:
    """Return the mean |omega| in bins of h s from the track's origin."""
    bins = (track.grid.t / h).astype(np.int64)
    good = track.chain >= 0
    count = np.bincount(bins[good], minlength=bins[-1] + 1)
    total = np.bincount(bins[good], np.linalg.norm(track.rate[good], axis=1), minlength=bins[-1] + 1)
    has = count > 0
    return _clipped(total / np.maximum(count, 1), has), has


def _rate_of_turns(turns: Turns, h: float) -> tuple[Array, Mask]:
    """Return |angle| / duration in bins of h s from the first stamp, between the turns' middles where no turn is missing."""
    start = (turns.t_ns[turns.first] - turns.t_ns[0]) * 1e-9
    middle, rate = start + turns.duration / 2, np.linalg.norm(turns.angle, axis=1) / turns.duration
    at = (np.arange(int(middle[-1] / h) + 1) + 0.5) * h
    after = np.clip(np.searchsorted(middle, at), 1, len(middle) - 1)
    has = (middle[after] - middle[after - 1] < 2.5 * max(float(np.median(turns.duration)), h)) & (at >= middle[0] - h) & (at <= middle[-1])
    return _clipped(np.interp(at, middle, rate), has), np.asarray(has, np.bool_)
