"""Simulated corners: they are the model's projections, cover the image, and carry the noise that they state."""

import numpy as np
import pytest

from calibkit.geometry import se3
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import SimCamera, random_board_poses
from calibkit.simulation.corners import simulate_board_views

RADTAN = SimCamera(CAMERAS["pinhole-radtan"], np.array([461.2, 460.1, 367.3, 248.1, -0.28, 0.07, 2e-4, 2e-5]), (752, 480))
FISHEYE = SimCamera(CAMERAS["pinhole-equi"], np.array([383.5, 384.5, 638.6, 477.5, 0.040, -0.049, 0.021, -0.0035]), (1280, 960))
BOARDS = [AprilGrid(6, 6, 0.088, 0.3), Checkerboard(9, 6, 0.05, 0.04), Charuco(8, 5, 0.05, 0.037), CircleGrid(7, 6, 0.05, asymmetric=True)]


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=lambda c: c.model.name)
@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
def test_views_are_the_projections_of_the_true_poses(camera: SimCamera, board: Board) -> None:
    views, truth = simulate_board_views(camera, board, 40, seed=0, noise_px=0.2)
    points = se3.transform(truth.T_cam_board, board.points)[views.frame, views.corner]
    exact = camera.model.project(points, camera.params)
    assert exact.valid.all()
    assert np.abs(exact.uv - truth.uv).max() < 1e-9
    assert np.std(views.uv - truth.uv) == pytest.approx(0.2, rel=4 / np.sqrt(2 * views.uv.size))
    assert np.all(views.sigma_px == 0.2)
    assert views.n_frames == 40


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
def test_boards_show_their_printed_side_at_all_tilts(board: Board) -> None:
    T = random_board_poses(RADTAN, board, 400, np.random.default_rng(1))
    centre = se3.transform(T, (board.points.min(0) + board.points.max(0))[None] / 2)[:, 0]
    # Seen upright Kalibr's grid has z towards the viewer, OpenCV's boards have it away from him.
    outward = T[:, :3, 2] if board.kind == "aprilgrid" else -T[:, :3, 2]
    tilt = np.arccos(-np.sum(outward * centre, axis=-1) / np.linalg.norm(centre, axis=-1))
    assert tilt.max() < np.pi / 4 + 1e-9
    assert tilt.max() > 0.9 * np.pi / 4
    assert tilt.min() < 0.1 * np.pi / 4


NARROW_FISHEYE = SimCamera(CAMERAS["pinhole-equi"], np.array([350.0, 351.0, 374.0, 243.0, -0.01, 0.03, -0.02, 0.005]), (752, 480))


@pytest.mark.parametrize("camera", [RADTAN, NARROW_FISHEYE], ids=lambda c: c.model.name)
def test_the_whole_image_is_covered(camera: SimCamera) -> None:
    views, _ = simulate_board_views(camera, BOARDS[0], 100, seed=2)
    width, height = camera.size
    counts, _, _ = np.histogram2d(*views.uv.T, bins=[8, 6], range=[[0, width], [0, height]])
    assert counts.min() >= 20  # in each of 48 cells, its corners included


def test_the_seed_decides() -> None:
    first, again, other = (simulate_board_views(RADTAN, BOARDS[0], 5, seed=s)[0].uv for s in (3, 3, 4))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_without_noise_the_corners_are_exact_and_weighed_as_one_pixel() -> None:
    views, truth = simulate_board_views(RADTAN, BOARDS[0], 5, seed=0, noise_px=0.0)
    assert np.array_equal(views.uv, truth.uv)
    assert np.all(views.sigma_px == 1.0)


def test_no_corners_where_the_lens_ends() -> None:
    views, truth = simulate_board_views(FISHEYE, BOARDS[0], 200, seed=0)
    points = se3.transform(truth.T_cam_board, BOARDS[0].points)[views.frame, views.corner]
    angle = np.arctan2(np.linalg.norm(points[:, :2], axis=-1), points[:, 2])
    assert np.radians(90) < angle.max() < np.radians(102)  # this lens turns back at 107 deg
