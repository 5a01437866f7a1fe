"""Checkerboards and ChArUco boards: OpenCV finds which corner is which, the symmetry fit says where it is.

Where the inner rows + columns of a checkerboard are odd, the square beyond its first corner is the black one of the two at its ends, and
its frame is the same in every image. Where they are even it looks the same turned by 180 degrees, where they are equal by 90 degrees too:
its frame is then the finder's choice, image by image. A lens does not mind; hand-eye and several cameras do: use an odd sum, or tags.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calibkit.detection.corner_fit import saddle, sample, smooth, symmetry
from calibkit.detection.found import NOTHING, Detection, Gray, Image, scaled_to, to_8_bit
from calibkit.detection.plane_maps import in_line, local_maps
from calibkit.errors import BadInputError
from calibkit.models.board import Charuco, Checkerboard
from calibkit.opencv import cv2

Array = NDArray[np.float64]

_WORK_SIZE = 1000  # px, long side at which boards are looked for first
_SMALL_SIZE = 640  # px, for the finder that takes long where it fails
_WEAKEST = 0.3  # of the middling corner's saddle, in the weakest of a board: above 0.49 on real boards, below where a part is out of view
_ALIKE = 0.8  # of it, in the first saddles beyond half as many again: a larger board; beside real boards up to 0.65
_RADIUS = 0.3  # of the windows, in squares
_REACH = 1.0  # squares over which neighbours tell how a lens bends
_OUT_OF_LINE = 0.1  # squares
_OUTSIDE = np.array([[1.875, -1.25, 0.375], [4.375, -5.25, 1.875]])  # of three rows, for the places 0.5 and 1.5 squares beyond the first
_ENOUGH = 0.9  # of a checkerboard's corners: a glare may take a few


def detect_checkerboard(image: Image, board: Checkerboard) -> Detection:
    """Return the inner corners of a checkerboard wholly in view: one in part cannot say which part."""
    gray = to_8_bit(image)
    n = board.columns * board.rows
    saddles = _saddles(scaled_to(gray, _WORK_SIZE)[0])
    if len(saddles) < n or saddles[n - 1] < _WEAKEST * saddles[n // 2]:
        return NOTHING  # the finders would spend up to a second to say so
    crowded = len(saddles) > 1.5 * n and saddles[3 * n // 2] > _ALIKE * saddles[n // 2]
    for size, find in _FINDERS[: 1 if crowded else None]:
        resized, scale = scaled_to(gray, size)
        uv = find(resized, (board.columns, board.rows))
        if uv is not None:
            if _goes_on(resized, uv.reshape(board.rows, board.columns, 2)):
                return NOTHING
            corner = np.arange(board.columns * board.rows, dtype=np.int32)
            xy = np.stack([corner % board.columns, corner // board.columns], axis=-1).astype(float)
            found = _refine(image, corner, xy, _turned(gray, xy, (uv + 0.5) / scale - 0.5, board), _RADIUS)
            if len(found.corner) >= _ENOUGH * len(corner):
                return found
    return NOTHING


def _saddles(gray: Gray) -> Array:
    """Return how saddle-shaped the places are that are most so around, by the Hessian's determinant, the strongest first."""
    smoothed = cv2.GaussianBlur(gray, (0, 0), 1.5)
    xx, xy, yy = (cv2.Sobel(smoothed, cv2.CV_32F, *order) for order in ((2, 0), (1, 1), (0, 2)))
    like = np.asarray(xy * xy - xx * yy)
    peaks: Array = np.sort(like[(like >= cv2.dilate(like, np.ones((7, 7), np.uint8))) & (like > 0)].astype(float))[::-1]
    return peaks


def _goes_on(gray: Gray, uv: Array) -> bool:
    """Return whether black and white go on beyond the outer squares on a side of the corners uv (rows, columns, 2).

    It is part of a larger board then: beyond a board's end, one and a half squares outside its corners, nothing alternates.
    """
    image = gray.astype(np.float32)
    for side in (uv, uv[::-1], uv.swapaxes(0, 1), uv.swapaxes(0, 1)[::-1]):
        middle = (side[:3, :-1] + side[:3, 1:]) / 2
        near, beyond = (np.tensordot(weight, middle, 1) for weight in _OUTSIDE)
        if not ((beyond >= 0) & (beyond <= np.array(gray.shape[::-1]) - 1)).all():
            continue
        alternating = (-1.0) ** np.arange(len(near))
        inner, outer = (alternating * (v - v.mean()) for v in (sample(image, near), sample(image, beyond)))
        contrast = inner.mean()
        if (outer * np.sign(contrast) < -0.5 * abs(contrast)).mean() > 0.9:
            return True
    return False


