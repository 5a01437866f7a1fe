"""Where an IMU stood still: stands, their means and how well those are known, the threshold chosen by the data."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.errors import BadInputError
from calibkit.estimation.imu_seed import seed_accel

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_WINDOW_S = 0.5  # variance is taken over this; a stand loses half of it at each end
_SHORTEST_S = 0.75  # of a stand, after that
_MULTIPLIERS = np.geomspace(2.0, 100.0, 12)  # of the still variance, scanned (Tedaldi 2014, III-C)
_USUAL_MULTIPLIER = 10.0  # where too few stands can tell one from another
_AS_GOOD = 2.0  # of the log determinant of nine numbers: a tenth of their sigmas
_QUIET = 0.1  # quantile of the windows' variances that is taken for stillness
_BLOCK_S, _LONG_BLOCK_S = 0.25, 1.0  # means over the first are many, over the second independent
_TRUSTED_MEDIAN = 6  # blocks a stand
_POOLED_BLOCKS = 16  # weight of what all stands say of the noise, beside a stand's own blocks
_TURNS_STILL = 0.05  # rms of the stands' mean rates over that of the recording, above which it never stood still
_GAP = 5.0  # median intervals
_SCANNED = 12  # stands and more can choose the multiplier
MIN_STANDS = 6


class NoStandsError(BadInputError):
    """The recording holds too few stands to begin with."""


@dataclass(frozen=True)
class Stands:
    """Stands of one recording, in its units; rows [first, last) of the samples."""

    first: Index  # (n,)
    last: Index  # (n,)
    start_s: Array  # (n,)
    end_s: Array  # (n,)
    accel: Array  # (n, 3) mean
    cov_accel: Array  # (n, 3, 3) of the mean
    gyro: Array  # (n, 3) mean
    cov_gyro: Array  # (n, 3, 3) of the mean
    white_gyro: Array  # (3, 3) noise density squared, units^2 / Hz, all stands together
    multiplier: float  # of the still variance: the threshold

    def __len__(self) -> int:
        return len(self.first)

    @property
    def middle_s(self) -> Array:
        return 0.5 * (self.start_s + self.end_s)

    def select(self, keep: NDArray[np.bool_]) -> "Stands":
        """Return only the stands to keep."""
        per_stand = ("first", "last", "start_s", "end_s", "accel", "cov_accel", "gyro", "cov_gyro")
        return replace(self, **{name: getattr(self, name)[keep] for name in per_stand})


def find_stands(t: Array, gyro: Array, accel: Array, gravity: float) -> Stands:
    """Return the stands of samples at t (n,) s, gyro and accel (n, 3) in any unit.

    Still is where the variance of every sensor over half a second is below m times the quiet variance. Of m = 2 ... 100 the one is
    taken that determines the accelerometer best: the largest det(J^T J / s^2), s^2 the variance of |a| at rest, which stands too few,
    too short and with motion in them all lower; of those as good, the smallest. Raises BadInputError where there are no stands.
    """
    ratio = _variance_ratio(t, gyro, accel)
    choices = [intervals(t, ratio, float(m)) for m in _MULTIPLIERS]
    scores = [_score(accel, gravity, *choice) for choice in choices]
    best = int(np.argmin(np.abs(np.log(_MULTIPLIERS / _USUAL_MULTIPLIER))))
    if np.isfinite(scores).any():
        best = int(np.argmax(scores >= np.max(scores) - _AS_GOOD))
    first, last = choices[best]
    if len(first) == 0:
        raise NoStandsError(f"the IMU never stood still for {_SHORTEST_S + _WINDOW_S:.1f} s: put it down, still, in 12 or more attitudes")
    stands = _stands(t, gyro, accel, first, last, float(_MULTIPLIERS[best]))
    wandering = np.sqrt(np.mean(np.sum((stands.gyro - np.median(stands.gyro, axis=0)) ** 2, axis=1)))
    overall = np.sqrt(np.mean(np.sum((gyro - np.median(stands.gyro, axis=0)) ** 2, axis=1)))
    if len(stands) > 1 and wandering > _TURNS_STILL * overall:
        raise NoStandsError(
            "the IMU never stood still, or never moved: its quietest parts turn about as much as the others; "
            "put it down, still, in 12 or more attitudes (calibkit allan is for a recording at rest)"
        )
    return stands


def _variance_ratio(t: Array, gyro: Array, accel: Array) -> Array:
    """Return per sample the variance over the window around it, relative to stillness: the larger of gyroscope and accelerometer."""
    size = max(round(_WINDOW_S / float(np.median(np.diff(t)))), 4)
    ratio = np.zeros(len(t))
    for x in (gyro, accel):
        x = x - np.median(x, axis=0)
        sums = [np.concatenate([np.zeros((1, 3)), np.cumsum(power, axis=0)]) for power in (x, x * x)]
        mean, square = ((s[size:] - s[:-size]) / size for s in sums)
        variance = np.sum(np.maximum(square - mean * mean, 0), axis=1)
        step = _quantum(x)
        quiet = max(float(np.quantile(variance[::size], _QUIET)), float(step @ step) / 12, 1e-300)
        padded = np.pad(variance / quiet, (size // 2, len(t) - len(variance) - size // 2), constant_values=np.inf)
        ratio = np.maximum(ratio, padded)
    gap = np.diff(t) > _GAP * np.median(np.diff(t))
    ratio[1:][gap] = np.inf
    ratio[:-1][gap] = np.inf
    # The very ends have no whole window around them: they are as still as the nearest that has.
    half = size // 2
    if len(ratio) > 2 * size:
        ratio[:half], ratio[-half:] = ratio[half], ratio[-half - 1]
    return ratio


def _quantum(x: Array) -> Array:
    """Return the smallest step (3,) between values, 0 where values hardly ever repeat."""
    few = x[:: max(1, len(x) // 20000)]
    steps = np.zeros(3)
    for i in range(3):
        values = np.unique(few[:, i])
        if 1 < len(values) < len(few) / 2:
            steps[i] = np.diff(values).min()
    return steps


def intervals(t: Array, ratio: Array, multiplier: float) -> tuple[Index, Index]:
    """Return [first, last) of the stretches below the multiplier that last long enough."""
    still = np.concatenate([[False], ratio < multiplier, [False]])
    edges = np.flatnonzero(np.diff(still.astype(np.int8)))
    first, last = edges[::2], edges[1::2]
    long = t[last - 1] - t[first] >= _SHORTEST_S
    return first[long], last[long]


def _means(x: Array, first: Index, last: Index) -> Array:
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(x - x[0], axis=0)])
    out: Array = x[0] + (sums[last] - sums[first]) / (last - first)[:, None]
    return out


def _score(accel: Array, gravity: float, first: Index, last: Index) -> float:
    """Return log det of the accelerometer's information from these stands, or -inf where they cannot tell."""
    if len(first) < _SCANNED:
        return -np.inf
    seed = seed_accel(_means(accel, first, last), gravity)
    variance = float(np.sum(seed.misfit**2)) / (len(first) - 9)
    sign, logdet = np.linalg.slogdet(seed.information)
    return float(logdet - 9 * np.log(max(variance, 1e-30))) if sign > 0 else -np.inf


