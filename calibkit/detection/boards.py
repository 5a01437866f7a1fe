"""The detector of each kind of board: add one here."""

from collections.abc import Callable
from typing import Any

import numpy as np

from calibkit.detection import aprilgrid
from calibkit.detection.checkerboard import detect_charuco, detect_checkerboard
from calibkit.detection.circlegrid import detect_circlegrid
from calibkit.detection.found import Detection, Image
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid

DETECTORS: dict[str, Callable[[Image, Any], Detection]] = {
    AprilGrid.kind: aprilgrid.detect,
    Checkerboard.kind: detect_checkerboard,
    Charuco.kind: detect_charuco,
    CircleGrid.kind: detect_circlegrid,
}


def detect(image: Image, board: Board) -> Detection:
    """Return the board's corners in a gray image (h, w); empty where it is not found."""
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"detect needs a gray uint8 or uint16 image (h, w), got {image.dtype} {image.shape}")
    if min(image.shape) < 16:
        return DETECTORS[board.kind](np.zeros((16, 16), np.uint8), board)
    return DETECTORS[board.kind](image, board)
