"""A time offset over time: constant, drifting or jumping, chosen by likelihood among windows that each measured it.

Model: td(t) = D(t) + sum_j size_j H(t - t_j), with H the unit step and D a polynomial: constant, a skew, or a skew that changes with
temperature. Errors of windows are Student's t with 4 degrees of freedom times scatter * sigma: those that went wrong, or have a jump in
their middle, count little.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from calibkit.data.plural import counted

Array = NDArray[np.float64]
Kind = Literal["constant", "drifting", "jumping"]

FEWEST = 4  # windows; below, nothing is said of the clock
_DOF = 4.0  # of Student's t; heavier tails cost power, lighter ones false alarms
_SIGMA_LOG_SCATTER = 0.3  # prior of ln(scatter): windows' sigmas may be too small by half
_MAX_DEGREE = 6  # of the drift
_LEAST = 2  # windows on each side of a jump: one alone may simply be wrong
_LONGEST_PULSE = 64  # windows between a jump up and one down that are looked for together; longer ones are seen one by one
_TRIED = 4  # best places of each kind of change whose likelihood is computed in full
_PRICE = 16.0  # -2 ln likelihood that a change must gain; tuned for false alarms below 0.5 % (tests/test_clock.py)
_PRICE_PLACE = 3.0  # more for each ln of the places where a jump could be
_STRADDLES = 5.0  # sigmas off, above which the window next to a jump is taken to have it inside
_CONFIDENT = 1.96  # 95 %
_SIGNIFICANT = 4.0  # sigmas: the price of a skew
_WORSE = 1.3  # scatter that is worth telling


@dataclass(frozen=True)
class Jump:
    """A step of the offset, somewhere within an interval between or inside windows."""

    t_s: float  # middle of that interval
    t_sigma_s: float  # of a uniform distribution over it
    size_s: float  # after minus before
    sigma_s: float


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
    scatter: float  # of the windows over their sigmas, 1 or more
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


@dataclass(frozen=True)
class _Windows:
    t_s: Array  # (w,) increasing
    start_s: Array
    end_s: Array
    td: Array
    sigma: Array

    def design(self, model: "_Model") -> Array:
        """Return the columns of a model, (w, 1 + degree + steps): Legendre polynomials, and a step for each jump."""
        steps = np.arange(len(self.t_s))[:, None] >= np.array(model.steps, int)
        return np.hstack([self.drift_at(self.t_s, model.degree), steps])

    def drift_at(self, t_s: Array, degree: int) -> Array:
        return np.asarray(legendre.legvander((t_s - self.middle_s) / self.half_s, degree), np.float64)

    @property
    def middle_s(self) -> float:
        return float(self.t_s[0] + self.t_s[-1]) / 2

    @property
    def half_s(self) -> float:
        return max(float(self.t_s[-1] - self.t_s[0]) / 2, 1e-9)


@dataclass(frozen=True)
class _Model:
    degree: int = 0
    steps: tuple[int, ...] = ()  # first window after each jump

    def fits(self, n: int) -> bool:
        edges = np.array([0, *self.steps, n])
        return bool(np.all(np.diff(edges) >= _LEAST)) and n - len(self.steps) - self.degree >= 3 and self.degree <= _MAX_DEGREE

    def price(self, n: int) -> float:
        """Return what -2 ln likelihood must fall by for this model."""
        return _PRICE * (self.degree + len(self.steps)) + _PRICE_PLACE * float(np.log(n)) * len(self.steps)


@dataclass(frozen=True)
class _Fit:
    model: _Model
    beta: Array  # (p,)
    residual: Array  # (w,) over sigma
    scatter: float
    cost: float  # -2 ln likelihood, to a constant
    value: float  # cost and price


def fit_clock(t_s: Array, start_s: Array, end_s: Array, td: Array, sigma: Array) -> Clock:
    """Return the clock that explains the offsets td (w,) of windows with their sigmas, all in s; nothing is asked of their order."""
    order = np.argsort(t_s, kind="stable")
    windows = _Windows(*(np.asarray(a, np.float64)[order] for a in (t_s, start_s, end_s, td, sigma)))
    if not len(order):
        raise ValueError("a clock needs at least one window")
    constant = _fit(windows, _Model())
    best = constant if len(order) < FEWEST else _search(windows, constant)
    return _clock(windows, best, constant)


def _fit(windows: _Windows, model: _Model) -> _Fit:
    """Maximise the likelihood by reweighted least squares, the scatter by Newton's steps on its logarithm (convex) in between."""
    X, y = windows.design(model) / windows.sigma[:, None], windows.td / windows.sigma
    beta, n = np.linalg.lstsq(X, y, rcond=None)[0], len(y)
    r = y - X @ beta
    log_scatter = max(0.0, float(np.log(np.sqrt(np.mean(r**2)) + 1e-12)))
    before = np.inf
    for _ in range(60):
        u = (r * np.exp(-log_scatter)) ** 2 / _DOF
        slope = 2 * n - 2 * (_DOF + 1) * np.sum(u / (1 + u)) + 2 * log_scatter / _SIGMA_LOG_SCATTER**2
        curvature = 4 * (_DOF + 1) * np.sum(u / (1 + u) ** 2) + 2 / _SIGMA_LOG_SCATTER**2
        log_scatter = max(0.0, log_scatter - float(np.clip(slope / curvature, -0.5, 0.5)))
        weight = 1 / (1 + (r * np.exp(-log_scatter)) ** 2 / _DOF)
        beta = np.linalg.lstsq(X * np.sqrt(weight)[:, None], y * np.sqrt(weight), rcond=None)[0]
        r = y - X @ beta
        cost = _cost(r, log_scatter)
        if before - cost < 1e-3:
            break
        before = cost
    return _Fit(model, np.asarray(beta, np.float64), r, float(np.exp(log_scatter)), cost, cost + model.price(n))


