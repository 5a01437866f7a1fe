"""The noise of a resting IMU: N, B, K (and Q, R where they show) of each axis by maximum likelihood, with honest intervals.

The likelihood is that of the whole recording in the cosine basis (`noise_spectrum`), so every tau counts with its true weight and the
correlation of the estimates comes with them. A term whose 95 % interval reaches zero gets no number but a limit, and the hours needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.noise_hours import hours_to_resolve
from calibkit.estimation.noise_interval import Interval, interval
from calibkit.estimation.noise_likelihood import Fit, Problem, maximise, problem
from calibkit.estimation.noise_shape import (
    Feature,
    Misfit,
    discrepancy,
    find_cut,
    find_lines,
    goodness,
    half_octaves,
    mask,
    misfits,
)
from calibkit.estimation.noise_spectrum import TERMS, Spectrum, spectrum

Array = NDArray[np.float64]

MIN_SAMPLES = 400
_DETERMINED = 2.0  # upper over lower end of the 95 % interval up to which a term counts as determined
_TERM_SHOWS = 10.83  # gain of the deviance that Q or R must bring: 99.9 % of chi-squared with 1 degree of freedom
_MARKOV_SHOWS = 18.0  # and the Gauss-Markov term: 1.2e-4 of chi-squared with 2, its time being searched for
_MARKOV_CORNER = 4.0  # its corner frequency lies at least this factor below f_max: what is faster is the sensor's filter
_MARKOV_STEPS = 20
_MARKOV_PEAK = 1.89  # tau over correlation time where a Gauss-Markov process shows most (IEEE Std 952, annex C)
_AVAR = 2 * np.log(2) / np.pi


@dataclass(frozen=True)
class NoiseTerm:
    """One coefficient. Not observable: value and sigma are None, and 0 .. upper95 is what the recording leaves possible."""

    value: float | None
    sigma: float | None
    lower95: float
    upper95: float
    status: Status
    hours_needed: float | None = None  # not observable: a recording longer than this resolves `resolves`; inf: none of 1000 h does
    resolves: float | None = None

    @property
    def advice(self) -> str | None:
        """Return what to do about a term without a number."""
        if self.hours_needed is None:
            return None
        longer = f"longer than {self.hours_needed:.2g} h" if np.isfinite(self.hours_needed) else "more than a recording of 1000 h"
        return f"not resolved by this recording: {longer} needed"


@dataclass(frozen=True)
class Markov:
    """A first-order Gauss-Markov process (exponentially correlated noise) beside the five terms."""

    sigma: float  # its standard deviation, x
    time_s: float  # correlation time

    @property
    def text(self) -> str:
        seen = f"a bump in the Allan deviation near tau {_MARKOV_PEAK * self.time_s:.2g} s"
        return f"exponentially correlated noise of {self.sigma:.2g} over {self.time_s:.2g} s, {seen}; N is that of shorter tau"


@dataclass(frozen=True)
class AxisNoise:
    """The noise of one axis in its own units x.

    sigma^2(tau) = 3 Q^2 / tau^2 + N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + R^2 tau^2 / 2 (IEEE Std 952, annex C).
    """

    white: NoiseTerm  # N, x / sqrt(Hz)
    flicker: NoiseTerm  # B, x
    walk: NoiseTerm  # K, x / s / sqrt(Hz)
    quantisation: NoiseTerm | None  # Q, x s; None: does not show
    ramp: NoiseTerm | None  # R, x / s; None: does not show
    markov: Markov | None
    best: dict[str, float]  # coefficient of each term at the maximum, also of those that are not observable
    covariance: Array  # (3, 3) of N, B, K at the maximum
    f_max: float  # Hz, the highest frequency used
    features: tuple[Feature, ...]
    misfit: tuple[Misfit, ...]
    goodness: float  # probability that a right model fits no better
    discrepancy: float  # relative error of the model's power beyond chance, allowed for in the intervals
    reasons: tuple[str, ...]  # what is to be known besides the numbers, in sentences


def fit_noise(x: NDArray[np.floating] | Sequence[NDArray[np.floating]], rate_hz: float) -> list[AxisNoise]:
    """Return the noise of every axis from static rates x (n, c), or from the pieces (n_i, c) that remain of a recording.

    Pieces count as independent. Raises BadInputError where x is not finite or shorter than 400 samples.
    """
    pieces = [x] if isinstance(x, np.ndarray) else list(x)
    if any(p.ndim != 2 or p.shape[1] != pieces[0].shape[1] for p in pieces):
        raise BadInputError(f"static rates must be (n, axes), not {' '.join(str(p.shape) for p in pieces[:5])}")
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise BadInputError(f"the rate must be a positive number of Hz, not {rate_hz}")
    pieces = [p for p in pieces if len(p) >= MIN_SAMPLES]
    if not pieces:
        raise BadInputError(f"too short for a noise model: no piece of {MIN_SAMPLES} samples at rest; record longer")
    return [_fit_axis([p[:, axis] for p in pieces], rate_hz) for axis in range(pieces[0].shape[1])]


def model_deviation(noise: AxisNoise, tau: Array) -> Array:
    """Return the fitted model's Allan deviation at tau (s); terms that are not observable count with their likeliest value."""
    best = noise.best
    variance = best["white"] ** 2 / tau + _AVAR * best["flicker"] ** 2 + best["walk"] ** 2 * tau / 3
    variance = variance + 3 * best["quantisation"] ** 2 / tau**2 + best["ramp"] ** 2 * tau**2 / 2
    if noise.markov is not None:
        u = tau / noise.markov.time_s
        variance = variance + 2 * noise.markov.sigma**2 / u * (1 - (3 - 4 * np.exp(-u) + np.exp(-2 * u)) / (2 * u))
    deviation: Array = np.sqrt(variance)
    return deviation


