"""Broken files for the readers' tests: bytes flipped, keys dropped, values and types swapped, nesting and aliases (hypothesis)."""

import copy
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, TypeVar

import yaml
from hypothesis import strategies as st

from calibkit.errors import BadInputError

T = TypeVar("T")
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

HUGE = "a number of 5000 digits"
NASTY: tuple[Any, ...] = (
    None, True, False, "", "on", "1e-3", "nan", "\x1b[31m", "\u202e", "a" * 5000, -1, 0, 10**30, HUGE, -0.0, 1e308, -1e308, 5e-324,
    float("nan"), float("inf"), float("-inf"), [], {}, [[]], [1, [2]], {"a": 1}, {"value": float("nan")}, [float("nan")] * 3,
)  # fmt: skip
FLIPS = (
    b"",
    b" ",
    b"\n",
    b"\t",
    b":",
    b"-",
    b"{",
    b"]",
    b"'",
    b"#",
    b"e9",
    b".",
    b"1",
    b"*",
    b"!",
    b"\xff",
    b"\x00",
    b"\xc3\xa9",
    b"\xe2\x80\xae",
)
TAILS = (
    b"\n\t- x",
    b"\na: &a [*a]",
    b"\nb: *nothing",
    b"\n--- 1",
    b"\n? [x]\n: 1",
    b"\n!!python/name:os.system x: 1",
    b"\n\xff\xfe",
    b"\n'",
    b"\x00",
)


def read_or_refused(read: Callable[[], T]) -> T | None:
    """Return what was read, None where it was refused as every bad file must be: by BadInputError in one printable line."""
    try:
        return read()
    except BadInputError as error:
        message = str(error)
    assert message.isprintable()
    assert len(message) < 1000
    return None


def _places(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(node, (dict, list)):
        for key in node if isinstance(node, dict) else range(len(node)):
            yield (*path, key)
            yield from _places(node[key], (*path, key))


@lru_cache
def _parsed(text: str) -> Any:
    return yaml.safe_load(text)


@st.composite
def mutated(draw: st.DrawFn, text: str) -> bytes:
    """Return the YAML text with one to three changes to its values or its bytes."""
    data = copy.deepcopy(_parsed(text))
    for _ in range(draw(st.integers(0, 3))):
        places = list(_places(data))
        if not places:
            break
        *path, last = draw(st.sampled_from(places))
        node = data
        for key in path:
            node = node[key]
        change = draw(st.sampled_from(("drop", "nasty", "swap", "nest", "rename", "twice")))
        if change == "drop":
            del node[last]
        elif change == "nasty":
            node[last] = copy.deepcopy(draw(st.sampled_from(NASTY)))
        elif change == "swap":
            source = data
            for key in draw(st.sampled_from(places)):
                source = source[key]
            node[last] = copy.deepcopy(source)
        elif change == "nest":
            for _ in range(draw(st.sampled_from((1, 3, 60)))):
                node[last] = [node[last]]
        elif change == "rename" and isinstance(node, dict):
            node[f"{last}x"] = node.pop(last)
        else:
            node[last] = [node[last], node[last]]  # the dumper writes the second as an alias
    out = bytearray(yaml.dump(data, Dumper=_DUMPER, sort_keys=False, allow_unicode=True).replace(HUGE, "9" * 5000).encode())
    if draw(st.integers(0, 2)):
        return bytes(out)  # two in three reach the schema
    for _ in range(draw(st.integers(0, 2))):
        place = draw(st.integers(0, max(0, len(out) - 1)))
        out[place : place + draw(st.integers(0, 3))] = draw(st.sampled_from(FLIPS))
    return bytes(out) + draw(st.sampled_from((b"", b"", *TAILS)))
