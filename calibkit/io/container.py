"""What the three bag formats have in common: channels, messages in time order, and what to say of damage."""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from calibkit.errors import one_line


@dataclass(frozen=True)
class Channel:
    """One topic as one file has it."""

    topic: str
    type: str  # package/msg/Name
    encoding: str  # cdr | ros1, or what the file calls it
    md5: str = ""  # ROS 1 only


class Message(NamedTuple):
    channel: Channel
    record_ns: int
    payload: bytes


class Container(Protocol):
    """One bag file. Messages come in the order of their record times; nothing of the file stays open between calls."""

    path: Path
    start_ns: int
    counts: dict[Channel, int]  # messages claimed
    warnings: list[str]

    def messages(self, topics: Collection[str]) -> Iterator[Message]: ...


class Damage(Exception):
    """The file does not continue as its format says; `calibkit.io` turns it into a warning or a refusal."""


def ros_type(name: str) -> str:
    """Return package/msg/Name for ROS 1's package/Name."""
    parts = one_line(name, 200).split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else "/".join(parts)


class Chunk(NamedTuple):
    """Where a chunk of messages lies and the earliest record time in it."""

    start_ns: int
    position: int


def in_time_order(chunks: Iterable[Chunk], read: Callable[[Chunk], list[Message]]) -> Iterator[Message]:
    """Yield the messages of all chunks by record time, holding only the chunks that overlap in time."""
    waiting: list[Message] = []
    for chunk in sorted(chunks):
        ready = [m for m in waiting if m.record_ns < chunk.start_ns]
        yield from ready
        waiting = sorted([*waiting[len(ready) :], *read(chunk)], key=lambda m: m.record_ns)
    yield from waiting
