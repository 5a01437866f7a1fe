"""Several cameras on one rig: which views were taken at the same instant, and where the cameras sit to begin with."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

_MAX_SKEW_S = 0.005  # stamps farther apart than this are not one instant
_MAX_CANDIDATES = 80

Instants = tuple[NDArray[np.int64], ...]


def match_instants(cameras: Sequence[BoardViews]) -> Instants:
    """Return for every camera which instant each of its views belongs to.

    Views of different cameras share an instant when their stamps differ by less than 5 ms and a quarter of the frame period, or,
    without stamps, when their file names are equal.
    """
    if len(cameras) == 1:
        return (np.arange(cameras[0].n_frames),)
    if any(not views.t_ns.any() for views in cameras):
        names = {label: i for i, label in enumerate(dict.fromkeys(label for views in cameras for label in views.labels))}
        return tuple(np.array([names[label] for label in views.labels], np.int64) for views in cameras)
    t = np.concatenate([views.t_ns for views in cameras])
    camera = np.repeat(np.arange(len(cameras)), [views.n_frames for views in cameras])
    periods = [float(np.median(np.diff(np.sort(views.t_ns)))) for views in cameras if views.n_frames > 1]
    window = min([_MAX_SKEW_S * 1e9, *(period / 4 for period in periods)])
    instant = np.zeros(len(t), np.int64)
    current, start, present = -1, -np.inf, set[int]()
    for row in np.argsort(t, kind="stable"):
        if t[row] - start > window or int(camera[row]) in present:
            current, start, present = current + 1, float(t[row]), set()
        instant[row] = current
        present.add(int(camera[row]))
    return tuple(instant[camera == c] for c in range(len(cameras)))


def components(instants: Instants) -> list[list[int]]:
    """Return groups of cameras that are joined by shared instants, each in camera order."""
    left, groups = list(range(len(instants))), []
    while left:
        group, frontier = [left.pop(0)], 0
        while frontier < len(group):
            here = group[frontier]
            joined = [c for c in left if np.intersect1d(instants[here], instants[c]).size]
            group += joined
            left = [c for c in left if c not in joined]
            frontier += 1
        groups.append(sorted(group))
    return groups


def seed_rig(instants: Instants, poses: Sequence[Array], errors: Sequence[Array]) -> tuple[Array, Array]:
    """Return T_cam_cam0 (c, 4, 4) and T_cam0_board (m, 4, 4) from each camera's own poses T_cam_board (f, 4, 4).

    Cameras must be one component; each is reached from one already placed, by the medoid of the motions at shared instants.
    """
    T_cam_cam0: dict[int, Array] = {0: np.eye(4)}
    while len(T_cam_cam0) < len(instants):
        shared = {
            (a, b): np.intersect1d(instants[a], instants[b]).size for a in T_cam_cam0 for b in range(len(instants)) if b not in T_cam_cam0
        }
        a, b = max(shared, key=lambda pair: shared[pair])
        _, at_a, at_b = np.intersect1d(instants[a], instants[b], return_indices=True)
        T_b_a = _medoid(poses[b][at_b] @ se3.inverse(poses[a][at_a]))
        T_cam_cam0[b] = T_b_a @ T_cam_cam0[a]
    placed = np.stack([T_cam_cam0[c] for c in range(len(instants))])
    return placed, board_poses(instants, placed, poses, errors)


def board_poses(instants: Sequence[NDArray[np.int64]], T_cam_cam0: Array, poses: Sequence[Array], errors: Sequence[Array]) -> Array:
    """Return T_cam0_board (m, 4, 4) of every instant from the camera that has the best pose T_cam_board for it."""
    m = max(int(i.max(initial=-1)) for i in instants) + 1
    T_cam0_board, best = np.tile(np.eye(4), (m, 1, 1)), np.full(m, np.inf)
    for c, rows in enumerate(instants):
        better = errors[c] < best[rows]
        T_cam0_board[rows[better]] = se3.inverse(T_cam_cam0[c]) @ poses[c][better]
        best[rows[better]] = errors[c][better]
    return T_cam0_board


def _medoid(T: Array) -> Array:
    """Return the motion that lies nearest to all others: an average that outliers do not move."""
    T = T[np.linspace(0, len(T) - 1, min(len(T), _MAX_CANDIDATES)).astype(int)]
    step = se3.local(T[:, None], T[None, :])
    distance = np.linalg.norm(step[..., 3:], axis=-1) + np.linalg.norm(step[..., :3], axis=-1) / np.median(
        np.linalg.norm(T[:, :3, 3], axis=-1) + 1e-9
    )
    chosen: Array = T[np.argmin(np.median(distance, axis=1))]
    return se3.make(so3.project(chosen[:3, :3]), chosen[:3, 3])
