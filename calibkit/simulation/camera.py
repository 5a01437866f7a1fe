"""A camera of a simulated rig, how its pictures look, and where boards stand before it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import se3, so3
from calibkit.models.board import Board
from calibkit.models.cameras.base import CameraModel

Array = NDArray[np.float64]

# R_cam_board of a board seen upright and from its printed side: Kalibr's AprilGrid has y up, OpenCV's boards have it down.
_UPRIGHT = {"aprilgrid": np.diag([1.0, -1.0, -1.0])}


@dataclass(frozen=True)
class SimCamera:
    """A lens, its image size, and how it is mounted on and clocked against the IMU."""

    model: CameraModel
    params: Array  # (p,)
    size: tuple[int, int]  # width, height px
    T_imu_cam: Array = field(default_factory=lambda: np.eye(4))
    dt_imu_cam: float = 0.0  # s, t_imu = t_cam + dt_imu_cam
    rate_hz: float = 10.0
    name: str = "cam0"
    topic: str = "/cam0/image_raw"


@dataclass(frozen=True)
class RenderStyle:
    """How the scene is lit and how the sensor blurs it; gray levels of 255."""

    black: float = 25.0
    white: float = 205.0
    wall: int = 120  # behind the board, on a scale from 0 `black` to 255 `white`
    lighting: float = 0.3  # relative change of the light across the image
    blur_px: float = 0.5  # sigma of the optics
    noise: float = 2.0  # sigma of the sensor
    supersampling: int = 3


def board_centre(board: Board) -> Array:
    """Return the middle of the board's corners (3,) m in the board's frame."""
    points = board.points
    centre: Array = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre


def board_diagonal(board: Board) -> float:
    """Return the distance between the outermost corners in m."""
    return float(np.linalg.norm(np.ptp(board.points, axis=0)))


def place_board(board: Board, R_cam_upright: Array, centre_c: Array) -> Array:
    """Return T_cam_board (..., 4, 4) of a board turned by R_cam_upright from its upright view, with its middle at centre_c m."""
    R = R_cam_upright @ _UPRIGHT.get(board.kind, np.eye(3))
    return se3.make(R, centre_c - R @ board_centre(board))


def inside(camera: SimCamera, uv: Array, margin_px: float) -> NDArray[np.bool_]:
    """Return which pixels (..., 2) lie on the image, at least margin_px from its edge; NaN does not."""
    width, height = camera.size
    low, high = margin_px - 0.5, np.array([width, height]) - 0.5 - margin_px
    within: NDArray[np.bool_] = np.all((uv > low) & (uv < high), axis=-1)
    return within


def random_board_poses(
    camera: SimCamera,
    board: Board,
    n: int,
    rng: np.random.Generator,
    max_tilt: float = np.pi / 4,
    max_roll: float = np.pi / 4,
    fill: tuple[float, float] = (0.3, 0.9),
) -> Array:
    """Return T_cam_board (n, 4, 4): middles all over the image, tilts up to max_tilt about any axis, diagonals `fill` image widths long.

    Every pose has at least a quarter of its corners on the image.
    """
    poses: list[Array] = []
    found = 0
    for _ in range(100):
        batch = _draw_poses(camera, board, 2 * n, rng, max_tilt, max_roll, fill)
        seen = camera.model.project(se3.transform(batch, board.points), camera.params)
        share = np.mean(seen.valid & inside(camera, seen.uv, 0.0), axis=-1)
        poses.append(batch[share >= 0.25])
        found += len(poses[-1])
        if found >= n:
            return np.concatenate(poses)[:n]
    raise ValueError(f"this board is rarely in view of {camera.name}: {found} of {n} poses found; choose a smaller `fill`")


def _draw_poses(
    camera: SimCamera, board: Board, n: int, rng: np.random.Generator, max_tilt: float, max_roll: float, fill: tuple[float, float]
) -> Array:
    width, height = camera.size
    rays, valid = camera.model.unproject(rng.uniform((0, 0), (width - 1, height - 1), (n, 2)), camera.params)
    rays = rays[valid]
    n = len(rays)
    distance = board_diagonal(board) * camera.params[0] / (rng.uniform(*fill, n) * width)
    # The shortest turn from the optical axis to the ray; a ray near -z (no lens sees it) would have none.
    turn = np.arctan2(np.linalg.norm(rays[:, :2], axis=-1), rays[:, 2])
    axis = np.stack([-rays[:, 1], rays[:, 0], np.zeros(n)], axis=-1)
    axis /= np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-12)
    direction, tilt, roll = rng.uniform(0, 2 * np.pi, n), rng.uniform(0, max_tilt, n), rng.uniform(-max_roll, max_roll, n)
    tilt_axis = np.stack([np.cos(direction), np.sin(direction), np.zeros(n)], axis=-1)
    R = so3.exp(turn[:, None] * axis) @ so3.exp(tilt[:, None] * tilt_axis) @ so3.exp(roll[:, None] * np.array([0, 0, 1.0]))
    return place_board(board, R, distance[:, None] * rays)
