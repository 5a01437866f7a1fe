"""How long work tells how far it is, without knowing about terminals: stages take a `Progress`, the CLI draws it."""

from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

T = TypeVar("T")


class Progress(Protocol):
    """Wraps an iterable; `total` is None where it is not known beforehand."""

    def __call__(self, items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]: ...


def silent(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
    """Pass the items on and show nothing."""
    return iter(items)
