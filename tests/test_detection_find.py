"""Many images to corners: order, broken and odd images, interrupts, and a cache that never fails and never lies."""

import multiprocessing
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews, ImageFrame
from calibkit.data.progress import silent
from calibkit.detection import crew, sequence
from calibkit.detection.cache import CornerCache
from calibkit.detection.find import find_boards
from calibkit.detection.found import NOTHING, Detection, Tags
from calibkit.errors import BadInputError
from calibkit.models.board import AprilGrid, Checkerboard
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.simulation.camera import RenderStyle, SimCamera, place_board
from calibkit.simulation.render import Renderer

BOARD = AprilGrid(4, 3, 0.088, 0.3)
UNDER_WAY = 4 * (2 * (crew.os.cpu_count() or 1) + 2)  # images: batches of 4, and the one that is asked for
CAMERA = SimCamera(CAMERAS["pinhole-radtan"], np.array([300.0, 300, 159.5, 119.5, -0.1, 0.01, 0, 0]), (320, 240))


@pytest.fixture(scope="module")
def images() -> list[NDArray[np.uint8]]:
    renderer, rng = Renderer(CAMERA, BOARD, RenderStyle()), np.random.default_rng(0)
    return [renderer.render(place_board(BOARD, np.eye(3), np.array([0.01 * k, 0, 0.7])), rng) for k in range(6)]


def frames(images: Iterable[NDArray[np.uint8]]) -> list[ImageFrame]:
    return [ImageFrame(1000 + k, f"im_{k}.png", image.tobytes(), lambda image=image: image) for k, image in enumerate(images)]


def undecodable() -> NDArray[np.uint8]:
    raise BadInputError("this image is broken")


def same(a: BoardViews, b: BoardViews) -> bool:
    arrays = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("t_ns", "frame", "corner", "uv", "sigma_px"))
    return arrays and (a.labels, a.image_size, a.n_images, a.warnings) == (b.labels, b.image_size, b.n_images, b.warnings)


def test_order_empty_and_broken_frames(images: list[NDArray[np.uint8]]) -> None:
    asked = frames([images[0], np.full((240, 320), 90, np.uint8), *images[1:]])
    asked.insert(3, ImageFrame(7, "[bold]bad.png", b"x", undecodable))
    before = cv2.getNumThreads()
    views = find_boards(asked, BOARD, "cam0", None, silent, len(asked))
    assert cv2.getNumThreads() == before
    assert views.labels == ("im_0.png", "im_2.png", "im_3.png", "im_4.png", "im_5.png", "im_6.png")
    assert list(views.t_ns) == [1000, 1002, 1003, 1004, 1005, 1006]
    assert views.n_images == 8
    assert views.image_size == (320, 240)
    assert np.array_equal(np.bincount(views.frame), [48] * 6)
    assert len(views.warnings) == 1
    assert "1 of 8" in views.warnings[0]
    assert "bad.png" in views.warnings[0]


def test_images_that_cannot_be_read_at_all_are_not_taken_for_a_wrong_board() -> None:
    broken = [ImageFrame(k, f"im_{k}.png", b"x", undecodable) for k in range(3)]
    with pytest.raises(BadInputError, match=r"none of 3 images can be read, the first: im_0\.png"):
        find_boards(broken, BOARD, "cam0", None, silent)


def test_the_odd_size_is_named(images: list[NDArray[np.uint8]]) -> None:
    with pytest.raises(BadInputError, match=r"im_3\.png is 200x100, most others are 320x240"):
        find_boards(frames([*images[:3], np.zeros((100, 200), np.uint8), *images[3:]]), BOARD, "cam0", None, silent)


def test_an_odd_size_ends_the_search(images: list[NDArray[np.uint8]]) -> None:
    taken = 0

    def many() -> Iterator[ImageFrame]:
        nonlocal taken
        for image in [np.zeros((100, 200), np.uint8), *images * 20]:
            taken += 1
            yield frames([image])[0]

    with pytest.raises(BadInputError, match="is 200x100, most others are 320x240"):
        find_boards(many(), BOARD, "cam0", None, silent)
    assert taken <= UNDER_WAY


def test_no_images_at_all() -> None:
    views = find_boards([], BOARD, "cam0", None, silent)
    assert (views.n_images, views.n_frames, views.image_size) == (0, 0, (0, 0))


