"""A start for lens and board poses without a guess: bearing vectors under a scan of the focal length.

For every trial focal length the pixels become rays of the undistorted lens, and each view's plane-to-rays map H = [r1 r2 t]
follows linearly from ray x (H X) = 0 (the DLT of Hartley and Zisserman, 4.1, on rays: it holds beyond 90 degrees too).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.errors import NotConvergedError
from calibkit.estimation.camera_problem import CameraProblem, CameraViews, LensState
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.solver.levenberg_marquardt import minimise

_SCAN = np.geomspace(0.15, 12.0, 45)  # focal length over the image's half diagonal
_SCAN_VIEWS = 24
_HYPOTHESES = 4
_SEED_LOSS = 8.0  # px: wide enough to let a wrong lens pull itself straight, narrow enough to forget gross outliers


@dataclass(frozen=True)
class Poses:
    """Board poses of views and how well they fit."""

    T_cam_board: Array  # (f, 4, 4)
    error: Array  # (f,) median angle in rad between measured and predicted rays; inf where there is no pose


def poses_from_rays(rays: Array, usable: NDArray[np.bool_], points: Array) -> Poses:
    """Return each view's pose from unit rays (f, n, 3) of planar points (n, 3); needs 4 usable corners a view."""
    centre, spread = points[:, :2].mean(axis=0), points[:, :2].std() + 1e-300
    X = np.concatenate([(points[:, :2] - centre) / spread, np.ones((len(points), 1))], axis=1)
    off_ray = np.where(usable[..., None, None], np.eye(3) - rays[..., :, None] * rays[..., None, :], 0.0)
    normal = np.einsum("fnij,nkl->fikjl", off_ray, X[:, :, None] * X[:, None, :], optimize=True).reshape(-1, 9, 9)
    _, vectors = np.linalg.eigh(normal)
    H = vectors[:, :, 0].reshape(-1, 3, 3)
    ahead = np.einsum("fni,fij,nj->fn", np.where(usable[..., None], rays, 0.0), H, X, optimize=True)
    H = H * np.where(ahead.sum(axis=1) < 0, -1.0, 1.0)[:, None, None]
    scale = np.sqrt(np.linalg.norm(H[:, :, 0], axis=1) * np.linalg.norm(H[:, :, 1], axis=1))
    good = (usable.sum(axis=1) >= 4) & (scale > 1e-12)
    H = np.where(good[:, None, None], H, np.eye(3)) / np.where(good, scale, 1.0)[:, None, None]
    axes = H[:, :, :2]
    R = so3.project(np.concatenate([axes, np.cross(axes[:, :, 0], axes[:, :, 1])[:, :, None]], axis=2))
    t = H[:, :, 2] * spread - R[:, :, :2] @ centre
    T = se3.make(R, t)
    predicted = se3.transform(T, points)
    predicted /= np.maximum(np.linalg.norm(predicted, axis=-1, keepdims=True), 1e-12)
    angle = np.where(usable, np.linalg.norm(np.cross(predicted, rays), axis=-1), np.nan)
    angle = np.where(usable & (np.sum(predicted * rays, axis=-1) < 0), 2.0, angle)
    error = np.full(len(rays), np.inf)
    error[good] = np.nanmedian(angle[good], axis=1)
    return Poses(T, error)


def poses_of_views(views: CameraViews, lens: Array, points: Array) -> Poses:
    """Return each view's board pose under a known lens."""
    rays, valid = views.model.unproject(views.uv, lens)
    return poses_from_rays(rays, valid & (views.weight > 0), points)


def seed_camera(views: CameraViews, points: Array) -> tuple[Array, Poses]:
    """Return lens parameters and board poses to start from.

    The best focal lengths of the scan are each refined on a few views with a robust loss in px; the cheapest end wins.
    Raises NotConvergedError when no view gives a pose under any of them.
    """
    width, height = views.image_size
    centre = ((width - 1) / 2, (height - 1) / 2)
    few = _scan_views(views)
    trials: list[tuple[float, int, Array, Poses]] = []
    for focal in _SCAN * np.hypot(width, height) / 2:
        lens = views.model.seed(float(focal), centre)
        poses = poses_of_views(few, lens, points)
        finite = np.isfinite(poses.error)
        if finite.any():
            trials.append((float(np.median(poses.error[finite])) * focal, len(trials), lens, poses))
    if not trials:
        raise NotConvergedError("no board pose fits any focal length: check that the target file describes the board in the images")
    trials.sort(key=lambda trial: trial[:2])
    ends = [_refine(few, points, lens, poses) for _, _, lens, poses in trials[:_HYPOTHESES]]
    lens, _ = min(ends, key=lambda end: end[1])
    return lens, poses_of_views(views, lens, points)


def _scan_views(views: CameraViews) -> CameraViews:
    """Pick views with many corners, spread over the recording."""
    count = (views.weight > 0).sum(axis=1)
    pick = [int(group[np.argmax(count[group])]) for group in np.array_split(np.arange(len(count)), min(_SCAN_VIEWS, len(count)))]
    weight = (views.weight[pick] > 0).astype(float)  # in px
    return CameraViews(views.model, np.arange(len(pick)), views.uv[pick], weight, views.image_size)


def _refine(views: CameraViews, points: Array, lens: Array, poses: Poses) -> tuple[Array, float]:
    """Return the lens after a short robust solve from this start, and its cost."""
    keep = np.isfinite(poses.error)
    views = CameraViews(views.model, np.arange(keep.sum()), views.uv[keep], views.weight[keep], views.image_size)
    state = LensState((lens,), np.eye(4)[None], poses.T_cam_board[keep])
    solution = minimise(CameraProblem(points, (views,), loss_scale=_SEED_LOSS), state, max_steps=25, tolerance=1e-4)
    usable = solution.x.lenses[0][:2].min() > 0 and np.isfinite(solution.cost)
    return solution.x.lenses[0], solution.cost if usable else np.inf
