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


def _normalised(cells: Array) -> Array:
    cells = cells - cells.mean(-1, keepdims=True)
    out: Array = cells / np.maximum(np.linalg.norm(cells, axis=-1, keepdims=True), 1e-9)
    return out


def _templates() -> Array:
    codes = np.stack([code(tag) for tag in range(N_TAGS)]).astype(float)
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


def _finder(**settings: float) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = BORDER
    for name, value in settings.items():
        setattr(parameters, name, value)
    return cv2.aruco.ArucoDetector(_FAMILY, parameters)


def _one_window() -> cv2.aruco.ArucoDetector:
    # A threshold window of 3 px separates the tags from the small squares that touch their corners, larger ones merge them
    return _finder(adaptiveThreshWinSizeMin=3, adaptiveThreshWinSizeMax=3, minMarkerPerimeterRate=0.05, polygonalApproxAccuracyRate=0.05)


def _sharpen(image: Gray) -> Gray:
    darkest, brightest = int(image.min()), int(image.max())
    stretched = (image - np.float32(darkest)) * np.float32(255 / max(brightest - darkest, 1))
    sharp = 3 * stretched - 2 * np.asarray(cv2.GaussianBlur(stretched, (0, 0), 3))
    out: Gray = np.clip(sharp, 0, 255).astype(np.uint8)
    return out


@dataclass(frozen=True)
class _Way:
    """One way to find first tags."""

    size: int  # px, the long side that the image is reduced, or at most doubled, to
    prepare: Callable[[Gray], Gray]
    detector: Callable[[], cv2.aruco.ArucoDetector]
    inset: float  # px per axis of that image by which its corners lie inside the tag's


_WAYS = (  # the next is tried where the one before found no board
    _Way(_WORK_SIZE, lambda image: image, _one_window, 1.7),
    _Way(2 * _WORK_SIZE, _sharpen, _finder, 1.0),
    _Way(2 * _WORK_SIZE, lambda image: image, lambda: _finder(cornerRefinementMethod=cv2.aruco.CORNER_REFINE_APRILTAG), 0.0),
)


def seeds(image: Gray) -> Iterator[tuple[Ids, Array]]:
    """Yield first guesses (tags (n,), corners (n, 4, 2) px in Kalibr's order), the cheapest way first; corners err by some px."""
    for way in _WAYS:
        resized, scale = scaled_to(image, way.size, 2.0 if way.size > _WORK_SIZE else 1.0)
        quads, found, _ = way.detector().detectMarkers(way.prepare(resized))
        tags = np.asarray(found if len(quads) else [], np.int32).ravel()
        if not len(tags):
            continue
        corners = np.array(quads, float).reshape(-1, 4, 2)[:, [1, 0, 3, 2]]
        outward = corners - corners.mean(1, keepdims=True)
        corners += outward * (2 * way.inset / np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1))[:, None, None]
        yield tags, (corners + 0.5) / scale - 0.5
