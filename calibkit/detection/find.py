"""All images of one camera to board corners: several at once, in order, few in memory, from the cache where they were seen before."""

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from calibkit.data.observations import BoardViews, ImageFrame, Lost
from calibkit.data.plural import counted
from calibkit.data.progress import Progress
from calibkit.detection.cache import CornerCache
from calibkit.detection.crew import Answers, Crew
from calibkit.detection.found import NOTHING, Entry, Tags
from calibkit.errors import BadInputError, one_line
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid
from calibkit.opencv import cv2

# What stays of a corner's error at one place of the image, however many frames. Corners: maximum likelihood over six simulated recordings'
# lens errors is 0.0027 px, at most 0.0036 (95 %). Circles: 0.034 (0.026 to 0.05) over two.
BIAS_PX = {AprilGrid.kind: 0.004, Checkerboard.kind: 0.004, Charuco.kind: 0.004, CircleGrid.kind: 0.03}
_NAMED = 3  # broken images named one by one
_WRONG_LAYOUT = 0.25  # of the tags in an image: one column too many misplaces four fifths, a right target hardly any
_SHORT_BATCH, _LONG_BATCH = 4, 30  # consecutive images that are looked through together
_SOME = 32  # images in short batches, so that a few are shared out evenly
_BATCH_BYTES = 32 * 2**20  # as stored
_STRAY = 0.05  # of all tags, worth a warning
Outcome = tuple[int, str, "Entry | BadInputError"]  # stamp, label, what came of the frame


def find_boards(
    frames: Iterable[ImageFrame], board: Board, camera: str, cache: CornerCache | None, progress: Progress, total: int | None = None
) -> BoardViews:
    """Return the board's corners in every frame that shows it; frames that cannot be decoded are counted and named in the warnings."""
    outcomes = list(progress(_of_one_size(_in_order(frames, board, cache, total or 0), camera), f"boards in {camera}", total))
    broken = [f"{label}: {result}" for _, label, result in outcomes if isinstance(result, BadInputError)]
    if broken and len(broken) == len(outcomes):
        raise BadInputError(f"{camera}: none of {counted(len(broken), 'image')} can be read, the first: {one_line(broken[0], 160)}")
    seen = [(t_ns, label, *result) for t_ns, label, result in outcomes if not isinstance(result, BadInputError)]
    shown = [(t_ns, label, found) for t_ns, label, _, found in seen if len(found.corner)]
    found = [detection for _, _, detection in shown] or [NOTHING]
    about_tags = _about_tags([detection.tags for *_, detection in seen], camera)
    return BoardViews(
        board=board,
        image_size=_one_size([(label, size) for _, label, size, _ in seen], camera),
        t_ns=np.array([t_ns for t_ns, _, _ in shown], np.int64),
        labels=tuple(label for _, label, _ in shown),
        frame=np.repeat(np.arange(len(found), dtype=np.int32), [len(detection.corner) for detection in found]),
        corner=np.concatenate([detection.corner for detection in found]),
        uv=np.concatenate([detection.uv for detection in found]),
        sigma_px=np.concatenate([detection.sigma_px for detection in found]),
        camera=camera,
        sigma_bias_px=BIAS_PX[board.kind],
        n_images=len(outcomes),
        warnings=_about_broken(broken, len(outcomes)) + about_tags,
    )


def _of_one_size(outcomes: Generator[Outcome, None, None], camera: str) -> Iterator[Outcome]:
    """Pass outcomes on, and stop at the first image of another size; three images tell which of two sizes is the odd one."""
    sizes: list[tuple[str, tuple[int, int]]] = []
    odd = False
    with closing(outcomes):  # what is under way is dropped
        for outcome in outcomes:
            _, label, result = outcome
            if not isinstance(result, BadInputError):
                sizes.append((label, result[0]))
                odd = odd or result[0] != sizes[0][1]
                if odd and len(sizes) >= 3:
                    _one_size(sizes, camera)
            yield outcome


