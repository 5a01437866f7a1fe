"""Which models explain a time offset in windows, and how well: a drift, a polynomial, and jumps, chosen by likelihood and a price.

Errors of windows are Student's t with 4 degrees of freedom times scatter * sigma: those that went wrong, or have a jump in their
middle, count little.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DOF = 4.0  # of Student's t; heavier tails cost power, lighter ones false alarms
_SIGMA_LOG_SCATTER = 0.3  # prior of ln(scatter): windows' sigmas may be too small by half
_MAX_DEGREE, _PER_DEGREE = 12, 4  # of the drift; windows that each degree needs
_LEAST = 2  # windows on each side of a jump: one alone may simply be wrong
_LONGEST_PULSE = 64  # windows between a jump up and one down that are looked for together; longer ones are seen one by one
_TRIED = 4  # best places of each kind of change whose likelihood is computed in full
_BESIDE, _CLEAR = 3, 8.0  # windows on each side whose medians tell a jump that is clear at once; sigmas
_PRICE = 16.0  # -2 ln likelihood that a change must gain; tuned for false alarms below 0.5 % (tests/test_clock.py)
_RIDGE = 1e-12  # of the weights, for a drift over no time
_LONG = 8  # changes; beyond, jumps are moved only when none is added any more
_ENOUGH = 0.01  # of -2 ln likelihood; prices are a thousand times that
_PRICE_PLACE = 3.0  # more for each ln of the places where a jump could be
STRADDLES = 5.0  # sigmas off, above which a window tells nothing, but that a jump is inside


@dataclass(frozen=True)
class Windows:
    t_s: Array  # (w,) increasing
    start_s: Array
    end_s: Array
    td: Array
    sigma: Array

    def design(self, model: "Model") -> Array:
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
class Model:
    degree: int = 0
    steps: tuple[int, ...] = ()  # first window after each jump

    def fits(self, n: int) -> bool:
        edges = np.array([0, *self.steps, n])
        smooth = self.degree <= max(1, min(_MAX_DEGREE, n // _PER_DEGREE))
        return smooth and bool(np.all(np.diff(edges) >= _LEAST)) and n - len(self.steps) - self.degree >= 3

    def price(self, n: int) -> float:
        """Return what -2 ln likelihood must fall by for this model."""
        return _PRICE * (self.degree + len(self.steps)) + _PRICE_PLACE * float(np.log(n)) * len(self.steps)


@dataclass(frozen=True)
class Fit:
    model: Model
    beta: Array  # (p,)
    residual: Array  # (w,) over sigma
    scatter: float
    cost: float  # -2 ln likelihood, to a constant
    value: float  # cost and price


def fit_model(windows: Windows, model: Model) -> Fit:
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
        weighted = X.T * weight
        beta = np.linalg.solve(weighted @ X + _RIDGE * np.eye(X.shape[1]) * np.sum(weight), weighted @ y)
        r = y - X @ beta
        cost = _cost(r, log_scatter)
        if before - cost < _ENOUGH:
            break
        before = cost
    return Fit(model, np.asarray(beta, np.float64), r, float(np.exp(log_scatter)), cost, cost + model.price(n))


def _cost(r: Array, log_scatter: float) -> float:
    spread = np.sum(np.log1p((r * np.exp(-log_scatter)) ** 2 / _DOF))
    return float((_DOF + 1) * spread + 2 * len(r) * log_scatter + (log_scatter / _SIGMA_LOG_SCATTER) ** 2)


def search(windows: Windows) -> Fit:
    """Return the best model that is reached from a constant clock, or from the best smooth drift or all jumps that are clear at once.

    From the first alone, many jumps hide each other, and a slow wander is taken for a staircase: it is given up when it gets long.
    """
    n = len(windows.td)
    drifts = [fit_model(windows, model) for degree in range(_MAX_DEGREE + 1) if (model := Model(degree)).fits(n)]
    stairs = [fit_model(windows, model) for degree in (0, 1) if (model := Model(degree, _clear_jumps(windows))).fits(n)]
    best = _grow(windows, _best([*drifts, _settle(windows, _best(stairs))]))
    return _best([best, _grow(windows, drifts[0], best.value)])


def _best(fits: list[Fit]) -> Fit:
    return min(fits, key=lambda fit: fit.value)


def _clear_jumps(windows: Windows) -> tuple[int, ...]:
    """Return the first windows after jumps that the medians of a few windows on each side tell, a common slope taken out."""
    beside = np.lib.stride_tricks.sliding_window_view(windows.td, _BESIDE) if len(windows.td) >= 2 * _BESIDE else np.zeros((0, _BESIDE))
    level = np.median(beside, axis=1)
    change = level[_BESIDE:] - level[:-_BESIDE]
    size = np.abs(change - _BESIDE * np.median(np.diff(windows.td)))
    first = np.arange(len(size)) + _BESIDE
    places: list[int] = []
    for i in np.argsort(-size, kind="stable"):
        k = int(first[i])
        if size[i] < _CLEAR * np.median(windows.sigma[k - _BESIDE : k + _BESIDE]):
            break
        if all(abs(k - other) >= _BESIDE for other in places):
            places.append(k)
    return tuple(sorted(places))


def _grow(windows: Windows, best: Fit, rival: float = np.inf) -> Fit:
    """Add the change that gains most, move the jumps, drop what is no longer needed; until nothing gains, or a long way above a rival."""
    while best.value < rival or best.model.degree + len(best.model.steps) < _LONG:
        better = _best([best, *(fit_model(windows, model) for model in _grown(windows, best))])
        settled = _settle(windows, better) if better is best or len(better.model.steps) < _LONG else better
        if settled is best:
            break
        best = settled
    return best


def _settle(windows: Windows, best: Fit) -> Fit:
    """Try a simpler drift and what each jump could be instead, in turn, until none of them is better."""
    i = calm = 0
    while calm <= len(best.model.steps):
        i = (i + 1) % (len(best.model.steps) + 1)
        better = _best([best, *(fit_model(windows, model) for model in _neighbours(best.model, len(windows.td), i))])
        calm = calm + 1 if better is best else 0
        best = better
    return best


def _neighbours(model: Model, n: int, i: int) -> Iterator[Model]:
    """Yield the model with a simpler drift (i = 0), or without its i-th jump or with that a window earlier or later."""
    if i == 0:
        for degree in {0, model.degree // 2, model.degree - 1, model.degree - 2} & set(range(model.degree)):
            yield replace(model, degree=degree)
        return
    k, others = model.steps[i - 1], model.steps[: i - 1] + model.steps[i:]
    yield replace(model, steps=others)
    if (new := replace(model, steps=others, degree=model.degree + 1)).fits(n):
        yield new  # a slope that looked like a jump
    for moved in (k - 1, k + 1):
        steps = tuple(sorted({*others, moved}))
        if len(steps) == len(model.steps) and (new := replace(model, steps=steps)).fits(n):
            yield new


def _grown(windows: Windows, fit: Fit) -> Iterator[Model]:
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


def _places(windows: Windows, model: Model, r: Array) -> list[tuple[int, ...]]:
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


def sigma_of(windows: Windows, fit: Fit, row: Array) -> float:
    """Return the sigma of row @ beta."""
    return float(np.sqrt(row @ _covariance(windows, fit) @ row))


def _covariance(windows: Windows, fit: Fit) -> Array:
    """Return the covariance of the M-estimate, E[psi^2] / E[psi']^2 (X^T X)^-1, over the windows that count; never below sigma's own."""
    z = fit.residual / fit.scatter
    X = windows.design(fit.model) / windows.sigma[:, None]
    inside = np.abs(z) < STRADDLES
    if np.sum(inside) <= X.shape[1]:
        inside[:] = True
    X, u = X[inside], z[inside] ** 2 / _DOF
    psi_squared = np.sum(_DOF * u / (1 + u) ** 2) / max(len(u) - X.shape[1], 1)
    slope = float(np.mean((1 - u) / (1 + u) ** 2))
    factor = max(1.0, fit.scatter**2 * psi_squared / max(slope, 0.2) ** 2)
    out: Array = factor * np.linalg.pinv(X.T @ X)
    return out
