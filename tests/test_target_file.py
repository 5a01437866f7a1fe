"""Target files: Kalibr's read as they are, absurd ones refused with the key and the fix."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutate import mutated, read_or_refused

from calibkit.errors import BadInputError
from calibkit.io.target_file import dump_target, load_target
from calibkit.models.board import AprilGrid, Board, Charuco, Checkerboard, CircleGrid

BOARDS: list[Board] = [
    AprilGrid(6, 5, 0.088, 0.3),
    Checkerboard(24, 17, 0.015, 0.0151),
    CircleGrid(4, 11, 0.02, True),
    CircleGrid(7, 6, 0.02),
    Charuco(8, 6, 0.03, 0.0225, "DICT_5X5_100", True),
]
APRILGRID = dump_target(BOARDS[0])


def load(folder: Path, content: str | bytes) -> Board:
    path = folder / "target.yaml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_target(path)


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_boards_come_back_equal(tmp_path: Path, board: Board) -> None:
    read = load(tmp_path, dump_target(board))
    assert read == board
    assert type(read) is type(board)


def test_kalibrs_own_examples_are_read_as_they_are(tmp_path: Path) -> None:
    """The files of github.com/ethz-asl/kalibr/wiki/calibration-targets, comments included."""
    april = "target_type: 'aprilgrid' #gridtype\ntagCols: 6    #number\ntagRows: 6\ntagSize: 0.088 #[m]\ntagSpacing: 0.3 #ratio\n"
    board = load(tmp_path, april)
    assert board == AprilGrid(6, 6, 0.088, 0.3)
    np.testing.assert_allclose(board.points[4 * 7 + 2], [2 * 0.088 + 0.3 * 0.088, 2 * 0.088 + 0.3 * 0.088, 0], atol=1e-15)
    checker = "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\ncolSpacingMeters: 0.05\n"
    board = load(tmp_path, checker)
    np.testing.assert_allclose(board.points[6 * 1 + 2], [0.10, 0.06, 0], atol=1e-15)
    circles = "target_type: 'circlegrid'\ntargetCols: 6\ntargetRows: 7\nspacingMeters: 0.02\nasymmetricGrid: False\n"
    assert load(tmp_path, circles) == CircleGrid(6, 7, 0.02)


def test_keys_of_other_tools_are_tolerated_where_they_agree(tmp_path: Path) -> None:
    assert load(tmp_path, "%YAML:1.0\n---\n" + APRILGRID + "tagFamily: t36h11\nlowId: 0\ncodeOffset: 0\n") == BOARDS[0]
    for line in ("tagFamily: t25h9", "lowId: 10", "lowId: false"):
        with pytest.raises(BadInputError, match=rf"line 6: {line.split(':')[0]}: .* is not supported; print the board"):
            load(tmp_path, APRILGRID + line)


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_each_key_is_needed_or_has_a_default_and_is_checked(tmp_path: Path, board: Board) -> None:
    data = yaml.safe_load(dump_target(board))
    for key in data:
        for value in (0, -1, 101, 1e-320, float("nan"), float("inf"), "0.088", True, None, [1], {"a": 1}, 10**40, 1e300):
            if type(value) is type(data[key]) and value in (True, 101):
                continue  # a flag and a count that are in order
            with pytest.raises(BadInputError) as caught:
                load(tmp_path, yaml.safe_dump(data | {key: value}, sort_keys=False))
            assert str(caught.value).isprintable()
        rest = yaml.safe_dump({k: v for k, v in data.items() if k != key})
        if key in ("asymmetricGrid", "dictionary", "legacy"):
            assert load(tmp_path, rest).kind == board.kind
        else:
            with pytest.raises(BadInputError, match=f"{key} is missing"):
                load(tmp_path, rest)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "tagSize: 0.088",
            "tagSzie: 0.088",
            r"tagSize is missing \(is 'tagSzie' in line 4 meant\?\); give the edge of a tag's black square",
        ),
        ("tagSize: 0.088", "tagSize: 88", "the board would be .* m wide; lengths are in metres"),
        ("tagSize: 0.088", "tagSize: 0", r"line 4: tagSize: 0 will not do; give the edge .* in metres, such as 0.05"),
        ("tagSize: 0.088", "tagSize: 0.088\nextra: 1", "line 5: extra: is no key of target_type aprilgrid; remove it"),
        ("tagSpacing: 0.3", "tagSpacing: 11", "tagSpacing: 11 will not do; give the gap"),
        ("tagCols: 6", "tagCols: 6.0", "tagCols: 6.0 will not do; give the number of tags"),
        ("tagCols: 6", "tagCols: 600", "too many"),
        ("tagCols: 6", "tagCols: 120", "the family 36h11 has 587"),
        ("target_type: aprilgrid", "target_type: april", "'april' is not known; give one of aprilgrid, checkerboard"),
        ("target_type: aprilgrid", "type: aprilgrid", "target_type is missing"),
        ("target_type: aprilgrid", 'target_type: "\\e[31m\\u202e"', r"target_type: '\\x1b\[31m\\u202e' is not known"),
    ],
)
def test_messages_name_key_line_and_fix(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in APRILGRID
    with pytest.raises(BadInputError, match=message) as caught:
        load(tmp_path, APRILGRID.replace(old, new))
    assert str(caught.value).isprintable()


def test_a_charuco_must_be_printable(tmp_path: Path) -> None:
    text = dump_target(Charuco(12, 9, 0.03, 0.02, "DICT_4X4_100"))
    assert load(tmp_path, text).shape == (9, 12)
    with pytest.raises(BadInputError, match="too few markers for 12 x 9"):
        load(tmp_path, text.replace("DICT_4X4_100", "DICT_4X4_50"))
    with pytest.raises(BadInputError, match="does not fit into squareSize"):
        load(tmp_path, text.replace("markerSize: 0.02", "markerSize: 0.03"))


@settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.sampled_from([dump_target(board) for board in BOARDS]).flatmap(mutated))
def test_mutated_files_are_read_or_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    board = read_or_refused(lambda: load(tmp_path, content))
    if board is not None:
        assert np.all(np.isfinite(board.points))
        assert 1e-3 <= np.ptp(board.points, axis=0).max() <= 30
        assert load(tmp_path, dump_target(board)) == board
