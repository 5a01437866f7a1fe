"""Intervals of a noise coefficient by profile likelihood: asymmetric where the recording makes them so."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibkit.estimation.noise_likelihood import Fit, Problem, maximise

_RISE = 3.841  # of the deviance: 95 % of chi-squared with 1 degree of freedom


@dataclass(frozen=True)
class Interval:
    """A coefficient sqrt(theta), its sigma at the maximum and its 95 % interval; resolved: the interval does not reach zero."""

    value: float
    sigma: float
    lower: float
    upper: float
    resolved: bool


def interval(p: Problem, fit: Fit, i: int) -> Interval:
    """Return the interval of sqrt(theta_i), all other coefficients at their best for each value of it."""
    theta = float(fit.theta[i])
    spread = float(np.sqrt(np.linalg.pinv(fit.information)[i, i]))

    def rise(value: float) -> float:
        return maximise(p, fit.theta, (i, value)).deviance - fit.deviance - _RISE

    upper = _crossing(rise, max(theta, spread * 0.1), 2.0 if theta < 2 * spread else 1 + 3 * spread / theta)
    resolved = theta > 0 and rise(0.0) > 0
    lower = _crossing(rise, theta, 0.5 if theta < 2 * spread else 1 / (1 + 3 * spread / theta)) if resolved else 0.0
    value = np.sqrt(theta)
    return Interval(float(value), spread / (2 * float(value)) if value > 0 else 0.0, float(np.sqrt(lower)), float(np.sqrt(upper)), resolved)


def _crossing(rise: Callable[[float], float], start: float, factor: float) -> float:
    """Return where the rise crosses zero, going from start by the factor, then by false position in log theta (Illinois)."""
    a, fa = np.log(start), rise(start)
    if fa > 0:
        return start
    b, fb = a, fa
    for _ in range(60):
        a, fa = b, fb
        b = a + np.log(factor)
        fb = rise(float(np.exp(b)))
        if fb > 0:
            break
    side = 0
    for _ in range(20):
        c = (a * fb - b * fa) / (fb - fa)
        fc = rise(float(np.exp(c)))
        if abs(fc) < 0.02:
            return float(np.exp(c))
        if fc > 0:
            b, fb = c, fc
            fa = fa / 2 if side > 0 else fa
            side = 1
        else:
            a, fa = c, fc
            fb = fb / 2 if side < 0 else fb
            side = -1
    return float(np.exp((a + b) / 2))
