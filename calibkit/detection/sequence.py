"""Boards in a video: where the last image's corners are now is told by optical flow, and the search for the board is spared.

What the flow says is only a first guess: corners are fitted and judged as those of a search, and where a board has tags each carries its
own code, so that one slipped by a tag is none. Any doubt is a search.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibkit.detection import aprilgrid
from calibkit.detection.boards import detect
from calibkit.detection.found import Detection, Gray, Image, scaled_to, to_8_bit
from calibkit.detection.plane_maps import middling
from calibkit.models.board import AprilGrid, Board
from calibkit.opencv import cv2

Array = NDArray[np.float64]

FOLLOWERS: dict[str, Callable[[Image, Any, NDArray[np.int32], Array], Detection | None]] = {AprilGrid.kind: aprilgrid.follow}

_SIZE = 376  # px, long side of the images in which the flow is sought: it need not be exact
_WINDOW, _LEVELS = (11, 11), 3  # finds motions up to some 100 px of 752
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)
_POINTS = 36  # at most, that the flow follows
_FEWEST = 8  # of them that agree
_AGREE_PX = 6.0  # with one homography: at a fisheye's rim as much is bent by the lens
_PATIENCE = 2  # searches in vain for a board that flow foretold: these images are no video


class Sequence:
    """Looks for a board in one image after another."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._follow = FOLLOWERS.get(board.kind)
        self._last: tuple[Gray, Detection] | None = None
        self._failed = 0

    def look(self, image: Image) -> Detection:
        """Return the board's corners in the next image, as `detect` does."""
        if self._follow is None or self._failed >= _PATIENCE or min(image.shape) < 64:
            return detect(image, self._board)
        small = scaled_to(to_8_bit(image), _SIZE)[0]
        found = self._followed(image, small)
        if found is None:
            found = detect(image, self._board)
        in_order = not (found.tags.misplaced or found.tags.foreign)
        self._last = (small, found) if in_order and len(found.corner) >= _FEWEST else None
        return found

    def _followed(self, image: Image, small: Gray) -> Detection | None:
        if self._follow is None or self._last is None or self._last[0].shape != small.shape:
            return None
        last, before = self._last
        uv = _carried(last, small, before.uv, small.shape[1] / image.shape[1])
        found = None if uv is None else self._follow(image, self._board, before.corner, uv)
        self._failed += found is None
        return found


def _carried(last: Gray, now: Gray, uv: Array, scale: float) -> Array | None:
    """Return where points uv (n, 2) of the last image are now: by the homography that some of them have moved by, and beside it as those
    around, since a lens bends.
    """
    some = uv[np.unique(np.linspace(0, len(uv) - 1, _POINTS).astype(int))]
    start = ((some + 0.5) * scale - 0.5).astype(np.float32)
    end, found, _ = cv2.calcOpticalFlowPyrLK(last, now, start, np.zeros_like(start), winSize=_WINDOW, maxLevel=_LEVELS, criteria=_STOP)
    moved = found.ravel() > 0
    if moved.sum() < _FEWEST:
        return None
    before, after = some[moved], (end[moved].astype(float) + 0.5) / scale - 0.5
    H, inliers = cv2.findHomography(before, after, cv2.RANSAC, _AGREE_PX / scale)
    if H is None or inliers.sum() < max(_FEWEST, moved.sum() / 2):
        return None
    agree = inliers.ravel() > 0
    before, after = before[agree], after[agree]
    beside = after - cv2.perspectiveTransform(before[None], H)[0]
    apart = ((uv[:, None] - before) ** 2).sum(-1)
    weight = np.exp(-apart / (2 * middling(np.sort(apart, axis=1)[:, 1])))
    out: Array = cv2.perspectiveTransform(uv[None], H)[0] + weight @ beside / (weight.sum(1, keepdims=True) + 0.1)
    return out
