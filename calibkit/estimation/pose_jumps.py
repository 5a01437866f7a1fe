"""Poses that jump away from their neighbours in a stream and back, as a tracker's that has lost its target: by the medoid of a window."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import PoseSamples
from calibkit.estimation.pose_interpolation import PoseStream, stream_of
from calibkit.estimation.turns import in_order
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

_HALF = 7  # poses on either side: of 30 % wrong ones one window in 20 has no majority of right ones
_BEYOND = 3.0  # times the window's spread, which holds how fast it turns and moves
_LEAST = (np.radians(3.0), 0.05)  # rad, m
_LONGEST_S = 0.75  # from a window's middle to its end: in a longer time a robot goes somewhere and back
_ROUNDS = 3
TOLD = 0.01  # of the poses, from which on they are told of
_CHUNK = 20_000


def jumps(stream: PoseStream) -> NDArray[np.bool_]:
    """Return which poses (n,) lie far, by turn or place, from the one of their window that is nearest to all of it, by its own spread.

    None of a slow stream, in whose windows a motion looks alike.
    """
    wrong = np.zeros(len(stream.t_ns), bool)
    for _ in range(_ROUNDS if _HALF * stream.interval < _LONGEST_S else 0):  # what is left stands beside better neighbours
        rows = np.flatnonzero(~wrong)
        if len(rows) <= 2 * _HALF:
            break
        far = rows[_far(stream.T[rows])]
        wrong[far] = True
        if not len(far):
            break
    return wrong


def without_jumps(poses: PoseSamples) -> tuple[PoseSamples, float]:
    """Return the poses in the order of time without those that jump away and back, and the share of these."""
    rows = in_order(poses.t_ns)
    wrong = jumps(stream_of(poses.child, poses).select(rows))
    rows = rows[~wrong]
    return replace(poses, t_ns=poses.t_ns[rows], q=poses.q[rows], p=poses.p[rows]), float(np.mean(wrong)) if len(wrong) else 0.0


def _far(T: Array) -> NDArray[np.bool_]:
    q, p, n = so3.to_quat(T[:, :3, :3]), T[:, :3, 3], len(T)
    apart = np.zeros((2, 2 * _HALF + 1, n))  # by turn and by place, of pose i and pose i + lag
    for lag in range(1, 2 * _HALF + 1):
        apart[0, lag, :-lag] = 2 * np.arccos(np.clip(np.abs(np.einsum("ni,ni->n", q[:-lag], q[lag:])), 0, 1))
        apart[1, lag, :-lag] = np.linalg.norm(p[lag:] - p[:-lag], axis=1)
    first = np.clip(np.arange(n) - _HALF, 0, n - 2 * _HALF - 1)
    own = np.arange(n) - first
    i, j = np.indices((2 * _HALF + 1,) * 2)
    lag, low = np.abs(i - j), np.minimum(i, j)
    out = np.zeros(n, bool)
    for start in range(0, n, _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, n))
        windows = apart[:, lag, first[rows, None, None] + low]
        out[rows] = np.any([_beyond(each, own[rows], least) for each, least in zip(windows, _LEAST, strict=True)], axis=0)
    return out


def _beyond(apart: Array, own: NDArray[np.intp], least: float) -> NDArray[np.bool_]:
    """Return whether the window's pose `own` (k,) is far, of distances (k, w, w) between its poses."""
    rows = np.arange(len(apart))
    from_middle = apart[rows, np.argmin(apart.sum(axis=2), axis=1)]
    out: NDArray[np.bool_] = from_middle[rows, own] > np.maximum(_BEYOND * np.median(from_middle, axis=1), least)
    return out
