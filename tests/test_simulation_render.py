"""Rendered boards: corners where the model puts them, tags turned as Kalibr prints them, seen by OpenCV's own detectors."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.spatial import cKDTree

from calibkit.detection.artwork import artwork
from calibkit.geometry import se3
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.simulation.camera import RenderStyle, SimCamera, place_board, random_board_poses
from calibkit.simulation.corners import views_of_poses
from calibkit.simulation.render import PAINTERS, Renderer

Array = NDArray[np.float64]

RADTAN = SimCamera(CAMERAS["pinhole-radtan"], np.array([461.2, 460.1, 367.3, 248.1, -0.28, 0.07, 2e-4, 2e-5]), (752, 480))
FISHEYE = SimCamera(CAMERAS["pinhole-equi"], np.array([383.5, 384.5, 638.6, 477.5, 0.040, -0.049, 0.021, -0.0035]), (1280, 960))
CLEAN = RenderStyle(lighting=0, blur_px=0.5, noise=0)
APRILGRID = AprilGrid(6, 6, 0.088, 0.3)

# Older ArUco misses tags and sets raw corners half a pixel off; its figures follow what 4.10 was found to do.
NEW_ARUCO = tuple(int(part) for part in cv2.__version__.split(".")[:2]) >= (4, 14)


def upright(board: Board, distance: float) -> Array:
    return place_board(board, np.eye(3), np.array([0, 0, distance]))


def fit_saddles(image: NDArray[np.uint8], start: Array, radius: int) -> Array:
    """The stationary point of a quadratic fitted around each start, on the spline-interpolated image."""
    smooth = spline_filter(gaussian_filter(image.astype(float), 1.0))
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-radius, radius + 1.0), np.arange(-radius, radius + 1.0)))
    x, y = x[np.hypot(x, y) <= radius], y[np.hypot(x, y) <= radius]
    fit = np.linalg.pinv(np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=-1))
    uv = start.copy()
    for _ in range(5):
        samples = map_coordinates(smooth, [uv[:, 1:] + y, uv[:, :1] + x], prefilter=False)
        a, b, c, d, e, _ = fit @ samples.T
        uv += np.clip(np.stack([b * e - 2 * c * d, b * d - 2 * a * e], axis=-1) / (4 * a * c - b * b)[:, None], -1, 1)
    return uv


# The fit needs fields wider than its own support: 3 px and a smoothing of 1 px, so at least 12 px (tags: the gap between them).
@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=lambda c: c.model.name)
@pytest.mark.parametrize(
    ("board", "field_px"),
    [(Checkerboard(9, 6, 0.05, 0.04), 12), (Charuco(8, 6, 0.05, 0.03), 24), (APRILGRID, 12)],
    ids=lambda b: getattr(b, "kind", ""),
)
def test_saddle_points_lie_where_the_model_projects_them(camera: SimCamera, board: Board, field_px: float) -> None:
    rng = np.random.default_rng(0)
    renderer, errors = Renderer(camera, board, CLEAN), []
    for T in random_board_poses(camera, board, 6, rng, fill=(0.8, 0.9)):
        _, truth = views_of_poses(camera, board, T[None], rng)
        uv = truth.uv
        neighbour = cKDTree(uv).query(uv, k=2)[0][:, 1]
        inner = uv[(neighbour > field_px) & np.all((uv > 12) & (uv < np.array(camera.size) - 13), axis=-1)]
        errors.append(fit_saddles(renderer.render(T, rng), inner, radius=3) - inner)
    error = np.concatenate(errors)
    assert len(error) > 100
    assert np.sqrt(np.mean(np.sum(error**2, axis=-1))) < 0.02  # px, the fit's own error included
    assert np.abs(error.mean(axis=0)).max() < 0.004


def test_disc_centres_seen_from_the_front_lie_where_the_model_projects_them() -> None:
    board = CircleGrid(7, 6, 0.05, asymmetric=True)
    T = upright(board, 1.0)
    pinhole = SimCamera(RADTAN.model, np.array([460.0, 460, 375.5, 239.5, 0, 0, 0, 0]), RADTAN.size)
    image = Renderer(pinhole, board, CLEAN).render(T, np.random.default_rng(0))
    found, centres = cv2.findCirclesGrid(image, (7, 6), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    uv = pinhole.model.project(se3.transform(T, board.points), pinhole.params).uv
    assert found
    # OpenCV may count from either end of the grid, and its blob centres are good to a tenth of a pixel.
    distance = np.linalg.norm(centres.reshape(-1, 1, 2) - uv, axis=-1).min(axis=1)
    assert len(centres) == len(uv)
    assert distance.max() < 0.1


def marker_axes(image: NDArray[np.uint8]) -> dict[int, Array]:
    """Corners (4, 2) of each tag found, by id, from the upper left of OpenCV's picture of the tag."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    return {int(i): c[0] for i, c in zip(ids.ravel(), corners, strict=True)}