def _one_size(sizes: list[tuple[str, tuple[int, int]]], camera: str) -> tuple[int, int]:
    """Return the size that all images share; the odd one out is named."""
    counts = Counter(size for _, size in sizes)
    if not counts:
        return 0, 0
    (common, _), *others = counts.most_common()
    if others:
        label, odd = next((label, size) for label, size in sizes if size != common)
        raise BadInputError(
            f"{camera}: image {one_line(label, 80)} is {odd[0]}x{odd[1]}, most others are {common[0]}x{common[1]}: "
            "one camera has one image size, give each its own --camera or folder"
        )
    return common


def _about_broken(broken: list[str], n_images: int) -> tuple[str, ...]:
    if not broken:
        return ()
    more = f", and {len(broken) - _NAMED} more" if len(broken) > _NAMED else ""
    named = "; ".join(one_line(text, 120) for text in broken[:_NAMED])
    return (Lost(f"{len(broken)} of {n_images} images could not be read: {named}{more}"),)


def _about_tags(tags: list[Tags], camera: str) -> tuple[str, ...]:
    """Refuse a layout that most images contradict, as a wrong tagCols does: what is left fits together, and would calibrate well."""
    read = [t for t in tags if t.on_board >= 2]
    total, misplaced = sum(t.on_board for t in read), sum(t.misplaced for t in read)
    if 2 * sum(t.misplaced > _WRONG_LAYOUT * t.on_board for t in read) > len(read) and misplaced > _WRONG_LAYOUT * total:
        raise BadInputError(
            f"{camera}: {misplaced / total:.0%} of the tags found ({misplaced} of {total}) are not where the target file says: "
            "check its tagCols, tagRows and tagSpacing"
        )
    foreign, every = sum(t.foreign for t in tags), sum(t.on_board + t.foreign for t in tags)
    warnings = []
    if misplaced > _STRAY * total:
        warnings.append(
            f"{misplaced} of {total} tags found are not where the target file says, and are left out: is another board in view?"
        )
    if foreign > _STRAY * every:
        warnings.append(
            f"{foreign} of {every} tags found have numbers that the target does not have, and are left out: "
            "check its tagCols and tagRows, or is another board in view?"
        )
    return tuple(warnings)


def _in_order(frames: Iterable[ImageFrame], board: Board, cache: CornerCache | None, total: int) -> Generator[Outcome, None, None]:
    """Yield each frame's outcome in the frames' order, a few batches per worker under way."""
    waiting: deque[tuple[list[_Asked], Callable[[], Answers]]] = deque()
    n = 0
    with _one_thread_each(), closing(Crew(board)) as crew:
        for batch in _batches(frames, board, cache):
            missing = [asked.frame for asked in batch if asked.known is None]
            waiting.append((batch, crew.submit(missing, total - n) if missing else list))
            n += len(batch)
            if len(waiting) > 2 * crew.workers:
                yield from _outcomes(*waiting.popleft(), cache)
        while waiting:
            yield from _outcomes(*waiting.popleft(), cache)


class _Asked(NamedTuple):
    frame: ImageFrame
    key: bytes  # in the cache
    known: Entry | None  # from there


def _batches(frames: Iterable[ImageFrame], board: Board, cache: CornerCache | None) -> Iterator[list[_Asked]]:
    """Divide the frames into runs, short ones first; the same on any machine, since a run is followed as a video."""
    batch: list[_Asked] = []
    n, n_bytes = 0, 0
    for frame in frames:
        key = cache.key(frame.payload, board) if cache else b""
        batch.append(_Asked(frame, key, cache.get(key, board) if cache else None))
        n, n_bytes = n + 1, n_bytes + len(frame.payload)
        if len(batch) == (_LONG_BATCH if n > _SOME else _SHORT_BATCH) or n_bytes > _BATCH_BYTES:
            yield batch
            batch, n_bytes = [], 0
    if batch:
        yield batch


def _outcomes(batch: list[_Asked], answers: Callable[[], Answers], cache: CornerCache | None) -> Iterator[Outcome]:
    found = iter(answers())
    for frame, key, known in batch:
        answer = known or next(found)
        if cache and known is None and not isinstance(answer, BadInputError):
            cache.put(key, *answer)
        yield frame.t_ns, frame.label, answer


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Keep OpenCV and BLAS to one thread: the frames are the parallel work, threads inside them fight over the cores (3 times the CPU)."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)
