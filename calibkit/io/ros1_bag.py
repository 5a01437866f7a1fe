"""ROS 1 bags, version 2.0 (http://wiki.ros.org/Bags/Format/2.0), intact or damaged.

rosbags' reader refuses every damaged bag, unpacks chunks of any size and holds an index entry for each message; here only
the list of chunks is held, and without a usable index the records are walked from the start.
"""

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from calibkit.data.observations import Lost
from calibkit.errors import BadInputError, one_line
from calibkit.io.container import Channel, Chunk, Damage, Message, in_time_order, ros_type
from calibkit.io.unpack import MAX_CHUNK, UnpackError, unpack

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 5, 6, 7
_MAX_HEADER = 2**20
_U32 = struct.Struct("<I")
_Fields = dict[bytes, bytes]


def _fields(data: bytes) -> _Fields:
    """Parse a record header: length, name=value, repeated."""
    found, at = {}, 0
    while at < len(data):
        size = _U32.unpack_from(data, at)[0] if at + 4 <= len(data) else len(data)
        name, equals, value = data[at + 4 : at + 4 + size].partition(b"=")
        if at + 4 + size > len(data) or not equals:
            raise Damage("a record header is damaged")
        found[name] = value
        at += 4 + size
    return found


def _number(fields: _Fields, name: bytes, size: int = 4) -> int:
    value = fields.get(name, b"")
    if len(value) != size:
        raise Damage(f"a record lacks its field {name.decode()}")
    return int.from_bytes(value, "little")


def _time(fields: _Fields, name: bytes) -> int:
    both = _number(fields, name, 8)
    return (both & 0xFFFFFFFF) * 10**9 + (both >> 32)


def _record(file: BinaryIO, size: int) -> tuple[_Fields, int]:
    """Read one record's header; return its fields and the length of its data, at which the file now stands."""
    raw = file.read(4)
    length = _U32.unpack(raw)[0] if len(raw) == 4 else size
    if length > min(_MAX_HEADER, size - file.tell()):
        raise Damage("a record header is cut or damaged")
    fields = _fields(file.read(length))
    raw = file.read(4)
    if len(raw) < 4:
        raise Damage("a record is cut")
    return fields, _U32.unpack(raw)[0]


def _records(data: bytes) -> Iterator[tuple[_Fields, bytes]]:
    """Yield the records inside a chunk; Damage where they break off."""
    at = 0
    while at < len(data):
        ends = at + 4 + int.from_bytes(data[at : at + 4], "little")
        begins = ends + 4
        after = begins + int.from_bytes(data[ends:begins], "little")
        if begins > len(data) or after > len(data):
            raise Damage("a chunk breaks off")
        yield _fields(data[at + 4 : ends]), data[begins:after]
        at = after


