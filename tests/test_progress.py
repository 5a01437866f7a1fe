"""The progress bar on a terminal."""

import sys

import pytest

from calibkit.cli.progress import bar


def test_a_topics_name_is_no_markup(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert list(bar(range(3), "images of /cam[/x][bold]", 3)) == [0, 1, 2]
    assert capsys.readouterr().out == ""
