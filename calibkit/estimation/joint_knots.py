"""How fine the trajectory's knots must be: as coarse as the IMU's own samples allow."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots, basis

ORDER = 6
_RATES_ORDER = 4  # what accelerations of a trajectory of ORDER are
_SPACINGS = (0.1, 0.08, 0.06, 0.05, 0.04, 0.03, 0.025, 0.02, 0.015, 0.012, 0.01)  # s
_SAMPLES = 2.9  # of the IMU in a segment at least
_AS_GOOD = 1.02  # a coarser grid may leave this much more variance than the best


@dataclass(frozen=True)
class Fineness:
    """What each spacing leaves of the IMU's samples."""

    spacing: tuple[float, ...]  # s, coarse to fine
    variance: Array  # (s, 6) of what a spline of that spacing leaves of each axis, its freedom paid for

    @property
    def chosen(self) -> float:
        """Return the coarsest spacing that leaves no more than the best one, give or take 2 %."""
        relative = np.mean(self.variance / self.variance.min(axis=0), axis=1)
        return self.spacing[int(np.argmax(relative <= _AS_GOOD * relative.min()))]


def fineness(t: Array, rates: Array) -> Fineness:
    """Return how well splines of several spacings fit rates (n, 6) at times (n,) s, increasing: s^2 = SSE / (n - knots)."""
    interval = float(np.median(np.diff(t)))
    spacing = tuple(h for h in _SPACINGS if h >= _SAMPLES * interval) or (_SAMPLES * interval,)
    centred = rates - rates.mean(axis=0)
    return Fineness(spacing, np.array([_left(t, centred, h) for h in spacing]))


def _left(t: Array, rates: Array, spacing: float) -> Array:
    n, k = len(t), _RATES_ORDER
    knots = Knots(float(t[0]), spacing, k, int(np.floor((t[-1] - t[0]) / spacing)) + 1)
    i, u = knots.locate(t)
    B = basis(knots, u)
    ab, right = np.zeros((k, knots.controls)), np.zeros((knots.controls, rates.shape[1]))
    for a in range(k):
        np.add.at(right, i + a, B[:, a, None] * rates)
        for b in range(a + 1):
            np.add.at(ab[a - b], i + b, B[:, a] * B[:, b])
    met = int(np.sum(ab[0] > 0))
    ab[0] += 1e-9 * ab[0].max()  # gaps
    x = solveh_banded(ab, right, lower=True)
    left = rates - np.einsum("nl,nlc->nc", B, x[i[:, None] + np.arange(k)])
    variance: Array = np.sum(left**2, axis=0) / max(n - met, 1)
    return variance
