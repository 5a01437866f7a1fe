"""What corners err by together: too little to see in one of them, and what no number of frames averages out."""

import numpy as np
import pytest
from numpy.typing import NDArray

from calibkit.detection.boards import detect
from calibkit.detection.plane_maps import in_line, local_maps
from calibkit.estimation.camera_problem import CameraProblem, CameraViews, LensState
from calibkit.geometry import se3
from calibkit.models.board import AprilGrid, Board, Checkerboard
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import RenderStyle, SimCamera, inside, random_board_poses
from calibkit.simulation.render import Renderer

Array = NDArray[np.float64]

CAMERA = SimCamera(CAMERAS["pinhole-radtan"], np.array([461.2, 460.1, 367.3, 248.1, -0.28, 0.07, 2e-4, 2e-5]), (752, 480))
GRID = AprilGrid(6, 6, 0.088, 0.3)


def project(T_cam_board: Array, points: Array) -> Array:
    return CAMERA.model.project(se3.transform(T_cam_board, points), CAMERA.params).uv


# Terms up to the second order only would leave 0.009 and 0.013
@pytest.mark.parametrize(("board", "most"), [(GRID, 0.004), (Checkerboard(9, 6, 0.06, 0.06), 0.007)], ids=["aprilgrid", "checkerboard"])
def test_local_maps_bend_as_the_lens_and_the_perspective_do(board: Board, most: float) -> None:
    unit = board.tag_size if isinstance(board, AprilGrid) else 0.06
    errors = []
    for T in random_board_poses(CAMERA, board, 10, np.random.default_rng(1), max_tilt=np.deg2rad(40), fill=(0.5, 0.6)):
        X, h = board.points, 0.05 * unit
        X = X[inside(CAMERA, project(T, X), 5.0)]
        dx, dy = np.eye(3)[:2] * h
        uv = project(T, X)
        across = [project(T, X + d) + project(T, X - d) - 2 * uv for d in (dx, dy)]
        twist = (project(T, X + dx + dy) + project(T, X - dx - dy) - project(T, X + dx - dy) - project(T, X - dx + dy)) / 4
        truth = np.stack([across[0], twist, across[1]], axis=1) * (unit / h) ** 2
        maps, _ = local_maps(X[:, :2] / unit, uv, 1.0)
        errors.append(np.linalg.norm(maps.Q - truth, axis=(1, 2)) / np.linalg.norm(maps.J, axis=(1, 2)))
    assert np.mean(np.concatenate(errors)) < most


@pytest.mark.parametrize("corner", [0, 21, 142], ids=["the board's first", "inside", "its last"])
def test_a_wrong_corner_is_told_at_the_rim_too(corner: int) -> None:
    (T,) = random_board_poses(CAMERA, GRID, 1, np.random.default_rng(1), max_tilt=np.deg2rad(40), fill=(0.5, 0.6))
    uv = project(T, GRID.points)
    maps, _ = local_maps(GRID.points[:, :2] / GRID.tag_size, uv, 1.0)
    side = np.sqrt(np.abs(np.linalg.det(maps.J)))
    uv[corner] += 0.25 * side[corner]
    _, misfit = local_maps(GRID.points[:, :2] / GRID.tag_size, uv, 1.0)
    assert misfit.argmax() == corner
    assert not in_line(misfit, 0.05 * side)[corner]


def mean_error(style: RenderStyle, light: float) -> Array:
    """Return the mean corner errors (4, 2) px by the corner's place in its tag."""
    rng = np.random.default_rng(2)
    renderer, total, n = Renderer(CAMERA, GRID, style), np.zeros((4, 2)), np.zeros((4, 1))
    for T in random_board_poses(CAMERA, GRID, 6, rng, max_tilt=0.1, max_roll=0.05, fill=(0.55, 0.6)):
        found = detect(renderer.render(T, rng, light), GRID)
        error = found.uv - project(T, GRID.points)[found.corner]
        np.add.at(total, found.corner % 4, error)
        np.add.at(n, found.corner % 4, 1)
    return total / n


@pytest.mark.parametrize("light", [0.0, np.pi / 2])
def test_slanting_light_draws_no_corner(light: float) -> None:
    even, slanting = (mean_error(RenderStyle(noise=0.0, lighting=slope), light) for slope in (0.0, 0.6))
    assert np.abs(slanting - even).max() < 0.002  # 0.009 px where the light is not reckoned with


def test_corner_errors_do_not_add_up_to_a_focal_length() -> None:
    board, rng = GRID, np.random.default_rng(3)
    T = random_board_poses(CAMERA, board, 60, rng, max_tilt=np.deg2rad(40), fill=(0.5, 0.75))
    renderer = Renderer(CAMERA, board, RenderStyle(noise=0.0))
    uv, weight = project(T, board.points), np.zeros((len(T), len(board.points)))
    for k, pose in enumerate(T):
        found = detect(renderer.render(pose, rng), board)
        near = np.linalg.norm(found.uv - uv[k, found.corner], axis=-1) < 0.1
        uv[k, found.corner[near]], weight[k, found.corner[near]] = found.uv[near], 1.0
    seen = weight.any(1)
    views = CameraViews(CAMERA.model, np.arange(seen.sum()), uv[seen], weight[seen], CAMERA.size)
    problem = CameraProblem(board.points, (views,))
    S, score = problem.information(LensState((CAMERA.params,), np.eye(4)[None], T[seen]))
    shift = np.linalg.solve(S.sum(0), score.sum(0))
    assert np.abs(shift[:2]).max() < 0.015, shift  # 0.030 px with maps of second order
