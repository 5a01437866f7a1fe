"""Tags of the family 36h11 with Kalibr's two-bit border: their codes, first guesses of where they are, and whether one is really there.

OpenCV counts a tag's corners clockwise in the image from its code's top left; Kalibr's corner k is OpenCV's corner (1 - k) mod 4.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.detection.corner_fit import Smoothed, sample
from calibkit.detection.found import Gray, scaled_to
from calibkit.detection.plane_maps import apply, square_to
from calibkit.opencv import cv2

Array = NDArray[np.float64]
Ids = NDArray[np.int32]

_FAMILY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
N_TAGS = len(_FAMILY.bytesList)
_BITS, BORDER = 6, 2
CELLS = _BITS + 2 * BORDER  # across a tag
_WORK_SIZE = 1000  # px, long side of the image in which tags are looked for first


def code(tag: int) -> Gray:
    """Return the 6 x 6 cells inside a tag's border, 1 = white, [i, j] with i along the board's y and j along its x."""
    bits = np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(_FAMILY.bytesList[tag : tag + 1], _BITS), np.uint8)
    return bits[:, ::-1]


def _normalised(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    cells = cells - cells.mean(-1, keepdims=True)
    out: NDArray[np.float32] = cells / np.maximum(np.linalg.norm(cells, axis=-1, keepdims=True), 1e-6)
    return out


def _templates() -> NDArray[np.float32]:
    codes = np.stack([code(tag) for tag in range(N_TAGS)]).astype(np.float32)
    turned = [np.rot90(codes, turn, axes=(1, 2)) for turn in range(4)]
    return _normalised(np.stack(turned, axis=1).reshape(-1, _BITS**2))  # row 4 * tag + turn


_TEMPLATES = _templates()

_CELLS = (np.stack(np.meshgrid(np.arange(_BITS), np.arange(_BITS)), axis=-1).reshape(-1, 2) + BORDER + 0.5) / CELLS  # (36, 2) in tag sides
_RIM = np.array([[t, e] for t in (0.3, 0.5, 0.7) for e in (0.1, 0.9)])
_RIM = np.concatenate([_RIM, _RIM[:, ::-1]])  # in the black border


def verify(image: Smoothed, tags: Ids, corners: Array) -> NDArray[np.bool_]:
    """Return whether the cells inside `corners` (n, 4, 2) carry the code of `tags` (n,) rather than any other, the right way up."""
    H = square_to(corners)
    cells = sample(image, apply(H, _CELLS))
    score = _normalised(cells) @ _TEMPLATES.T
    own = np.take_along_axis(score, 4 * tags[:, None].astype(np.intp), 1)[:, 0]
    dark = sample(image, apply(H, _RIM)).mean(1) < (cells.min(1) + cells.max(1)) / 2
    out: NDArray[np.bool_] = (own >= score.max(1)) & (own > 0.5) & dark
    return out


def _finder(window: int) -> cv2.aruco.ArucoDetector:
    """OpenCV's detector with one threshold window: small ones part the tags from the black squares that touch their corners."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = BORDER
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window
    parameters.minMarkerPerimeterRate = 0.05
    parameters.polygonalApproxAccuracyRate = 0.05
    return cv2.aruco.ArucoDetector(_FAMILY, parameters)


def _plain(image: Gray) -> Gray:
    return image


def _soften(image: Gray) -> Gray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.2), np.uint8)


def _sharpen(image: Gray) -> Gray:
    """Stretch between the 2 % and 98 % levels, then an unsharp mask of three times the detail."""
    low, high = np.percentile(image[::4, ::4], (2, 98))
    gain = 255 / max(float(high - low), 1.0)
    stretched = np.asarray(cv2.convertScaleAbs(np.maximum(image, np.uint8(low)), alpha=gain, beta=-gain * np.floor(low)), np.uint8)
    return np.asarray(cv2.addWeighted(stretched, 3, cv2.GaussianBlur(stretched, (0, 0), 3), -2, 0), np.uint8)


@dataclass(frozen=True)
class _Way:
    """One way to find first tags."""

    enlarge: int  # at most, of an image reduced to `enlarge` times the work size
    prepare: Callable[[Gray], Gray]
    window: int  # px, of OpenCV's threshold
    inset: float  # px of the prepared image by which the found sides lie inside the tag's: measured on rendered boards


# The next is tried where the one before found no board. Of rendered boards the first finds the sharp ones (7 ms at 752 x 480), then come
# noise, blur or low contrast, stronger blur, and small or slanted tags.
_WAYS = (_Way(1, _plain, 3, 1.6), _Way(1, _soften, 5, 0.9), _Way(1, _sharpen, 3, 1.2), _Way(1, _sharpen, 5, 2.3), _Way(2, _sharpen, 3, 1.4))


def seeds(image: Gray) -> Iterator[tuple[Ids, Array]]:
    """Yield first guesses (tags (n,), corners (n, 4, 2) px in Kalibr's order), the cheapest way first; corners err by some px."""
    for way in _WAYS:
        resized, scale = scaled_to(image, way.enlarge * _WORK_SIZE, way.enlarge)
        quads, found, _ = _finder(way.window).detectMarkers(way.prepare(resized))
        tags = np.asarray(found if len(quads) else [], np.int32).ravel()
        if not len(tags):
            continue
        corners = np.array(quads, float).reshape(-1, 4, 2)[:, [1, 0, 3, 2]]
        outward = corners - corners.mean(1, keepdims=True)
        corners += outward * (2 * way.inset / np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1))[:, None, None]
        yield tags, (corners + 0.5) / scale - 0.5
