"""A sensor's orientation as a smooth function of time, from its gyroscope or its poses: what others are laid against at any instant.

Orientations on a uniform grid come from local quadratic regression on the rotation vectors of a few neighbours (Savitzky and Golay 1964,
with tricube weights, on uneven stamps): symmetric, so that it delays nothing, and smooth, so that the noise of what is read between
samples does not depend on where between them it is read (linear interpolation would pull every offset towards half a sample). Where
samples are sparse it reaches further, to two on either side.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples, PoseSamples, Times
from calibkit.errors import BadInputError
from calibkit.estimation.time_grid import TimeGrid, grid_over
from calibkit.estimation.turns import Index, gyro_steps, in_order
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

_REACH = 2.5  # samples to either side that the regression takes in
_LEAST_REACH_S = 0.012
_WIDER = 1.2  # reach over the farther one of the second neighbours, where that is more
_STEP_S = (0.0025, 0.01)  # of the grid
_CHUNK = 4096
_MOST = 64  # neighbours to either side
_HELD = 3.5  # median intervals; how a sensor turned in a longer gap is not known
_HELD_GYRO_S, _HELD_POSES_S = 0.03, 0.07  # unless it is shorter than this
_PAUSE_S = 1.0  # longer gaps are left out of the grid
_ENOUGH = 10_000  # samples that tell the noise
_LEAST = 4  # samples between two pauses; fewer tell no motion, and are often wrong stamps


@dataclass(frozen=True)
class OrientationTrack:
    """R_w_s on a grid, with the rate in the sensor's axes; w is any fixed frame."""

    origin_ns: int
    grid: TimeGrid
    q: Array  # (g, 4) xyzw
    rate: Array  # (g, 3) rad/s
    chain: NDArray[np.int32]  # (g,) orientations of different chains cannot be compared; -1 where there is none
    delta: Array  # (g - 1, 3) rotation vector from each grid point to the next
    rate_sigma: Array  # (3,) rad/s, noise of the rates after smoothing
    reach: float  # s; noise of rates is alike within it

    @property
    def step(self) -> float:
        return self.grid.step

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last, pauses included."""
        return self.grid.duration

    @cached_property
    def bend(self) -> Array:
        """Return (g - 1, 3) rad: by how much the way between two grid points would overshoot at the rate of its start, over four."""
        return np.asarray((0.5 * self.step) * (self.rate[:-1] - self.rate[1:]), np.float64)

    @cached_property
    def unknown(self) -> NDArray[np.int32]:
        """Return how many of the ways between grid points before each point (g,) are not known."""
        bad = (self.chain[:-1] < 0) | (self.chain[:-1] != self.chain[1:])
        return np.concatenate([[0], np.cumsum(bad)]).astype(np.int32)

    def followed(self, duration: float) -> float:
        """Return the share of the time from which on the track is known for so many s."""
        many = min(int(np.ceil(duration / self.step)), len(self.q) - 1)
        return float(np.mean(self.unknown[many:] == self.unknown[: len(self.q) - many]))

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
        place = self.grid.place(t)
        cell, _ = self._place(t)
        inside = (place >= 0) & (place <= len(self.q) - 1)
        return np.where(inside & (self.chain[cell] == self.chain[cell + 1]), self.chain[cell], -1)

    def _place(self, t: Array) -> tuple[NDArray[np.int64], Array]:
        place = np.clip(self.grid.place(np.asarray(t, float)), 0, len(self.q) - 1)
        cell = np.minimum(place.astype(np.int64), len(self.q) - 2)
        return cell, (place - cell)[..., None]


def track_of_gyro(samples: ImuSamples, bias: Array | None = None) -> OrientationTrack:
    """Return the orientation that a gyroscope (rad/s) adds up to, from its own start; gaps part it into chains."""
    order = _between_pauses(samples.t_ns, _HELD_GYRO_S, "gyroscope samples")
    t_ns, rate = samples.t_ns[order], samples.gyro[order] - (0.0 if bias is None else bias)
    return _smooth(t_ns, accumulate(so3.quat_exp(gyro_steps(t_ns, rate))), _noise(t_ns, rate), _HELD_GYRO_S, walked=True)


def track_of_poses(poses: PoseSamples) -> OrientationTrack:
    """Return the smoothed orientation of the poses' child in their parent; where they pause it is not known."""
    order = _between_pauses(poses.t_ns, _HELD_POSES_S, "poses")
    t_ns, q = poses.t_ns[order], poses.q[order]
    turned = np.cumsum(so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[:-1]), q[1:])), axis=0)
    return _smooth(t_ns, q, _noise(t_ns[1:], turned), _HELD_POSES_S, walked=False)


def _between_pauses(t_ns: Times, held_s: float, noun: str) -> Index:
    """Return the rows in the order of time, without those that lie alone between long pauses."""
    order = in_order(t_ns)
    t = t_ns[order]
    step = np.diff(t)
    pause = 1e9 * _pause(1e-9 * float(np.median(step)) if len(step) else 0.0, held_s)
    piece = np.concatenate([[0], np.cumsum(step > pause)])[: len(t)]
    order = order[np.bincount(piece)[piece] >= _LEAST] if len(t) else order
    if len(order) < 10:
        raise BadInputError(f"{len(order)} {noun} are too few to follow a motion: record 10 s or more")
    return order


def _held(interval: float, held_s: float) -> float:
    return max(_HELD * interval, held_s)


def _pause(interval: float, held_s: float) -> float:
    return max(_held(interval, held_s), _PAUSE_S)


