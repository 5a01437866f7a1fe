"""Images of a board through any lens, by inverse mapping: pixel -> ray -> board plane -> texture, averaged over each pixel's area."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid
from calibkit.opencv import cv2
from calibkit.simulation.camera import RenderStyle, SimCamera
from calibkit.simulation.texture import Canvas, Texture

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

_TAG_CELLS = 10  # Kalibr's tag: 6 data bits and two bits of border on each side
_FAR = -1e6  # a texel that is on no board


def _paint_marker(sheet: Canvas, picture: NDArray[Any], x: float, y: float, size: float) -> None:
    """A black square with its smallest corner at x, y, and the white cells of the picture [along y, along x]."""
    cell = size / len(picture)
    sheet.rectangles([(x, y, x + size, y + size)])
    white = np.argwhere(picture > 127)
    sheet.rectangles(((x + j * cell, y + i * cell, x + (j + 1) * cell, y + (i + 1) * cell) for i, j in white), ink=-1.0)


def paint_aprilgrid(board: AprilGrid) -> Texture:
    """Kalibr's print: tags with a two-bit border, and a black square wherever four gaps meet, the outer edge included."""
    tag, gap = board.tag_size, board.tag_size * board.spacing
    step, margin = tag + gap, gap + tag / 2
    sheet = Canvas((-margin, -margin), (board.columns * step - gap + margin, board.rows * step - gap + margin))
    sheet.rectangles((c * step - gap, r * step - gap, c * step, r * step) for r in range(board.rows + 1) for c in range(board.columns + 1))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for t in range(board.rows * board.columns):
        # OpenCV's picture of a tag is Kalibr's turned by half: its first row lies at the smallest y, its first column at the largest x.
        picture = dictionary.generateImageMarker(t, _TAG_CELLS, borderBits=2)[:, ::-1]
        _paint_marker(sheet, picture, t % board.columns * step, t // board.columns * step, tag)
    return sheet.texture()


def paint_checkerboard(board: Checkerboard) -> Texture:
    """(columns + 1) x (rows + 1) fields around the inner corners, the upper left one black, in a white frame of one field."""
    dx, dy = board.column_spacing, board.row_spacing
    sheet = Canvas((-2 * dx, -2 * dy), ((board.columns + 1) * dx, (board.rows + 1) * dy))
    fields = ((i, j) for i in range(-1, board.rows) for j in range(-1, board.columns) if (i + j) % 2 == 0)
    sheet.rectangles((j * dx, i * dy, (j + 1) * dx, (i + 1) * dy) for i, j in fields)
    return sheet.texture()


def paint_charuco(board: Charuco) -> Texture:
    """OpenCV's board: black and white squares, markers in the white ones where its layout has them, in a white frame of one square."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    layout = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_size, board.marker_size, dictionary)
    layout.setLegacyPattern(board.legacy)
    s = board.square_size
    sheet = Canvas((-s, -s), ((board.columns + 1) * s, (board.rows + 1) * s))
    first = int(board.legacy and board.rows % 2 == 0)  # whether the square at the origin is white
    squares = ((i, j) for i in range(board.rows) for j in range(board.columns) if (i + j) % 2 == first)
    sheet.rectangles((j * s, i * s, (j + 1) * s, (i + 1) * s) for i, j in squares)
    cells = dictionary.markerSize + 2
    for marker, corners in zip(np.ravel(layout.getIds()), layout.getObjPoints(), strict=True):
        picture = dictionary.generateImageMarker(int(marker), cells, borderBits=1)
        _paint_marker(sheet, picture, float(corners[0][0]), float(corners[0][1]), board.marker_size)
    return sheet.texture()


def paint_circles(board: CircleGrid) -> Texture:
    """Black discs of a diameter of half the distance between neighbours."""
    points = board.points[:, :2]
    neighbour = board.spacing * (np.sqrt(2) if board.asymmetric else 1.0)
    margin = 1.5 * board.spacing
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    sheet = Canvas((low[0], low[1]), (high[0], high[1]))
    sheet.discs(points, neighbour / 4)
    return sheet.texture()


PAINTERS: dict[str, Callable[[Any], Texture]] = {
    AprilGrid.kind: paint_aprilgrid,
    Checkerboard.kind: paint_checkerboard,
    Charuco.kind: paint_charuco,
    CircleGrid.kind: paint_circles,
}


class Renderer:
    """Renders one board for one camera; the rays of its pixels and the board's texture are computed once."""

    def __init__(self, camera: SimCamera, board: Board, style: RenderStyle | None = None) -> None:
        self.camera, self.style = camera, style or RenderStyle()
        self.texture = PAINTERS[board.kind](board)
        width, height = camera.size
        # One pixel more on every side, so that the map can be interpolated up to the image's edge.
        u, v = np.meshgrid(np.arange(-1, width + 1), np.arange(-1, height + 1))
        rays, valid = camera.model.unproject(np.stack([u, v], axis=-1).astype(float), camera.params)
        rays[~valid] = np.nan
        self._rays = rays.astype(np.float32)
        self._light_u = np.linspace(-0.5, 0.5, width, dtype=np.float32)
        self._light_v = np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None]

    def render(self, T_cam_board: Array, rng: np.random.Generator, light: float = 0.0) -> Gray:
        """Return the image (h, w) of the board at T_cam_board (4, 4), lit from direction `light` in rad."""
        style, (width, height) = self.style, self.camera.size
        scene: NDArray[np.float32] = np.full((height, width), style.wall, np.float32)
        x0, y0, x1, y1 = self._region(T_cam_board)
        if x1 > x0 and y1 > y0:
            scene[y0:y1, x0:x1] = self._board(T_cam_board, x0, y0, x1, y1)
        scene = style.black + (style.white - style.black) / np.float32(255) * scene
        gain = 1 + style.lighting * (np.float32(np.cos(light)) * self._light_u + np.float32(np.sin(light)) * self._light_v)
        scene *= gain
        if style.blur_px > 0:
            cv2.GaussianBlur(scene, (0, 0), style.blur_px, dst=scene, borderType=cv2.BORDER_REPLICATE)
        if style.noise > 0:
            scene += style.noise * rng.standard_normal(scene.shape, dtype=np.float32)
        return np.clip(np.rint(scene, out=scene), 0, 255, out=scene).astype(np.uint8)

    def _region(self, T_cam_board: Array) -> tuple[int, int, int, int]:
        """Return the box x0, y0, x1, y1 of pixels that can see the board: the whole image where a part of its outline has no pixel."""
        corners, share = self.texture.outline, np.linspace(0, 1, 20, endpoint=False)[:, None, None]
        edge = (corners + share * (np.roll(corners, -1, axis=0) - corners)).reshape(-1, 2)
        seen = self.camera.model.project(edge @ T_cam_board[:3, :2].T + T_cam_board[:3, 3], self.camera.params)
        width, height = self.camera.size
        if not seen.valid.all():
            return 0, 0, width, height
        # Between the outline's points a bent edge may bulge out by a few pixels.
        low = np.clip(np.floor(seen.uv.min(axis=0)) - 4, 0, (width, height)).astype(int)
        high = np.clip(np.ceil(seen.uv.max(axis=0)) + 5, 0, (width, height)).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def _board(self, T_cam_board: Array, x0: int, y0: int, x1: int, y1: int) -> NDArray[np.float32]:
        """Return the reflectance of the box, board and wall, 0 black to 255 white."""
        s = self.style.supersampling
        level = self._level(T_cam_board, s)
        # [x y w] = [r1 r2 t]^-1 ray is the board point (x/w, y/w), in front of the camera where w > 0.
        H = np.linalg.inv(np.column_stack([T_cam_board[:3, 0], T_cam_board[:3, 1], T_cam_board[:3, 3]]))
        A = np.vstack([self.texture.texel_of_board(level), [0, 0, 1]]) @ H
        hit = cv2.transform(self._rays[y0 : y1 + 2, x0 : x1 + 2], A.astype(np.float32))
        w = hit[..., 2]
        ahead = w > 1e-9  # NaN, a pixel without a ray, is not
        inverse = 1 / np.where(ahead, w, 1)
        maps = []
        for axis in range(2):
            coarse = np.where(ahead, np.clip(hit[..., axis] * inverse, _FAR, -_FAR), _FAR)
            # The map is smooth: between pixel centres it is linear to 1e-3 px, and resize puts the samples where they belong.
            fine = cv2.resize(coarse, None, fx=s, fy=s, interpolation=cv2.INTER_LINEAR)
            maps.append(fine[s:-s, s:-s])
        wall = self.style.wall  # beyond the texture
        samples = cv2.remap(
            self.texture.levels[level], maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=wall
        )
        return cv2.resize(samples, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA).astype(np.float32)

    def _level(self, T_cam_board: Array, supersampling: int) -> int:
        """Return the coarsest level whose texels are no wider than the samples' distance where the board is nearest."""
        outline = np.concatenate([self.texture.outline, self.texture.outline.mean(axis=0, keepdims=True)])
        nearest = np.linalg.norm(outline @ T_cam_board[:3, :2].T + T_cam_board[:3, 3], axis=-1).min()
        sample = nearest / self.camera.params[:2].max() / supersampling
        return int(np.clip(np.floor(np.log2(max(sample / self.texture.size, 1))), 0, len(self.texture.levels) - 1))


def encode_jpeg(image: Gray, quality: int) -> bytes:
    """Return the image as a JPEG file."""
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
