"""ROS 2 SQLite bags (.db3), intact or damaged: rows are read until the database breaks off."""

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from calibkit.data.observations import Lost
from calibkit.errors import BadInputError, one_line
from calibkit.io.container import Channel, Message, ros_type

_ERRORS = (sqlite3.Error, UnicodeDecodeError, OverflowError)  # a message of SQLite's may quote damaged bytes of the file


class Db3File:
    """One .db3 file; see `container.Container`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self.counts: dict[Channel, int] = {}
        self.distro: str | None = None
        self._damaged = False
        self._channels: dict[int, Channel] = {}
        self.start_ns = 0
        if path.stat().st_size == 0:
            raise BadInputError(f"{path.name} is empty: give a recording (.bag, .mcap, .db3, a folder or CSV)")
        if path.with_name(path.name + "-wal").exists():
            text = f"{path.name}-wal holds messages not yet in {path.name}: run sqlite3 {path.name} 'PRAGMA wal_checkpoint'"
            self.warnings.append(Lost(text))
        try:
            self._open()
        except _ERRORS as error:
            self._salvage(one_line(error))

    def _connect(self) -> "closing[sqlite3.Connection]":
        database = sqlite3.connect(f"file:{quote(str(self.path.resolve()))}?immutable=1", uri=True)
        database.execute("PRAGMA trusted_schema = OFF")  # the schema comes from the file
        if self._damaged:
            database.execute("PRAGMA writable_schema = ON")  # the only way to read a file that is shorter than its header says
        database.text_factory = lambda raw: raw.decode(errors="replace")
        return closing(database)

    def _open(self) -> None:
        with self.path.open("rb") as file:
            page = int.from_bytes(file.read(18)[16:], "big")  # bytes; 1 means 65536
        if page > 1 and self.path.stat().st_size % page:
            raise sqlite3.DatabaseError("it is cut")  # in its last page, which SQLite itself does not notice
        with self._connect() as database:
            self._read_topics(database)
            self._count(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
            self.start_ns = database.execute("SELECT min(timestamp) FROM messages").fetchone()[0] or 0

    def _salvage(self, why: str) -> None:
        self._damaged = True
        try:
            with self._connect() as database:
                self._read_topics(database)
                found = [(number, time) for number, time, _ in self._rows(database, self._channels.keys())]
        except _ERRORS as error:
            raise BadInputError(
                f"{self.path.name}: nothing can be saved of this SQLite bag ({one_line(error)}): record it again"
            ) from error
        self._count(Counter(number for number, _ in found).items())
        self.start_ns = min((time for _, time in found), default=0)
        self.warnings.insert(0, Lost(f"{self.path.name} is damaged ({why}): {len(found)} messages saved"))

    def _count(self, numbers: Iterable[tuple[int, int]]) -> None:
        by_channel: Counter[Channel] = Counter(dict.fromkeys(self._channels.values(), 0))
        for number, count in numbers:
            if number in self._channels:
                by_channel[self._channels[number]] += count
        self.counts = dict(by_channel)

    def _read_topics(self, database: sqlite3.Connection) -> None:
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise BadInputError(f"{self.path.name} is an SQLite file but no bag: it has no tables topics and messages")
        for table in ("topics", "messages"):
            if any(hidden for *_, hidden in database.execute(f"PRAGMA table_xinfo({table})")):  # one row could compute gigabytes
                raise BadInputError(f"{self.path.name} computes columns of its table {table}, which no bag does: it is not read")
        for number, topic, kind, encoding in database.execute("SELECT id, name, type, serialization_format FROM topics"):
            self._channels[number] = Channel(one_line(topic), ros_type(str(kind)), one_line(encoding, 20))
        if "schema" in tables:
            self.distro = self._schema_distro(database)

    @staticmethod
    def _schema_distro(database: sqlite3.Connection) -> str | None:
        try:
            row = database.execute("SELECT ros_distro FROM schema").fetchone()
        except _ERRORS:
            return None
        return one_line(row[0], 40) if row else None

    def _rows(self, database: sqlite3.Connection, numbers: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield topic, record time and payload; of a damaged file in the order of the rows, until it breaks off."""
        order = "" if self._damaged else " ORDER BY timestamp"
        marks = ",".join("?" * len(numbers))
        try:
            rows = database.execute(f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}){order}", tuple(numbers))
            for number, time, data in rows:
                if isinstance(time, int) and isinstance(data, bytes):
                    yield number, time, data
        except _ERRORS as error:
            text = Lost(f"{self.path.name} breaks off ({one_line(error)})")
            if text not in self.warnings:
                self.warnings.append(text)

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        numbers = [number for number, channel in self._channels.items() if channel.topic in topics]
        with self._connect() as database:
            for number, time, data in self._rows(database, numbers):
                yield Message(self._channels[number], time, data)