def _stands(t: Array, gyro: Array, accel: Array, first: Index, last: Index, multiplier: float) -> Stands:
    accel_mean, gyro_mean = _means(accel, first, last), _means(gyro, first, last)
    length = t[last - 1] - t[first] + float(np.median(np.diff(t)))
    cov_accel, _ = _covariance_of_means(t, accel, first, last, accel_mean, length)
    cov_gyro, white_gyro = _covariance_of_means(t, gyro, first, last, gyro_mean, length)
    return Stands(first, last, t[first], t[last - 1], accel_mean, cov_accel, gyro_mean, cov_gyro, white_gyro, multiplier)


def _covariance_of_means(t: Array, x: Array, first: Index, last: Index, mean: Array, length: Array) -> tuple[Array, Array]:
    """Return the covariance (n, 3, 3) of the stands' means and the noise density squared (3, 3).

    Batch means: blocks of a quarter of a second, a stand's own few shrunk towards those of all, times what blocks of a second say more
    where neighbours are alike for longer. Coarse steps that noise does not dither add their own error (Widrow 1996).
    """
    outer, freedom, pooled = _blocks(t, x, first, last, mean, _BLOCK_S)
    longer = float(np.trace(_blocks(t, x, first, last, mean, _LONG_BLOCK_S)[2])) / max(float(np.trace(pooled)), 1e-300)
    own = (outer + _POOLED_BLOCKS * pooled) / (freedom + _POOLED_BLOCKS)[:, None, None] * max(longer, 1.0)
    step = _quantum(x)
    variance = np.maximum(np.diag(pooled) / float(np.median(np.diff(t))), 1e-300)
    dither = 0.5 * (step / np.pi) ** 2 * np.exp(-4 * np.pi**2 * variance / np.where(step > 0, step, 1.0) ** 2)
    cov: Array = own / length[:, None, None] + np.diag(dither + step**2 * 1e-6 + 1e-300)
    return cov, pooled * max(longer, 1.0)


def _blocks(t: Array, x: Array, first: Index, last: Index, mean: Array, block_s: float) -> tuple[Array, Array, Array]:
    """Return per stand the sum of its blocks' scatter as density squared (n, 3, 3), their freedom (n,), and the density of all (3, 3)."""
    interval = float(np.median(np.diff(t)))
    per_block = max(round(block_s / interval), 2)
    counts = np.maximum((last - first) // per_block, 1)
    stand = np.repeat(np.arange(len(first)), counts)
    number = np.arange(len(stand)) - np.repeat(np.cumsum(counts) - counts, counts)
    begin = first[stand] + number * per_block
    of_block = _means(x, begin, np.minimum(begin + per_block, last[stand]))
    middle = np.zeros_like(mean)
    np.add.at(middle, stand, of_block / counts[stand, None])
    d = of_block - middle[stand]
    outer = np.zeros((len(first), 3, 3))
    np.add.at(outer, stand, d[:, :, None] * d[:, None, :] * per_block * interval)
    freedom = counts - 1
    total = outer.sum(axis=0) / max(int(freedom.sum()), 1)
    # Not above the median stand's: one stand that moves does not raise everyone's; its own blocks raise its own.
    some = freedom > 0
    median = float(np.median(np.trace(outer[some], axis1=1, axis2=2) / freedom[some])) if some.any() else 0.0
    few = 1.0 if np.median(freedom) >= _TRUSTED_MEDIAN else 1.5  # the median of a few squares is below their mean
    return outer, freedom, total * min(1.0, few * median / max(float(np.trace(total)), 1e-300))
