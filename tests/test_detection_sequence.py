"""Boards followed through a video: the corners of a search, in less time, and never a wrong number."""

import numpy as np
import pytest
from numpy.typing import NDArray

from calibkit.detection import sequence
from calibkit.detection.boards import detect
from calibkit.detection.found import Detection
from calibkit.detection.sequence import Sequence
from calibkit.geometry import so3
from calibkit.models.board import AprilGrid, Board
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import RenderStyle, SimCamera, place_board
from calibkit.simulation.render import Renderer

Array = NDArray[np.float64]
BOARD = AprilGrid(4, 3, 0.088, 0.3)
CAMERA = SimCamera(CAMERAS["pinhole-radtan"], np.array([300.0, 300, 159.5, 119.5, -0.2, 0.03, 0, 0]), (320, 240))
STEP = 0.088 * 1.3  # m, from tag to tag


class Video:
    """A board that moves before a camera, and how often it was searched for."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, style: RenderStyle, poses: list[tuple[float, float, float]], taken_for: Board = BOARD
    ) -> None:
        rng, renderer = np.random.default_rng(0), Renderer(CAMERA, BOARD, style)
        self.searches = 0
        placed = [place_board(BOARD, so3.exp(np.array([0.2, 0.1, turn])), np.array([x, y, 0.6])) for x, y, turn in poses]
        self.images = [renderer.render(T, rng) for T in placed]
        self.truth = [CAMERA.model.project(BOARD.points @ T[:3, :3].T + T[:3, 3], CAMERA.params).uv for T in placed]

        def counted(image: NDArray[np.uint8], board: Board) -> Detection:
            self.searches += 1
            return detect(image, board)

        monkeypatch.setattr(sequence, "detect", counted)
        look = Sequence(taken_for).look
        self.found = [look(image) for image in self.images]

    def worst(self) -> float:
        pairs = zip(self.found, self.truth, strict=True)
        return max(float(np.linalg.norm(found.uv - truth[found.corner], axis=1).max()) for found, truth in pairs)


@pytest.mark.parametrize(
    "style", [RenderStyle(), RenderStyle(blur_px=1.2), RenderStyle(black=60, white=100, noise=3)], ids=["sharp", "blurred", "dark"]
)
def test_a_followed_board_has_the_corners_of_a_search(monkeypatch: pytest.MonkeyPatch, style: RenderStyle) -> None:
    # It enters the image from the left and turns, 15 px an image
    video = Video(monkeypatch, style, [(-0.16 + 0.03 * k, 0.01 * k, 0.03 * k) for k in range(8)])
    assert video.searches <= 2
    searched = [detect(image, BOARD) for image in video.images]
    assert sum(len(found.corner) for found in video.found) >= sum(len(found.corner) for found in searched)
    z = []
    for ours, theirs in zip(video.found, searched, strict=True):
        _, i, j = np.intersect1d(ours.corner, theirs.corner, return_indices=True)
        z.append((ours.uv[i] - theirs.uv[j]) / theirs.sigma_px[j, None])
    assert np.sqrt((np.concatenate(z) ** 2).mean()) < 0.1
    assert video.worst() < 0.5
    assert all(found.tags.on_board and not found.tags.misplaced for found in video.found)


def test_a_board_that_slips_by_a_tag_keeps_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    video = Video(monkeypatch, RenderStyle(), [(x, y, 0.0) for x, y in ((0, 0), (STEP, 0), (STEP, STEP), (0, STEP), (-STEP, 0))])
    assert video.worst() < 0.5
    assert min(len(found.corner) for found in video.found) >= 24


def test_images_that_are_no_video_are_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    follow = sequence.FOLLOWERS["aprilgrid"]
    monkeypatch.setitem(sequence.FOLLOWERS, "aprilgrid", lambda *a: asked.append(1) or follow(*a))
    video = Video(monkeypatch, RenderStyle(), [(0.05 * (-1) ** k, -0.05 * (-1) ** k, 1.5 * k) for k in range(8)])
    assert video.searches == 8
    assert len(asked) <= 2
    for found, image in zip(video.found, video.images, strict=True):
        assert np.array_equal(found.uv, detect(image, BOARD).uv)


def test_a_board_that_contradicts_its_layout_is_searched_in_every_image(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = AprilGrid(5, 3, 0.088, 0.3)
    video = Video(monkeypatch, RenderStyle(), [(0.01 * k, 0, 0) for k in range(4)], wrong)
    assert video.searches == 4
    assert all(found.tags.misplaced for found in video.found)
