"""A report as Markdown (GitHub's kind, with tables): verdict, reasons, limits, parameters and signals, for the page of a CI job."""

import re
from collections.abc import Iterator, Sequence

from calibkit.data.verdict import Verdict
from calibkit.errors import one_line
from calibkit.report.summary import Summary
from calibkit.report.summary_text import about, camera_lines, limit_cells, parameter_cells, signal_cells, stage_lines
from calibkit.version import __version__

MEANING = {
    Verdict.PASS: "use it",
    Verdict.CHECK: "usable, but read the reasons",
    Verdict.FAIL: "do not use it",
}


def markdown(summary: Summary) -> bytes:
    """Return the report's words and tables; whatever text came from files stays text."""
    return "\n".join(_blocks(summary)).encode()


def _blocks(summary: Summary) -> Iterator[str]:
    yield f"## calibkit: {summary.verdict.value}, {MEANING[summary.verdict]}\n"
    yield "\n".join(f"- **{reason.verdict.value}** {escape(reason.text)}" for reason in summary.reasons) + "\n"
    if summary.limits:
        yield "### Limits\n"
        yield _table(limit_cells(summary))
    if told := [*camera_lines(summary), *stage_lines(summary)]:
        yield "### Seen\n"
        yield "\n".join(f"- {escape(line)}" for line in told) + "\n"
    if summary.parameters:
        yield "### Parameters\n"
        yield _table(parameter_cells(summary))
    if summary.signals:
        yield "### Signals\n"
        yield _table(signal_cells(summary))
    yield f"{escape(about(summary))} · calibkit {__version__}\n"


def _table(cells: Sequence[Sequence[str]]) -> str:
    head, *rows = ["| " + " | ".join(escape(cell) for cell in row) + " |" for row in cells]
    return "\n".join([head, "|" + " --- |" * len(cells[0]), *rows]) + "\n"


def escape(text: str) -> str:
    """Return text as Markdown that reads as just that text: no markup, HTML, links, mentions or formulas, and on one line."""
    flat = re.sub(r"([\\`*_\[\]<>|~&$#!@{}])", r"\\\1", one_line(text, 1000))
    flat = re.sub(r"(?i)(:(?=//)|(?<=www)\.)", r"\\\1", flat)  # bare addresses become links
    return re.sub(r"^([-+=]|\d+(?=[.)](?:\s|$)))", lambda found: f"{found[0]}\\" if found[0].isdigit() else f"\\{found[0]}", flat)
