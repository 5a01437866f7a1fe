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
from calibkit.models.board import AprilGrid, Board
from calibkit.opencv import cv2

Array = NDArray[np.float64]

FOLLOWERS: dict[str, Callable[[Image, Any, NDArray[np.int32], Array], Detection | None]] = {AprilGrid.kind: aprilgrid.follow}

_SIZE = 376  # px, long side of the images in which the flow is sought: it need not be exact
_WINDOW, _LEVELS = (11, 11), 3  # finds motions up to some 100 px of 752
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.03)
_POINTS = 24  # at most, that the flow follows
_FEWEST = 8  # of them that agree
_AGREE_PX = 3.0  # with one homography, in the image's own px
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
    """Return where points uv (n, 2) of the last image are now, by the homography that most of some of them have moved by."""
    some = uv[np.unique(np.linspace(0, len(uv) - 1, _POINTS).astype(int))]
    start = ((some + 0.5) * scale - 0.5).astype(np.float32)
    end, found, _ = cv2.calcOpticalFlowPyrLK(last, now, start, np.zeros_like(start), winSize=_WINDOW, maxLevel=_LEVELS, criteria=_STOP)
    moved = found.ravel() > 0
    if moved.sum() < _FEWEST:
        return None
    H, agree = cv2.findHomography(some[moved], (end[moved].astype(float) + 0.5) / scale - 0.5, cv2.RANSAC, _AGREE_PX)
    if H is None or agree.sum() < max(_FEWEST, moved.sum() / 2):
        return None
    out: Array = cv2.perspectiveTransform(uv[None], H)[0]
    return out