@dataclass(frozen=True)
class _Model:
    terms: tuple[int, ...] = (0, 1, 2)
    markov_s: float | None = None
    ramp: bool = False


def _fit_axis(pieces: Sequence[NDArray[np.floating]], rate_hz: float) -> AxisNoise:
    columns = [np.asarray(p, dtype=np.float64) for p in pieces]
    if not all(np.all(np.isfinite(c)) for c in columns):
        raise BadInputError("the samples hold NaN or infinity; cut them out first")
    unit = float(np.sqrt(np.mean(np.concatenate([np.diff(c) ** 2 for c in columns]))))
    if unit == 0:
        return _stuck(rate_hz)
    s = spectrum([(c - c.mean()) / unit for c in columns], rate_hz)
    lines = find_lines(s)
    f_max, cut = find_cut(s, lines)
    weight = s.count * mask(s.f, lines, f_max)
    model, p, fit = _choose(s, weight, f_max)
    delta = discrepancy(misfits(p, fit, s))
    if delta > 0:
        p = _problem(s, _damped(s.f, weight, delta), model)
        fit = maximise(p, fit.theta)
    return _axis(s, model, p, fit, unit, f_max, [*lines, *([cut] if cut else [])], delta)


def _problem(s: Spectrum, weight: Array, model: _Model) -> Problem:
    return problem(s, weight, model.terms, model.markov_s, model.ramp)


def _choose(s: Spectrum, weight: Array, f_max: float) -> tuple[_Model, Problem, Fit]:
    """Return the model: N, B, K, and whatever else the likelihood demands."""

    def tried(model: _Model) -> tuple[_Model, Problem, Fit]:
        p = _problem(s, weight, model)
        return model, p, maximise(p)

    def better(now: tuple[_Model, Problem, Fit], model: _Model, gain: float) -> tuple[_Model, Problem, Fit]:
        new = tried(model)
        return new if now[2].deviance - new[2].deviance > gain else now

    best = tried(_Model())
    best = better(best, replace(best[0], ramp=True), _TERM_SHOWS)
    best = better(best, replace(best[0], terms=(0, 1, 2, 3)), _TERM_SHOWS)
    times = np.geomspace(_MARKOV_CORNER / (2 * np.pi * f_max), s.durations_s.max() / 20, _MARKOV_STEPS)

    def deviance(log_time: float) -> float:
        return tried(replace(best[0], markov_s=float(np.exp(log_time))))[2].deviance

    at = int(np.argmin([deviance(t) for t in np.log(times)]))
    bounds = (float(np.log(times[max(at - 1, 0)])), float(np.log(times[min(at + 1, len(times) - 1)])))
    time = float(np.exp(minimize_scalar(deviance, bounds=bounds, method="bounded", options={"xatol": 0.02}).x))
    return better(best, replace(best[0], markov_s=time), _MARKOV_SHOWS)


