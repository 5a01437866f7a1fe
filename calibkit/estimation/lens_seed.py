"""A start for lens and board poses without a guess: bearing vectors under a scan of the focal length.

For every trial focal length the pixels become rays of the undistorted lens, and each view's plane-to-rays map H = [r1 r2 t]
follows linearly from ray x (H X) = 0 (the DLT of Hartley and Zisserman, 4.1, on rays: it holds beyond 90 degrees too).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.errors import NotConvergedError
from calibkit.estimation.camera_problem import CameraProblem, CameraViews, LensState
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.solver.levenberg_marquardt import minimise

_SCAN = np.geomspace(0.15, 12.0, 30)  # focal length over the image's half diagonal
_SCAN_VIEWS = 24
_SCAN_CORNERS = 60
_ENOUGH_CORNERS = 16
_HYPOTHESES = 3
_HOPELESS = 5.0  # times the best error: no start there
_REWEIGHTINGS = 8
_SMALL_ANGLE = 1e-3
_SEED_LOSS = 8.0  # px: wide enough to let a wrong lens pull itself straight, narrow enough to forget gross outliers


@dataclass(frozen=True)
class Poses:
    """Board poses of views and how well they fit."""

    T_cam_board: Array  # (f, 4, 4)
    error: Array  # (f,) median angle in rad between measured and predicted rays; inf where there is no pose


def poses_from_rays(rays: Array, weight: Array | NDArray[np.bool_], points: Array) -> Poses:
    """Return each view's pose from unit rays (f, n, 3) of planar points (n, 3); needs 4 corners of weight > 0 a view."""
    usable = weight > 0
    centre, spread = points[:, :2].mean(axis=0), points[:, :2].std() + 1e-300
    X = np.concatenate([(points[:, :2] - centre) / spread, np.ones((len(points), 1))], axis=1)
    off_ray = np.where(usable[..., None, None], np.eye(3) - rays[..., :, None] * rays[..., None, :], 0.0) * weight[..., None, None]
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
    angle = np.where(usable, _angles(T, rays, points), np.inf)
    count = usable.sum(axis=1)
    median = np.take_along_axis(np.sort(angle, axis=1), (np.maximum(count, 1) // 2)[:, None], axis=1)[:, 0]
    return Poses(T, np.where(good, median, np.inf))


def _angles(T: Array, rays: Array, points: Array) -> Array:
    """Return sines of the angles (f, n) between points under T_cam_board and their rays, 2 where they lie on opposite sides."""
    predicted = se3.transform(T, points)
    predicted /= np.maximum(np.linalg.norm(predicted, axis=-1, keepdims=True), 1e-12)
    sine = np.linalg.norm(np.cross(predicted, rays), axis=-1)
    return np.where(np.sum(predicted * rays, axis=-1) < 0, 2.0, sine)


def poses_of_views(views: CameraViews, lens: Array, points: Array) -> Poses:
    """Return each view's board pose under a known lens."""
    rays, valid = views.model.unproject(views.uv, lens)
    return poses_from_rays(rays, valid & (views.weight > 0), points)


def robust_poses_of_views(views: CameraViews, lens: Array, points: Array) -> Poses:
    """Return each view's pose under a known lens as if by the least sum of angles, which a fifth of wrong corners does not turn over.

    The linear solution, weighed anew by the inverse of each corner's angle (Weiszfeld 1937).
    """
    rays, valid = views.model.unproject(views.uv, lens)
    usable = valid & (views.weight > 0)
    poses = poses_from_rays(rays, usable, points)
    for _ in range(_REWEIGHTINGS):
        poses = poses_from_rays(rays, np.where(usable, 1 / np.maximum(_angles(poses.T_cam_board, rays, points), _SMALL_ANGLE), 0.0), points)
    return poses


def seed_camera(views: CameraViews, points: Array) -> tuple[Array, Poses]:
    """Return lens parameters and board poses to start from.

    The best focal lengths of the scan are each refined on a few views with a robust loss in px; the cheapest end wins.
    Raises NotConvergedError when no view gives a pose under any of them.
    """
    width, height = views.image_size
    centre = ((width - 1) / 2, (height - 1) / 2)
    few, few_points = _scan_views(views, points)
    focals = _SCAN * np.hypot(width, height) / 2
    lenses = [views.model.seed(float(focal), centre) for focal in focals]
    rays, valid = (np.stack(each) for each in zip(*(views.model.unproject(few.uv, lens) for lens in lenses), strict=True))
    found = poses_from_rays(rays.reshape(-1, *rays.shape[2:]), (valid & (few.weight > 0)).reshape(-1, valid.shape[-1]), few_points)
    errors = found.error.reshape(len(focals), -1)
    finite = np.isfinite(errors)
    median = np.array([np.median(e[ok]) if ok.any() else np.inf for e, ok in zip(errors, finite, strict=True)])
    T = found.T_cam_board.reshape(len(focals), -1, 4, 4)
    ends = [_refine(few, few_points, lenses[i], Poses(T[i], errors[i])) for i in _valleys(median * focals)[:_HYPOTHESES]]
    if not ends:
        raise NotConvergedError("no board pose fits any focal length: check that the target file describes the board in the images")
    lens, _ = min(ends, key=lambda end: end[1])
    some = _part_of_corners(points)
    if (views.weight[:, some] > 0).sum(axis=1).min() < _ENOUGH_CORNERS:
        some = slice(None)
    part = replace(views, uv=views.uv[:, some], weight=views.weight[:, some])
    return lens, poses_of_views(part, lens, points[some])


def _part_of_corners(points: Array) -> slice:
    """Pick a part of a large board's corners, spread over it: a start needs no more."""
    return slice(None, None, max(1, len(points) // _SCAN_CORNERS))


def _valleys(scores: Array) -> list[int]:
    """Return the local minima of the scan that are not hopeless, the lowest first."""
    padded = np.concatenate([[np.inf], scores, [np.inf]])
    lowest = np.isfinite(scores) & (scores <= padded[:-2]) & (scores <= padded[2:]) & (scores <= _HOPELESS * scores.min())
    return sorted(np.flatnonzero(lowest).tolist(), key=lambda i: scores[i])


def _scan_views(views: CameraViews, points: Array) -> tuple[CameraViews, Array]:
    """Pick views with many corners, spread over the recording."""
    some = _part_of_corners(points)
    views = replace(views, uv=views.uv[:, some], weight=views.weight[:, some])
    count = (views.weight > 0).sum(axis=1)
    pick = [int(group[np.argmax(count[group])]) for group in np.array_split(np.arange(len(count)), min(_SCAN_VIEWS, len(count)))]
    weight = (views.weight[pick] > 0).astype(float)  # in px
    return replace(views, instant=np.arange(len(pick)), uv=views.uv[pick], weight=weight), points[some]


def _refine(views: CameraViews, points: Array, lens: Array, poses: Poses) -> tuple[Array, float]:
    """Return the lens after a short robust solve from this start, and its cost."""
    keep = np.isfinite(poses.error)
    reach = float(views.image_size[0] ** 2 + views.image_size[1] ** 2) / 4 / lens[0] ** 2
    views = replace(views, instant=np.arange(keep.sum()), uv=views.uv[keep], weight=views.weight[keep], reach=reach)
    state = LensState((lens,), np.eye(4)[None], poses.T_cam_board[keep])
    solution = minimise(CameraProblem(points, (views,), loss_scale=_SEED_LOSS), state, max_steps=20, tolerance=1e-3)
    usable = solution.x.lenses[0][:2].min() > 0 and np.isfinite(solution.cost)
    return solution.x.lenses[0], solution.cost if usable else np.inf