class Ros1Bag:
    """One .bag file; see `container.Container`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self.counts: dict[Channel, int] = {}
        self._size = path.stat().st_size
        self._connections: dict[int, Channel] = {}
        self._chunks: dict[Chunk, Collection[int]] = {}  # with the connections that each holds
        try:
            with path.open("rb") as file:
                self._open(file)
        except Damage as damage:
            raise BadInputError(
                f"{path.name}: nothing can be saved of this bag ({'; '.join([str(damage), *self.warnings])}): record it again"
            ) from damage
        self.start_ns = min((chunk.start_ns for chunk in self._chunks), default=0)

    def _open(self, file: BinaryIO) -> None:
        magic = file.readline(100)
        if magic != _MAGIC:
            what = "is not a ROS 1 bag of version 2.0" if magic else "is empty"
            raise BadInputError(f"{self.path.name} {what}: give a recording (.bag, .mcap, .db3, a folder or CSV)")
        fields, length = _record(file, self._size)
        first = file.tell() + length
        if fields.get(b"encryptor"):
            raise BadInputError(f"{self.path.name} is encrypted: decrypt it first")
        try:
            counts = self._read_index(file, _number(fields, b"index_pos", 8))
            if len(self._chunks) != _number(fields, b"chunk_count") or len(self._connections) != _number(fields, b"conn_count"):
                raise Damage("its index is incomplete")
        except Damage as damage:
            self._connections, self._chunks = {}, {}
            counts = self._find_chunks(file, first)
            if not counts:
                raise
            self.warnings.insert(0, Lost(f"{self.path.name} is damaged ({damage}): {sum(counts.values())} messages saved"))
        by_channel: Counter[Channel] = Counter()
        for connection, channel in self._connections.items():
            by_channel[channel] += counts[connection]
        self.counts = dict(by_channel)

    def _read_index(self, file: BinaryIO, position: int) -> Counter[int]:
        if not 0 < position <= self._size:
            raise Damage("it was not closed, or is cut")
        file.seek(position)
        counts: Counter[int] = Counter()
        while file.tell() < self._size:
            fields, length = _record(file, self._size)
            if length > self._size - file.tell():
                raise Damage("its index is cut")
            data, op = file.read(length), _number(fields, b"op", 1)
            if op == _CONNECTION:
                self._add_connection(fields, data)
            elif op == _CHUNK_INFO:
                inside = dict(struct.iter_unpack("<II", data[: len(data) // 8 * 8]))
                chunk = Chunk(_time(fields, b"start_time") if inside else 0, _number(fields, b"chunk_pos", 8))
                if chunk.position >= self._size:
                    raise Damage("its index points beyond its end")
                self._chunks[chunk] = frozenset(inside)
                counts.update(inside)
        return counts

    def _find_chunks(self, file: BinaryIO, position: int) -> Counter[int]:
        """Walk the file from the start, as far as it goes."""
        counts: Counter[int] = Counter()
        while position < self._size:
            try:
                file.seek(position)
                fields, length = _record(file, self._size)
                after = file.tell() + length
                if _number(fields, b"op", 1) == _CHUNK:
                    found = self._read_chunk(file, position)
                    inside = Counter(connection for connection, _, _ in found)
                    self._chunks[Chunk(min((time for _, time, _ in found), default=0), position)] = frozenset(inside)
                    counts.update(inside)
            except Damage:
                break
            position = after
        return counts

    def _add_connection(self, fields: _Fields, data: bytes) -> None:
        inner = _fields(data)
        topic = inner.get(b"topic", b"") or fields.get(b"topic", b"")
        md5 = inner.get(b"md5sum", b"").decode("ascii", errors="replace")
        channel = Channel(one_line(topic.decode(errors="replace")), ros_type(inner.get(b"type", b"").decode(errors="replace")), "ros1", md5)
        self._connections[_number(fields, b"conn")] = channel

    def _read_chunk(self, file: BinaryIO, position: int, wanted: Collection[int] | None = None) -> list[tuple[int, int, bytes]]:
        """Return connection, record time and payload of the messages in a chunk, as far as it is whole."""
        messages = []
        try:
            for header, body in _records(self._unpack_chunk(file, position)):
                op, connection = _number(header, b"op", 1), _number(header, b"conn")
                if op == _CONNECTION and connection not in self._connections:
                    self._add_connection(header, body)
                elif op == _MESSAGE and (wanted is None or connection in wanted):
                    messages.append((connection, _time(header, b"time"), body))
        except (Damage, UnpackError) as damage:
            text = Lost(f"{self.path.name}: the chunk at byte {position} is damaged ({one_line(damage)})")
            if text not in self.warnings:
                self.warnings.append(text)
        return messages

    def _unpack_chunk(self, file: BinaryIO, position: int) -> bytes:
        file.seek(position)
        fields, length = _record(file, self._size)
        declared = _number(fields, b"size")
        if max(declared, length) > MAX_CHUNK:
            raise BadInputError(
                f"{self.path.name}: the chunk at byte {position} declares {max(declared, length)} bytes, more than {MAX_CHUNK}: "
                "record with smaller chunks (rosbag record --chunksize)"
            )
        packed = file.read(length)
        return unpack(fields.get(b"compression", b"").decode(errors="replace"), packed, declared, partial=len(packed) < length)

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        wanted = {connection: channel for connection, channel in self._connections.items() if channel.topic in topics}
        chunks = [chunk for chunk, inside in self._chunks.items() if not wanted.keys().isdisjoint(inside)]
        with self.path.open("rb") as file:

            def read(chunk: Chunk) -> list[Message]:
                return [Message(wanted[c], time, payload) for c, time, payload in self._read_chunk(file, chunk.position, wanted)]

            yield from in_time_order(chunks, read)
