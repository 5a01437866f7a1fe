"""A sensor's orientation as a smooth function of time, from its gyroscope or its poses: what others are laid against at any instant.

Orientations on a uniform grid come from local quadratic regression on the rotation vectors of a few neighbours (Savitzky and Golay 1964,
with tricube weights, on uneven stamps): symmetric, so that it delays nothing, and smooth, so that the noise of what is read between
samples does not depend on where between them it is read (linear interpolation would pull every offset towards half a sample).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples, PoseSamples
from calibkit.errors import BadInputError
from calibkit.estimation.turns import in_order
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

_REACH = 2.5  # samples to either side that the regression takes in
_LEAST_REACH_S = 0.012
_STEP_S = (0.0025, 0.01)  # of the grid
_CHUNK = 4096
_MOST = 64  # neighbours to either side
_MOST_POINTS = 40_000_000  # of the grid, 90 bytes each
_HELD = 3.5  # median intervals; the rate across a longer gap in a gyroscope's stream is not known


@dataclass(frozen=True)
class OrientationTrack:
    """R_w_s on a uniform grid, with the rate in the sensor's axes; w is any fixed frame."""

    origin_ns: int
    step: float  # s
    q: Array  # (g, 4) xyzw
    rate: Array  # (g, 3) rad/s
    chain: NDArray[np.int64]  # (g,) orientations of different chains cannot be compared; -1 where there is none
    delta: Array  # (g - 1, 3) rotation vector from each grid point to the next
    rate_sigma: Array  # (3,) rad/s, noise of the rates after smoothing
    reach: float  # s; noise of rates is alike within it

    @cached_property
    def bend(self) -> Array:
        """Return (g - 1, 3) rad: by how much the way between two grid points would overshoot at the rate of its start, over four."""
        return np.asarray((0.5 * self.step) * (self.rate[:-1] - self.rate[1:]), np.float64)

    def orientation(self, t: Array) -> Array:
        """Return orientations (..., 4) at seconds from the origin; outside, those of the ends.

        Between grid points the rate is linear: phi(f) = f delta + f (1 - f) / 2 step (rate_0 - rate_1).
        """
        cell, f = self._place(t)
        phi = f * (self.delta[cell] + (1 - f) * self.bend[cell])
        return so3.quat_multiply(self.q[cell], so3.quat_exp(phi))

    def rate_at(self, t: Array) -> Array:
        """Return rates (..., 3) at seconds from the origin."""
        cell, f = self._place(t)
        return np.asarray((1 - f) * self.rate[cell] + f * self.rate[cell + 1], np.float64)

    def chain_at(self, t: Array) -> NDArray[np.int64]:
        """Return the chain (...) that seconds from the origin belong to; -1 where nothing is known."""
        cell, _ = self._place(t)
        inside = (t >= 0) & (t <= self.step * (len(self.q) - 1))
        return np.where(inside & (self.chain[cell] == self.chain[cell + 1]), self.chain[cell], -1)

    def _place(self, t: Array) -> tuple[NDArray[np.int64], Array]:
        place = np.clip(np.asarray(t, float) / self.step, 0, len(self.q) - 1)
        cell = np.minimum(place.astype(np.int64), len(self.q) - 2)
        return cell, (place - cell)[..., None]


def track_of_gyro(samples: ImuSamples, bias: Array | None = None) -> OrientationTrack:
    """Return the orientation that a gyroscope (rad/s) adds up to, from its own start; gaps part it into chains.

    Each interval turns by h (w0 + w1) / 2 + h^2 (w0 x w1) / 12 (Magnus to fourth order, Iserles et al. 2000, on a linear rate).
    """
    order = in_order(samples.t_ns)
    t_ns, rate = samples.t_ns[order], samples.gyro[order] - (0.0 if bias is None else bias)
    if len(t_ns) < 10:
        raise BadInputError(f"{len(t_ns)} gyroscope samples are too few to follow a motion: record 10 s or more")
    sigma = _noise(rate, 5)
    t_ns, rate = _filled(t_ns, rate)
    h = np.diff(t_ns)[:, None] * 1e-9
    steps = h * (rate[:-1] + rate[1:]) / 2 + h**2 * np.cross(rate[:-1], rate[1:]) / 12
    parted = np.concatenate([[0], np.cumsum(h[:, 0] > max(_HELD * float(np.median(h)), 2 * _LEAST_REACH_S))])
    return _smooth(t_ns, accumulate(so3.quat_exp(steps)), parted, sigma, walked=True)


def _filled(t_ns: NDArray[np.int64], rate: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the samples with those that are missing put in on a straight line, where no more than two or three in a row are."""
    h = np.diff(t_ns)
    typical = float(np.median(h))
    short = (h > 1.5 * typical) & (h <= max(_HELD * typical, 2e9 * _LEAST_REACH_S))
    missing = np.where(short, np.maximum(np.rint(h / typical).astype(np.int64) - 1, 1), 0)
    after = np.repeat(np.arange(len(h)), missing)
    nth = np.arange(len(after)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    f = nth / (missing[after] + 1)
    t_new = t_ns[after] + np.rint(f * h[after]).astype(np.int64)
    rate_new = rate[after] + f[:, None] * (rate[after + 1] - rate[after])
    t_all, rate_all = np.concatenate([t_ns, t_new]), np.concatenate([rate, rate_new])
    order = np.argsort(t_all, kind="stable")
    return t_all[order], rate_all[order]


def track_of_poses(poses: PoseSamples) -> OrientationTrack:
    """Return the smoothed orientation of the poses' child in their parent; where they pause it is not known."""
    order = in_order(poses.t_ns)
    if len(order) < 10:
        raise BadInputError(f"{len(order)} poses are too few to follow a motion: record 10 s or more")
    t_ns, q = poses.t_ns[order], poses.q[order]
    steps = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[:-1]), q[1:]))
    return _smooth(t_ns, q, np.zeros(len(order), np.int64), _noise(steps, 4), walked=False)