def _turned(gray: Gray, xy: Array, uv: Array, board: Checkerboard) -> Array:
    """Return the corners in the order that gives the board's frame: seen from the front, and from the black end where there is one."""
    maps, _ = local_maps(xy, uv, _REACH)
    if np.linalg.det(maps.J).sum() < 0:
        uv = uv.reshape(board.rows, board.columns, 2)[:, ::-1].reshape(-1, 2)
        maps, _ = local_maps(xy, uv, _REACH)
    across, down = maps.J[:, :, 0] / 2, maps.J[:, :, 1] / 2
    image = gray.astype(np.float32)
    diagonal = sample(image, uv - across - down) + sample(image, uv + across + down)
    other = sample(image, uv - across + down) + sample(image, uv + across - down)
    first_is_white = ((-1.0) ** xy.sum(1) * (diagonal - other)).sum() > 0
    return uv[::-1] if first_is_white and (board.rows + board.columns) % 2 else uv


def _classic(gray: Gray, size: tuple[int, int]) -> Array | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(gray, size, flags=flags)
    return corners.reshape(-1, 2).astype(float) if found else None


def _sectors(gray: Gray, size: tuple[int, int]) -> Array | None:
    found, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    return corners.reshape(-1, 2).astype(float) if found else None


_Finder = Callable[[Gray, tuple[int, int]], "Array | None"]
_FINDERS: tuple[tuple[int, _Finder], ...] = (
    (_WORK_SIZE, _classic),
    (_SMALL_SIZE, _sectors),
)


def _refine(image: Image, corner: NDArray[np.int32], xy: Array, uv: Array, radius: float) -> Detection:
    """Return the corners at xy (n, 2) squares pinned down from uv (n, 2) px, those out of line with their neighbours left out."""
    smoothed = smooth(image)
    maps, _ = local_maps(xy, uv, _REACH)
    start, found = saddle(smoothed, uv, radius * maps.J)
    start = np.where(found[:, None], start, uv)
    maps, _ = local_maps(xy, start, _REACH)
    fit = symmetry(smoothed, start, maps, radius)
    side = np.sqrt(np.abs(np.linalg.det(maps.J)))
    ok = fit.ok & in_line(local_maps(xy, fit.uv, _REACH)[1], _OUT_OF_LINE * side)
    return Detection(corner[ok], fit.uv[ok], fit.sigma_px[ok])


@lru_cache(maxsize=4)
def charuco_board(board: Charuco) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's form of the board."""
    name = board.dictionary
    if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
        raise BadInputError(f"OpenCV has no tag dictionary {name!r}: use one such as DICT_4X4_50 or DICT_5X5_100")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    needed = board.columns * board.rows // 2
    if needed > len(dictionary.bytesList):
        raise BadInputError(
            f"a ChArUco board of {board.columns} x {board.rows} needs {needed} tags, {name} has {len(dictionary.bytesList)}: "
            "use fewer squares or a dictionary of more"
        )
    made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_size, board.marker_size, dictionary)
    made.setLegacyPattern(board.legacy)
    return made


def detect_charuco(image: Image, board: Charuco) -> Detection:
    """Return the inner corners in view, each next to a tag that was read."""
    gray = to_8_bit(image)
    resized, scale = scaled_to(gray, 2 * _WORK_SIZE)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco_board(board)).detectBoard(resized)
    if ids is None or len(ids) < 4:
        return NOTHING
    corner = ids.ravel().astype(np.int32)
    order = np.argsort(corner)
    xy = board.points[corner[order], :2] / board.square_size
    margin = (1 - board.marker_size / board.square_size) / 2  # white between a tag and its square's edge
    uv = (corners.reshape(-1, 2)[order].astype(float) + 0.5) / scale - 0.5
    return _refine(image, corner[order], xy, uv, min(_RADIUS, 1.2 * margin))
