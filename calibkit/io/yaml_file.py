"""YAML files from strangers, read into plain data by the YAML 1.2 core schema, each key with its line; and written for people.

Every fault of a file is one BadInputError that names file, line and remedy. The data is built from parser events without
recursion, so that nesting, aliases and sizes are bounded while they are read.
"""

import re
import stat
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, NoReturn

import yaml

from calibkit.errors import BadInputError, one_line
from calibkit.io.atomic import reason_of

MAX_BYTES = 4_000_000  # a rig of ten cameras with all covariances is 0.1 MB
_MAX_DEPTH = 40
_MAX_NODES = 1_000_000  # aliases counted as often as they are used
_MAX_NUMBER = 100  # characters
_OPENCV_TAGS = ("tag:yaml.org,2002:opencv-matrix", "tag:yaml.org,2002:opencv-nd-matrix")
_PARSER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml where the wheel has it: 10 times faster

_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_CORE: tuple[tuple[re.Pattern[str], Callable[[str], Any]], ...] = (  # YAML 1.2.2, section 10.3.2; OpenCV writes .Nan and .Inf
    (re.compile(r"null|Null|NULL|~|"), lambda text: None),
    (re.compile(r"true|True|TRUE|false|False|FALSE"), lambda text: text.lower() == "true"),
    (re.compile(r"[-+]?[0-9]+"), int),
    (re.compile(r"0o[0-7]+"), lambda text: int(text[2:], 8)),
    (re.compile(r"0x[0-9a-fA-F]+"), lambda text: int(text[2:], 16)),
    (_FLOAT, float),
    (re.compile(r"[-+]?\.inf|\.nan", re.IGNORECASE), lambda text: float(text.replace(".", ""))),
)


@dataclass(frozen=True)
class Document:
    """Plain data (dict with str keys, list, str, int, float, bool, None) and where each key stood."""

    path: Path
    data: Any
    sha256: str
    _lines: dict[int, dict[Hashable, int]] = field(repr=False)  # id of a container -> line of each of its keys

    def line_of(self, keys: Iterable[Hashable]) -> int:
        """Return the line of the deepest key on this path that the file has."""
        node, line = self.data, 1
        for key in keys:
            lines = self._lines.get(id(node), {})
            if key not in lines:
                break
            node, line = node[key], lines[key]
        return line

    def error(self, keys: Sequence[Hashable], text: str) -> BadInputError:
        """Return the error that says `text` about the value under these keys; what it quotes must have gone through one_line."""
        where = one_line(".".join(map(str, keys)), 120)
        return BadInputError(f"{one_line(self.path)}, line {self.line_of(keys)}: {where + ': ' if where else ''}{text}")


def load_yaml(path: Path, max_bytes: int = MAX_BYTES, opencv: bool = False) -> Document:
    """Read a file of one YAML document; `opencv` also tolerates the first line %YAML:1.0 and the tag !!opencv-matrix."""
    content = read_capped(path, max_bytes, "the YAML file")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise BadInputError(f"{one_line(path)}, line {line}: is not UTF-8 text; save it as a UTF-8 YAML file") from None
    if opencv and text.startswith("%YAML:"):
        text = "#" + text  # not YAML, but what OpenCV's FileStorage writes and OpenVINS demands
    data, lines = _Builder(path, text, _OPENCV_TAGS if opencv else ()).build()
    return Document(path, data, sha256(content).hexdigest(), lines)


