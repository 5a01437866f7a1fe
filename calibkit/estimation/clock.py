"""A time offset over time: constant, drifting or jumping, chosen by likelihood among windows that each measured it.

Model: td(t) = D(t) + sum_j size_j H(t - t_j), with H the unit step and D a polynomial: constant, a skew, or a skew that changes with
temperature; `clock_model` chooses among them.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from calibkit.data.plural import counted
from calibkit.estimation.clock_model import STRADDLES, Fit, Model, Windows, fit_model, search, sigma_of

Array = NDArray[np.float64]
Kind = Literal["constant", "drifting", "jumping"]

FEWEST = 4  # windows; below, nothing is said of the clock
_CONFIDENT = 1.96  # 95 %
_SIGNIFICANT = 4.0  # sigmas: the price of a skew
_JUMPS_TOLD = 5  # one by one
_HUNDREDTHS = 0.05  # s


@dataclass(frozen=True)
class Jump:
    """A step of the offset, somewhere within an interval between or inside windows."""

    t_s: float  # middle of that interval
    t_sigma_s: float  # of a uniform distribution over it
    size_s: float  # after minus before
    sigma_s: float

    @property
    def when(self) -> str:
        """Its time to hundredths where they are known, else to tenths."""
        return f"{self.t_s:.{2 if self.t_sigma_s < _HUNDREDTHS else 1}f} s"


@dataclass(frozen=True)
class Clock:
    """How an offset goes with time; `kind` is drifting with a skew and without jumps, jumping with jumps, skewed or not."""

    kind: Kind
    t_ref_s: float
    offset_s: float  # at t_ref_s
    sigma_s: float
    skew: float  # s/s, from the first window to the last without the jumps; 0 for a constant clock
    skew_sigma: float  # of the skew that was found, or would have been
    skew_limit: float  # |skew| is below, at 95 %
    drift: tuple[float, ...]  # Legendre coefficients of D from degree 1 on, in s, over middle_s +- half_s
    middle_s: float
    half_s: float
    jumps: tuple[Jump, ...]
    gain: float  # -2 ln likelihood below that of a constant clock
    price: float  # what the gain had to exceed; 0 for a constant clock
    span_s: float  # from the first window's start to the last one's end
    n_windows: int

    @property
    def too_short(self) -> bool:
        """Whether there were too few windows to tell a constant clock from another."""
        return self.n_windows < FEWEST

    def at(self, t_s: Array) -> Array:
        """Return the offset at some times, in s."""
        out: Array = self.offset_s + self._shape(np.asarray(t_s, np.float64)) - self._shape(np.array(self.t_ref_s))
        return out

    def _shape(self, t_s: Array) -> Array:
        steps = (jump.size_s * (t_s >= jump.t_s) for jump in self.jumps)
        out: Array = legendre.legval((t_s - self.middle_s) / self.half_s, [0, *self.drift]) + sum(steps, np.zeros_like(t_s))
        return out

    @property
    def drifts(self) -> bool:
        """Whether there is a skew to speak of; a clock that jumps is fitted with one in any case."""
        return len(self.drift) > 1 or abs(self.skew) > _SIGNIFICANT * self.skew_sigma

    @property
    def skew_range(self) -> tuple[float, float]:
        """The least and the greatest skew while it lasted, s/s."""
        rates = legendre.legval(np.linspace(-1, 1, 101), legendre.legder([0, *self.drift])) / self.half_s
        return float(np.min(rates)), float(np.max(rates))


def fit_clock(t_s: Array, start_s: Array, end_s: Array, td: Array, sigma: Array) -> Clock:
    """Return the clock that explains the offsets td (w,) of windows with their sigmas, all in s; nothing is asked of their order."""
    order = np.argsort(t_s, kind="stable")
    if not len(order) or not np.all(sigma > 0):
        raise ValueError("a clock needs windows, and their sigmas")
    level = float(np.median(td))  # minutes may be between two clocks, and digits are few
    windows = Windows(*(np.asarray(a, np.float64)[order] for a in (t_s, start_s, end_s, td - level, sigma)))
    constant = fit_model(windows, Model())
    best = constant if len(order) < FEWEST else search(windows)
    found = _clock(windows, best, constant)
    return replace(found, offset_s=found.offset_s + level)


def _clock(windows: Windows, fit: Fit, constant: Fit) -> Clock:
    n, chosen = len(windows.t_s), fit.model
    sloped = replace(chosen, degree=max(1, chosen.degree))
    skewed = fit_model(windows, sloped)
    if chosen.steps and sloped.fits(n):
        fit = skewed  # a skew too small to be seen would make the jumps' sizes wrong by more than their sigmas
    skew_of = np.where(np.arange(skewed.beta.size) % 2, 1.0, 0.0) / windows.half_s  # P_k(1) - P_k(-1) = 2 for odd k
    skew_of[1 + sloped.degree :] = 0
    skew, skew_sigma = float(skew_of @ skewed.beta), sigma_of(windows, skewed, skew_of) if windows.t_s[-1] > windows.t_s[0] else np.inf
    places = [_interval(windows, fit, k) for k in chosen.steps]
    t_ref = float(np.average(windows.t_s, weights=windows.sigma**-2.0))  # there, offset and skew do not depend on each other
    after = [float(t_ref >= (low + high) / 2) for low, high in places]
    first = 1 + fit.model.degree
    at_ref = np.concatenate([windows.drift_at(np.array([t_ref]), fit.model.degree)[0], after])
    return Clock(
        kind="jumping" if places else "drifting" if fit.model.degree else "constant",
        t_ref_s=t_ref,
        offset_s=float(at_ref @ fit.beta),
        sigma_s=sigma_of(windows, fit, at_ref),
        skew=skew if fit.model.degree else 0.0,
        skew_sigma=skew_sigma,
        skew_limit=abs(skew) + _CONFIDENT * skew_sigma,
        drift=tuple(fit.beta[1:first].tolist()),
        middle_s=windows.middle_s,
        half_s=windows.half_s,
        jumps=tuple(
            Jump((low + high) / 2, (high - low) / float(np.sqrt(12)), float(fit.beta[i]), sigma_of(windows, fit, np.eye(len(fit.beta))[i]))
            for i, (low, high) in enumerate(places, first)
        ),
        gain=constant.cost - fit.cost,
        price=chosen.price(n),
        span_s=float(windows.end_s.max() - windows.start_s.min()),
        n_windows=n,
    )


def _interval(windows: Windows, fit: Fit, k: int) -> tuple[float, float]:
    """Return between which times a jump lies: inside windows that fit neither side, else between the middles of its neighbours."""
    wrong = np.abs(fit.residual) > STRADDLES * fit.scatter
    before, after = k - 1, k
    while wrong[before] and before > 0:
        before -= 1
    while wrong[after] and after < len(wrong) - 1:
        after += 1
    if after - before > 1:
        return float(windows.start_s[before + 1]), float(windows.end_s[after - 1])
    return float(windows.t_s[before]), float(windows.t_s[after])


def describe(clock: Clock, to: str, frame_hz: float | None = None) -> list[str]:
    """Return what there is to say of the clock, td = t_to - t_of, its times counted from the first sample of `to`.

    Jumps by whole frame periods are named where the rate of the stamps of `of` is given.
    """
    if clock.too_short:
        few = counted(clock.n_windows, "window of 5 s tells", "windows of 5 s tell")
        return [f"too short to tell whether the clocks drift or jump: {few} td, {FEWEST} are needed"]
    said = []
    if clock.drifts:
        least, greatest = clock.skew_range
        between = f", from {least * 1e6:+.1f} to {greatest * 1e6:+.1f} ppm" if len(clock.drift) > 1 else ""
        skew, total = _with_sigma(clock.skew * 1e6, clock.skew_sigma * 1e6), clock.skew * clock.span_s * 1e3
        said.append(f"the clock drifts: td changes by {skew} ppm{between} ({total:+.3g} ms over {clock.span_s:.4g} s)")
    told = clock.jumps if len(clock.jumps) <= _JUMPS_TOLD else clock.jumps[: _JUMPS_TOLD - 1]
    for jump in told:
        cause = _frames(jump, frame_hz) or "dropped frames or a driver's re-sync"
        size = _with_sigma(jump.size_s * 1e3, jump.sigma_s * 1e3)
        said.append(f"the clock jumps: td changes by {size} ms at {jump.when} after the first sample of {to} ({cause})")
    if others := [jump.size_s * 1e3 for jump in clock.jumps[len(told) :]]:
        said.append(f"{len(others)} more jumps, of {min(others):+.1f} to {max(others):+.1f} ms, the last at {clock.jumps[-1].when}")
    if not said:
        limit = f"{clock.skew_limit * 1e6:.2g} ppm ({clock.skew_limit * clock.span_s * 1e3:.2g} ms over {clock.span_s:.4g} s)"
        said.append(f"the clocks keep step: no jump, and a drift is below {limit}")
    return said


def _with_sigma(value: float, sigma: float) -> str:
    """Return both to the sigma's first digit that counts, tenths at least."""
    digits = int(np.clip(np.ceil(-np.log10(max(sigma, 1e-6))), 1, 4))
    return f"{value:+.{digits}f} +- {sigma:.{digits}f}"


def _frames(jump: Jump, frame_hz: float | None) -> str:
    """Return how many frame periods a jump is, where it is a whole number of them and known well enough to say so."""
    if frame_hz is None or not 0.1 / frame_hz > 3 * jump.sigma_s:
        return ""
    periods = abs(jump.size_s) * frame_hz
    whole = round(periods)
    if whole < 1 or abs(periods - whole) > max(3 * jump.sigma_s * frame_hz, 0.02):
        return ""
    return f"{counted(whole, 'frame period')} of {frame_hz:.4g} Hz: dropped frames or a driver's re-sync"
