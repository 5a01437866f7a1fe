"""OpenCV's installation is checked at first use, and the remedy is on the same line."""

import os
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from calibkit.errors import BadInputError
from calibkit.opencv import check, cv2, installed_distributions

WANTED = "opencv-contrib-python-headless"
PIP = f"{shlex.quote(sys.executable)} -m pip"


def fake_cv2(version: str) -> SimpleNamespace:
    return SimpleNamespace(__version__=version, findChessboardCorners=0, aruco=0, remap=0, imdecode=0)


def remedy_of(installed: list[str], module: object) -> str:
    with pytest.raises(BadInputError) as caught:
        check(installed, module)
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)
    assert f'&& {PIP} install "{WANTED}>=4.10,!=4.12.*"' in str(caught.value)
    return str(caught.value)


def test_the_installed_opencv_passes() -> None:
    assert installed_distributions() == [WANTED]
    check(installed_distributions(), cv2)


@pytest.mark.parametrize("version", ["4.10.0", "4.11.0", "4.13.0", "4.14.0", "5.0.0", "5.1.0-dev"])
def test_supported_versions_pass(version: str) -> None:
    check([WANTED], fake_cv2(version))


@pytest.mark.parametrize("version", ["3.4.18", "4.9.0", "4.12.0", "garbage"])
def test_unsupported_versions_are_named(version: str) -> None:
    message = remedy_of([WANTED], fake_cv2(version))
    assert f"OpenCV {version} is not supported" in message
    assert f"{PIP} uninstall -y {WANTED} &&" in message


def test_two_distributions_are_both_removed() -> None:
    message = remedy_of(["opencv-python", WANTED], fake_cv2("4.14.0"))
    assert message.startswith("2 OpenCV distributions overwrite each other")
    assert f"{PIP} uninstall -y opencv-python {WANTED} &&" in message


def test_a_missing_part_is_named() -> None:
    module = fake_cv2("4.14.0")
    del module.aruco
    assert "is incomplete: no aruco;" in remedy_of(["opencv-python"], module)


PROBE = """
from calibkit.cli.main import app, main

@app.command()
def probe():
    import calibkit.opencv

main()
"""


def run_probe(first_on_path: Path) -> subprocess.CompletedProcess[str]:
    """Run a command that needs cv2 through the whole command line, with a folder before all others on the path."""
    environment = {**os.environ, "PYTHONPATH": str(first_on_path)}
    return subprocess.run([sys.executable, "-c", PROBE, "probe"], env=environment, capture_output=True, text=True, check=False)


def assert_one_line_code_2(result: subprocess.CompletedProcess[str], wanted: str) -> None:
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("calibkit: ")
    assert wanted in result.stderr
    assert f'&& {PIP} install "{WANTED}>=4.10,!=4.12.*"' in result.stderr


def test_the_command_runs_with_a_sound_opencv(tmp_path: Path) -> None:
    assert run_probe(tmp_path).returncode == 0


def test_an_empty_cv2_ends_the_command_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "cv2").mkdir()
    (tmp_path / "cv2" / "__init__.py").touch()
    assert_one_line_code_2(run_probe(tmp_path), f"cv2 in {tmp_path}/cv2/__init__.py) is incomplete: no findChessboardCorners")


def test_a_cv2_that_cannot_be_imported_ends_the_command_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "cv2.py").write_text("raise ImportError('libGL.so.1: cannot open\\nshared object file')\n")
    assert_one_line_code_2(run_probe(tmp_path), "OpenCV cannot be imported (libGL.so.1: cannot open shared object file)")


def test_a_second_distribution_ends_the_command_with_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "opencv_python-4.14.0.94.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: opencv-python\nVersion: 4.14.0.94\n")
    assert_one_line_code_2(run_probe(tmp_path), f"uninstall -y opencv-python {WANTED} &&")
