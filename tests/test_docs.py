"""The examples in the documents are true."""

import doctest
import re
from pathlib import Path

import pytest

from calibkit.data.rig import CONVENTIONS

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGE = DOCS / "conventions.md"


@pytest.mark.parametrize(
    ("name", "examples"), [("conventions.md", 12), ("time_offset.md", 20), ("handeye.md", 18), ("joint.md", 7), ("diff_and_budget.md", 15)]
)
def test_the_examples_run(name: str, examples: int) -> None:
    result = doctest.testfile(str(DOCS / name), module_relative=False, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted >= examples
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


def test_links_lead_somewhere() -> None:
    pages = [ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS.glob("*.md")]
    for page in pages:
        for target, anchor in re.findall(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)", page.read_text(encoding="utf-8")):
            to = page if not target else page.parent / target
            assert to.exists(), f"{page.name}: {target}"
            if anchor:
                headings = re.findall(r"^#+ (.*)$", to.read_text(encoding="utf-8"), re.MULTILINE)
                assert anchor in {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}, (
                    f"{page.name}: #{anchor}"
                )


def test_the_demo_runs_what_the_readme_shows() -> None:
    shown = re.findall(r"^    \$ (calibkit .*)$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    script = (ROOT / "scripts" / "demo").read_text(encoding="utf-8")
    assert len(shown) == 2
    assert all(f"    {command} || status" in script or f"\n{command} || status" in script for command in shown)
