"""Arguments that would destroy an input or name nothing are refused in one line, and what they name stays as it is."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import Run


@pytest.fixture
def refused(run: Run) -> Callable[..., str]:
    return lambda *arguments: run(*arguments).mistake


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["info", "a", "--json", "a"], "an input"),
        (["info", "b", "a", "--json", "./link"], "an input"),
        (["intrinsics", "a", "--target", "b", "-o", "b"], "an input"),
        (["intrinsics", "a", "--target", "b", "-o", "a"], "an input"),
        (["intrinsics", "a", "--target", "b", "--json", "hard"], "an input"),
        (["intrinsics", "a", "--target", "b", "--report", "a"], "an input"),
        (["intrinsics", "a", "--target", "b", "--rig", "c", "-o", "c", "--json", "c"], "an output"),
        (["intrinsics", "a", "--target", "b", "--rig", "c", "--json", "c"], "an input"),
        (["intrinsics", "a", "--target", "b", "-o", "new", "--json", "./new"], "an output"),
        (["intrinsics", "a", "--target", "b", "-o", "new", "--report", "new"], "an output"),
        (["report", "a", "--json", "a"], "an input"),
        (["report", "a", "--json", "new", "-o", "new"], "an output"),
        (["import", "b", "a", "-o", "a"], "an input"),
    ],
    ids=" ".join,
)
def test_an_output_over_an_input_or_another_output_is_refused(words, what, refused, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in "abc":
        Path(name).write_text(name)
    Path("link").symlink_to("a")
    os.link("a", "hard")
    assert f"is {what} of this command, too; give another name" in refused(*words, "--force")
    assert [Path(name).read_text() for name in "abc"] == ["a", "b", "c"]
    assert not Path("new").exists()


@pytest.mark.parametrize("words", [["info", ""], ["intrinsics", "a", "--target", ""], ["import", "a", "-o", ""], ["info", "--", ""]])
def test_an_empty_argument_is_an_unset_variable_and_not_this_folder(words, refused) -> None:
    assert refused(*words) == "an argument is empty: is a variable of the shell unset?"


def test_an_error_of_the_system_comes_with_a_remedy(refused) -> None:
    told = refused("info", "a" * 5000)
    assert "File name too long" in told
    assert "check the path, its permissions" in told
    assert "Errno" not in told


def test_an_output_whose_name_is_no_utf_8_is_refused_before_the_work(refused, tmp_path: Path) -> None:
    (tmp_path / "a").write_text("")
    assert "the name is not UTF-8; give another name" in refused("info", tmp_path / "a", "--json", tmp_path / "j\udcff.json")


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "latin-1"])
def test_a_log_without_greek_letters_is_no_error(encoding: str) -> None:
    program = "from calibkit.cli import main; main.app.command('say')(lambda: print('\u2264 \u03c3')); main.main()"
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run([sys.executable, "-c", program, "say"], capture_output=True, env=environment, check=False)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, b"? ?", b"")


def test_h_is_help_everywhere(run: Run) -> None:
    for words in (["-h"], ["info", "-h"], ["target", "aprilgrid", "-h"]):
        said = run(*words)
        assert said.code == 0
        assert "--help" in said.out