def read_capped(path: Path, max_bytes: int, what: str) -> bytes:
    """Return the content of a regular file of at most so many bytes; BadInputError where it is none ("give `what` itself")."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise BadInputError(f"{one_line(path)}: is not a file; give {what} itself")
        with path.open("rb") as file:
            content = file.read(max_bytes + 1)
    except (OSError, ValueError) as error:
        raise BadInputError(f"{one_line(path)}: cannot be read ({reason_of(error)}); check the path") from None
    if len(content) > max_bytes:
        raise BadInputError(f"{one_line(path)}: is larger than {max_bytes} bytes; this cannot be the right file")
    return content


class _Builder:
    """Builds data from parser events: the open containers on a stack, each with its lines and its size."""

    def __init__(self, path: Path, text: str, tags: tuple[str, ...]) -> None:
        self.path, self.text, self.tags = path, text, tags
        self.lines: dict[int, dict[Hashable, int]] = {}
        self.stack: list[dict[str, Any] | list[Any]] = []
        self.keys: list[str | None] = []  # the key that waits for its value, one for each open container
        self.sizes: list[int] = []  # nodes below, one for each open container
        self.anchors: dict[str, tuple[Any, int]] = {}
        self.pending: list[str | None] = []  # the anchor of each open container
        self.root: list[Any] = []
        self.nodes = 0

    def fail(self, line: int, text: str) -> NoReturn:
        raise BadInputError(f"{one_line(self.path)}, line {line + 1}: {text}")

    def build(self) -> tuple[Any, dict[int, dict[Hashable, int]]]:
        for event in self._events():
            line = event.start_mark.line
            if isinstance(event, yaml.DocumentStartEvent) and self.root:
                self.fail(line, "a second YAML document starts here; keep one document in a file")
            elif isinstance(event, yaml.AliasEvent):
                if event.anchor not in self.anchors:
                    self.fail(line, f"the alias *{one_line(event.anchor, 40)} stands for nothing before it; write the value out")
                self._add(*self.anchors[event.anchor], line)
            elif isinstance(event, yaml.ScalarEvent):
                self._scalar(event, line)
            elif isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
                self._open(event, line)
            elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
                self._close(line)
        if not self.root or self.root[0] is None:
            raise BadInputError(f"{one_line(self.path)}: is empty; it must hold a YAML document")
        return self.root[0], self.lines

    def _events(self) -> Iterator[Any]:
        try:
            yield from yaml.parse(self.text, Loader=_PARSER)
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            line = mark.line if mark else self.text.count("\n", 0, max(0, getattr(error, "position", 0) or 0))
            problem = one_line(getattr(error, "problem", None) or getattr(error, "reason", None) or error, 80)
            rows = self.text.splitlines()
            around = rows[max(0, line - 1) : line + 1]
            if any("\t" in row for row in around):
                self.fail(line, f"is not YAML ({problem}): a tab is used as white space near here; replace tabs by spaces")
            self.fail(line, f"is not YAML ({problem}); mend the indentation, brackets or quotes near this line")

    def _open(self, event: Any, line: int) -> None:
        self._refuse_tag(event, line)
        if len(self.stack) >= _MAX_DEPTH:
            self.fail(line, f"is nested deeper than {_MAX_DEPTH} levels; this cannot be the right file")
        if self.stack and isinstance(self.stack[-1], dict) and self.keys[-1] is None:
            self.fail(line, "a key must be a plain word; quote it or mend the brackets near this line")
        self.stack.append({} if isinstance(event, yaml.MappingStartEvent) else [])
        self.lines[id(self.stack[-1])] = {}
        self.keys.append(None)
        self.sizes.append(1)
        self.pending.append(event.anchor)
        if event.anchor is not None:
            self.anchors.pop(event.anchor, None)  # not to be used inside itself

    def _close(self, line: int) -> None:
        value, size, anchor = self.stack.pop(), self.sizes.pop(), self.pending.pop()
        self.keys.pop()
        if anchor is not None:
            self.anchors[anchor] = (value, size)
        self._add(value, size, line)

    def _scalar(self, event: Any, line: int) -> None:
        self._refuse_tag(event, line)
        waits_for_key = bool(self.stack) and isinstance(self.stack[-1], dict) and self.keys[-1] is None
        if waits_for_key:
            if event.value in self.stack[-1]:
                self.fail(line, f"the key '{one_line(event.value, 60)}' is given twice; remove one")
            self.keys[-1] = event.value
            self.lines[id(self.stack[-1])][event.value] = line + 1
            return
        value = self._resolve(event.value, line) if event.implicit[0] else event.value
        if event.anchor is not None:
            self.anchors[event.anchor] = (value, 1)
        self._add(value, 1, line)

    def _resolve(self, text: str, line: int) -> Any:
        convert = next((convert for pattern, convert in _CORE if pattern.fullmatch(text)), None)
        if convert is not None and len(text) > _MAX_NUMBER:
            self.fail(line, f"a number of {len(text)} characters; write it with at most 17 digits")
        return convert(text) if convert else text

    def _add(self, value: Any, size: int, line: int) -> None:
        self.nodes += 1
        if not self.stack:
            self.root.append(value)
            return
        parent, self.sizes[-1] = self.stack[-1], self.sizes[-1] + size
        if max(self.nodes, self.sizes[-1]) > _MAX_NODES:
            self.fail(line, f"holds more than {_MAX_NODES} values, aliases written out; this cannot be the right file")
        if isinstance(parent, list):
            self.lines[id(parent)][len(parent)] = line + 1
            parent.append(value)
        elif self.keys[-1] is None:
            self.fail(line, "an alias cannot be a key; write the key out")
        else:
            parent[self.keys[-1]] = value
            self.keys[-1] = None

    def _refuse_tag(self, event: Any, line: int) -> None:
        if event.tag is not None and event.tag not in self.tags:
            self.fail(line, f"the tag {one_line(event.tag, 60)} is not allowed; remove it")


class _Dumper(yaml.SafeDumper):
    """Writes floats so that they read back exactly, in YAML 1.1 readers too, and small collections on one line."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> yaml.SequenceNode:
        return super().represent_sequence(tag, sequence, _fits_a_line(sequence))

    def represent_mapping(self, tag: str, mapping: Any, flow_style: bool | None = None) -> yaml.MappingNode:
        return super().represent_mapping(tag, mapping, _fits_a_line(mapping.values()) and bool({"value"} & mapping.keys()))

    def represent_str(self, data: str) -> yaml.ScalarNode:
        return self.represent_scalar("tag:yaml.org,2002:str", data, style=None if data.isprintable() else '"')

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        return super().increase_indent(flow, False)


_Dumper.add_representer(str, _Dumper.represent_str)
# What YAML 1.2 reads as a number is quoted where it is text; 1.1's own rules are there already.
_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(rf"^(?:{_FLOAT.pattern}|0o[0-7]+)$"), list("-+.0123456789"))


def _fits_a_line(values: Iterable[Any]) -> bool:
    items = list(values)
    if any(isinstance(item, (dict, list, tuple)) for item in items):
        return False
    return not any(isinstance(item, str) for item in items) or sum(len(str(item)) + 2 for item in items) < 130


def dump_yaml(data: Any) -> str:
    """Return plain data as YAML in the order of its keys; matrices row by row, floats exact, a mapping with a `value` on one line."""
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=10**6)
    return text