def _noise(values: Array, order: int) -> Array:
    """Return sigma (3,) of white noise in values that are differenced to the fifth order in all: motion is smooth, and drops out."""
    return np.asarray(1.4826 * np.median(np.abs(np.diff(values, order, axis=0)), axis=0) / np.sqrt(252), np.float64)


def accumulate(q: Array) -> Array:
    """Return identity, q_0, q_0 q_1, ... (n + 1, 4), as many products at once as there are steps in one."""
    width = max(1, int(np.sqrt(len(q))))
    rows = -(-len(q) // width)
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    padded = np.tile(identity, (rows * width, 1))
    padded[: len(q)] = q
    table = padded.reshape(rows, width, 4)
    for k in range(1, width):
        table[:, k] = so3.quat_multiply(table[:, k - 1], table[:, k])
    start = identity
    for row in table:
        row[:] = so3.quat_multiply(start, row)
        start = row[-1] / np.linalg.norm(row[-1])
    return np.concatenate([identity[None], padded[: len(q)]])


def _smooth(t_ns: NDArray[np.int64], q: Array, parted: NDArray[np.int64], sigma: Array, walked: bool) -> OrientationTrack:
    """Return the track through orientations with noise sigma (3,) rad; `walked`: through sums of rates with noise sigma rad/s."""
    t: Array = np.asarray((t_ns - t_ns[0]) * 1e-9, np.float64)
    interval = float(np.median(np.diff(t)))
    reach = max(_REACH * interval, _LEAST_REACH_S)
    step = float(np.clip(interval, *_STEP_S))
    if t[-1] > _MOST_POINTS * step:
        raise BadInputError(f"its {len(t)} stamps span {t[-1] / 3600:.0f} h: cut it, or correct stamps that are far from the others")
    grid: Array = np.arange(int(t[-1] / step) + 1, dtype=float) * step
    parts = [_regress(grid[i : i + _CHUNK], t, q, parted, reach, interval, walked) for i in range(0, len(grid), _CHUNK)]
    fitted, rate, chain, power = (np.concatenate(each) for each in zip(*parts, strict=True))
    delta = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(fitted[:-1]), fitted[1:]))
    gain = float(np.sqrt(np.median(power)))
    return OrientationTrack(int(t_ns[0]), step, fitted, rate, chain, delta, gain * sigma, reach)


def _regress(
    grid: Array, t: Array, q: Array, parted: NDArray[np.int64], reach: float, interval: float, walked: bool
) -> tuple[Array, Array, NDArray[np.int64], Array]:
    """Return orientation, rate and chain at the grid's instants, and the rate's variance for noise of unit variance.

    v(s) = v0 + v1 s + v2 s^2 by least squares, v = log(q_nearest^-1 q).
    """
    most = min(int(np.ceil(reach / interval)) + 1, _MOST)
    centre = np.clip(np.searchsorted(t, grid), 0, len(t) - 1)
    near = centre[:, None] + np.arange(-most, most + 1)
    real = (near >= 0) & (near < len(t))
    near = np.clip(near, 0, len(t) - 1)
    s = t[near] - grid[:, None]
    inside = real & (np.abs(s) < reach)
    w = np.where(inside, (1 - np.minimum(np.abs(s) / reach, 1) ** 3) ** 3, 0.0)
    s = s / reach
    moments = np.stack([np.sum(w * s**k, axis=1) for k in range(5)], axis=1)
    normal = moments[:, np.add.outer(np.arange(3), np.arange(3))]
    around = (np.sum(inside & (s <= 0), axis=1) >= 2) & (np.sum(inside & (s >= 0), axis=1) >= 2) & (inside.sum(axis=1) >= 4)
    first, last = np.where(inside, near, len(t)).min(axis=1), np.where(inside, near, -1).max(axis=1)
    known = around & (parted[np.minimum(first, len(t) - 1)] == parted[last])
    normal[~known] = np.eye(3)
    rows = np.linalg.inv(normal)[:, :2] @ (np.stack([w, w * s, w * s**2], axis=1))  # (g, 2, k): what v0 and v1 take of each neighbour
    v = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[centre])[:, None], q[near]))
    v0, v1 = np.moveaxis(rows @ v, 1, 0)
    rate = (so3.right_jacobian(v0) @ (v1 / reach)[..., None])[..., 0]
    weights = rows[:, 1] / reach
    if walked:  # what an orientation takes of each rate: of all before it
        weights = interval * np.cumsum(weights[:, ::-1], axis=1)[:, :-1]
    power: Array = np.sum(weights**2, axis=1)
    return so3.quat_multiply(q[centre], so3.quat_exp(v0)), rate, np.where(known, parted[centre], -1), power
