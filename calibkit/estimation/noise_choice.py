"""Which terms a recording's noise has: N, B and K always; quantisation, ramp and Gauss-Markov process where the likelihood demands them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from calibkit.estimation.noise_likelihood import Fit, Problem, maximise, problem
from calibkit.estimation.noise_shape import half_octaves
from calibkit.estimation.noise_spectrum import Spectrum

Array = NDArray[np.float64]

_TERM_SHOWS = 10.83  # gain of the deviance that Q or R must bring: 99.9 % of chi-squared with 1 degree of freedom
_MARKOV_SHOWS = 18.0  # and the Gauss-Markov term: 1.2e-4 of chi-squared with 2, its time being searched for
_MARKOV_CORNER = 4.0  # its corner frequency lies at least this factor below f_max: what is faster is the sensor's filter
_MARKOV_CYCLES = 20  # and its time fits so often into the longest piece: what is slower cannot be told from a walk
_MARKOV_STEPS = 20


@dataclass(frozen=True)
class Model:
    """Which terms a fit has."""

    terms: tuple[int, ...] = (0, 1, 2)
    markov_s: float | None = None
    ramp: bool = False


def problem_of(s: Spectrum, weight: Array, model: Model) -> Problem:
    """Return the problem of fitting the model's terms."""
    return problem(s, weight, model.terms, model.markov_s, model.ramp)


def choose(s: Spectrum, weight: Array, f_max: float) -> tuple[Model, Problem, Fit]:
    """Return the model: N, B, K, and whatever else the likelihood demands."""

    def tried(model: Model) -> tuple[Model, Problem, Fit]:
        p = problem_of(s, weight, model)
        return model, p, maximise(p)

    def better(now: tuple[Model, Problem, Fit], model: Model, gain: float) -> tuple[Model, Problem, Fit]:
        new = tried(model)
        return new if now[2].deviance - new[2].deviance > gain else now

    best = tried(Model())
    best = better(best, replace(best[0], ramp=True), _TERM_SHOWS)
    best = better(best, replace(best[0], terms=(0, 1, 2, 3)), _TERM_SHOWS)
    shortest, longest = _MARKOV_CORNER / (2 * np.pi * f_max), s.durations_s.max() / _MARKOV_CYCLES
    if shortest >= longest:
        return best
    times = np.geomspace(shortest, longest, _MARKOV_STEPS)

    def deviance(log_time: float) -> float:
        return tried(replace(best[0], markov_s=float(np.exp(log_time))))[2].deviance

    at = int(np.argmin([deviance(t) for t in np.log(times)]))
    bounds = (float(np.log(times[max(at - 1, 0)])), float(np.log(times[min(at + 1, len(times) - 1)])))
    time = float(np.exp(minimize_scalar(deviance, bounds=bounds, method="bounded", options={"xatol": 0.02}).x))
    return better(best, replace(best[0], markov_s=time), _MARKOV_SHOWS)


def damped(f: Array, weight: Array, delta: float) -> Array:
    """Return weights for a model that is off by delta from half octave to half octave: n modes count as n / (1 + n delta^2 / 2)."""
    group = half_octaves(f, f.min())
    damped: Array = weight / (1 + np.bincount(group, weight)[group] * delta**2 / 2)
    return damped
