"""Boards in batches of images: by threads where there are few, else by processes, since Python lets one thread work at a time.

Processes are begun anew (spawned: a forked OpenCV may hang) and import nothing of the caller's program. Where none can be had, or
images cannot be handed over, threads do all.
"""

import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import parent_process
from multiprocessing.context import SpawnContext, SpawnProcess
from types import ModuleType
from typing import Protocol

from threadpoolctl import threadpool_limits

from calibkit.data.observations import ImageFrame
from calibkit.detection.found import Entry
from calibkit.detection.sequence import Sequence as BoardSequence
from calibkit.errors import BadInputError, one_line
from calibkit.models.board import Board
from calibkit.opencv import cv2

Answers = list["Entry | BadInputError"]

_MANY = 200  # images: so many are worth the start of processes


class _Stop(Protocol):
    def is_set(self) -> bool: ...

    def set(self) -> None: ...


def look_through(frames: Sequence[ImageFrame], board: Board, stop: _Stop) -> Answers:
    """Return what came of each of some consecutive images; what is missing at the end was stopped."""
    sequence, answers = BoardSequence(board), Answers()
    for frame in frames:
        if stop.is_set():
            break
        try:
            image = frame.decode()
            answers.append(((image.shape[1], image.shape[0]), sequence.look(image)))
        except BadInputError as error:
            answers.append(error)
        except cv2.error as error:  # one odd image must not end the run
            answers.append(BadInputError(f"OpenCV cannot work on it ({one_line(error, 80)})"))
    return answers


class Crew:
    """Looks through batches of images, several at once; `close` drops what has not begun and ends what has after its image."""

    def __init__(self, board: Board) -> None:
        self.workers = os.cpu_count() or 1
        self._board = board
        self._stop = threading.Event()
        self._threads = ThreadPoolExecutor(self.workers, thread_name_prefix="boards")
        self._processes: ProcessPoolExecutor | None = None
        self._tell_processes: _Stop | None = None
        self._alone = self.workers == 1
        self._seen = 0

    def submit(self, frames: Sequence[ImageFrame], to_come: int = 0) -> Callable[[], Answers]:
        """Have the images looked through, where at least so many are `to_come`; what is returned waits for the answers."""
        self._seen += len(frames)
        many = self._processes is not None or max(self._seen, to_come) >= _MANY
        remote = self._submit_to_process(frames) if many and not self._alone else None
        if remote is None:
            return self._threads.submit(look_through, frames, self._board, self._stop).result

        def result() -> Answers:
            try:
                return remote.result()
            except BrokenExecutor:  # a process was ended from outside, or could not begin
                self._alone = True
                return look_through(frames, self._board, self._stop)

        return result

    def _submit_to_process(self, frames: Sequence[ImageFrame]) -> "Future[Answers] | None":
        try:
            packed = pickle.dumps((frames, self._board))
            if self._processes is None:
                context = _Context()
                self._tell_processes = context.Event()
                self._processes = ProcessPoolExecutor(self.workers, context, _begin, (self._tell_processes,))
            return self._processes.submit(_look_through_packed, packed)
        except (pickle.PicklingError, AttributeError, TypeError, OSError, ImportError, NotImplementedError, BrokenExecutor):
            self._alone = True
            return None

    def close(self) -> None:
        """End all work."""
        for stop in (self._stop, self._tell_processes):
            if stop is not None:
                stop.set()
        for pool in (self._threads, self._processes):
            if pool is not None:
                pool.shutdown(wait=True, cancel_futures=True)


_told: _Stop = threading.Event()  # in a process of a crew: by the crew


def _begin(stop: _Stop) -> None:
    global _told
    _told = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the crew tells when to stop
    cv2.setNumThreads(1)
    threadpool_limits(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _look_through_packed(packed: bytes) -> Answers:
    frames, board = pickle.loads(packed)  # noqa: S301  our own parent's
    return look_through(frames, board, _told)


class _Process(SpawnProcess):
    def start(self) -> None:
        with _without_main(), _without_interrupts():
            super().start()


class _Context(SpawnContext):
    Process = _Process


@contextmanager
def _without_main() -> Iterator[None]:
    """Hide the caller's program: a spawned process would run a script without `if __name__ == "__main__"` a second time."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Keep Ctrl-C from a process that is not yet ready to ignore it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
