"""How long a recording must be to resolve a noise term: from the information it would hold, before it is made."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.noise_interval import Interval
from calibkit.estimation.noise_likelihood import Problem, maximise
from calibkit.estimation.noise_spectrum import shapes

Array = NDArray[np.float64]

MOST_HOURS = 1000.0
_NO_LOW_MODES = (np.zeros((0, 0, 0, 0)), np.zeros((0, 0)), np.zeros((0, 0)))
# Expected gain of the deviance for nine of ten such recordings to resolve the term: (1.96 + 1.28)^2 = 10.5 were its estimate Gaussian, as
# flicker's nearly is; a walk is seen over a few cycles only, and needs 20 (measured, 40 seeds).
_RISE = 20.0
_PART = np.array([0.5, 0.5, 0.25, 0.5])  # of the present upper limit, by term: what is to be resolved; a walk's limit is the loosest
_STEP = 1.25


def hours_to_resolve(
    theta: Array, spans: Sequence[Interval], terms: Sequence[int], i: int, hours: float, f_max: float, rate_hz: float
) -> tuple[float, float]:
    """Return the hours of recording that resolve coefficient i if it is as large as the recording suggests, and that value.

    The value is what the term has at least by one sigma, or a half (walk: a quarter) of its upper limit if that is more.

    The expected data of such a recording (its power exactly the model's) are fitted without the term (Cowan et al. 2011, the Asimov set);
    what the deviance loses is the expected test statistic. What else is not resolved is taken to be there likewise.
    Infinite where 1000 h do not do.
    """
    part = _PART[list(terms)]
    least = np.array([max((q * s.upper) ** 2, s.value**2 - 2 * s.value * s.sigma) for q, s in zip(part, spans, strict=True)])
    truth = np.where([s.resolved for s in spans], theta[: len(terms)], np.maximum(theta[: len(terms)], least))
    truth[i] = least[i]
    value = float(np.sqrt(least[i]))
    length = hours
    while length < MOST_HOURS:
        length *= _STEP
        if _expected_rise(truth, terms, i, length * 3600, f_max, rate_hz) > _RISE:
            return length, value
    return np.inf, value


def _expected_rise(truth: Array, terms: Sequence[int], i: int, duration_s: float, f_max: float, rate_hz: float) -> float:
    edges = np.unique(np.round(np.geomspace(1, 2 * duration_s * f_max, 80)))
    count, f = np.diff(edges), (edges[:-1] + edges[1:] - 1) / 2 / (2 * duration_s)
    shape = shapes(f, rate_hz)[list(terms)]
    p = Problem(shape, truth @ shape, count, *_NO_LOW_MODES)
    return maximise(p, truth, (i, 0.0)).deviance - maximise(p, truth).deviance
