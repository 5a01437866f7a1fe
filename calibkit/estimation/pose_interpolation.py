"""A pose stream between its stamps: pose, twist and how far the curve between the neighbours may be off.

Around each instant t, four neighbours' poses in the tangent of the nearest one are fitted by a quadratic with tricube weights (Savitzky
and Golay 1964 on uneven stamps), v(s) = v0 + v1 s + v2 s^2, v = (R_n^T (p - p_n), log R_n^T R). Nothing is read beyond the ends nor
across gaps.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import PoseSamples, Times
from calibkit.errors import BadInputError
from calibkit.estimation.board_poses import BoardPoses
from calibkit.estimation.turns import in_order
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

LONGEST_GAP = 3.5  # median intervals
_SIDE = 2  # neighbours to each side
_WIDER = 1.2  # reach of the weights over the farthest neighbour
_REST_NS = 300_000_000  # for as long, a robot that stands still repeats its pose
_SAME_NS = 1000  # a sample as near as this to the instant serves where there is no curve
_CHUNK = 20_000


@dataclass(frozen=True)
class PoseStream:
    """T_w_s (n, 4, 4) of one sensor, as the recording had it or `clean`."""

    name: str
    t_ns: Times  # (n,)
    T: Array  # (n, 4, 4)
    cov: Array | None = None  # (n, 6, 6) right tangent
    labels: tuple[str, ...] = ()  # (n,) image names; empty: its stamps are what poses are called by

    @property
    def interval(self) -> float:
        """Median seconds between stamps, inf where there are fewer than two."""
        return float(np.median(np.diff(self.t_ns))) * 1e-9 if len(self.t_ns) > 1 else np.inf

    def select(self, rows: Index | Mask) -> "PoseStream":
        """Return some of the poses."""
        labels = tuple(np.array(self.labels, object)[rows]) if self.labels else ()
        return replace(self, t_ns=self.t_ns[rows], T=self.T[rows], cov=None if self.cov is None else self.cov[rows], labels=labels)


@dataclass(frozen=True)
class Interpolated:
    """What a stream was at n instants; where it is not known, the nearest pose."""

    T: Array  # (n, 4, 4)
    twist: Array  # (n, 6) (m/s, rad/s) in the sensor's axes: T(t + s) = retract(T, twist s); 0 where it is not known
    cov: Array | None  # (n, 6, 6) of the neighbours, not averaged: a robot's error goes with its pose
    curve_cov: Array  # (n, 6, 6) of the curve between them
    known: Mask  # (n,)


def stream_of(name: str, poses: PoseSamples) -> PoseStream:
    """Return the stream T_parent_child."""
    return PoseStream(name, poses.t_ns, se3.make(so3.from_quat(poses.q), poses.p))


def stream_of_board(poses: BoardPoses) -> PoseStream:
    """Return the stream T_board_cam: T_cam_board exp(d) has the inverse exp(-d) T = T exp(-Ad(T_cam_board) d)."""
    Ad = se3.adjoint(poses.T_cam_board)
    return PoseStream(poses.camera, poses.t_ns, se3.inverse(poses.T_cam_board), Ad @ poses.cov @ np.swapaxes(Ad, 1, 2), poses.labels)


def inverted(stream: PoseStream) -> PoseStream:
    """Return T_s_w, with its covariance."""
    Ad = se3.adjoint(stream.T)
    cov = None if stream.cov is None else Ad @ stream.cov @ np.swapaxes(Ad, 1, 2)
    return replace(stream, T=se3.inverse(stream.T), cov=cov)


def in_time(stream: PoseStream) -> PoseStream:
    """Return the stream in the order of time, of equal stamps the first; stamps that are not set are left out."""
    out = stream.select(in_order(stream.t_ns))
    if len(out.t_ns) < 2:
        raise BadInputError(f"{stream.name}: {len(out.t_ns)} poses with stamps are no stream: give a recording, or pairs by name")
    return out


def held(stream: PoseStream) -> Mask:
    """Return which poses (n,) of a stream in time repeat the one before to the last digit, and tell of no instant of their own.

    A longer run of them is a rest.
    """
    new = np.concatenate([[True], np.any(np.diff(stream.T, axis=0) != 0, axis=(1, 2))])
    start = np.flatnonzero(new)
    end = np.concatenate([start[1:], [len(new)]]) - 1
    rest = stream.t_ns[end] - stream.t_ns[start] >= _REST_NS
    return np.asarray(~new & ~np.repeat(rest, end - start + 1))


def without_repeats(stream: PoseStream) -> PoseStream:
    """Return the stream (in time) without held poses."""
    return stream.select(~held(stream))


def interpolate(stream: PoseStream, t_ns: Times) -> Interpolated:
    """Return the stream (in time, without repeats) at t_ns (n,).

    The curve's covariance is the mean of r r^T (gap / gap_r)^2, r what the four nearest samples are off the curve of the others across a
    gap_r: noise and all, so that it errs to the large side (on simulated motions by 1.2 to 1.6 without noise).
    """
    parts = [_interpolate(stream, t_ns[i : i + _CHUNK]) for i in range(0, max(len(t_ns), 1), _CHUNK)]
    T, twist, curve, known = (np.concatenate([getattr(part, name) for part in parts]) for name in ("T", "twist", "curve_cov", "known"))
    cov = None if stream.cov is None else np.concatenate([part.cov for part in parts if part.cov is not None])
    return Interpolated(T, twist, cov, curve, known)


def _interpolate(stream: PoseStream, t_ns: Times) -> Interpolated:
    n, longest = len(stream.t_ns), LONGEST_GAP * stream.interval * 1e9
    after = np.searchsorted(stream.t_ns, t_ns, side="left")
    near = after[:, None] + np.arange(-_SIDE, _SIDE)
    inner = np.clip(after, 1, n - 1)
    gap = (stream.t_ns[inner] - stream.t_ns[inner - 1]) * 1e-9
    nearest = np.where(t_ns - stream.t_ns[inner - 1] < stream.t_ns[inner] - t_ns, inner - 1, inner)
    between = (after > 0) & (after < n) & (gap * 1e9 <= longest)
    T, twist, weights, rows = _curve(stream, t_ns, near, nearest)
    touched = ~between & (np.abs(stream.t_ns[nearest] - t_ns) <= _SAME_NS)
    T = np.where(between[:, None, None], T, stream.T[nearest])
    twist = np.where(between[:, None], twist, 0.0)
    cov = None
    if stream.cov is not None:
        share = np.abs(weights) / np.abs(weights).sum(axis=1, keepdims=True)
        cov = np.where(between[:, None, None], np.einsum("nk,nkij->nij", share, stream.cov[rows]), stream.cov[nearest])
    return Interpolated(T, twist, cov, _curve_cov(stream, inner, np.asarray(gap, np.float64)) * between[:, None, None], between | touched)


def _curve_cov(stream: PoseStream, inner: Index, gap: Array) -> Array:
    """Return (n, 6, 6) of the curve in the gap before sample `inner`."""
    n = len(stream.t_ns)
    beside = np.clip(inner[:, None] + np.arange(-2, 2), 0, n - 1)
    used, back = np.unique(beside, return_inverse=True)
    others = used[:, None] + np.concatenate([np.arange(-_SIDE, 0), np.arange(1, _SIDE + 1)])
    T, _, _, _ = _curve(stream, stream.t_ns[used], others, np.where(used > 0, used - 1, 1))
    r = se3.local(T, stream.T[used])
    across = (stream.t_ns[np.minimum(used + 1, n - 1)] - stream.t_ns[np.maximum(used - 1, 0)]) * 1e-9
    inside = (used > 0) & (used < n - 1)
    scaled = np.where(inside, 1 / np.maximum(across, 1e-9), 0.0)[:, None] * r
    count = np.maximum(inside[back.reshape(beside.shape)].sum(axis=1), 1)
    each = scaled[back.reshape(beside.shape)] * (gap / np.sqrt(count))[:, None, None]
    return np.asarray(np.swapaxes(each, 1, 2) @ each, np.float64)


def _curve(stream: PoseStream, t_ns: Times, near: Index, centre: Index) -> tuple[Array, Array, Array, Index]:
    """Return pose (n, 4, 4) and twist (n, 6) of the local curves, the neighbours' weights in the pose (n, k), and the neighbours."""
    n, longest = len(stream.t_ns), LONGEST_GAP * stream.interval * 1e9
    rows = np.clip(near, 0, n - 1)
    t = stream.t_ns[rows]
    half = near.shape[1] // 2
    # Neighbours beyond another gap, on either side, are not of this piece of the curve.
    joined = np.ones(near.shape, bool)
    step = np.diff(t, axis=1) <= longest
    joined[:, : half - 1] = np.flip(np.cumprod(np.flip(step[:, : half - 1], axis=1), axis=1), axis=1)
    joined[:, half + 1 :] = np.cumprod(step[:, half:], axis=1)
    inside = (near >= 0) & (near < n) & joined
    s = (t - t_ns[:, None]) * 1e-9
    reach = _WIDER * np.maximum(np.max(np.abs(s) * inside, axis=1, keepdims=True), 1e-9)
    x = s / reach
    w = np.where(inside, (1 - np.minimum(np.abs(x), 1) ** 3) ** 3, 0.0)
    bends = (inside[:, :half].sum(axis=1) >= 2) & (inside[:, half:].sum(axis=1) >= 2)
    w[~bends] *= np.isin(np.arange(2 * half), (half - 1, half))  # else straight from one to the next
    moments = np.stack([np.sum(w * x**k, axis=1) for k in range(5)], axis=1)
    normal = moments[:, np.add.outer(np.arange(3), np.arange(3))]
    normal[~bends, 2] = normal[~bends, :, 2] = 0
    normal[~bends, 2, 2] = 1
    powers = np.stack([w, w * x, w * x**2], axis=1)
    powers[~bends, 2] = 0
    lonely = (w > 0).sum(axis=1) < 2
    normal[lonely] = np.eye(3)
    take = np.linalg.inv(normal)[:, :2] @ powers
    v = se3.local(stream.T[centre][:, None], stream.T[rows])
    v0, v1 = np.moveaxis(take @ v, 1, 0)
    v1 = v1 / reach
    T = se3.retract(stream.T[centre], v0)
    back = so3.exp(-v0[:, 3:])
    twist = np.concatenate([(back @ v1[:, :3, None])[:, :, 0], (so3.right_jacobian(v0[:, 3:]) @ v1[:, 3:, None])[:, :, 0]], axis=1)
    return T, twist, take[:, 0], rows
