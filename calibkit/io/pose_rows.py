"""Pose files of text: rows of numbers with or without a header and image names, or matrices in blocks of 4 lines."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calibkit.errors import BadInputError, one_line
from calibkit.io.pose_names import ROTATIONS, Array, PoseRows, name_of
from calibkit.io.text_table import XYZ

_COMMENT = re.compile(r"\s*(#|%|//)+")
_PART = r"[^\s,;\[\]]"  # of a word
# A name that has some, im[01].jpg or [1].png; and numpy's, p[...] of UR's scripts.
_BRACKETS = re.compile(rf"(?<![^\s,;\[])({_PART}+(?:\[{_PART}*\])+{_PART}*|(?:\[{_PART}*\])+{_PART}+)|\bp?\[|\[|\]")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_MAX_LINE = 8192  # characters
_MAX_ROWS = 500_000
_COLUMNS = (4, 200)  # at least, at most


class _Line(NamedTuple):
    number: int
    fields: list[str]


class _Table(NamedTuple):
    """The rows of a text, all of one width, and the lines of words before and between them."""

    rows: list[_Line]
    titles: list[_Line]  # before the first row
    words: dict[int, str]  # index of a row -> the single word on the line before it


def number(text: str) -> float | None:
    """Return the number that a field is (nan and inf too), None where it is none."""
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def read_rows(path: Path, text: str, with_header: bool = True) -> PoseRows:
    """Return the poses of a text; BadInputError where its rows are ragged or hold something else than poses."""
    table = _table(path, text)
    columns = _header(path, table) if with_header else None
    if columns is not None:
        return _named(path, table.rows, columns)
    first = [number(value) is None for value in table.rows[0].fields]
    if sum(first[1:-1]) or sum(first) > 1:
        raise _error(path, table.rows[0].number, f"{_odd(table.rows[0].fields[1:])}: only an image's name may stand there")
    start, end = int(first[0]), len(first) - int(first[-1])
    values = _numbers(path, table.rows, range(start, end))
    labels = tuple(row.fields[0 if start else -1] for row in table.rows) if any(first) else None
    places, firsts = tuple(f"line {row.number}" for row in table.rows), tuple(row.fields[start] for row in table.rows)
    if values.shape[1] == 4 and labels is None:
        return _blocks(path, values, places, firsts, table.words)
    return PoseRows(path, values, places, firsts, labels=labels)


def _error(path: Path, place: int | str, text: str) -> BadInputError:
    return BadInputError(f"{one_line(path)}, {place if isinstance(place, str) else f'line {place}'}: {text}")


def _odd(fields: Sequence[str]) -> str:
    """Return what is wrong with the first field that is no number."""
    odd = next(value for value in fields if number(value) is None)
    return f"'{one_line(odd, 40)}' is not a number" if odd else "a field is empty"


def _table(path: Path, text: str) -> _Table:
    table = _Table([], [], {})
    for line, content in enumerate(text.splitlines(), 1):
        if len(content) > _MAX_LINE or len(table.rows) >= _MAX_ROWS:
            raise _error(path, line, f"more than {_MAX_LINE} characters in a line, or {_MAX_ROWS} rows: this cannot be the right file")
        comment = _COMMENT.match(content)
        if comment or not content.strip():
            if comment and not table.rows:
                table.titles.append(_Line(0, _titles(content[comment.end() :])))
            continue
        fields = _fields(path, line, _BRACKETS.sub(lambda found: found[1] or " ", content))
        if not fields:  # brackets only
            continue
        if all(number(value) is None for value in fields):
            if len(fields) == 1:
                table.words[len(table.rows)] = fields[0]
            elif table.rows:
                raise _error(path, line, f"'{one_line(content, 40)}' is no row of numbers: remove it, or begin it with #")
            if not table.rows:
                table.titles.append(_Line(line, _titles(content)))
            continue
        table.rows.append(_Line(line, fields))
        width = len(table.rows[0].fields)
        if not _COLUMNS[0] <= width <= _COLUMNS[1]:
            raise _error(path, line, f"{width} columns are no pose: remove this line, or give one pose a row or in 4 rows")
        if len(fields) != width:
            raise _error(path, line, f"has {len(fields)} columns, and the first row {width}: every row must have the same")
    if not table.rows:
        raise BadInputError(f"{one_line(path)}: holds no poses; give rows of numbers, or a YAML or JSON list")
    return table


def _fields(path: Path, line: int, content: str) -> list[str]:
    """Return the fields of a line: split at commas or semicolons where it has some, and at blanks between numbers."""
    mark = next((mark for mark in ";," if mark in content), None)
    if mark is None:
        return [value.strip("\"'") for value in content.split()]
    words = [word.strip() for word in re.split(r"[;\s]+", content) if word]
    if (";" in content and "," in content) or (len(words) > 1 and all(_DECIMAL_COMMA.fullmatch(word) for word in words)):
        raise _error(
            path, line, "looks like decimal commas: write the numbers with decimal points, separated by blanks or by one kind of mark"
        )
    parts = [value.strip(" \t\"'") for value in content.strip().removesuffix(mark).split(mark)]
    return [field for part in parts for field in _between_blanks(part)]


def _between_blanks(part: str) -> list[str]:
    words = part.split()
    return words if len(words) > 1 and all(number(word) is not None for word in words) else [part]


def _titles(content: str) -> list[str]:
    content = re.sub(r" (?=[\[(])", "", " ".join(content.split()))  # x [mm]
    return re.split(" ?[,;] ?", content) if re.search("[,;]", content) else content.split()


def _header(path: Path, table: _Table) -> list[tuple[str | None, str]] | None:
    """Return name and unit of each column, where a line before the rows names a position and a part of a rotation."""
    turns = {name for names in ROTATIONS for name in names}
    width = len(table.rows[0].fields)
    for line, titles in reversed(table.titles):
        columns = [name_of(title) for title in titles]
        names = [name for name, _ in columns if name]
        if not (set(names) >= set(XYZ) and set(names) & turns):
            continue
        twice = next((name for name in names if names.count(name) > 1 and name != "label"), None)
        if len(columns) == width and twice is None:
            return columns
        if line:  # no comment, so it is meant
            what = f"names {len(columns)} columns, and the rows have {width}" if twice is None else f"names {twice} twice"
            raise _error(path, line, f"the header {what}: mend the header, or remove it")
    return None


def _named(path: Path, rows: list[_Line], columns: list[tuple[str | None, str]]) -> PoseRows:
    at = {name: i for i, (name, _) in reversed(list(enumerate(columns))) if name}  # the first of several labels

    def texts(name: str) -> tuple[str, ...] | None:
        return tuple(row.fields[at[name]] for row in rows) if name in at else None

    names = tuple(sorted(at.keys() - {"t", "label"}, key=lambda name: at[name]))
    values = _numbers(path, rows, [at[name] for name in names])
    places, stamps = tuple(f"line {row.number}" for row in rows), texts("t")
    units = {name: columns[i][1] for name, i in at.items()}
    return PoseRows(path, values, places, stamps or texts(names[0]) or (), names, units, texts("label"), stamps)


def _numbers(path: Path, rows: list[_Line], columns: Sequence[int]) -> Array:
    def values() -> Iterator[float]:
        for row in rows:
            for column in columns:
                value = number(row.fields[column])
                if value is None:
                    raise _error(path, row.number, f"{_odd([row.fields[column]])}: write it like 0.05, or leave this pose out")
                yield value

    return np.fromiter(values(), np.float64).reshape(len(rows), len(columns))


def _blocks(path: Path, values: Array, places: tuple[str, ...], firsts: tuple[str, ...], words: dict[int, str]) -> PoseRows:
    """Return blocks of 4 lines of 4 numbers as rows of 16."""
    if len(values) % 4:
        raise _error(path, places[-1], f"{len(values)} rows of 4 numbers are no blocks of 4 rows, one a pose: add what is missing")
    if any(row % 4 for row in words):
        row = next(row for row in words if row % 4)
        raise _error(path, places[min(row, len(places) - 1)], "a word stands within a block of 4 rows: begin it with #, or mend the block")
    labels = tuple(words.get(row, "") for row in range(0, len(values), 4))
    return PoseRows(path, values.reshape(-1, 16), places[::4], firsts[::4], labels=labels if all(labels) else None)