def _damped(f: Array, weight: Array, delta: float) -> Array:
    """Return weights for a model that is off by delta from half octave to half octave: n modes count as n / (1 + n delta^2 / 2)."""
    group = half_octaves(f, f.min())
    damped: Array = weight / (1 + np.bincount(group, weight)[group] * delta**2 / 2)
    return damped


def _axis(s: Spectrum, model: _Model, p: Problem, fit: Fit, unit: float, f_max: float, features: list[Feature], delta: float) -> AxisNoise:
    hours = float(s.durations_s.sum()) / 3600
    found = misfits(p, fit, s)
    features = [f.scaled(unit) for f in features]
    spans = [interval(p, fit, i) for i in range(len(model.terms))]
    needed = [
        None if span.resolved else hours_to_resolve(fit.theta, spans, model.terms, i, hours, f_max, s.rate_hz)
        for i, span in enumerate(spans)
    ]
    terms = {TERMS[term]: _term(span, unit, need) for term, span, need in zip(model.terms, spans, needed, strict=True)}
    variance = np.linalg.pinv(fit.information)[:3, :3]
    root = np.sqrt(np.maximum(fit.theta[:3], 1e-30))
    best = dict.fromkeys((*TERMS, "ramp"), 0.0)
    best |= {TERMS[t]: float(np.sqrt(fit.theta[i])) * unit for i, t in enumerate(model.terms)}
    ramp = None
    if model.ramp:
        sigma = float(np.sqrt(fit.ramp_variance))
        best["ramp"] = abs(fit.ramp) * unit
        low, high = sorted((abs(fit.ramp) - 1.96 * sigma, abs(fit.ramp) + 1.96 * sigma))
        ramp = _term(Interval(abs(fit.ramp), sigma, max(low, 0.0), high, low > 0), unit, None)
    markov = Markov(float(np.sqrt(fit.theta[-1])) * unit, model.markov_s) if model.markov_s else None
    return AxisNoise(
        white=terms["white"],
        flicker=terms["flicker"],
        walk=terms["walk"],
        quantisation=terms.get("quantisation"),
        ramp=ramp,
        markov=markov,
        best=best,
        covariance=variance / (4 * root[:, None] * root) * unit**2,
        f_max=f_max,
        features=tuple(features),
        misfit=tuple(found),
        goodness=goodness(found),
        discrepancy=delta,
        reasons=tuple(_reasons(features, markov, delta)),
    )


def _reasons(features: Sequence[Feature], markov: Markov | None, delta: float) -> list[str]:
    texts = [f.text for f in features] + ([markov.text] if markov else [])
    if delta > 0:
        texts.append(f"the noise terms describe this spectrum to {100 * delta:.2g} % of power only; the intervals allow for that")
    return texts


def _term(span: Interval, unit: float, needed: tuple[float, float] | None) -> NoiseTerm:
    if not span.resolved:
        hours, resolves = needed if needed is not None else (None, None)
        return NoiseTerm(None, None, 0.0, span.upper * unit, Status.NOT_OBSERVABLE, hours, None if resolves is None else resolves * unit)
    status = Status.DETERMINED if span.upper <= _DETERMINED * span.lower else Status.WEAK
    return NoiseTerm(span.value * unit, span.sigma * unit, span.lower * unit, span.upper * unit, status)


def _stuck(rate_hz: float) -> AxisNoise:
    nothing = NoiseTerm(None, None, 0.0, 0.0, Status.NOT_OBSERVABLE)
    reason = "every sample has the same value: the axis is stuck, or its noise is below the resolution"
    best = dict.fromkeys((*TERMS, "ramp"), 0.0)
    return AxisNoise(nothing, nothing, nothing, None, None, None, best, np.zeros((3, 3)), rate_hz / 2, (), (), 1.0, 0.0, (reason,))
