"""What is wrong with a calibration, by the fewest of many suspected causes that explain why new data ask for another one.

New data want the calibration moved by delta, known to P = their own covariance + that of the calibration under test. If only some
causes C are at work, delta = C theta + noise, so that with M = P^-1

    theta = (C^T M C)^-1 C^T M delta        evidence = theta^T C^T M C theta ~ chi^2 of as many degrees of freedom as C has columns

where nothing is wrong: generalised least squares and its score test (Rao 1948). Causes are taken one after the other, each beside those
before, as long as one is significant; the chance that any is named where none is there stays below FAMILY_WISE (Bonferroni).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from calibkit.geometry.so3 import Array

FAMILY_WISE = 0.01
_TERMS = 40  # over 1 - x: of a series of about x^n, to rounding
_MOST = 4  # causes at once: with more the calibration as a whole does not fit
_AS_GOOD = 9.0  # of evidence: another cause that has less than this less is not told from the first


@dataclass(frozen=True)
class Suspect:
    """A cause that may be wrong."""

    key: str
    columns: Array  # (p, d) what it moves


@dataclass(frozen=True)
class Evidence:
    """What new data say about a calibration."""

    delta: Array  # (p,) how they want it moved
    cov: Array  # (p, p) of that, the calibration's own included
    information: Array  # (p, p) of the new data alone, all else free: what their cost grows by
    scales: Array  # (p,) what each must be known to
    freedom: float  # independent blocks behind the covariance


@dataclass(frozen=True)
class Cause:
    """A suspect that is found guilty."""

    key: str
    theta: Array  # (d,) its size
    cov: Array  # (d, d)
    log_p: float  # natural logarithm of the chance of as much evidence, or more, where it is innocent
    share: float  # of what the data lose by the calibration: what mending this, after those before, brings back
    alike: tuple[str, ...] = ()  # suspects that this recording does not tell from it


@dataclass(frozen=True)
class Alone:
    """A suspect as if it were the only cause."""

    theta: Array  # (d,)
    cov: Array  # (d, d)
    log_p: float
    share: float  # of what the data lose by the calibration: what mending it alone brings back; negative where that makes it worse


@dataclass(frozen=True)
class Diagnosis:
    causes: tuple[Cause, ...]
    alone: dict[str, Alone]  # every suspect
    sigmas: dict[str, float]  # of each suspect alone, in units of what must be known: the least that would be found is some 4 times that
    unexplained_log_p: float  # of what the causes leave


def diagnose(evidence: Evidence, suspects: Sequence[Suspect]) -> Diagnosis:
    """Return the causes, the first the strongest."""
    scaled = _Scaled.of(evidence)
    columns = {suspect.key: suspect.columns / evidence.scales[:, None] for suspect in suspects}
    limit = np.log(FAMILY_WISE / max(len(suspects), 1))
    chosen: list[str] = []
    alike: dict[str, tuple[str, ...]] = {}
    log_p: dict[str, float] = {}
    while len(chosen) < _MOST:
        tried = {key: scaled.gain(columns, chosen, key) for key in columns if key not in chosen}
        tests = {key: scaled.log_p(gain, columns[key].shape[1]) for key, gain in tried.items()}
        if not tests or min(tests.values()) > limit:
            break
        best = min(tests, key=lambda key: tests[key])
        near = (key for key in tests if key != best and tried[key] > tried[best] - _AS_GOOD and tests[key] < limit)
        alike[best] = tuple(key for key in near if not _holds(columns[key], columns[best]))
        log_p[best] = tests[best]
        chosen.append(best)
        for key in chosen[:-1]:  # one that the others explain was none
            others = [other for other in chosen if other != key]
            if scaled.log_p(scaled.gain(columns, others, key), columns[key].shape[1]) > limit:
                chosen = others
    theta, cov = scaled.sizes(columns, chosen)
    causes, left, start = [], scaled.delta, 0
    for key in chosen:
        part = slice(start, start := start + columns[key].shape[1])
        before, left = left, left - columns[key] @ theta[part]
        causes.append(Cause(key, theta[part], cov[part, part], log_p[key], scaled.share(before, left), alike[key]))
    alone = {key: scaled.alone(columns, key) for key in columns}
    sigmas = {key: scaled.sigma(each) for key, each in columns.items()}
    rest = scaled.chi2 - scaled.evidence(columns, chosen)
    return Diagnosis(tuple(causes), alone, sigmas, scaled.log_p(max(rest, 0.0), len(evidence.delta) - len(theta)))


@dataclass(frozen=True)
class _Scaled:
    """The evidence in units of what must be known."""

    delta: Array
    M: Array  # P^-1
    information: Array
    freedom: float

    @classmethod
    def of(cls, evidence: Evidence) -> "_Scaled":
        s = evidence.scales
        values, vectors = np.linalg.eigh(evidence.cov / s / s[:, None])
        M = vectors / np.maximum(values, values[-1] * 1e-15) @ vectors.T
        return cls(evidence.delta / s, M, evidence.information * s * s[:, None], evidence.freedom)

    @property
    def chi2(self) -> float:
        return float(self.delta @ self.M @ self.delta)

    def sizes(self, columns: dict[str, Array], keys: Sequence[str]) -> tuple[Array, Array]:
        if not keys:
            return np.zeros(0), np.zeros((0, 0))
        C = np.concatenate([columns[key] for key in keys], axis=1)
        cov = np.linalg.pinv(C.T @ self.M @ C, hermitian=True)
        return cov @ C.T @ self.M @ self.delta, cov

    def evidence(self, columns: dict[str, Array], keys: Sequence[str]) -> float:
        if not keys:
            return 0.0
        theta, _ = self.sizes(columns, keys)
        C = np.concatenate([columns[key] for key in keys], axis=1)
        return float(theta @ C.T @ self.M @ self.delta)

    def share(self, before: Array, after: Array) -> float:
        """Return what of the whole excess the data win back where what is off shrinks from before to after."""
        lost = [float(off @ self.information @ off) for off in (before, after, self.delta)]
        return (lost[0] - lost[1]) / max(lost[2], 1e-300)

    def alone(self, columns: dict[str, Array], key: str) -> Alone:
        theta, cov = self.sizes(columns, [key])
        test = self.log_p(self.evidence(columns, [key]), len(theta))
        return Alone(theta, cov, test, self.share(self.delta, self.delta - columns[key] @ theta))

    def gain(self, columns: dict[str, Array], beside: Sequence[str], key: str) -> float:
        """Return the evidence that a suspect adds to others."""
        return self.evidence(columns, [*beside, key]) - self.evidence(columns, beside)

    def log_p(self, chi2: float, d: int) -> float:
        """Return log P(evidence >= chi2): F, since the covariance is itself known by some blocks only."""
        return log_tail(chi2, d, self.freedom) if d else 0.0

    def sigma(self, column: Array) -> float:
        """Return how well the recording tells a suspect by itself, relative to what its own columns must be known to."""
        cov = np.linalg.pinv(column.T @ self.M @ column, hermitian=True)
        size = np.linalg.norm(column, axis=0)
        return float(np.max(np.sqrt(np.diag(cov)) * size))


def _holds(wide: Array, narrow: Array) -> bool:
    """Whether one suspect is a case of another, which then explains all that it does."""
    left = narrow - wide @ np.linalg.lstsq(wide, narrow, rcond=None)[0]
    return bool(np.linalg.norm(left) < 1e-9 * np.linalg.norm(narrow))


def log_tail(chi2: float, d: int, freedom: float) -> float:
    """Return log P(d F >= chi2) of F with d and `freedom` degrees of freedom: log I_x(a, b), and its series where that is no number."""
    a, b, x = freedom / 2, d / 2, freedom / (freedom + max(chi2, 0.0))
    chance = float(special.betainc(a, b, x))
    if chance > 0:
        return float(np.log(chance))
    # DLMF 8.17.8: I_x(a, b) = x^a (1 - x)^b / (a B(a, b)) sum_n x^n (a + b)_n / (a + 1)_n
    n = np.arange(int(np.ceil(_TERMS / (1 - x))))
    terms = np.cumprod(x * (a + b + n) / (a + 1 + n))
    return float(a * np.log(x) + b * np.log1p(-x) - np.log(a) - special.betaln(a, b) + np.log1p(terms.sum()))
