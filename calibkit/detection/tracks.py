"""Features followed from image to image (Lucas and Kanade 1981, pyramids by Bouguet 2000), all over the image, few images in memory."""

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import FeatureTracks, ImageFrame, Lost
from calibkit.data.plural import counted
from calibkit.data.progress import Progress
from calibkit.errors import BadInputError, one_line
from calibkit.opencv import cv2

Points = NDArray[np.float32]
Gray = NDArray[np.uint8]

_FEATURES = 200
_CELLS = (6, 4)  # of the image, across and down: each gets its share of the features
_SPACING_PX = 9  # between features
_EDGE_PX = 6
_WINDOW, _LEVELS = (15, 15), 3  # 60 px beyond where they are looked for; of wider windows the middle is less exact: they turn and stretch
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003)
_BACK_PX = 0.5  # how far a feature tracked there and back may miss its start
_WEAKEST = 0.01  # of the strongest corner of the image
_AHEAD = 2  # images decoded before they are needed


def track_features(
    images: Iterable[ImageFrame], camera: str, progress: Progress, total: int | None = None, n_features: int = _FEATURES
) -> FeatureTracks:
    """Return about n_features tracks in each image; images that cannot be decoded, that are not later than the one before,
    or that repeat it, are left out.

    An image of another size is bad input, and so are images of which none can be read.
    """
    tracker = _Tracker(n_features)
    broken: list[str] = []
    late, repeated, n_images, size, first = 0, 0, 0, (0, 0), ""
    t_ns: list[int] = []
    labels: list[str] = []
    rows: list[tuple[NDArray[np.int32], NDArray[np.int32], Points]] = []
    with closing(_decoded(images)) as decoded:
        for frame, image in progress(decoded, f"features in {camera}", total):
            n_images += 1
            if isinstance(image, BadInputError):
                broken.append(f"{frame.label}: {image}")
                continue
            if t_ns and frame.t_ns <= t_ns[-1]:
                late += 1
                continue
            here = (image.shape[1], image.shape[0])
            if not t_ns:
                size, first = here, frame.label
            if here != size:
                raise BadInputError(
                    f"{camera}: image {one_line(frame.label, 80)} is {here[0]}x{here[1]}, {one_line(first, 80)} is {size[0]}x{size[1]}: "
                    "one camera has one image size, give each its own --camera or folder"
                )
            if tracker.same(image):
                repeated += 1
                continue
            number, uv = tracker.follow(image)
            rows.append((np.full(len(number), len(t_ns), np.int32), number, uv))
            t_ns.append(frame.t_ns)
            labels.append(frame.label)
    if not t_ns:
        why = (
            f"none of {counted(len(broken), 'image')} can be read, the first: {one_line(broken[0], 160)}"
            if broken
            else "there are no images"
        )
        raise BadInputError(f"{camera}: {why}")
    frame_of, track, points = (np.concatenate(column) for column in zip(*rows, strict=True))
    warnings: list[str] = []
    if broken:
        warnings.append(Lost(f"{len(broken)} of {n_images} images could not be read, the first: {one_line(broken[0], 160)}"))
    if late:
        warnings.append(f"{late} of {n_images} images are left out: their stamps repeat or go back")
    if repeated:
        warnings.append(f"{repeated} of {n_images} images are left out: pixel by pixel they are the one before")
    return FeatureTracks(
        camera, size, np.array(t_ns, np.int64), tuple(labels), frame_of, track, points.astype(np.float64), warnings=tuple(warnings)
    )


Decoded = tuple[ImageFrame, "NDArray[np.uint8] | NDArray[np.uint16] | BadInputError"]


def _decoded(images: Iterable[ImageFrame]) -> Generator[Decoded, None, None]:
    """Yield the images in order, a few decoded ahead while the caller works."""
    waiting: deque[Future[Decoded]] = deque()
    pool = ThreadPoolExecutor(1, thread_name_prefix="images")
    try:
        for frame in images:
            waiting.append(pool.submit(_decode, frame))
            if len(waiting) > _AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:  # an interrupt or an error: what has not begun is dropped
        pool.shutdown(wait=True, cancel_futures=True)


def _decode(frame: ImageFrame) -> Decoded:
    try:
        return frame, frame.decode()
    except BadInputError as error:
        return frame, error


