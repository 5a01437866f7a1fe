"""Fixtures for all tests: where the real recordings are, and how many tests went without them."""

import os
import sys
from pathlib import Path

import pytest
from commands import Run, Said

from calibkit.cli.main import main


@pytest.fixture
def data_dir(request: pytest.FixtureRequest) -> Path:
    """The folder of real recordings (CALIBKIT_TEST_DATA); skips where it is absent."""
    value = os.environ.get("CALIBKIT_TEST_DATA", "")
    if not value or not Path(value).is_dir():
        pytest.skip("needs the real recordings: set CALIBKIT_TEST_DATA to their folder")
    return Path(value).resolve()


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the tests away from the user's corner cache."""
    monkeypatch.setenv("CALIBKIT_CACHE_DIR", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs the command line in this process."""

    def calibkit(*arguments: object) -> Said:
        monkeypatch.setattr(sys, "argv", ["calibkit", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        said = capsys.readouterr()
        return Said(int(end.value.code or 0), said.out, said.err)

    return calibkit


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    skipped = [r for r in terminalreporter.stats.get("skipped", []) if "CALIBKIT_TEST_DATA" in str(r.longrepr)]
    terminalreporter.write_line(f"{len(skipped)} tests skipped for want of the real recordings (CALIBKIT_TEST_DATA)")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("-m") or os.environ.get("CALIBKIT_SLOW"):
        return
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="slow: run by scripts/test --slow"))
