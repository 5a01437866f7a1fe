"""Decompression with a limit: what a file declares is checked before, what comes out is bounded while unpacking."""

import bz2
import sys
from collections.abc import Callable
from typing import Any

import lz4.frame

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_CHUNK = 2**30  # bytes, unpacked; recorders write chunks of about 1 MB
__all__ = ["MAX_CHUNK", "UnpackError", "unpack", "unpack_message", "zstd"]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}


class UnpackError(Exception):
    """The packed data is damaged, larger than it declares, or of an unknown kind."""


def unpack(compression: str, data: bytes, limit: int, partial: bool = False) -> bytes:
    """Return `data` unpacked, at most `limit` bytes; `partial` accepts packed data that was cut short, as far as its blocks are whole."""
    if compression in ("", "none"):
        return data
    if compression not in _DECOMPRESSORS:
        raise UnpackError(f"compression {compression!r} is not supported")
    decompressor = _DECOMPRESSORS[compression]()
    try:
        out: bytes = decompressor.decompress(data, limit + 1)
    except (OSError, RuntimeError, ValueError, EOFError, zstd.ZstdError) as error:
        raise UnpackError(f"{compression} data is damaged ({error})") from error
    if len(out) > limit:
        raise UnpackError(f"{compression} data unpacks to more than the {limit} bytes declared")
    if not decompressor.eof and not (partial and out):
        raise UnpackError(f"{compression} data ends too soon")
    return out


def unpack_message(payload: bytes, limit: int = MAX_CHUNK) -> bytes:
    """Return a ROS 2 payload that may be compressed by itself: CDR never starts with zstd's magic number."""
    return unpack("zstd", payload, limit) if payload[:4] == ZSTD_MAGIC else payload
