"""Untrusted YAML: the 1.2 core schema, lines, and one printable line for every fault; and atomic writing."""

import math
import os
import stat
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutate import read_or_refused

from calibkit.errors import BadInputError
from calibkit.io.atomic import write_atomic
from calibkit.io.yaml_file import dump_yaml, load_yaml


def write(folder: Path, content: bytes | str) -> Path:
    path = folder / "file.yaml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refused(path: Path, **options: bool) -> str:
    with pytest.raises(BadInputError) as caught:
        load_yaml(path, **options)  # type: ignore[arg-type]
    message = str(caught.value)
    assert message.isprintable()
    assert path.name in message
    return message


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *[
            (word, word)
            for word in ("on", "off", "yes", "no", "y", "1:30", "1_000", "nan", "inf", "-a", "e5", "1e", "0x", "2001-01-01", "<<")
        ],
        *[("1e-3", 1e-3), ("1E+3", 1000.0), ("1.", 1.0), (".5", 0.5), ("-.5e1", -5.0), ("010", 10), ("+7", 7), ("0o17", 15), ("0x1F", 31)],
        *[("~", None), ("Null", None), ("''", ""), ("True", True), ("FALSE", False), ("'1'", "1"), ('"1"', "1"), ("-.Inf", -math.inf)],
        ("2.5e-324", 5e-324),
        ("1e999", math.inf),
    ],
)
def test_scalars_follow_the_core_schema_of_yaml_1_2(tmp_path: Path, text: str, value: object) -> None:
    read = load_yaml(write(tmp_path, f"a: {text}\nb: 1\n")).data["a"]
    assert type(read) is type(value)
    assert read == value


def test_not_a_number_is_read_as_such(tmp_path: Path) -> None:
    assert all(math.isnan(x) for x in load_yaml(write(tmp_path, "[.nan, .NaN, .Nan]")).data)


def test_keys_are_always_text_and_know_their_lines(tmp_path: Path) -> None:
    document = load_yaml(write(tmp_path, "on:\n  1: x\n  list:\n  - 5\n  - {deep: 6,\n     flow: 7}\nback: &b\n  z: 1\nalias: *b\n"))
    assert document.data == {"on": {"1": "x", "list": [5, {"deep": 6, "flow": 7}]}, "back": {"z": 1}, "alias": {"z": 1}}
    assert [document.line_of(keys) for keys in [("on",), ("on", "1"), ("on", "list", 1, "flow"), ("back", "z"), ("alias", "z")]] == [
        1,
        2,
        6,
        8,
        8,
    ]
    assert document.line_of(("on", "list", 9, "x")) == 3  # the deepest that exists
    assert str(document.error(("on", "1"), "is bad")) == f"{document.path}, line 2: on.1: is bad"


@pytest.mark.parametrize(
    ("content", "line", "words"),
    [
        (b"", None, "empty"),
        (b"# only a comment\n", None, "empty"),
        (b"a: 1\na: 2\n", 2, "twice"),
        (b"a: 1\n'a': 2\n", 2, "twice"),
        (b"a: 1\nb:\n\t- 2\n", 3, "tab"),
        (b"a:\n - 1\n   b: 2\n  c: 3\n", 3, "indentation"),
        (b"a: [1, 2\nb: 3\n", 2, "brackets"),
        (b"a: 'x\n", 2, "quotes"),
        (b"x: 1\ny: \xff\xfe\n", 2, "UTF-8"),
        ("a: 1".encode("utf-16"), 1, "UTF-8"),
        (b"a: \x00", 1, "not YAML"),
        (b"a: " + b"9" * 5000, 1, "number of 5000"),
        (b"a: 1" + b"0" * 200 + b".5", 1, "number of 203"),
        (b"[" * 100_000, 1, "nested deeper"),
        (b"a:\n" + b"".join(b" " * i + b"- \n" for i in range(1, 100)), None, "nested deeper"),
        (b"{a: " * 50, 1, "nested deeper"),
        (b"a: &x [1, *x]", 1, "alias"),
        (b"a: *x", 1, "alias"),
        (b"a: &x 1\n*x : 2", 2, "alias"),
        (b"a: !!python/object/apply:os.system [x]", 1, "tag"),
        (b"a: !!float 1", 1, "tag"),
        (b"a: !!opencv-matrix {rows: 1}", 1, "tag"),
        (b"a: 1\n---\nb: 2\n", 2, "second"),
        (b"? [a, b]\n: 1\n", 1, "plain word"),
        (b"%YAML:1.0\na: 1\n", 1, "not YAML"),
        (b"%YAML 9.0\n---\na: 1\n", 1, "not YAML"),
        (b"\x1b[31mred: [", 1, "not YAML"),
    ],
)
def test_each_fault_is_one_line_with_its_place(tmp_path: Path, content: bytes, line: int | None, words: str) -> None:
    message = refused(write(tmp_path, content))
    assert words in message
    if line is not None:
        assert f"line {line}:" in message


