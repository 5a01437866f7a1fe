"""Circle grids: OpenCV finds the blobs; their weighted centroids are the centres.

A projected circle's centroid is not its centre's projection (by some hundredths of a pixel at strong tilt): prefer boards with corners.
"""

import numpy as np

from calibkit.detection.found import NOTHING, Detection, Image, to_8_bit
from calibkit.models.board import CircleGrid
from calibkit.opencv import cv2

_SIGMA_PX = 0.1  # of OpenCV's blob centroids on clean images; they carry no estimate of their own


def detect_circlegrid(image: Image, board: CircleGrid) -> Detection:
    """Return all centres, or none."""
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    gray = to_8_bit(image)
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centres = cv2.findCirclesGrid(gray, (board.columns, board.rows), flags=flags)
        if found:
            n = board.columns * board.rows
            return Detection(np.arange(n, dtype=np.int32), centres.reshape(-1, 2).astype(float), np.full(n, _SIGMA_PX))
    return NOTHING
