"""Where two sensors on one rig both stood still: the rests of a stop-and-go recording, each averaged to one pair of poses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import Times
from calibkit.estimation.pose_interpolation import LONGEST_GAP, PoseStream
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Intervals = list[tuple[float, float]]

LEAST_REST_S = 0.3
_WINDOW_S = 0.2  # stillness is judged over this
_FEWEST = 3  # poses in a window; a slower stream cannot show that it is still, and the other one's word is taken
_LOUDER = 2.5  # sigmas of the stream's noise: what a window may scatter by
_FLOOR = 1e-4  # m and rad: creeping by less does no harm
_SAME = 10 * _FLOOR  # m and rad between neighbouring rests: one that something shook
_APART_S = 1.0
_OUTSIDE = 6.0  # median distances from the median
_MOST_ALIKE = 10.0  # poses of one rest that count: a lens's error and a robot's are the same in all of them


@dataclass(frozen=True)
class Rests:
    """One stream's mean pose in each rest."""

    T: Array  # (r, 4, 4)
    cov: Array | None  # (r, 6, 6) right tangent
    count: Index  # (r,) poses averaged
    middle: Index  # (r,) row of the stream in the middle of each


def common_rests(first: PoseStream, second: PoseStream, margin_s: float) -> tuple[Times, Times]:
    """Return start and end (r,) ns of rests of both streams (in time, on one clock), `margin_s` taken off each end."""
    t0 = int(first.t_ns[0])
    one, two = ([(b, e) for b, e in zip(*still, strict=True)] if (still := _still(s, t0)) is not None else None for s in (first, second))
    if one is None and two is None:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    both = two if one is None else one if two is None else _intersection(one, two)
    assert both is not None
    long = [(b + margin_s, e - margin_s) for b, e in _merged(first if one is not None else second, t0, both)]
    at = np.array([(b, e) for b, e in long if e - b >= LEAST_REST_S - 2 * margin_s - _WINDOW_S / 2 and e > b]).reshape(-1, 2)
    begin, end = (t0 + np.round(at * 1e9).astype(np.int64)).T
    seen = [np.searchsorted(s.t_ns, end, side="right") > np.searchsorted(s.t_ns, begin) for s in (first, second)]
    return begin[seen[0] & seen[1]], end[seen[0] & seen[1]]


