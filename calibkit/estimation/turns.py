"""How a sensor turned between pairs of its stamps: what every source of rotation is brought to, before two of them are compared."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples, PoseSamples, Times
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

Index = NDArray[np.intp]

_LONGEST_NS = 1_000_000_000  # between two stamps; what happened in a longer pause is anyone's guess
_GAP = 1.75  # median intervals
_FAR_NS = 86_400e9  # from the middle one; a stamp further off is not set, or of another clock


@dataclass(frozen=True)
class Turns:
    """Rotation vectors in the sensor's own axes: exp(hat(angle_k)) = R_w_s(t[first_k])^T R_w_s(t[last_k]), |angle| < pi.

    With e_i the error of the orientation at stamp i and n_k the turn's own, angle_k = true + e_last - e_first + n_k to first order:
    turns that share a stamp share its error.
    """

    t_ns: Times  # (m,) increasing
    first: Index  # (n,) into t_ns, increasing
    last: Index  # (n,) > first
    angle: Array  # (n, 3) rad
    end_cov: Array | None = None  # (m, 3, 3) rad^2 of e_i, to a common factor; None: the same for all stamps and axes
    own_cov: Array | None = None  # (n, 3, 3) rad^2 of n_k, to a common factor; None: as white noise of a rate
    axes: tuple[bool, bool, bool] = (True, True, True)  # which are measured: a vehicle's odometer knows z alone

    def __post_init__(self) -> None:
        m, n = len(self.t_ns), len(self.first)
        if self.last.shape != (n,) or self.angle.shape != (n, 3):
            raise ValueError(f"Turns has {n} first, {self.last.shape} last and {self.angle.shape} angle")
        if n and not (np.all(self.last > self.first) and np.all(np.diff(self.first) >= 0) and self.first[0] >= 0 and self.last.max() < m):
            raise ValueError("Turns must go forward in time, sorted by their first stamp")
        for name, array, shape in (("end_cov", self.end_cov, (m, 3, 3)), ("own_cov", self.own_cov, (n, 3, 3))):
            if array is not None and array.shape != shape:
                raise ValueError(f"Turns.{name} has shape {array.shape}, expected {shape}")

    @property
    def duration(self) -> Array:
        """Seconds that each turn took, (n,)."""
        return np.asarray((self.t_ns[self.last] - self.t_ns[self.first]) * 1e-9, np.float64)

    @property
    def joined(self) -> NDArray[np.bool_]:
        """Whether each turn starts where the one before it ends, (n,)."""
        follows = self.first[1:] == self.last[:-1]
        return np.concatenate([np.zeros(min(len(self.first), 1), bool), follows])

    def select(self, rows: NDArray[np.generic] | slice) -> "Turns":
        """Return some of the turns (a mask, increasing indices or a slice), with no more stamps than they need."""
        first, last = self.first[rows], self.last[rows]
        start, stop = (int(first[0]), int(last.max()) + 1) if len(first) else (0, 0)
        end = None if self.end_cov is None else self.end_cov[start:stop]
        own = None if self.own_cov is None else self.own_cov[rows]
        return Turns(self.t_ns[start:stop], first - start, last - start, self.angle[rows], end, own, self.axes)


def in_order(t_ns: Times) -> Index:
    """Return the rows in the order of time, of equal stamps the first one only; without stamps more than a day off the middle one."""
    order = np.argsort(t_ns, kind="stable")
    order = order[np.abs(t_ns[order].astype(float) - np.median(t_ns)) <= _FAR_NS] if len(order) else order
    return order[np.concatenate([[True], np.diff(t_ns[order]) > 0])] if len(order) else order


def turns_of_poses(poses: PoseSamples) -> Turns:
    """Return how the poses' child turned from each pose to the next; a pose that repeats the one before to the last digit is none."""
    order = in_order(poses.t_ns)
    values = np.concatenate([poses.q, poses.p], axis=1)[order]
    order = order[np.concatenate([[True], np.any(np.diff(values, axis=0) != 0, axis=1)])] if len(order) else order
    q = poses.q[order]
    return turns_of_orientations(poses.t_ns[order], q)


def turns_of_gyro(samples: ImuSamples, interval: float = 0.02) -> Turns:
    """Return how a gyroscope turned over intervals of about `interval` s, bias included; none across gaps."""
    order = in_order(samples.t_ns)
    t_ns, rate = samples.t_ns[order], samples.gyro[order]
    h = np.diff(t_ns) * 1e-9
    typical = float(np.median(h)) if len(h) else interval
    many = max(1, round(interval / typical))
    steps = gyro_steps(t_ns, rate)
    whole = len(steps) // many * many
    q = so3.quat_exp(steps[:whole]).reshape(-1, many, 4)
    turned = q[:, 0]
    for k in range(1, many):
        turned = so3.quat_multiply(turned, q[:, k])
    angle = so3.quat_log(turned)
    stamps = t_ns[: whole + 1 : many]
    steady = (h[:whole].reshape(-1, many) < _GAP * typical).all(axis=1)
    first = np.flatnonzero(steady)
    moving = np.any(samples.gyro != 0, axis=0) if len(samples.gyro) else np.ones(3, bool)
    return Turns(stamps, first, first + 1, angle[first], axes=(bool(moving[0]), bool(moving[1]), bool(moving[2])))


def gyro_steps(t_ns: Times, rate: Array) -> Array:
    """Return the rotation vectors (n - 1, 3) between the stamps of rates (n, 3) in rad/s, linear in between.

    h (w0 + w1) / 2 + h^2 (w0 x w1) / 12, Magnus to fourth order (Iserles et al. 2000, Lie-group methods).
    """
    h = np.diff(t_ns)[:, None] * 1e-9
    return np.asarray(h * (rate[:-1] + rate[1:]) / 2 + h**2 * np.cross(rate[:-1], rate[1:]) / 12, np.float64)


def turns_of_orientations(t_ns: Times, q: Array, end_cov: Array | None = None) -> Turns:
    """Return the turns between consecutive orientations R_w_s (m, 4) xyzw that are less than a second and three quarters of pi apart."""
    angle = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[:-1]), q[1:]))
    near = (np.diff(t_ns) < _LONGEST_NS) & (np.linalg.norm(angle, axis=1) < 0.75 * np.pi)
    first = np.flatnonzero(near)
    return Turns(t_ns, first, first + 1, angle[first], end_cov)
