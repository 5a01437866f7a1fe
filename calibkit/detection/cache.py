"""Corners found before, kept under the user's cache folder so that a second run needs no images.

One SQLite file, written by any number of processes; an entry is a checksum and raw little-endian arrays, so that nothing in it is
ever executed, and whatever does not fit is a miss. The cache is a convenience: no fault of it is ever an error.
"""

import hashlib
import os
import sqlite3
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import astuple
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import platformdirs

from calibkit.detection.found import Detection, Entry, Tags
from calibkit.models.board import Board
from calibkit.opencv import cv2
from calibkit.version import __version__

if TYPE_CHECKING:
    from importlib.abc import Traversable

T = TypeVar("T")

_HEADER = struct.Struct("<4s6I")
_MAGIC = b"ckc2"
_ANSWERING = ("detection", "models/board.py", "io/images.py")  # the code between an image as stored and its corners
_MAX_BYTES = 512 * 2**20
_ROW = np.dtype([("corner", "<i4"), ("u", "<f8"), ("v", "<f8"), ("sigma", "<f8")])


def folder() -> Path:
    """Return where the cache lives: CALIBKIT_CACHE_DIR, or the platform's folder for caches."""
    return Path(os.environ.get("CALIBKIT_CACHE_DIR") or platformdirs.user_cache_dir("calibkit"))


def code_hash(package: "Traversable") -> str:
    """Return a hash of the source that finds corners; calibkit's version where it is installed without sources."""
    try:
        modules = [module for name in _ANSWERING for module in _modules(package / name)]
        digests = [hashlib.sha256(module.read_bytes()).digest() for module in modules]
    except OSError:
        return __version__
    return hashlib.sha256(b"".join(digests)).hexdigest()


def _modules(place: "Traversable") -> list["Traversable"]:
    if not place.is_dir():
        return [place]
    inside = sorted(place.iterdir(), key=lambda entry: entry.name)
    return [module for entry in inside if entry.is_dir() or entry.name.endswith(".py") for module in _modules(entry)]


@cache
def _detector() -> bytes:
    return f"{code_hash(files('calibkit'))}\0{cv2.__version__}".encode()


class CornerCache:
    """Detections by content: the image's bytes, the board, the detector's source and OpenCV's version."""

    def __init__(self, path: Path | None = None, max_bytes: int = _MAX_BYTES) -> None:
        self._path = path or folder() / "corners.sqlite3"
        self._max_bytes = max_bytes
        self._lock = threading.Lock()
        self._used: list[bytes] = []
        self._db = self._quiet(self._open)

    def key(self, payload: bytes, board: Board) -> bytes:
        """Return the key of an image as stored, for this board and detector."""
        return hashlib.sha256(b"\0".join((board.key().encode(), _detector(), hashlib.sha256(payload).digest()))).digest()

    def get(self, key: bytes, board: Board) -> Entry | None:
        """Return what is known under the key, None where nothing valid is."""
        row = self._quiet(lambda: self._db.execute("SELECT value FROM corners WHERE key = ?", (key,)).fetchone() if self._db else None)
        entry = _unpack(row[0], len(board.points)) if row and isinstance(row[0], bytes) else None
        if entry:
            self._used.append(key)
        return entry

    def put(self, key: bytes, size: tuple[int, int], found: Detection) -> None:
        """Remember a detection."""
        value = _pack(size, found)
        self._quiet(
            lambda: (
                self._db.execute("INSERT OR REPLACE INTO corners VALUES (?, ?, ?)", (key, int(time.time()), value)) if self._db else None
            )
        )

    def close(self) -> None:
        """Write what is left, forget the entries unused for longest beyond the size allowed."""
        self._quiet(self._finish)
        self._db = None

    def __enter__(self) -> "CornerCache":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _open(self) -> sqlite3.Connection:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        try:
            return self._connect()
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError:  # another kind of file, or a damaged one: it is only a cache
            self._path.unlink()
            return self._connect()

    def _connect(self) -> sqlite3.Connection:
        db = sqlite3.connect(self._path, timeout=2, isolation_level=None, check_same_thread=False)
        try:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = OFF")
            db.execute("CREATE TABLE IF NOT EXISTS corners (key BLOB PRIMARY KEY, used INTEGER, value BLOB) WITHOUT ROWID")
            db.execute("SELECT key, used, value FROM corners LIMIT 1").fetchone()
        except BaseException:
            db.close()
            raise
        return db

    def _finish(self) -> None:
        if self._db is None:
            return
        try:
            now = int(time.time())
            self._db.execute("BEGIN IMMEDIATE")
            self._db.executemany("UPDATE corners SET used = ? WHERE key = ?", [(now, key) for key in self._used])
            (total,) = self._db.execute("SELECT COALESCE(SUM(LENGTH(value) + 100), 0) FROM corners").fetchone()
            if total > self._max_bytes:
                keep = "SELECT key, SUM(LENGTH(value) + 100) OVER (ORDER BY used DESC, key) AS running FROM corners"
                self._db.execute(f"DELETE FROM corners WHERE key IN (SELECT key FROM ({keep}) WHERE running > ?)", (self._max_bytes,))
            self._db.execute("COMMIT")
        finally:
            self._db.close()

    def _quiet(self, work: Callable[[], T]) -> T | None:
        with self._lock:
            try:
                return work()
            except (sqlite3.OperationalError, OSError, ValueError, OverflowError):
                return None  # locked, read-only, full
            except sqlite3.Error:  # damaged: the next run starts anew
                self._db = None
                with suppress(OSError):
                    self._path.unlink()
                return None


def _pack(size: tuple[int, int], found: Detection) -> bytes:
    rows = np.empty(len(found.corner), _ROW)
    rows["corner"], rows["u"], rows["v"], rows["sigma"] = found.corner, found.uv[:, 0], found.uv[:, 1], found.sigma_px
    body = _HEADER.pack(_MAGIC, *size, len(rows), *astuple(found.tags)) + rows.tobytes()
    return hashlib.sha256(body).digest()[:8] + body


def _unpack(value: bytes, n_points: int) -> Entry | None:
    checksum, body = value[:8], value[8:]
    if len(body) < _HEADER.size or hashlib.sha256(body).digest()[:8] != checksum:
        return None
    magic, width, height, n, *tags = _HEADER.unpack_from(body)
    if magic != _MAGIC or len(body) != _HEADER.size + n * _ROW.itemsize or n > n_points:
        return None
    rows = np.frombuffer(body, _ROW, offset=_HEADER.size)
    uv = np.stack([rows["u"], rows["v"]], axis=-1).astype(float)
    found = Detection(rows["corner"].astype(np.int32), uv, rows["sigma"].astype(float), Tags(*tags))
    in_range = np.all((found.corner >= 0) & (found.corner < n_points)) and len(np.unique(found.corner)) == n
    if not (in_range and np.isfinite(found.uv).all() and np.isfinite(found.sigma_px).all() and np.all(found.sigma_px > 0)):
        return None
    return (width, height), found