def averaged(stream: PoseStream, begin: Times, end: Times) -> Rests:
    """Return the mean of the stream's poses in each rest, those far from its median left out.

    The rotation is the mean of chords (Hartley et al. 2013, 5.3); the covariance is the poses' mean over n (1 - rho) / (1 + rho),
    rho the correlation of neighbours over all rests, at most 10.
    """
    first, last = np.searchsorted(stream.t_ns, begin), np.searchsorted(stream.t_ns, end, side="right")
    T, left, rows = [], [], []
    for b, e in zip(first, last, strict=True):
        at = np.arange(b, e)
        middle = se3.make(so3.project(np.median(stream.T[at, :3, :3], axis=0)), np.median(stream.T[at, :3, 3], axis=0))
        off = se3.local(middle, stream.T[at])
        far = np.stack([np.linalg.norm(off[:, part], axis=1) for part in (slice(0, 3), slice(3, 6))])
        at = at[np.all(far <= _OUTSIDE * np.median(far, axis=1, keepdims=True) + _FLOOR, axis=0)]
        at = np.arange(b, e) if not len(at) else at
        mean = se3.make(so3.project(stream.T[at, :3, :3].mean(axis=0)), stream.T[at, :3, 3].mean(axis=0))
        T.append(mean)
        rows.append(at)
        left.append(se3.local(mean, stream.T[at]))
    count = np.array([len(at) for at in rows], np.intp)
    rho = _correlation(left)
    cov = None
    if stream.cov is not None:
        many = np.clip(count * (1 - rho) / (1 + rho), 1, _MOST_ALIKE)
        cov = np.stack([stream.cov[at].mean(axis=0) for at in rows]) / many[:, None, None]
    return Rests(np.stack(T), cov, count, np.array([at[len(at) // 2] for at in rows], np.intp))


def distinct(T: Array, angle: float) -> int:
    """Return how many of the poses (r, 4, 4) differ from one another by `angle` rad or more."""
    kept = np.zeros((0, 3, 3))
    for R in T[:, :3, :3]:
        if np.all(np.linalg.norm(so3.log(np.swapaxes(kept, 1, 2) @ R), axis=1) >= angle):
            kept = np.concatenate([kept, R[None]])
    return len(kept)


def _correlation(left: list[Array]) -> float:
    """Return the correlation of neighbours, 0 ... 0.99, of residuals of many rests; a rest's own mean takes one of its freedoms."""
    scale = np.sqrt(np.mean(np.concatenate(left) ** 2, axis=0)) + 1e-12
    products = sum(float(np.sum(r[1:] * r[:-1] / scale**2)) for r in left)
    squares = sum(float(np.sum(r * r / scale**2)) * (len(r) - 1) / len(r) for r in left)
    return float(np.clip(products / squares, 0, 0.99)) if squares > 0 else 0.0


def _still(stream: PoseStream, t0: int) -> tuple[Array, Array] | None:
    """Return start and end (k,) s from t0 where the stream is still; None where it is too slow to show it."""
    if stream.interval * _FEWEST > _WINDOW_S * 1.5:
        return None
    t: Array = np.asarray((stream.t_ns - t0) * 1e-9, np.float64)
    half = max(_WINDOW_S, _FEWEST * stream.interval) / 2
    first, last = np.searchsorted(t, t - half), np.searchsorted(t, t + half, side="right")
    whole = (last - first >= _FEWEST) & (t[first] <= t - half / 2) & (t[last - 1] >= t + half / 2)
    # Of a turn phi, |R exp(phi) - R|^2 = 2 |phi|^2.
    columns = (stream.T[:, :3, 3] - stream.T[0, :3, 3], stream.T[:, :3, :3].reshape(-1, 9) / np.sqrt(2))
    still = whole
    for x, sigma in zip(columns, _noise(stream), strict=True):
        sums = [np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(power, axis=0)]) for power in (x, x * x)]
        n = (last - first)[:, None]
        mean, square = ((s[last] - s[first]) / n for s in sums)
        still = still & (np.sum(square - mean**2, axis=1) <= 3 * (_LOUDER * sigma) ** 2 + _FLOOR**2)
    still[1:] &= np.diff(t) <= max(LONGEST_GAP * stream.interval, half)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    begin, end = edges[::2], edges[1::2] - 1
    return np.maximum(t[begin] - half / 2, t[0]), np.minimum(t[end] + half / 2, t[-1])


def _noise(stream: PoseStream) -> tuple[float, float]:
    """Return sigma of a coordinate, m and rad, by fourth differences: motion is smooth, and drops out."""
    turns = so3.log(np.swapaxes(stream.T[:-1, :3, :3], 1, 2) @ stream.T[1:, :3, :3])
    found = []
    for values, order in ((stream.T[:, :3, 3], 4), (turns, 3)):
        d = np.diff(values, order, axis=0)
        found.append(float(1.4826 * np.median(np.abs(d)) / np.sqrt(70)) if len(d) else 0.0)
    return found[0], found[1]


def _intersection(one: Intervals, two: Intervals) -> Intervals:
    out, i, j = [], 0, 0
    while i < len(one) and j < len(two):
        begin, end = max(one[i][0], two[j][0]), min(one[i][1], two[j][1])
        if begin < end:
            out.append((begin, end))
        i, j = (i + 1, j) if one[i][1] < two[j][1] else (i, j + 1)
    return out


def _merged(stream: PoseStream, t0: int, rests: Intervals) -> Intervals:
    """Return the rests with neighbours less than a second apart at one place joined."""
    out: Intervals = []
    for begin, end in rests:
        if out and begin - out[-1][1] < _APART_S:
            a, b = (stream.T[np.searchsorted(stream.t_ns, t0 + round(1e9 * t)) - 1] for t in (out[-1][1], begin + _WINDOW_S / 2))
            step = se3.local(a, b)
            sigma = _LOUDER * np.array(_noise(stream)) + _SAME
            if np.linalg.norm(step[:3]) < 2 * sigma[0] and np.linalg.norm(step[3:]) < 2 * sigma[1]:
                out[-1] = (out[-1][0], end)
                continue
        out.append((begin, end))
    return out
