"""MCAP files (https://mcap.dev/spec), intact or damaged, read through their summary or, without one, from the start.

rosbags' reader refuses files that were not closed or hold other than ROS 2 profiles, and unpacks chunks of any size.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from calibkit.data.observations import Lost
from calibkit.errors import BadInputError, one_line
from calibkit.io.container import Channel, Chunk, Damage, Message, in_time_order, ros_type
from calibkit.io.unpack import MAX_CHUNK, UnpackError, unpack

_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX, _STATISTICS, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x08, 0x0B, 0x0F
_FOOTER_LENGTH = 9 + 20 + len(_MAGIC)


def _unpack(form: str, data: bytes, at: int = 0) -> tuple[int, ...]:
    try:
        return struct.unpack_from(form, data, at)
    except struct.error as error:
        raise Damage("a record is cut") from error


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Return a length-prefixed string and the position after it."""
    (size,) = _unpack("<I", data, at)
    if at + 4 + size > len(data):
        raise Damage("a record is cut")
    return data[at + 4 : at + 4 + size].decode(errors="replace"), at + 4 + size


class _Found(NamedTuple):
    """A message before its channel is looked up."""

    channel: int
    record_ns: int
    payload: bytes


class McapFile:
    """One .mcap file; see `container.Container`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self.counts: dict[Channel, int] = {}
        self._size = path.stat().st_size
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: dict[Chunk, Collection[int]] = {}  # with the channels that each holds; a message outside chunks is one too
        with path.open("rb") as file:
            self._open(file)
        self.start_ns = min((chunk.start_ns for chunk in self._chunks), default=0)

    def _open(self, file: BinaryIO) -> None:
        magic = file.read(len(_MAGIC))
        if magic != _MAGIC:
            what = "is not an MCAP file" if magic else "is empty"
            raise BadInputError(f"{self.path.name} {what}: give a recording (.bag, .mcap, .db3, a folder or CSV)")
        try:
            counts = self._read_summary(file)
        except Damage as damage:
            self._schemas, self._channels, self._chunks = {}, {}, {}
            counts = self._find_messages(file)
            if not counts and not self._channels:
                raise BadInputError(f"{self.path.name}: nothing can be saved of this file ({damage}): record it again") from damage
            self.warnings.insert(0, Lost(f"{self.path.name} is damaged ({damage}): {sum(counts.values())} messages saved"))
        by_channel: Counter[Channel] = Counter()
        for number, channel in self._channels.items():
            by_channel[channel] += counts[number]
        self.counts = dict(by_channel)

    def _read_summary(self, file: BinaryIO) -> Counter[int]:
        """Read schemas, channels, chunk positions and counts from the file's end; walk the file where it has no summary."""
        end = self._size - _FOOTER_LENGTH
        file.seek(max(end, 0))
        footer = file.read()
        if end < len(_MAGIC) or footer[:1] != b"\x02" or footer[-len(_MAGIC) :] != _MAGIC:
            raise Damage("it was not closed, or is cut")
        (start,) = _unpack("<Q", footer, 9)
        if not 0 < start <= end:
            return self._find_messages(file)
        file.seek(start)
        counts: Counter[int] = Counter()
        chunked = True
        while file.tell() < end:
            op, length = _unpack("<BQ", file.read(9))
            if length > end - file.tell():
                raise Damage("its summary is damaged")
            data = file.read(length)
            if op == _CHUNK_INDEX:
                first, _, position, _, index_size = _unpack("<QQQQI", data)
                inside = {channel for channel, _ in struct.iter_unpack("<HQ", data[36 : 36 + index_size // 10 * 10])}
                if position >= self._size:
                    raise Damage("its summary points beyond its end")
                self._chunks[Chunk(first, position)] = frozenset(inside)
            elif op == _STATISTICS:
                chunked = _unpack("<QHIIII", data)[5] > 0 or _unpack("<Q", data)[0] == 0
                counts.update(dict(struct.iter_unpack("<HQ", data[46 : 46 + (len(data) - 46) // 10 * 10])))
            else:
                self._define(op, data)
        if not self._channels or not chunked or (self._chunks and not counts):
            self._chunks = {}
            return self._find_messages(file)
        return counts

    def _define(self, op: int, data: bytes) -> None:
        if op == _SCHEMA:
            self._schemas[_unpack("<H", data)[0]] = _text(data, 2)[0]
        elif op == _CHANNEL:
            number, schema = _unpack("<HH", data)
            topic, at = _text(data, 4)
            encoding, _ = _text(data, at)
            self._channels[number] = Channel(one_line(topic), ros_type(self._schemas.get(schema, "")), one_line(encoding, 20))

    def _find_messages(self, file: BinaryIO) -> Counter[int]:
        """Walk the file from the start, as far as it goes."""
        counts: Counter[int] = Counter()
        position = len(_MAGIC)
        while position + 9 <= self._size:
            file.seek(position)
            op, length = _unpack("<BQ", file.read(9))
            try:
                if op == _CHUNK or (op == _MESSAGE and length <= self._size - file.tell()):
                    found = self._read_chunk(file, position)
                    inside = Counter(message.channel for message in found)
                    self._chunks[Chunk(min((message.record_ns for message in found), default=0), position)] = frozenset(inside)
                    counts.update(inside)
                elif op in (_SCHEMA, _CHANNEL) and length <= MAX_CHUNK:
                    self._define(op, file.read(length))
            except Damage:
                break
            if op == _DATA_END:
                break
            position += 9 + length
        return counts

    def _read_chunk(self, file: BinaryIO, position: int, wanted: Collection[int] | None = None) -> list[_Found]:
        """Return the messages of the chunk (or the one message) at a position, as far as it is whole."""
        found: list[_Found] = []
        try:
            inside = self._unpack_chunk(file, position)
            at = 0
            while at < len(inside):
                op, length = _unpack("<BQ", inside, at)
                at += 9
                if at + length > len(inside):
                    raise Damage("it breaks off")
                if op == _MESSAGE:
                    channel, _, record_ns, _ = _unpack("<HIQQ", inside, at)
                    if wanted is None or channel in wanted:
                        found.append(_Found(channel, record_ns, inside[at + 22 : at + length]))
                elif op in (_SCHEMA, _CHANNEL):
                    self._define(op, inside[at : at + length])
                at += length
        except (Damage, UnpackError) as damage:
            text = Lost(f"{self.path.name}: the chunk at byte {position} is damaged ({one_line(damage)})")
            if text not in self.warnings:
                self.warnings.append(text)
        return found

    def _unpack_chunk(self, file: BinaryIO, position: int) -> bytes:
        """Return the records in a chunk, or the record itself where a message lies outside of chunks."""
        file.seek(position)
        head = file.read(9)
        op, length = _unpack("<BQ", head)
        self._refuse_large(position, length)
        data = file.read(length)
        if op != _CHUNK:
            return head + data
        _, _, size, checksum = _unpack("<QQQI", data)
        self._refuse_large(position, size)
        compression, at = _text(data, 28)
        (packed_size,) = _unpack("<Q", data, at)
        cut = len(data) < length
        inside = unpack(compression, data[at + 8 : at + 8 + packed_size], size, partial=cut)
        if checksum and not cut and zlib.crc32(inside) != checksum:
            raise Damage("its checksum is wrong")
        return inside

    def _refuse_large(self, position: int, size: int) -> None:
        if size > MAX_CHUNK:
            raise BadInputError(
                f"{self.path.name}: the chunk at byte {position} declares {size} bytes, more than {MAX_CHUNK}: record with smaller chunks"
            )

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        wanted = {number: channel for number, channel in self._channels.items() if channel.topic in topics}
        # An index without channels says nothing about its chunk.
        chunks = [chunk for chunk, inside in self._chunks.items() if not inside or not wanted.keys().isdisjoint(inside)]
        with self.path.open("rb") as file:

            def read(chunk: Chunk) -> list[Message]:
                found = self._read_chunk(file, chunk.position, wanted)
                return [Message(wanted[channel], record_ns, payload) for channel, record_ns, payload in found]

            yield from in_time_order(chunks, read)