def test_few_frames_wait_and_an_interrupt_stops_at_once(images: list[NDArray[np.uint8]], monkeypatch: pytest.MonkeyPatch) -> None:
    taken, looked = 0, 0

    def endless() -> Iterator[ImageFrame]:
        nonlocal taken
        while True:
            taken += 1
            yield frames(images[:1])[0]

    def slow(image: NDArray[np.uint8], board: object) -> Detection:
        nonlocal looked
        looked += 1
        return NOTHING

    def interrupted(items: Iterable[object], what: str, total: int | None = None) -> Iterator[object]:
        for k, item in enumerate(items):
            if k == 5:
                raise KeyboardInterrupt
            yield item

    monkeypatch.setattr(sequence, "detect", slow)
    alive = threading.active_count()
    with pytest.raises(KeyboardInterrupt):
        find_boards(endless(), BOARD, "cam0", None, interrupted)
    assert taken <= 5 + UNDER_WAY
    assert looked <= taken
    assert threading.active_count() == alive


def decoded(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image


def decoded_here_only(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if multiprocessing.parent_process() is not None:
        crew.os._exit(1)
    return image


def many(images: list[NDArray[np.uint8]], decode: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> list[ImageFrame]:
    return [ImageFrame(k, f"im_{k}.png", image.tobytes(), partial(decode, image)) for k, image in enumerate(images * 8)]


def test_processes_find_what_threads_find(images: list[NDArray[np.uint8]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crew.os, "cpu_count", lambda: 2)
    broken = ImageFrame(7, "bad.png", b"x", undecodable)
    asked = [broken, *many(images, decoded)]
    by_threads = find_boards(asked, BOARD, "cam0", None, silent)
    monkeypatch.setattr(crew, "_MANY", 20)
    monkeypatch.setattr(crew, "look_through", lambda *_: pytest.fail("no process was asked"))
    assert same(find_boards(asked, BOARD, "cam0", None, silent, len(asked)), by_threads)


@pytest.mark.slow
def test_processes_that_end_are_done_without(images: list[NDArray[np.uint8]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crew.os, "cpu_count", lambda: 2)
    asked = many(images, decoded)
    by_threads = find_boards(asked, BOARD, "cam0", None, silent)
    asked = many(images, decoded_here_only)
    assert same(find_boards(asked, BOARD, "cam0", None, silent, 200), by_threads)


@pytest.mark.slow
def test_images_that_cannot_be_handed_over_stay_here(images: list[NDArray[np.uint8]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crew.os, "cpu_count", lambda: 2)
    assert find_boards(frames(images), BOARD, "cam0", None, silent, 200).n_frames == len(images)


SCRIPT = """
print("once")
import numpy as np
from functools import partial
from calibkit.data.observations import ImageFrame
from calibkit.data.progress import silent
from calibkit.detection import crew
from calibkit.detection.find import find_boards
from calibkit.models.board import AprilGrid
crew.os.cpu_count = lambda: 2
frames = [ImageFrame(k, str(k), b"", partial(np.full, (240, 320), k, np.uint8)) for k in range(240)]
print(find_boards(frames, AprilGrid(4, 3, 0.088, 0.3), "cam0", None, silent, 240).n_images)
"""


@pytest.mark.slow
def test_processes_do_not_run_the_callers_script(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    ran = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert (ran.stdout, ran.stderr) == ("once\n240\n", "")


def test_second_run_decodes_nothing(images: list[NDArray[np.uint8]], tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite3"
    with CornerCache(path) as cache:
        first = find_boards(frames(images), BOARD, "cam0", cache, silent)
    sealed = [ImageFrame(f.t_ns, f.label, f.payload, undecodable) for f in frames(images)]
    with CornerCache(path) as cache:
        assert same(first, find_boards(sealed, BOARD, "cam0", cache, silent))
        assert cache.get(cache.key(sealed[0].payload, AprilGrid(4, 3, 0.089, 0.3)), BOARD) is None, "another board is another key"


@pytest.mark.parametrize(
    ("tags", "refused", "warnings"),
    [
        ([Tags(30, 24, 6)] * 3, True, 0),
        ([Tags(30, 0)] * 3, False, 0),
        ([Tags(20, 10), Tags(30, 0), Tags(30, 0)], False, 1),  # one image of another board
        ([Tags(30, 0, 6)] * 3, False, 1),
    ],
)
def test_a_layout_that_most_images_contradict_is_refused(
    images: list[NDArray[np.uint8]], monkeypatch: pytest.MonkeyPatch, tags: list[Tags], refused: bool, warnings: int
) -> None:
    answers = iter(tags)
    monkeypatch.setattr(sequence, "detect", lambda image, board: replace(NOTHING, tags=next(answers)))
    asked = frames(images[:3])
    if refused:
        with pytest.raises(BadInputError, match=r"80% of the tags found \(72 of 90\) .* check its tagCols"):
            find_boards(asked, BOARD, "cam0", None, silent)
    else:
        assert len(find_boards(asked, BOARD, "cam0", None, silent).warnings) == warnings


ENTRY = Detection(np.array([0, 5], np.int32), np.array([[1.5, 2.5], [3.0, 4.0]]), np.array([0.02, 0.03]), Tags(4, 1, 2))


def test_damaged_or_foreign_entries_are_misses(tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite3"
    with CornerCache(path) as cache:
        key = cache.key(b"image", BOARD)
        cache.put(key, (320, 240), ENTRY)
        size, found = cache.get(key, BOARD) or pytest.fail("not kept")
        assert size == (320, 240)
        assert np.array_equal(found.uv, ENTRY.uv)
        assert cache.get(key, Checkerboard(2, 2, 1.0, 1.0)) is None, "corner 5 is on no such board"
    db = sqlite3.connect(path)
    (value,) = db.execute("SELECT value FROM corners").fetchone()
    rng = np.random.default_rng(0)
    bad = [value[:k] for k in range(len(value))] + ["text", None, 5, b"\x80\x04N.", bytes(100_000)]
    for _ in range(200):
        noisy = bytearray(value)
        noisy[rng.integers(len(noisy))] ^= 1 << rng.integers(8)
        bad.append(bytes(noisy))
    db.executemany("INSERT OR REPLACE INTO corners VALUES (?, 0, ?)", [(bytes([k % 256, k // 256]), v) for k, v in enumerate(bad)])
    db.commit()
    db.close()
    with CornerCache(path) as cache:
        assert all(cache.get(bytes([k % 256, k // 256]), BOARD) is None for k in range(len(bad)))
        assert cache.get(key, BOARD) is not None


@pytest.mark.parametrize("content", [b"", b"not a database, but long enough to look like one" * 100, b"SQLite format 3\x00" + bytes(4000)])
def test_a_damaged_file_is_begun_anew(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite3"
    path.write_bytes(content)
    with CornerCache(path) as cache:
        cache.put(cache.key(b"a", BOARD), (1, 1), ENTRY)
    with CornerCache(path) as cache:
        assert cache.get(cache.key(b"a", BOARD), BOARD) is not None


def test_damage_inside_is_no_error_and_heals(tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite3"
    with CornerCache(path) as cache:
        for k in range(2000):
            cache.put(cache.key(bytes([k % 256, k // 256]), BOARD), (1, 1), ENTRY)
    data = bytearray(path.read_bytes())
    data[4096:-4096] = bytes(len(data) - 8192)
    path.write_bytes(data)
    for _ in range(3):
        with CornerCache(path) as cache:
            cache.get(cache.key(b"\x01\x01", BOARD), BOARD)
            cache.put(cache.key(b"new", BOARD), (1, 1), ENTRY)
    with CornerCache(path) as cache:
        assert cache.get(cache.key(b"new", BOARD), BOARD) is not None


def test_where_nothing_can_be_written_there_is_no_cache_and_no_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with CornerCache(tmp_path / "file" / "c.sqlite3") as cache:
        cache.put(cache.key(b"a", BOARD), (1, 1), ENTRY)
        assert cache.get(cache.key(b"a", BOARD), BOARD) is None


def test_size_stays_bounded_and_what_was_used_last_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(10_000))
    monkeypatch.setattr("calibkit.detection.cache.time.time", lambda: next(clock))
    path = tmp_path / "c.sqlite3"
    with CornerCache(path, max_bytes=10_000) as cache:
        keys = [cache.key(bytes([k]), BOARD) for k in range(200)]
        for key in keys:
            cache.put(key, (1, 1), ENTRY)
        assert cache.get(keys[0], BOARD) is not None  # used now, so younger than all
    with CornerCache(path, max_bytes=10_000) as cache:
        kept = [cache.get(key, BOARD) is not None for key in keys]
    assert 10 < sum(kept) <= 10_000 // 100
    assert kept[0]
    assert kept[-1]
    assert not any(kept[1:50])


def fill(path: Path, start: int) -> None:
    with CornerCache(path) as cache:
        for k in range(start, start + 300):
            cache.put(cache.key(k.to_bytes(4, "little"), BOARD), (1, 1), ENTRY)


def test_two_processes_may_share_it(tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite3"
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=fill, args=(path, 300 * k)) for k in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert [worker.exitcode for worker in workers] == [0, 0]
    with CornerCache(path) as cache:
        assert all(cache.get(cache.key(k.to_bytes(4, "little"), BOARD), BOARD) is not None for k in range(600))
