"""The noise of a resting IMU: N, B, K (and Q, R where they show) of each axis by maximum likelihood, with honest intervals.

The likelihood is that of the whole recording in the cosine basis (`noise_spectrum`), so every tau counts with its true weight and the
correlation of the estimates comes with them. A term whose 95 % interval reaches zero gets no number but a limit, and the hours needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.noise_choice import Model, choose, damped, problem_of
from calibkit.estimation.noise_hours import hours_to_resolve
from calibkit.estimation.noise_interval import Interval, interval
from calibkit.estimation.noise_likelihood import Fit, Problem, maximise
from calibkit.estimation.noise_shape import (
    Feature,
    Misfit,
    discrepancy,
    find_cut,
    find_lines,
    goodness,
    mask,
    misfits,
)
from calibkit.estimation.noise_spectrum import TERMS, Spectrum, spectrum
from calibkit.models.noise import FLOOR

Array = NDArray[np.float64]

MIN_SAMPLES = 400
_DETERMINED = 2.0  # upper over lower end of the 95 % interval up to which a term counts as determined


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


@dataclass(frozen=True)
class Markov:
    """A first-order Gauss-Markov process (exponentially correlated noise) beside the five terms: a bump near tau = 1.9 time_s."""

    sigma: float  # its standard deviation, x
    time_s: float  # correlation time


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
    reasons: tuple[str, ...]  # why there is no number at all, in sentences


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
    variance = best["white"] ** 2 / tau + (FLOOR * best["flicker"]) ** 2 + best["walk"] ** 2 * tau / 3
    variance = variance + 3 * best["quantisation"] ** 2 / tau**2 + best["ramp"] ** 2 * tau**2 / 2
    if noise.markov is not None:
        u = tau / noise.markov.time_s
        variance = variance + 2 * noise.markov.sigma**2 / u * (1 - (3 - 4 * np.exp(-u) + np.exp(-2 * u)) / (2 * u))
    deviation: Array = np.sqrt(variance)
    return deviation


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
    model, p, fit = choose(s, weight, f_max)
    delta = discrepancy(misfits(p, fit, s))
    if delta > 0:
        p = problem_of(s, damped(s.f, weight, delta), model)
        fit = maximise(p, fit.theta)
    return _axis(s, model, p, fit, unit, f_max, [*lines, *([cut] if cut else [])], delta)


def _axis(s: Spectrum, model: Model, p: Problem, fit: Fit, unit: float, f_max: float, features: list[Feature], delta: float) -> AxisNoise:
    hours = float(s.durations_s.sum()) / 3600
    found = misfits(p, fit, s)
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
        features=tuple(f.scaled(unit) for f in features),
        misfit=tuple(found),
        goodness=goodness(found),
        discrepancy=delta,
        reasons=(),
    )


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