def _flow(last: Gray, image: Gray, uv: Points, shift: Points) -> tuple[Points, NDArray[np.bool_]]:
    """Return where the features (n, 2) of the last image are in this one, looked for at uv + shift first, and which were found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        last, image, uv, uv + shift, winSize=_WINDOW, maxLevel=_LEVELS, criteria=_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    return np.asarray(there, np.float32), np.asarray(found)[:, 0] > 0


class _Tracker:
    """The features in the last image; `follow` moves them on to the next, and finds new ones where they have become few."""

    def __init__(self, n_features: int) -> None:
        self._quota = max(1, round(n_features / (_CELLS[0] * _CELLS[1])))
        self._gain: float | None = None  # from 16 bit to 8
        self._image: Gray | NDArray[np.uint16] = np.zeros((0, 0), np.uint8)  # as it came
        self._last = np.zeros((0, 0), np.uint8)
        self._uv: Points = np.zeros((0, 2), np.float32)
        self._number: NDArray[np.int32] = np.zeros(0, np.int32)
        self._shift: Points = np.zeros((0, 2), np.float32)  # how far each moved last time: where to look for it next
        self._born = 0

    def same(self, image: Gray | NDArray[np.uint16]) -> bool:
        """Return whether this is the last image again, as a driver that repeats itself gives it: a turn of exactly nothing."""
        return np.array_equal(self._image, image)

    def follow(self, image: NDArray[np.uint8] | NDArray[np.uint16]) -> tuple[NDArray[np.int32], Points]:
        """Return the numbers (n,), ascending, and pixels (n, 2) of the features in the next image."""
        gray, self._image = self._eight_bit(image), image
        if len(self._uv):
            self._move(gray)
        self._add(gray)
        self._last = gray
        return self._number, self._uv

    def _eight_bit(self, image: NDArray[np.uint8] | NDArray[np.uint16]) -> Gray:
        """Return the image with 8 bits: one gain for the recording, from the first image's bright end."""
        if image.dtype == np.uint8:
            return image.astype(np.uint8, copy=False)
        if self._gain is None:
            self._gain = 200.0 / max(float(np.percentile(image, 99.5)), 1.0)
        out: Gray = np.clip(np.rint(image * self._gain), 0, 255).astype(np.uint8)
        return out

    def _move(self, gray: Gray) -> None:
        there, found = _flow(self._last, gray, self._uv, self._shift)
        back, found_back = _flow(gray, self._last, there, -self._shift)
        high = np.array([gray.shape[1], gray.shape[0]]) - 1 - _EDGE_PX
        good = found & found_back & (np.linalg.norm(back - self._uv, axis=-1) < _BACK_PX)
        good &= np.all((there >= _EDGE_PX) & (there <= high), axis=-1)
        there, number, shift = there[good], self._number[good], (there - self._uv)[good]
        # Two that have run together are one: the older stays.
        _, alone = np.unique(np.floor(there / (_SPACING_PX / 2)), axis=0, return_index=True)
        alone.sort()
        self._uv, self._number, self._shift = there[alone], number[alone], shift[alone]

    def _add(self, gray: Gray) -> None:
        """Fill the cells that have less than their share with the strongest corners (Shi and Tomasi 1994) away from the features there."""
        height, width = gray.shape
        need = self._quota - np.bincount(self._cell(self._uv, width, height), minlength=_CELLS[0] * _CELLS[1])
        if need.max() <= self._quota // 4:
            return
        strength = cv2.cornerMinEigenVal(gray, 5)
        side = 2 * _SPACING_PX + 1
        highest = strength == cv2.dilate(strength, np.ones((side, side), np.uint8))
        highest &= strength > max(_WEAKEST * float(strength.max()), 1e-7)
        free = np.zeros_like(gray)
        free[_EDGE_PX : height - _EDGE_PX, _EDGE_PX : width - _EDGE_PX] = 1
        for u, v in np.rint(self._uv).astype(int).tolist():
            cv2.circle(free, (u, v), _SPACING_PX, 0, -1)
        v_new, u_new = np.nonzero(highest & (free > 0))
        order = np.argsort(-strength[v_new, u_new], kind="stable")
        uv = np.stack([u_new, v_new], axis=-1)[order].astype(np.float32)
        cell = self._cell(uv, width, height)
        by_cell = np.argsort(cell, kind="stable")
        count = np.bincount(cell, minlength=len(need))
        rank = np.empty(len(uv), np.intp)
        rank[by_cell] = np.arange(len(uv)) - np.repeat(np.cumsum(count) - count, count)
        fresh = uv[rank < need[cell]]
        self._uv = np.concatenate([self._uv, fresh])
        self._number = np.concatenate([self._number, np.arange(self._born, self._born + len(fresh), dtype=np.int32)])
        self._born += len(fresh)
        usual = np.median(self._shift, axis=0) if len(self._shift) else np.zeros(2)
        self._shift = np.concatenate([self._shift, np.tile(usual, (len(fresh), 1))]).astype(np.float32)

    @staticmethod
    def _cell(uv: Points, width: int, height: int) -> NDArray[np.intp]:
        column, row = (np.clip(uv[:, k] * _CELLS[k] / (width, height)[k], 0, _CELLS[k] - 1).astype(np.intp) for k in range(2))
        out: NDArray[np.intp] = row * _CELLS[0] + column
        return out
