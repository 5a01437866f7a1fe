"""The examples on the conventions page are true."""

import doctest
from pathlib import Path

from calibkit.data.rig import CONVENTIONS

PAGE = Path(__file__).parent.parent / "docs" / "conventions.md"


def test_the_conventions_pages_examples_run() -> None:
    result = doctest.testfile(str(PAGE), module_relative=False, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted >= 10
    assert result.failed == 0


def test_the_page_and_the_rig_file_say_the_same() -> None:
    text = " ".join(PAGE.read_text(encoding="utf-8").split())
    for phrase in (
        "p_a = T_a_b p_b",
        "t_a = t_b + dt_a_b",
        "T exp(d)",
        "Pixel (0, 0) is the centre of the top-left pixel",
        "x right, y down, z forward",
    ):
        assert phrase in text
        assert phrase.lower() in " ".join(CONVENTIONS.values()).lower()