def half_turned(tags: dict[int, Array]) -> int:
    """Count tags whose picture runs against the direction to their right-hand neighbour, and check that all do."""
    pairs = [(t, t + 1) for t in tags if t + 1 in tags and t % 6 < 5]
    for t, right in pairs:
        along = tags[right].mean(axis=0) - tags[t].mean(axis=0)
        assert np.dot(tags[t][1] - tags[t][0], along) < -0.9 * np.linalg.norm(tags[t][1] - tags[t][0]) * np.linalg.norm(along)
    return len(pairs)


def test_tags_lie_in_the_grid_as_kalibr_prints_them() -> None:
    T = upright(APRILGRID, 0.8)
    tags = marker_axes(Renderer(RADTAN, APRILGRID).render(T, np.random.default_rng(0)))
    centres = (APRILGRID.points.reshape(-1, 4, 3)).mean(axis=1)
    expected = RADTAN.model.project(se3.transform(T, centres), RADTAN.params).uv
    assert len(tags) >= (36 if NEW_ARUCO else 32)
    assert all(np.linalg.norm(c.mean(axis=0) - expected[t]) < 3 for t, c in tags.items())
    assert expected[0, 1] > expected[35, 1]  # seen upright, tag 0 is at the lower left
    assert half_turned(tags) >= (30 if NEW_ARUCO else 20)


def test_real_prints_turn_their_tags_the_same_way(data_dir: Path) -> None:
    image = cv2.imread(str(data_dir / "aprilgrid_frames" / "EuRoC.png"), cv2.IMREAD_GRAYSCALE)
    assert half_turned(marker_axes(image)) > 10


def test_opencv_finds_its_own_boards() -> None:
    rng = np.random.default_rng(0)
    checkerboard = Checkerboard(9, 6, 0.05, 0.05)
    found, _ = cv2.findChessboardCorners(Renderer(RADTAN, checkerboard).render(upright(checkerboard, 0.7), rng), (9, 6))
    assert found
    charuco = Charuco(8, 5, 0.05, 0.037)
    layout = cv2.aruco.CharucoBoard((8, 5), 0.05, 0.037, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    T = upright(charuco, 0.6)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(layout).detectBoard(Renderer(RADTAN, charuco).render(T, rng))
    uv = RADTAN.model.project(se3.transform(T, charuco.points), RADTAN.params).uv
    assert len(ids) == 28
    assert np.abs(corners.reshape(-1, 2) - uv[ids.ravel()]).max() < (0.5 if NEW_ARUCO else 0.7)


def test_style_is_what_it_says() -> None:
    away = se3.make(np.eye(3), [0, 0, -1.0])  # behind the camera: only the wall is seen
    flat = Renderer(RADTAN, APRILGRID, RenderStyle(lighting=0, noise=4.0)).render(away, np.random.default_rng(0)).astype(float)
    assert flat.std() == pytest.approx(np.hypot(4.0, np.sqrt(1 / 12)), rel=0.01)
    assert flat.mean() == pytest.approx(25 + 180 * 120 / 255, abs=0.05)
    lit = Renderer(RADTAN, APRILGRID, RenderStyle(lighting=0.4, noise=0)).render(away, np.random.default_rng(0)).astype(float)
    assert lit[:, -1].mean() / lit[:, 0].mean() == pytest.approx(1.2 / 0.8, rel=0.01)


def test_the_seed_decides_the_noise() -> None:
    renderer, T = Renderer(RADTAN, APRILGRID), upright(APRILGRID, 0.8)
    first, again, other = (renderer.render(T, np.random.default_rng(s)) for s in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    "board", [APRILGRID, Checkerboard(9, 6, 0.05, 0.04), Charuco(8, 5, 0.05, 0.037), Charuco(7, 6, 0.05, 0.037, legacy=True)]
)
def test_what_is_rendered_is_what_is_printed(board: Board) -> None:
    texture, printed = PAINTERS[board.kind](board), artwork(board)
    xy = np.random.default_rng(0).uniform(texture.outline[0], texture.outline[2], (4_000, 2))

    def inside(boxes: Array) -> NDArray[np.bool_]:
        return np.any(np.all((xy[:, None] > boxes[:, :2]) & (xy[:, None] < boxes[:, 2:]), axis=-1), axis=-1)

    black = inside(printed.black) & ~inside(printed.white)
    column, row = np.clip(np.floor((xy - texture.low) / texture.size).astype(int), 1, np.array(texture.levels[0].shape)[::-1] - 2).T
    around = np.stack([texture.levels[0][row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
    clear = np.ptp(around.astype(int), axis=0) == 0  # not on an edge
    assert np.mean(clear) > 0.9
    assert 0.2 < np.mean(black) < 0.8
    assert np.array_equal(around[4][clear] == 0, black[clear])
