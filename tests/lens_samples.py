"""Simulated lenses of every model, a board and its views, for the tests of the estimator."""

from dataclasses import replace

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.geometry import se3, so3
from calibkit.models.board import AprilGrid, Board
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import SimCamera, random_board_poses
from calibkit.simulation.corners import views_of_poses

LENSES = {
    "pinhole-none": SimCamera(CAMERAS["pinhole-none"], np.array([441.2, 439.8, 366.7, 247.9]), (752, 480)),
    "pinhole-radtan": SimCamera(CAMERAS["pinhole-radtan"], np.array([461.2, 459.8, 366.7, 247.9, -0.28, 0.07, 2e-4, 2e-5]), (752, 480)),
    "pinhole-radtan5": SimCamera(
        CAMERAS["pinhole-radtan5"], np.array([556.2, 555.8, 483.4, 290.6, -0.31, 0.13, 1e-4, -2e-4, -0.03]), (960, 600)
    ),
    "pinhole-radtan8": SimCamera(
        CAMERAS["pinhole-radtan8"],
        np.array([520.1, 519.7, 322.3, 241.9, 0.31, -0.12, 1e-4, -3e-4, 0.02, 0.52, -0.03, 0.01]),
        (640, 480),
    ),
    # 180 degrees across, as data/mei_fisheye.
    "pinhole-equi": SimCamera(CAMERAS["pinhole-equi"], np.array([383.5, 384.5, 638.6, 477.5, 0.040, -0.049, 0.021, -0.0035]), (1280, 960)),
}
GRID = AprilGrid(6, 6, 0.088, 0.3)
# Asymmetric in every number, so that no sign or direction can hide.
T_CAM1_CAM0 = se3.make(so3.exp(np.array([0.03, -0.06, 0.10])), np.array([-0.12, 0.02, 0.035]))


def board_views(camera: SimCamera | str, frames: int, seed: int, noise_px: float = 0.2, board: Board = GRID) -> BoardViews:
    """Return views of a board in random poses without stamps, every frame on its own."""
    camera = LENSES[camera] if isinstance(camera, str) else camera
    rng = np.random.default_rng(seed)
    return views_of_poses(camera, board, random_board_poses(camera, board, frames, rng), rng, noise_px)[0]


def rig_views(
    cameras: list[SimCamera], T_cam_cam0: list[np.ndarray], frames: int, seed: int, noise_px: float = 0.2, jitter_s: float = 0.0
) -> list[BoardViews]:
    """Return views by several cameras of the same boards, one a second, each stamp off by up to `jitter_s`; cameras are cam0, cam1, ..."""
    rng = np.random.default_rng(seed)
    T_cam0_board = random_board_poses(cameras[0], GRID, frames, rng, fill=(0.3, 0.6))
    found = []
    for i, (camera, T) in enumerate(zip(cameras, T_cam_cam0, strict=True)):
        t_ns = (1e9 * (np.arange(1, frames + 1) + rng.uniform(-jitter_s, jitter_s, frames))).astype(np.int64)
        found.append(views_of_poses(replace(camera, name=f"cam{i}"), GRID, T @ T_cam0_board, rng, noise_px, t_ns)[0])
    return found


def scrambled(views: BoardViews, share: float, seed: int, off_px: float = 30.0) -> tuple[BoardViews, np.ndarray]:
    """Return the views with a share of their corners moved by `off_px` or more in a random direction, and which those are."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(views.uv)) < share
    angle, length = rng.uniform(0, 2 * np.pi, len(wrong)), rng.uniform(off_px, 3 * off_px, len(wrong))
    return replace(views, uv=views.uv + np.where(wrong, length * [np.cos(angle), np.sin(angle)], 0.0).T), wrong
