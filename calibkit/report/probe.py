"""What a signal is: what it measures, what is good, what is bad, and what it found."""

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite

from calibkit.data.verdict import Reason, Verdict
from calibkit.report.view import View

SIGNIFICANT = 4.0  # sigma below which structure is taken for chance


@dataclass(frozen=True)
class Measured:
    """A value in its probe's unit and what there is to say about it; `exempt` when the value tells nothing (too few data, chance)."""

    value: float
    note: str = ""
    exempt: bool = False


@dataclass(frozen=True)
class Probe:
    """One signal: PASS up to `good`, CHECK up to `bad`, FAIL beyond (the other way round where bad < good)."""

    key: str
    title: str
    unit: str
    good: float
    bad: float
    needs: frozenset[str]
    measure: Callable[[View], Measured]
    means: str  # what it says when it is not good, and the remedy

    def judge(self, value: float) -> Verdict:
        sign = 1 if self.bad >= self.good else -1
        if sign * value <= sign * self.good:
            return Verdict.PASS
        return Verdict.CHECK if sign * value <= sign * self.bad else Verdict.FAIL

    @property
    def limit(self) -> str:
        """What is good, and beyond which it fails, as people read it."""
        below, above = ("≤", ">") if self.bad >= self.good else ("≥", "<")
        unit = f" {self.unit}" if self.unit else ""
        good = f"{below} {self.good:g}{unit}"
        return f"{good} (FAIL {above} {self.bad:g}{unit})" if isfinite(self.bad) else good


@dataclass(frozen=True)
class Signal:
    """What a probe found in one sensor's residuals."""

    probe: Probe
    stage: str
    sensor: str
    value: float
    note: str
    verdict: Verdict

    @property
    def mark(self) -> str:
        """The verdict in one word; "-" where the value is beyond its limit but tells nothing, as the note says."""
        return self.verdict.value if self.probe.judge(self.value) is self.verdict else "-"

    @property
    def reason(self) -> Reason:
        """The signal as a sentence of a verdict."""
        unit = f" {self.probe.unit}" if self.probe.unit else ""
        note = f" ({self.note})" if self.note else ""
        means = "" if self.verdict is Verdict.PASS else f": {self.probe.means}"
        return Reason(self.verdict, f"{self.sensor}: {self.probe.title} {self.value:.3g}{unit}{note}, good is {self.probe.limit}{means}")