def test_a_billion_laughs_are_refused_and_honest_aliases_are_not(tmp_path: Path) -> None:
    laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 9))
    assert "aliases written out" in refused(write(tmp_path, laughs))
    assert load_yaml(write(tmp_path, "a: &a [1, 2]\nb: *a\nc: {d: *a}\n")).data == {"a": [1, 2], "b": [1, 2], "c": {"d": [1, 2]}}


def test_what_opencv_writes_is_tolerated_where_the_format_allows_it(tmp_path: Path) -> None:
    document = load_yaml(write(tmp_path, "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 1\n   data: [ 1., .Nan ]\n"), opencv=True)
    assert document.data["K"]["rows"] == 1
    assert document.line_of(("K", "rows")) == 4
    assert "tag" in refused(write(tmp_path, "K: !!python/none x"), opencv=True)


def test_what_is_no_readable_file_is_refused(tmp_path: Path) -> None:
    refused(tmp_path)
    refused(tmp_path / "absent.yaml")
    loop = tmp_path / "loop.yaml"
    loop.symlink_to(loop)
    refused(loop)
    fifo = tmp_path / "fifo.yaml"
    os.mkfifo(fifo)
    refused(fifo)
    with pytest.raises(BadInputError, match="cannot be read"):
        load_yaml(Path("nul\0byte"))
    large = write(tmp_path, b"#" * 1001)
    with pytest.raises(BadInputError, match="larger than 1000 bytes"):
        load_yaml(large, max_bytes=1000)


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**90), 10**90) | st.floats(allow_nan=False) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=100, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.dictionaries(st.text(max_size=8), plain, min_size=1, max_size=3))
def test_what_is_written_reads_back_exactly(tmp_path: Path, data: dict[str, object]) -> None:
    assert load_yaml(write(tmp_path, dump_yaml(data))).data == data


@pytest.mark.parametrize("text", ["1e5", "1e-05", "0o17", "0x1f", "on", "1:30", "null", "1.5", ".5", "", "-", "2001-01-01", "=", "<<"])
def test_text_that_looks_like_a_number_stays_text(tmp_path: Path, text: str) -> None:
    dumped = dump_yaml({"a": text})
    assert load_yaml(write(tmp_path, dumped)).data == {"a": text}
    assert yaml.safe_load(dumped) == {"a": text}  # as other tools read it, by YAML 1.1


def test_floats_are_numbers_to_yaml_1_1_readers_too() -> None:
    values = [1e-05, 1e300, 5e-324, -1.5e-7, 0.1]
    assert yaml.safe_load(dump_yaml({"a": values})) == {"a": values}


@settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=60) | st.text("[]{}:,-?&*!|>'\"%@`# \t\na1.", max_size=40).map(str.encode))
def test_no_bytes_at_all_cause_a_traceback(tmp_path: Path, content: bytes) -> None:
    path = write(tmp_path, content)
    read_or_refused(lambda: load_yaml(path, opencv=True))


def test_an_existing_file_is_kept_unless_forced(tmp_path: Path) -> None:
    path = tmp_path / "out.yaml"
    write_atomic(path, "first")
    with pytest.raises(BadInputError, match="--force"):
        write_atomic(path, "second")
    assert path.read_text() == "first"
    write_atomic(path, b"third", overwrite=True)
    assert path.read_text() == "third"
    assert list(tmp_path.iterdir()) == [path]


def test_permissions_are_the_users(tmp_path: Path) -> None:
    path = tmp_path / "out.yaml"
    old = os.umask(0o027)
    try:
        write_atomic(path, "x")
    finally:
        os.umask(old)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    path.chmod(0o600)
    write_atomic(path, "y", overwrite=True)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "out.yaml"
    write_atomic(path, "old")

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BadInputError, match="No space left"):
        write_atomic(path, "new", overwrite=True)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link_and_strange_places_are_refused(tmp_path: Path) -> None:
    real, link = tmp_path / "real.yaml", tmp_path / "link.yaml"
    real.write_text("old")
    link.symlink_to(real)
    write_atomic(link, "new", overwrite=True)
    assert link.is_symlink()
    assert real.read_text() == "new"
    for bad in (tmp_path, tmp_path / "absent" / "x.yaml", Path("nul\0byte"), tmp_path / ("n" * 300), real / "x.yaml"):
        with pytest.raises(BadInputError) as caught:
            write_atomic(bad, "x", overwrite=True)
        assert str(caught.value).isprintable()
