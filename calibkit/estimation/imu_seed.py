"""First guesses of an IMU's scale, bias and axes, good enough for Gauss-Newton, whatever the units."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry.so3 import hat
from calibkit.models.imu import lower

Array = NDArray[np.float64]

_ROWS, _COLUMNS = np.tril_indices(3)
_NOMINAL = 0.1  # how far scales may differ and axes lean, relative: rules only where the positions leave a number open
_MISFIT = 1e-3  # of gravity, beside it
_STEPS = 8


@dataclass(frozen=True)
class AccelSeed:
    """a_meas = M a + b of positions at rest, and how far |a| is from gravity in each."""

    M: Array  # (3, 3) lower triangular
    b: Array  # (3,)
    misfit: Array  # (n,) |a| / gravity - 1
    information: Array  # (9, 9) of M^-1 and b relative to nominal, per unit variance of the misfit

    def directions(self, accel: Array) -> Array:
        """Return the unit vectors (n, 3) of measured rest values: up, in the IMU's frame."""
        a = (accel - self.b) @ np.linalg.inv(self.M).T
        out: Array = a / np.linalg.norm(a, axis=-1, keepdims=True)
        return out


def seed_accel(accel: Array, gravity: float) -> AccelSeed:
    """Return M and b from means (n, 3) at rest by | L (a - b) | = gravity, L lower triangular (Tedaldi 2014, eq. 10).

    First a sphere through the points, its centre the nearest to their mean where they leave it open; then Gauss-Newton on L and b.
    """
    middle = accel.mean(axis=0)
    centred = accel - middle
    spread = float(np.sqrt(np.mean(centred**2))) or 1.0
    x = centred / spread
    solution = np.linalg.lstsq(np.column_stack([2 * x, np.ones(len(x))]), np.sum(x**2, axis=1), rcond=1e-2)[0]
    centre = solution[:3]
    radius = np.sqrt(max(solution[3] + centre @ centre, 1e-6))
    x = (x - centre) / radius
    values = np.zeros(9)
    values[[0, 2, 5]] = 1.0
    nominal = values.copy()
    J = np.zeros((len(x), 9))
    for _ in range(_STEPS):
        v = x @ lower(values[:6]).T - values[6:]
        length = np.linalg.norm(v, axis=1)
        unit = v / length[:, None]
        J = np.concatenate([unit[:, _ROWS] * x[:, _COLUMNS], -unit], axis=1)
        weight = _MISFIT / _NOMINAL
        rows = np.concatenate([J, weight * np.eye(9)])
        values = values + np.linalg.lstsq(rows, np.concatenate([1 - length, weight * (nominal - values)]), rcond=None)[0]
    L = lower(values[:6])
    v = x @ L.T - values[6:]
    scale = spread * radius
    inverse = np.linalg.inv(L)
    M = inverse * scale / gravity
    sign = np.where(np.diag(M) < 0, -1.0, 1.0)
    return AccelSeed(M * sign, middle + spread * centre + scale * inverse @ values[6:], np.linalg.norm(v, axis=1) - 1, J.T @ J)


def seed_gyro(t: Array, gyro: Array, up: Array, moving: NDArray[np.bool_]) -> Array:
    """Return K (3, 3) of omega = K gyro (bias removed) from how the accelerometer's direction `up` (n, 3) turns: d up / dt = up x omega.

    Linear in K over pieces of about a fifth of a second, the hand's own accelerations taken for chance.
    """
    rate = 1 / float(np.median(np.diff(t)))
    size = max(round(0.2 * rate), 1)
    n = (len(t) - 1) // size
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(t)[:, None], axis=0)])
    at = np.arange(n + 1) * size
    smooth = np.add.reduceat(up, at[:-1], axis=0)
    smooth = smooth / np.linalg.norm(smooth, axis=1, keepdims=True)
    middle = at[:-1] + size // 2
    turned = angle[middle[1:]] - angle[middle[:-1]]
    ends, starts = smooth[1:], smooth[:-1]
    turning = np.logical_or.reduceat(moving, at[:-1])[:-1]
    mean = 0.5 * (ends + starts)[turning]
    J = np.einsum("nij,nk->nijk", hat(mean), turned[turning]).reshape(-1, 9)
    right = (ends - starts)[turning].ravel()
    weight = np.ones(len(right))
    size_of_turn = float(np.sqrt(np.mean(turned**2))) or 1.0
    K = np.zeros(9)
    for _ in range(5):
        K = np.linalg.lstsq(J / size_of_turn * weight[:, None], right * weight, rcond=1e-3)[0]
        r = np.abs(right - J / size_of_turn @ K)
        weight = 1 / np.sqrt(1 + (r / (3 * np.median(r) + 1e-12)) ** 2)
    return K.reshape(3, 3) / size_of_turn
