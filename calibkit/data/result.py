"""What a stage found: estimates with covariance and verdict, and the residuals that a report is drawn from."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibkit.data.rig import Rig
from calibkit.data.verdict import Reason, Verdict, worst

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ResidualSet:
    """Residuals of one sensor (measured minus predicted) with the context that a reader needs to judge them.

    `context` holds arrays of n rows by agreed names: uv (n, 2) px measured, corner (n,), frame (n,), kept (n,) bool,
    distance (n,) m, tilt (n,) rad.
    """

    sensor: str
    unit: str
    t_ns: NDArray[np.int64]  # (n,)
    raw: Array  # (n, d) in `unit`
    sigma: Array  # (n,) the sigma that each component was weighed by
    context: dict[str, NDArray[np.generic]] = field(default_factory=dict)


@dataclass(frozen=True)
class Thumbnail:
    """A worst frame: JPEG with found and predicted corners drawn, and its caption."""

    label: str
    jpeg: bytes


@dataclass(frozen=True)
class Result:
    """The outcome of one stage, all that the rig file, the residual file and the report are made from."""

    stage: str
    rig: Rig
    reasons: tuple[Reason, ...]
    residuals: tuple[ResidualSet, ...] = ()
    facts: dict[str, object] = field(default_factory=dict)  # stage-specific, JSON-ready, for --json and the report
    thumbnails: tuple[Thumbnail, ...] = ()
    not_observable: tuple[str, ...] = ()  # names of what was asked for and cannot be known from this recording
    made: dict[str, str] = field(default_factory=dict)  # of a result read back: the hash of each rig entry that it made, by key

    @property
    def verdict(self) -> Verdict:
        return worst(self.reasons)

    @property
    def exit_code(self) -> int:
        """SPEC section 6: 3 something is not observable, 1 FAIL, 0 otherwise."""
        if self.not_observable:
            return 3
        return 1 if self.verdict is Verdict.FAIL else 0
