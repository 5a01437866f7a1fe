"""Checkerboards, ChArUco boards and circle grids, rendered and real."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibkit.detection.boards import DETECTORS, detect
from calibkit.errors import BadInputError
from calibkit.geometry import se3, so3
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.simulation.camera import RenderStyle, SimCamera, board_diagonal, place_board
from calibkit.simulation.render import PAINTERS, Renderer

Array = NDArray[np.float64]

CAMERA = SimCamera(CAMERAS["pinhole-radtan"], np.array([461.2, 460.1, 367.3, 248.1, -0.28, 0.07, 2e-4, 2e-5]), (752, 480))


def test_every_board_that_can_be_drawn_can_be_found() -> None:
    assert set(DETECTORS) == set(PAINTERS)


@pytest.mark.parametrize(
    ("board", "most_px"),
    [
        (Checkerboard(9, 6, 0.05, 0.05), 0.02),
        (Checkerboard(8, 5, 0.05, 0.04), 0.02),
        (Charuco(8, 7, 0.05, 0.037, "DICT_5X5_100"), 0.04),
        (Charuco(8, 6, 0.05, 0.037, "DICT_5X5_100", legacy=True), 0.04),
        (CircleGrid(7, 6, 0.05), 0.04),
        (CircleGrid(4, 11, 0.03, asymmetric=True), 0.04),
    ],
    ids=lambda b: b.key() if hasattr(b, "key") else "",
)
def test_rendered_boards_are_found_with_honest_sigmas(board: Board, most_px: float) -> None:
    rng = np.random.default_rng(0)
    renderer = Renderer(CAMERA, board, RenderStyle())
    errors, sigmas = [], []
    for turn in ([0.1, 0.2, 0.05], [-0.4, 0.1, -0.3], [0.2, -0.5, 0.2]):
        T = place_board(board, so3.exp(np.array(turn)), np.array([0.01, 0.0, 1.35 * board_diagonal(board)]))
        truth = CAMERA.model.project(se3.transform(T, board.points), CAMERA.params).uv
        found = detect(renderer.render(T, rng), board)
        assert len(found.corner) >= 0.95 * len(board.points)
        error = found.uv - truth[found.corner]
        if (
            board.kind in ("checkerboard", "circlegrid") and sum(board.shape) % 2 == 0
        ):  # alike when turned by half: either answer is the board
            turned = found.uv - truth[::-1][found.corner]
            error = min(error, turned, key=lambda e: np.abs(e).max())
        errors.append(error)
        sigmas.append(found.sigma_px)
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    rms = np.sqrt((error**2).sum(1).mean())
    assert rms <= most_px, f"rms {rms:.4f} px"
    if not isinstance(board, CircleGrid):
        assert 0.6 <= np.sqrt(((error / sigma[:, None]) ** 2).mean()) <= 1.4


@pytest.mark.parametrize("roll", np.deg2rad([0, 90, 180, 270]))
@pytest.mark.parametrize("board", [Checkerboard(9, 6, 0.05, 0.05), Checkerboard(6, 7, 0.05, 0.05)], ids=lambda b: b.key())
def test_a_checkerboard_of_odd_sum_has_one_frame(board: Checkerboard, roll: float) -> None:
    T = place_board(board, so3.exp(np.array([0.2, 0.1, 0])) @ so3.exp(np.array([0, 0, roll])), np.array([0.0, 0.0, 0.9]))
    truth = CAMERA.model.project(se3.transform(T, board.points), CAMERA.params).uv
    found = detect(Renderer(CAMERA, board, RenderStyle()).render(T, np.random.default_rng(0)), board)
    assert len(found.corner) == len(board.points)
    assert np.abs(found.uv - truth).max() < 0.2


@pytest.mark.parametrize(("columns", "rows"), [(6, 5), (11, 6), (8, 8), (13, 8)])
def test_another_size_of_checkerboard_is_not_found(columns: int, rows: int) -> None:
    shown = Checkerboard(12, 8, 0.05, 0.05)
    image = Renderer(CAMERA, shown, RenderStyle()).render(
        place_board(shown, so3.exp(np.array([0.2, 0.1, 0.1])), np.array([0.0, 0.0, 0.9])), np.random.default_rng(0)
    )
    assert len(detect(image, shown).corner) == len(shown.points)
    assert len(detect(image, Checkerboard(columns, rows, 0.05, 0.05)).corner) == 0


def test_charuco_in_part_keeps_its_numbers() -> None:
    board = Charuco(8, 7, 0.05, 0.037, "DICT_5X5_100")
    T = place_board(board, np.eye(3), np.array([0.0, 0.0, 0.6]))
    image = Renderer(CAMERA, board, RenderStyle()).render(T, np.random.default_rng(1))
    image[:, 376:] = 120
    truth = CAMERA.model.project(se3.transform(T, board.points), CAMERA.params).uv
    found = detect(image, board)
    assert 8 <= len(found.corner) < len(board.points)
    assert np.linalg.norm(found.uv - truth[found.corner], axis=1).max() < 0.2


@pytest.mark.parametrize(
    "board", [Checkerboard(9, 6, 0.05, 0.05), Charuco(8, 7, 0.05, 0.037), CircleGrid(7, 6, 0.05)], ids=lambda b: b.kind
)
def test_no_image_is_too_odd(board: Board) -> None:
    rng = np.random.default_rng(2)
    for shape in ((1, 1), (16, 16), (17, 90), (240, 320)):
        for image in (np.zeros(shape, np.uint8), np.full(shape, 65535, np.uint16), rng.integers(0, 256, shape, np.uint8)):
            assert len(detect(image, board).corner) == 0


def test_boards_that_no_dictionary_holds_are_refused_in_a_line() -> None:
    image = np.zeros((100, 100), np.uint8)
    for board in (AprilGrid(30, 30, 0.02, 0.3), Charuco(8, 7, 0.05, 0.03, "DICT_NONE"), Charuco(20, 20, 0.05, 0.03, "DICT_4X4_50")):
        with pytest.raises(BadInputError):
            detect(image, board)


def test_kuka_checkerboards(data_dir: Path) -> None:
    board = Checkerboard(24, 17, 0.015, 0.015)
    found = [detect(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), board) for path in sorted((data_dir / "kuka2").glob("*.png"))]
    assert [len(d.corner) for d in found] == [408] * 28
    points = [board.points.astype(np.float32)] * 28
    rms, *_ = cv2.calibrateCamera(points, [d.uv.astype(np.float32)[:, None] for d in found], (1920, 1200), None, None)
    assert rms <= 0.104


@pytest.mark.slow
def test_fisheye_checkerboards(data_dir: Path) -> None:
    board = Checkerboard(9, 6, 0.12, 0.12)
    found = [detect(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), board) for path in sorted((data_dir / "mei_fisheye").glob("*.png"))]
    assert sum(len(d.corner) > 0 for d in found) >= 61
    whole = [d.uv[None] for d in found if len(d.corner) == 54]
    K, k = np.array([[390.0, 0, 640], [0, 390, 480], [0, 0, 1]]), np.zeros(4)
    names = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # OpenCV 5 has moved them
    flags = names.CALIB_USE_INTRINSIC_GUESS | names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW
    rms, *_ = cv2.fisheye.calibrate([board.points[None]] * len(whole), whole, (1280, 960), K, k, flags=flags)
    assert rms <= 0.50
