"""How far a result may be trusted, in the three words that people and CI read."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum


class Verdict(str, Enum):
    """PASS: use it. CHECK: usable, read the reasons. FAIL: do not use it."""

    PASS = "PASS"
    CHECK = "CHECK"
    FAIL = "FAIL"


class Status(str, Enum):
    """What the recording says about one parameter."""

    GIVEN = "given"  # taken over from a file, not estimated here
    DETERMINED = "determined"
    WEAK = "weak"
    NOT_OBSERVABLE = "not observable"


@dataclass(frozen=True)
class Reason:
    """One sentence of a verdict, naming the cause and, where there is one, the remedy."""

    verdict: Verdict
    text: str


def worst(reasons: Iterable[Reason]) -> Verdict:
    """Return the gravest verdict among the reasons, PASS where there is none."""
    order = list(Verdict)
    return max((reason.verdict for reason in reasons), key=order.index, default=Verdict.PASS)
