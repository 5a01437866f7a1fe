"""What the terms of IEEE Std 952 cannot describe in a spectrum, found before and after they are fitted: lines, filters, bumps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.stats import chi2

from calibkit.estimation.noise_likelihood import Fit, Problem, maximise, problem, whitened
from calibkit.estimation.noise_spectrum import Spectrum

Array = NDArray[np.float64]

TAU_F = 0.371  # the Allan variance of noise at frequency f is largest at tau = 0.371 / f, where sin^4(pi f tau) / (pi f tau)^2 is
_OCTAVE = 35  # bands of 2 %
_LINE_MODES = 30  # bands with fewer modes are too noisy to show a line
_LINE_SIGMAS, _LINE_EDGE, _LINE_EXCESS = 6.0, 3.0, 0.14  # above the octave around it: where found, how far it reaches, and at least
_MARGIN = 1.03
_HALF = np.sqrt(2.0)
_CUT_SIGMAS, _CUT_RATIO, _MOST_CUTS, _LEAST_MODES = 4.0, 0.02, 16, 200
_FITS = 1e-3  # goodness below which the model is taken to be off


@dataclass(frozen=True)
class Feature:
    """Something in the spectrum that is none of the five terms; the fit leaves its frequencies out."""

    kind: Literal["line", "filter", "excess"]
    f_low: float  # Hz
    f_high: float
    tau: float  # s: line: where it shows most in the Allan deviation; filter, excess: down to where the model holds
    amplitude: float = 0.0  # line: of the sine of its power, x

    def scaled(self, unit: float) -> "Feature":
        return replace(self, amplitude=self.amplitude * unit)


@dataclass(frozen=True)
class Misfit:
    """Half an octave of the spectrum against the fitted model."""

    tau: float  # s, where the Allan deviation sees it
    f: float  # Hz
    ratio: float  # measured power over the model's
    dof: float
    z: float  # (ratio - 1) / sqrt(2 / dof)
    used: bool


def find_lines(s: Spectrum) -> list[Feature]:
    """Return what stands out of the octave around it: periodic vibration, supply hum, a resonance."""
    usable = s.count >= _LINE_MODES
    if usable.sum() < _OCTAVE:
        return []
    f, power, count = s.f[usable], s.power[usable], s.count[usable]
    base = np.exp(median_filter(np.log(np.maximum(power, 1e-300)), size=_OCTAVE, mode="nearest"))
    excess, sigma = np.log(np.maximum(power, 1e-300) / base), np.sqrt(2 / count)  # of a logarithm: chance has no long tail upwards
    core = excess > np.maximum(_LINE_SIGMAS * sigma, _LINE_EXCESS)
    reach = excess > np.maximum(_LINE_EDGE * sigma, _LINE_EXCESS / 3)
    starts = np.flatnonzero(reach & ~np.concatenate([[False], reach[:-1]]))
    ends = np.flatnonzero(reach & ~np.concatenate([reach[1:], [False]])) + 1
    lines = []
    for a, b in zip(starts, ends, strict=True):
        if not core[a:b].any():
            continue
        variance = float(np.sum((power - base)[a:b] * count[a:b])) / s.durations_s.sum()  # two-sided: 2 x df = 1 / T a mode
        reach_f = (f[a] / _MARGIN, f[b - 1] * _MARGIN)  # a line leaks a little
        centre = float(np.average(f[a:b], weights=np.maximum(power - base, 0)[a:b] * count[a:b]))
        lines.append(Feature("line", *reach_f, TAU_F / centre, float(np.sqrt(2 * max(variance, 0.0)))))
    return lines


def mask(f: Array, lines: Sequence[Feature], f_max: float) -> Array:
    """Return 1 for the frequencies that the fit uses, else 0."""
    use = f <= f_max
    for line in lines:
        use &= (f < line.f_low) | (f > line.f_high)
    return use.astype(np.float64)


def find_cut(s: Spectrum, lines: Sequence[Feature]) -> tuple[float, Feature | None]:
    """Return the frequency up to which the spectrum is the model's: a filter takes power away above it, or something adds.

    From the Nyquist frequency down, half an octave is given up while it differs from the fit of all below it and quantisation does not
    explain it.
    """
    nyquist = s.rate_hz / 2
    top, ratio = nyquist, 1.0
    for _ in range(_MOST_CUTS):
        below = top / _HALF
        used = s.count * mask(s.f, lines, below)
        tested = s.count * mask(s.f, lines, top) - used
        if used.sum() < _LEAST_MODES:
            break
        if tested.sum() > 0:
            p = problem(s, used, (0, 1, 2))
            found = float(np.average(p.power / (maximise(p).theta @ p.shape), weights=tested))
            if _small(found, tested.sum()) or (found > 1 and top == nyquist and _quantised(s, lines)):
                break
            ratio = found
        top = below
    if top == nyquist:
        return nyquist, None
    return top, Feature("filter" if ratio < 1 else "excess", top, nyquist, TAU_F / top)


def _small(ratio: float, dof: float) -> bool:
    return bool(abs(ratio - 1) < max(_CUT_RATIO, _CUT_SIGMAS * np.sqrt(2 / dof)))


def _quantised(s: Spectrum, lines: Sequence[Feature]) -> bool:
    """Return whether white noise with quantisation describes the upper octaves."""
    weight = s.count * mask(s.f, lines, s.rate_hz / 2)
    p = problem(s, weight, (0, 1, 2, 3))
    fit = maximise(p)
    return all(_small(m.ratio, m.dof) for m in misfits(p, fit, s) if m.used and m.f > s.rate_hz / 16)


def misfits(p: Problem, fit: Fit, s: Spectrum) -> list[Misfit]:
    """Return measured over modelled power by half octaves, whether the fit used them or not."""
    f = np.concatenate([s.low_f.ravel(), s.f])
    ratio = np.concatenate([whitened(p, fit).ravel() ** 2, p.power / (fit.theta @ p.shape)])
    dof = np.concatenate([np.ones(s.low.size), s.count])
    used = np.concatenate([np.ones(s.low.size, dtype=bool), p.weight > 0])
    group = 2 * half_octaves(f, f.min()) + ~used
    n = np.bincount(group, dof)
    seen = n > 0
    n = n[seen]
    mean = np.bincount(group, dof * ratio)[seen] / n
    centre = np.exp(np.bincount(group, dof * np.log(f))[seen] / n)
    z = (mean - 1) / np.sqrt(2 / n)
    parts = zip(TAU_F / centre, centre, mean, n, z, np.flatnonzero(seen) % 2 == 0, strict=True)
    return [Misfit(float(t), float(c), float(r), float(d), float(zed), bool(u)) for t, c, r, d, zed, u in parts]


def half_octaves(f: Array, lowest: float) -> NDArray[np.int64]:
    """Return the number of the half octave above the lowest frequency."""
    number: NDArray[np.int64] = np.floor(2 * np.log2(f / lowest) + 1e-9).astype(np.int64)
    return number


def goodness(found: Sequence[Misfit]) -> float:
    """Return the probability that a right model fits no better (chi-squared over the half octaves used; each by its own tail)."""
    used = [m for m in found if m.used]
    tails = np.array([chi2.sf(m.ratio * m.dof, m.dof) for m in used])
    worst = 2 * np.minimum(tails, 1 - tails)
    # Fisher (1925): -2 sum ln p is chi-squared with 2 degrees of freedom each.
    return float(chi2.sf(-2 * np.sum(np.log(np.maximum(worst, 1e-300))), 2 * len(used)))


def discrepancy(found: Sequence[Misfit]) -> float:
    """Return by how much, relative, the model's power is off from half octave to half octave, beyond chance: 0 where it fits."""
    used = [m for m in found if m.used]
    if goodness(used) > _FITS:
        return 0.0

    def excess(delta: float) -> float:
        return sum((m.ratio - 1) ** 2 / (2 / m.dof + delta**2) for m in used) - len(used)

    return _root(excess, 1e-4, 10.0)


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a falling function of a positive number crosses zero, by bisection of its logarithm; the end where it does not."""
    if function(low) <= 0:
        return 0.0
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if function(middle) > 0 else (low, middle)
    return low
