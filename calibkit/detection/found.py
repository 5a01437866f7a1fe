"""What a detector hands back for one image, and how images are made ready for OpenCV's finders."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.opencv import cv2

Gray = NDArray[np.uint8]
Image = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True)
class Tags:
    """How many tags were read in an image by their own codes, and how many of them contradict the board's layout."""

    on_board: int = 0  # with numbers that the board has
    misplaced: int = 0  # of those, not where the others and the layout put them
    foreign: int = 0  # with numbers that the board does not have


@dataclass(frozen=True)
class Detection:
    """Corners of one board in one image; empty where there is none. Pixel (0, 0) is the centre of the top-left pixel."""

    corner: NDArray[np.int32]  # (n,) index into board.points
    uv: NDArray[np.float64]  # (n, 2) px
    sigma_px: NDArray[np.float64]  # (n,) px per coordinate
    tags: Tags = Tags()  # of an AprilGrid, which numbers its tags by their codes


Entry = tuple[tuple[int, int], Detection]  # image width and height, what was found
NOTHING = Detection(np.zeros(0, np.int32), np.zeros((0, 2)), np.zeros(0))


def to_8_bit(image: Image) -> Gray:
    """Return the image in 8 bits for OpenCV's finders; 16 bits are stretched, since cameras of 10 or 12 bits fill only a part."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    low, high = np.percentile(image[::4, ::4], (0.1, 99.9))
    scaled: Gray = np.clip((image.astype(np.float32) - low) * (255 / max(high - low, 1)), 0, 255).astype(np.uint8)
    return scaled


def scaled_to(gray: Gray, long_side: int, at_most: float = 1.0) -> tuple[Gray, float]:
    """Return the image with the long side asked for, enlarged `at_most` times, and the scale: u_scaled + 1/2 = scale (u + 1/2)."""
    scale = min(long_side / max(gray.shape), at_most)
    if scale == 1:
        return gray, scale
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=how), np.uint8), scale
