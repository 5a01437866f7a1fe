"""A report as JUnit XML, which CI servers show as tests: one test case a reason, limit, signal and parameter.

A test case fails where the report's exit code is 1 for it; no times are written, so that the same report gives the same bytes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree

from calibkit.data.verdict import Status, Verdict
from calibkit.errors import one_line
from calibkit.report.summary import Summary
from calibkit.version import __version__

_MAX = 1000  # characters of a text


@dataclass(frozen=True)
class _Case:
    """One test case: its verdict, and what there is to say about it."""

    group: str
    name: str
    verdict: Verdict
    text: str


def junit(summary: Summary, strict: bool = False) -> bytes:
    """Return the report as one JUnit test suite; `strict`: CHECK fails, too."""
    cases = list(_cases(summary))
    failing = {Verdict.FAIL, Verdict.CHECK} if strict else {Verdict.FAIL}
    failures = sum(case.verdict in failing for case in cases)
    counts = {"tests": str(len(cases)), "failures": str(failures), "errors": "0", "time": "0"}
    root = ElementTree.Element("testsuites", {"name": "calibkit report", **counts})
    suite = ElementTree.SubElement(root, "testsuite", {"name": "calibkit report", **counts, "skipped": "0"})
    properties = ElementTree.SubElement(suite, "properties")
    for name, value in (("verdict", summary.verdict.value), ("calibkit", __version__)):
        ElementTree.SubElement(properties, "property", {"name": name, "value": value})
    for case in cases:
        # ElementTree escapes < > & and quotes; one_line leaves out what XML cannot hold at all.
        name, text = one_line(case.name, _MAX), one_line(case.text, _MAX)
        node = ElementTree.SubElement(suite, "testcase", {"classname": f"calibkit.{one_line(case.group, 200)}", "name": name, "time": "0"})
        if case.verdict in failing:
            ElementTree.SubElement(node, "failure", {"type": case.verdict.value, "message": text}).text = text
        elif text:
            ElementTree.SubElement(node, "system-out").text = f"{case.verdict.value} {text}"
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'.encode()


def _cases(summary: Summary) -> Iterator[_Case]:
    for reason in summary.reasons:
        yield _Case("verdict", reason.text, reason.verdict, reason.text)
    for one in summary.limits:
        yield _Case(f"limits.{one.part}", f"{one.name}: {one.what}{_by(one.stage)}", one.reason.verdict, one.reason.text)
    for signal in summary.signals:
        yield _Case(f"signals.{signal.sensor}", f"{signal.probe.title}{_by(signal.stage)}", signal.verdict, signal.reason.text)
    for row in summary.parameters:
        verdict = {Status.NOT_OBSERVABLE: Verdict.FAIL, Status.WEAK: Verdict.CHECK}.get(row.status, Verdict.PASS)
        sigma = f" +- {row.sigma_text}" if row.sigma is not None else ""
        unit = f" {row.unit}" if row.unit else ""
        known = "" if row.value is None else f" {row.value_text}{sigma}{unit},"
        yield _Case(f"parameters.{row.part}", row.name, verdict, f"{row.part} {row.name}{known} {row.status.value}")


def _by(stage: str) -> str:
    return f" ({stage})" if stage else ""
