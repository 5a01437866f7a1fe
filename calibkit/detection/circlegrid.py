"""Circle grids: OpenCV finds the blobs; their centroids, corrected for perspective and lens, are the centres."""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from calibkit.detection.found import NOTHING, Detection, Gray, Image, scaled_to, to_8_bit
from calibkit.detection.plane_maps import local_maps
from calibkit.models.board import CircleGrid
from calibkit.opencv import cv2

Array = NDArray[np.float64]

_SIGMA_PX = 0.1  # of OpenCV's blob centroids on clean images; they carry no estimate of their own
_WORK_SIZES = (1000, 2000)  # px, long sides at which discs are looked for
_LARGEST = 0.05  # of the image, that one disc may cover; OpenCV's own limit is 5000 px
_REACH = 0.85  # distances to the nearest neighbour over which they tell how the image of a disc bends


def detect_circlegrid(image: Image, board: CircleGrid) -> Detection:
    """Return all centres, or none."""
    gray = to_8_bit(image)
    for size in _WORK_SIZES:
        resized, scale = scaled_to(gray, size)
        blobs, radius = _blobs(resized)
        centres = _arranged(blobs, board)
        if centres is not None:
            n = board.columns * board.rows
            nearest = np.linalg.norm(blobs - centres[:, None], axis=-1).argmin(1)
            uv = centres - _drawn_by_perspective(board, centres, radius[nearest])
            return Detection(np.arange(n, dtype=np.int32), (uv + 0.5) / scale - 0.5, np.full(n, _SIGMA_PX / scale))
    return NOTHING


def _blobs(gray: Gray) -> tuple[Array, Array]:
    """Return the centroids (n, 2) and radii (n,) of dark blobs in px."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.maxArea = max(gray.size * _LARGEST, parameters.minArea)
    found = cv2.SimpleBlobDetector.create(parameters).detect(gray)
    return np.array([blob.pt for blob in found], float).reshape(-1, 2), np.array([blob.size / 2 for blob in found], float)


def _arranged(blobs: Array, board: CircleGrid) -> Array | None:
    """Return the blobs (n, 2) in the board's order, if they make it up."""
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    if len(blobs) < board.columns * board.rows:
        return None
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centres = cv2.findCirclesGrid(
            blobs.astype(np.float32)[:, None],
            (board.columns, board.rows),
            flags=flags,
            blobDetector=cast(Any, None),  # the image is the list of blobs then
            parameters=cv2.CirclesGridFinderParameters(),
        )
        if found:
            return np.asarray(centres, float).reshape(-1, 2)
    return None


def _drawn_by_perspective(board: CircleGrid, uv: Array, radius_px: Array) -> Array:
    """Return by how much (n, 2) px the centroids of the discs' images lie off the images of their centres.

    For a disc of radius r and the map p(d) = J d + Q(d, d) / 2: r^2 / 8 tr Q + r^2 / 4 J grad log |det p'|, the second for the area that
    one side of the disc has more than the other (Heikkila 2000 gives the same for a homography).
    """
    neighbour = board.spacing * (np.sqrt(2) if board.asymmetric else 1.0)
    maps, _ = local_maps(board.points[:, :2] / neighbour, uv, _REACH)
    J, Q = maps.J, maps.Q
    columns = np.stack([Q[:, [0, 1]], Q[:, [1, 2]]], axis=1)  # (n, direction, column of p', 2)
    slope = np.trace(np.linalg.solve(J[:, None], np.swapaxes(columns, 2, 3)), axis1=2, axis2=3)  # of log |det p'|
    r2 = np.median(radius_px**2 / np.abs(np.linalg.det(J)))  # the discs are all the same
    out: Array = r2 * ((Q[:, 0] + Q[:, 2]) / 8 + (J @ slope[..., None])[..., 0] / 4)
    return out