def _cost(r: Array, log_scatter: float) -> float:
    spread = np.sum(np.log1p((r * np.exp(-log_scatter)) ** 2 / _DOF))
    return float((_DOF + 1) * spread + 2 * len(r) * log_scatter + (log_scatter / _SIGMA_LOG_SCATTER) ** 2)


def _search(windows: _Windows, best: _Fit) -> _Fit:
    """Add the change that gains most, move the jumps, drop what is no longer needed; until nothing gains."""
    while True:
        better = min((_fit(windows, model) for model in _grown(windows, best)), key=lambda fit: fit.value, default=best)
        if better.value >= best.value:
            return best
        best = _settle(windows, better)


def _settle(windows: _Windows, best: _Fit) -> _Fit:
    """Try the neighbours of a model as long as one of them is better."""
    while True:
        better = min((_fit(windows, model) for model in _neighbours(best.model, len(windows.td))), key=lambda fit: fit.value, default=best)
        if better.value >= best.value:
            return best
        best = better


def _neighbours(model: _Model, n: int) -> Iterator[_Model]:
    """Yield the model with a simpler drift, without one of its jumps, and with one jump a window earlier or later."""
    for degree in range(model.degree):
        yield replace(model, degree=degree)
    for i, k in enumerate(model.steps):
        others = model.steps[:i] + model.steps[i + 1 :]
        yield replace(model, steps=others)
        if (new := replace(model, steps=others, degree=model.degree + 1)).fits(n):
            yield new  # a slope that looked like a jump
        for moved in (k - 1, k + 1):
            steps = tuple(sorted({*others, moved}))
            if len(steps) == len(model.steps) and (new := replace(model, steps=steps)).fits(n):
                yield new


def _grown(windows: _Windows, fit: _Fit) -> Iterator[_Model]:
    """Yield models with one change more: a drift, a jump, or a jump and one back, where least squares sees them most."""
    n = len(windows.td)
    for more in (1, 2):
        if (new := replace(fit.model, degree=fit.model.degree + more)).fits(n):
            yield new
    found = {places for r in (fit.residual, _without_spikes(fit.residual)) for places in _places(windows, fit.model, r)}
    for places in sorted(found):
        steps = tuple(sorted({*fit.model.steps, *places}))
        if len(steps) == len(fit.model.steps) + len(places) and (new := replace(fit.model, steps=steps)).fits(n):
            yield new