def _noise(t_ns: Times, values: Array) -> Array:
    """Return sigma (3,) of white noise in values (n, 3), from divided differences of fifth order: motion is smooth, and drops out."""
    start = np.arange(0, len(t_ns) - 5, -(-len(t_ns) // _ENOUGH))[:, None] + np.arange(6)
    t = (t_ns[start] - t_ns[start[:, :1]]) * 1e-9
    apart = t[:, :, None] - t[:, None] + np.eye(6)
    weight = 1 / np.prod(apart / apart[:, -1:, :1], axis=2)
    weight /= np.linalg.norm(weight, axis=1, keepdims=True)
    return np.asarray(1.4826 * np.median(np.abs(np.einsum("wk,wki->wi", weight, values[start])), axis=0), np.float64)


def accumulate(q: Array) -> Array:
    """Return identity, q_0, q_0 q_1, ... (n + 1, 4), as many products at once as there are steps in one."""
    width = max(1, int(np.sqrt(len(q))))
    rows = -(-len(q) // width)
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    out = np.tile(identity, (rows * width + 1, 1))
    out[1 : len(q) + 1] = q
    table = out[1:].reshape(rows, width, 4)
    for k in range(1, width):
        table[:, k] = so3.quat_multiply(table[:, k - 1], table[:, k])
    start = identity
    for row in table:
        row[:] = so3.quat_multiply(start, row)
        start = row[-1] / np.linalg.norm(row[-1])
    return out[: len(q) + 1]


def _smooth(t_ns: Times, q: Array, sigma: Array, held_s: float, walked: bool) -> OrientationTrack:
    """Return the track through orientations with noise sigma (3,) rad; `walked`: through sums of rates with noise sigma rad/s."""
    t: Array = np.asarray((t_ns - t_ns[0]) * 1e-9, np.float64)
    interval = float(np.median(np.diff(t)))
    parted = np.concatenate([[0], np.cumsum(np.diff(t) > _held(interval, held_s))])
    grid = grid_over(t, float(np.clip(interval, *_STEP_S)), _pause(interval, held_s))
    at, size = grid.t, int(grid.first[-1])
    fitted, rate, power = np.empty((size, 4)), np.empty((size, 3)), np.empty(size)
    chain, delta = np.empty(size, np.int32), np.empty((size - 1, 3))
    for i in range(0, size, _CHUNK):
        rows = slice(i, i + _CHUNK)
        fitted[rows], rate[rows], chain[rows], power[rows] = _regress(at[rows], t, q, parted, interval, walked)
        rows = slice(max(i - 1, 0), min(i + _CHUNK, size) - 1)
        delta[rows] = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(fitted[rows]), fitted[rows.start + 1 : rows.stop + 1]))
    if not np.any((chain[1:] >= 0) & (chain[1:] == chain[:-1])):
        noun = "gyroscope samples" if walked else "poses"
        raise BadInputError(f"{len(t)} {noun} come too unevenly to follow a motion: record without losses, with the sensor's own stamps")
    gain = float(np.sqrt(np.mean(power[chain >= 0])))
    if not walked:
        np.minimum(chain, 0, out=chain)
    return OrientationTrack(int(t_ns[0]), grid, fitted, rate, chain, delta, gain * sigma, _reach(interval))


def _reach(interval: float) -> float:
    return max(_REACH * interval, _LEAST_REACH_S)


def _regress(
    grid: Array, t: Array, q: Array, parted: NDArray[np.int64], interval: float, walked: bool
) -> tuple[Array, Array, NDArray[np.int64], Array]:
    """Return orientation, rate and chain at the grid's instants, and the rate's variance for noise of unit variance.

    v(s) = v0 + v1 s + v2 s^2 by least squares, v = log(q_nearest^-1 q).
    """
    n, least = len(t), _reach(interval)
    most = min(int(np.ceil(least / interval)) + 1, _MOST)
    after, beyond = np.searchsorted(t, grid), np.searchsorted(t, grid, side="right")
    second, second_last = after + 1, beyond - 2
    centre = np.clip(after, 0, n - 1)
    near = centre[:, None] + np.arange(-most, most + 1)
    real = (near >= 0) & (near < n)
    real[:, -1] &= beyond > after  # as many before as after: one more would delay
    near = np.clip(near, 0, n - 1)
    known = (second_last >= 0) & (second < n)
    second, second_last = np.minimum(second, n - 1), np.maximum(second_last, 0)
    known &= parted[second_last] == parted[second]
    far = np.where(known, np.maximum(grid - t[second_last], t[second] - grid), 0.0)
    reach = np.maximum(least, _WIDER * far)[:, None]
    s = (t[near] - grid[:, None]) / reach
    inside = real & (np.abs(s) < 1) & (parted[near] == parted[second][:, None])
    w = np.where(inside, (1 - np.minimum(np.abs(s), 1) ** 3) ** 3, 0.0)
    moments = np.stack([np.sum(w * s**k, axis=1) for k in range(5)], axis=1)
    normal = moments[:, np.add.outer(np.arange(3), np.arange(3))]
    normal[~known] = np.eye(3)
    rows = np.linalg.inv(normal)[:, :2] @ (np.stack([w, w * s, w * s**2], axis=1))  # (g, 2, k): what v0 and v1 take of each neighbour
    v = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[centre])[:, None], q[near]))
    v0, v1 = np.moveaxis(rows @ v, 1, 0)
    rate = (so3.right_jacobian(v0) @ (v1 / reach)[..., None])[..., 0]
    weights = rows[:, 1] / reach
    if walked:  # what an orientation takes of each rate: of all before it
        weights = interval * np.cumsum(weights[:, ::-1], axis=1)[:, :-1]
    power: Array = np.sum(weights**2, axis=1)
    return so3.quat_multiply(q[centre], so3.quat_exp(v0)), rate, np.where(known, parted[second], -1), power
