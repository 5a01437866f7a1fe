"""Circle grids: OpenCV finds the blobs; their weighted centroids are the centres.

A projected circle's centroid is not its centre's projection (by some hundredths of a pixel at strong tilt): prefer boards with corners.
"""

import numpy as np

from calibkit.detection.found import NOTHING, Detection, Image, scaled_to, to_8_bit
from calibkit.models.board import CircleGrid
from calibkit.opencv import cv2

_SIGMA_PX = 0.1  # of OpenCV's blob centroids on clean images; they carry no estimate of their own
_WORK_SIZES = (1000, 2000)  # px, long sides at which discs are looked for
_LARGEST = 0.05  # of the image, that one disc may cover; OpenCV's own limit is 5000 px


def detect_circlegrid(image: Image, board: CircleGrid) -> Detection:
    """Return all centres, or none."""
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    gray = to_8_bit(image)
    for size in _WORK_SIZES:
        resized, scale = scaled_to(gray, size)
        blobs = _blob_detector(resized.size * _LARGEST)
        for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
            found, centres = cv2.findCirclesGrid(resized, (board.columns, board.rows), flags=flags, blobDetector=blobs)
            if found:
                n = board.columns * board.rows
                uv = (centres.reshape(-1, 2).astype(float) + 0.5) / scale - 0.5
                return Detection(np.arange(n, dtype=np.int32), uv, np.full(n, _SIGMA_PX / scale))
    return NOTHING


def _blob_detector(largest: float) -> cv2.SimpleBlobDetector:
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.maxArea = max(largest, parameters.minArea)
    return cv2.SimpleBlobDetector.create(parameters)