def _without_spikes(r: Array) -> Array:
    """Return residuals with those pulled in that stand out among their four neighbours; steps stay."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(r, 2, mode="reflect" if len(r) > 2 else "edge"), 5)
    middle = np.median(around, axis=1)
    limit = 3 * max(1.0, 1.4826 * float(np.median(np.abs(r - middle))))
    out: Array = middle + np.clip(r - middle, -limit, limit)
    return out


def _places(windows: _Windows, model: _Model, r: Array) -> list[tuple[int, ...]]:
    """Return where a step, and where a pair of steps, lowers the sum of squares most: by g^T G^-1 g, G their Gram matrix."""
    n, weight = len(r), 1 / windows.sigma
    Q, _ = np.linalg.qr(windows.design(model) * weight[:, None])
    total, seen, g = _after(weight**2), _after(Q * weight[:, None]), _after((r - Q @ (Q.T @ r)) * weight)
    own = np.maximum(total - np.sum(seen**2, axis=1), 1e-9 * total)
    single = np.where(own > 1e-6 * total, g**2 / own, 0)
    peak = np.flatnonzero((single >= np.roll(single, 1)) & (single >= np.roll(single, -1)))
    found = [((int(k),), float(single[k])) for k in peak[np.argsort(-single[peak])][:_TRIED]]
    pairs = []
    for length in range(_LEAST, min(_LONGEST_PULSE, n - 2 * _LEAST) + 1):
        cross = total[length:] - np.sum(seen[:-length] * seen[length:], axis=1)
        det = own[:-length] * own[length:] - cross**2
        gain = g[:-length] ** 2 * own[length:] + g[length:] ** 2 * own[:-length] - 2 * g[:-length] * g[length:] * cross
        gain = np.where(det > 1e-6 * own[:-length] * own[length:], gain / np.where(det > 0, det, 1), 0)
        k = int(np.argmax(gain))
        pairs.append(((k, k + length), float(gain[k])))
    pairs.sort(key=lambda pair: -pair[1])
    return [places for places, _ in found + pairs[:_TRIED]]


def _after(rows: Array) -> Array:
    """Return the sums over each row and all that follow."""
    out: Array = np.cumsum(rows[::-1], axis=0)[::-1]
    return out


def _clock(windows: _Windows, fit: _Fit, constant: _Fit) -> Clock:
    n, chosen = len(windows.t_s), fit.model
    sloped = replace(chosen, degree=max(1, chosen.degree))
    skewed = _fit(windows, sloped)
    if chosen.steps and sloped.fits(n):
        fit = skewed  # a skew too small to be seen would make the jumps' sizes wrong by more than their sigmas
    skew_of = np.where(np.arange(skewed.beta.size) % 2, 1.0, 0.0) / windows.half_s  # P_k(1) - P_k(-1) = 2 for odd k
    skew_of[1 + sloped.degree :] = 0
    skew, skew_sigma = float(skew_of @ skewed.beta), _sigma(windows, skewed, skew_of) if n > 1 else np.inf
    places = [_interval(windows, fit, k) for k in chosen.steps]
    t_ref = float(np.average(windows.t_s, weights=windows.sigma**-2.0))  # there, offset and skew do not depend on each other
    after = [float(t_ref >= (low + high) / 2) for low, high in places]
    first = 1 + fit.model.degree
    at_ref = np.concatenate([windows.drift_at(np.array([t_ref]), fit.model.degree)[0], after])
    return Clock(
        kind="jumping" if places else "drifting" if fit.model.degree else "constant",
        t_ref_s=t_ref,
        offset_s=float(at_ref @ fit.beta),
        sigma_s=_sigma(windows, fit, at_ref),
        skew=skew if fit.model.degree else 0.0,
        skew_sigma=skew_sigma,
        skew_limit=abs(skew) + _CONFIDENT * skew_sigma,
        drift=tuple(fit.beta[1:first].tolist()),
        middle_s=windows.middle_s,
        half_s=windows.half_s,
        jumps=tuple(
            Jump((low + high) / 2, (high - low) / float(np.sqrt(12)), float(fit.beta[i]), _sigma(windows, fit, np.eye(len(fit.beta))[i]))
            for i, (low, high) in enumerate(places, first)
        ),
        scatter=fit.scatter,
        gain=constant.cost - fit.cost,
        price=chosen.price(n),
        span_s=float(windows.end_s.max() - windows.start_s.min()),
        n_windows=n,
    )


def _sigma(windows: _Windows, fit: _Fit, row: Array) -> float:
    """Return the sigma of row @ beta."""
    return float(np.sqrt(row @ _covariance(windows, fit) @ row))


def _covariance(windows: _Windows, fit: _Fit) -> Array:
    """Return the covariance of the M-estimate, E[psi^2] / E[psi']^2 (X^T X)^-1, over the windows that count; never below sigma's own."""
    z = fit.residual / fit.scatter
    X = windows.design(fit.model) / windows.sigma[:, None]
    inside = np.abs(z) < _STRADDLES
    X, u = X[inside], z[inside] ** 2 / _DOF
    psi_squared = np.sum(_DOF * u / (1 + u) ** 2) / max(len(u) - X.shape[1], 1)
    slope = float(np.mean((1 - u) / (1 + u) ** 2))
    factor = max(1.0, fit.scatter**2 * psi_squared / max(slope, 0.2) ** 2)
    out: Array = factor * np.linalg.pinv(X.T @ X)
    return out


def _interval(windows: _Windows, fit: _Fit, k: int) -> tuple[float, float]:
    """Return between which times a jump lies: inside windows that fit neither side, else between the middles of its neighbours."""
    wrong = np.abs(fit.residual) > _STRADDLES * fit.scatter
    before, after = k - 1, k
    while wrong[before] and before > 0:
        before -= 1
    while wrong[after] and after < len(wrong) - 1:
        after += 1
    if after - before > 1:
        return float(windows.start_s[before + 1]), float(windows.end_s[after - 1])
    return float(windows.t_s[before]), float(windows.t_s[after])


def describe(clock: Clock, frame_hz: float | None = None) -> list[str]:
    """Return what there is to say of the clock, td = t_to - t_of; jumps by whole frame periods are named where the rate is given."""
    if clock.too_short:
        return [f"too short to tell whether the clocks drift or jump: {counted(clock.n_windows, 'window')} of td, {FEWEST} are needed"]
    said = []
    if clock.drifts:
        total = clock.skew * clock.span_s * 1e3
        least, greatest = clock.skew_range
        between = f", from {least * 1e6:+.1f} to {greatest * 1e6:+.1f} ppm" if len(clock.drift) > 1 else ""
        skew = f"{clock.skew * 1e6:+.1f} +- {clock.skew_sigma * 1e6:.1f} ppm{between}"
        said.append(f"the clock drifts: td changes by {skew} ({total:+.2g} ms over {clock.span_s:.3g} s)")
    for jump in clock.jumps:
        cause = _frames(jump, frame_hz) or "dropped frames or a driver's re-sync"
        said.append(f"the clock jumps: td changes by {jump.size_s * 1e3:+.1f} +- {jump.sigma_s * 1e3:.1f} ms at {jump.t_s:.1f} s ({cause})")
    if not said:
        limit = f"{clock.skew_limit * 1e6:.2g} ppm ({clock.skew_limit * clock.span_s * 1e3:.2g} ms over {clock.span_s:.3g} s)"
        said.append(f"the clocks keep step: no jump, and a drift is below {limit}")
    if clock.scatter > _WORSE:
        said.append(f"td of the windows scatters {clock.scatter:.1f} times as much as their sigmas say")
    return said


def _frames(jump: Jump, frame_hz: float | None) -> str:
    """Return how many frame periods a jump is, where it is a whole number of them and known well enough to say so."""
    if frame_hz is None or not 0.1 / frame_hz > 3 * jump.sigma_s:
        return ""
    periods = abs(jump.size_s) * frame_hz
    whole = round(periods)
    if whole < 1 or abs(periods - whole) > max(3 * jump.sigma_s * frame_hz, 0.02):
        return ""
    return f"{counted(whole, 'frame period')} of {frame_hz:.4g} Hz: frames numbered wrong after a drop, or a driver's re-sync"
