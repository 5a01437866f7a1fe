"""Board corners as a perfect detector with Gaussian noise would find them: observations without images."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews
from calibkit.geometry import se3
from calibkit.models.board import Board
from calibkit.models.cameras.base import Projection
from calibkit.simulation.camera import SimCamera, inside, random_board_poses

Array = NDArray[np.float64]

_EDGE_PX = 3.0  # a detector needs a few pixels around a corner
_SQUEEZED = 0.5  # near a fisheye's end lengths shrink to less than this share of the centre's, and no detector finds corners


@dataclass(frozen=True)
class ViewsTruth:
    """What a set of simulated views was made from."""

    camera: SimCamera
    T_cam_board: Array  # (f, 4, 4)
    uv: Array  # (n, 2) px, without noise, rows as in the views


def views_of_poses(
    camera: SimCamera,
    board: Board,
    T_cam_board: Array,
    rng: np.random.Generator,
    noise_px: float = 0.2,
    t_ns: NDArray[np.int64] | None = None,
) -> tuple[BoardViews, ViewsTruth]:
    """Return the corners inside the image, with noise of sigma noise_px per coordinate; frames without any are left out.

    Rows state sigma_px = noise_px, or 1 px when there is no noise.
    """
    points = se3.transform(T_cam_board, board.points)
    seen = camera.model.project(points, camera.params, jacobians=True)
    visible = seen.valid & inside(camera, seen.uv, _EDGE_PX)
    visible[visible] = _least_magnification(camera, points[visible], seen, visible) > _SQUEEZED
    kept = np.flatnonzero(visible.any(axis=-1))
    frame, corner = np.nonzero(visible[kept])
    uv = seen.uv[kept][frame, corner]
    views = BoardViews(
        board=board,
        image_size=camera.size,
        t_ns=np.zeros(len(kept), np.int64) if t_ns is None else t_ns[kept],
        labels=tuple(f"frame {k}" for k in kept),
        frame=frame.astype(np.int32),
        corner=corner.astype(np.int32),
        uv=uv + noise_px * rng.standard_normal(uv.shape),
        sigma_px=np.full(len(uv), noise_px if noise_px > 0 else 1.0),
        camera=camera.name,
        n_images=len(T_cam_board),
    )
    return views, ViewsTruth(camera, T_cam_board[kept], uv)


def _least_magnification(camera: SimCamera, points: Array, seen: Projection, rows: NDArray[np.bool_]) -> Array:
    """Return px per rad over the focal length in the direction in which it is least: the smaller singular value of |p| duv/dp / f."""
    assert seen.J_point is not None
    J = seen.J_point[rows] * np.linalg.norm(points, axis=-1)[:, None, None] / camera.params[:2, None]
    squared: Array = np.linalg.eigvalsh(J @ np.swapaxes(J, -1, -2))[:, 0]
    return np.sqrt(np.maximum(squared, 0))


def simulate_board_views(camera: SimCamera, board: Board, n_frames: int, seed: int, noise_px: float = 0.2) -> tuple[BoardViews, ViewsTruth]:
    """Return views of a board held before a camera in n_frames random poses (`random_board_poses`), without motion or stamps."""
    rng = np.random.default_rng(seed)
    return views_of_poses(camera, board, random_board_poses(camera, board, n_frames, rng), rng, noise_px)
