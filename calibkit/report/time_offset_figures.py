"""The pictures of a time offset: the V that it is the bottom of, and the offset over time."""

import re
from dataclasses import dataclass
from math import floor, log10

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibkit.data.plural import counted
from calibkit.report.look import ACCENT, INK, PALE
from calibkit.report.view import Array, Bottom, ClockLine, View, given

LIMIT = 3.84  # chi-squared of one parameter at 95 %
FLAT = 5 * LIMIT  # a curve that stays below is drawn no taller: a flat bowl must look flat
MAX_STEPS = 20  # jumps that are marked
FEWEST = 4  # windows that tell a clock's drift, as the estimator has it


@dataclass(frozen=True)
class Seconds:
    """An axis of time offsets: ms from zero, of far ones from a round number of seconds; seconds where they spread over many."""

    base: float
    unit: str

    @classmethod
    def over(cls, values: Array) -> "Seconds":
        middle, many = float(np.median(values)), bool(np.ptp(values) > 10)
        return cls(0.0 if many or abs(middle) < 1 else round(middle, 1), "s" if many else "ms")

    def __call__(self, values: Array) -> Array:
        return (values - self.base) * {"s": 1, "ms": 1e3}[self.unit]

    def label(self, name: str) -> str:
        return f"{name} ({self.unit})" if self.base == 0 else f"{name}, {self.unit} from {self.base:+.1f} s"


def v_curve(figure: Figure, view: View) -> None:
    """Draw the cost of every offset that was tried and, beside it, the bottom with its 95 % interval, as narrow as that may be."""
    order = np.argsort(given(view.delay), kind="stable")
    tau, cost, bottom = given(view.delay)[order], view.raw[order, 0], view.bottom
    axis = Seconds.over(tau)
    a, b = names(view)
    if bottom is None:
        panel, said = figure.subplots(), "no bottom: this recording does not tell td"
    elif not tau[0] <= bottom.low <= bottom.high <= tau[-1]:
        panel, said = figure.subplots(), f"{_shown(bottom)}, beyond what was tried"
    else:
        panel, near = figure.subplots(1, 2, width_ratios=[1.7, 1])
        _near(near, bottom, axis)
        said = _shown(bottom)
    figure.suptitle(f"t_{a} = t_{b} + td:  {said}", fontsize=11, fontweight="bold", color=INK)
    panel.plot(axis(tau), cost, "-", color=INK, lw=1.2, marker=".", ms=2.5)
    reach = max(float(cost.max()), FLAT)
    panel.set(ylim=(-0.05 * reach, 1.1 * reach), xlabel=axis.label("time offset tau"), ylabel="cost above the bottom (chi-squared)")
    panel.yaxis.set_major_formatter(lambda value, _: f"{value:,.10g}")
    panel.set_title("every offset that was tried")
    if reach == FLAT:
        _limit(panel)
    if bottom is not None:
        panel.axvspan(*axis(np.array([bottom.low, bottom.high])), color=PALE, alpha=0.5, lw=0)
        _table(panel, tau, cost, bottom, axis)


def _table(panel: Axes, tau: Array, cost: Array, bottom: Bottom, axis: Seconds) -> None:
    """Write what the bottom costs, what a few offsets on both sides cost, and mark a second bottom."""
    step = 0.4 * min(bottom.offset - tau[0], tau[-1] - bottom.offset)
    wide = panel.get_ylim()[1] > 1.2 * FLAT
    for at in bottom.offset + step * np.array([-2, -1, 1, 2] if wide and step > 0 and bottom.second is None else []):
        height = float(np.interp(at, tau, cost))
        panel.plot(axis(np.array([at])), [height], "o", color="white", mec=INK, ms=6)
        side = -1 if at > bottom.offset else 1
        where = (float(axis(np.array(at))), height)
        text = f"{_two_digits(height):,.10g}"
        panel.annotate(text, where, (8 * side, 3), textcoords="offset points", va="center", ha="left" if side > 0 else "right")
    panel.plot(axis(np.array([bottom.offset])), [0], "v", color=ACCENT, ms=8, mec="white", clip_on=False, zorder=4)
    if bottom.second is not None and tau[0] <= bottom.second <= tau[-1]:
        height = float(np.interp(bottom.second, tau, cost))
        at = float(axis(np.array([bottom.second]))[0])
        panel.plot([at], [height], "X", color="black", ms=9, mec="white", clip_on=False, zorder=4)
        text = f"second bottom\n{ms(bottom.second, 1e-5)}\ncost {height:.2g}"
        panel.annotate(text, (at, height), (0, 10), textcoords="offset points", ha="center", va="bottom", color="black")


def _near(panel: Axes, bottom: Bottom, axis: Seconds) -> None:
    """Draw the bottom alone: the parabola that meets the limit at both ends of the interval.

    The offsets that were tried are no part of it: they lie above the lowest of them, and what residuals share is not in their cost.
    """
    half = max(bottom.high - bottom.offset, bottom.offset - bottom.low)
    x = np.linspace(-2 * half, 2 * half, 201)
    side = np.maximum(np.where(x < 0, bottom.offset - bottom.low, bottom.high - bottom.offset), 1e-3 * half)
    panel.axvspan(*axis(np.array([bottom.low, bottom.high])), color=PALE, alpha=0.5, lw=0)
    _limit(panel)
    panel.plot(axis(bottom.offset + x), LIMIT * (x / side) ** 2, color=INK, lw=1.2)
    panel.plot(axis(np.array([bottom.offset])), [0], "v", color=ACCENT, ms=8, mec="white", clip_on=False, zorder=4)
    panel.set(xlim=axis(bottom.offset + x[[0, -1]]), ylim=(-0.2 * LIMIT, 4 * LIMIT), xlabel=axis.label("tau"))
    panel.locator_params(axis="x", nbins=5)
    panel.set_title("the bottom alone; band: 95 % interval")


def _limit(panel: Axes) -> None:
    panel.axhline(LIMIT, color="black", lw=0.8, ls="--")
    panel.text(0.01, LIMIT, "95 %", transform=panel.get_yaxis_transform(), va="bottom")


def offset_over_time(figure: Figure, view: View) -> None:
    """Draw the offset of each window and, where td is known, the clock fitted to them or their mean; below, what a moving one leaves."""
    order = np.argsort(given(view.t), kind="stable")
    t, offset, sigma = (given(column)[order] for column in (view.t, view.window_offset, view.window_sigma))
    sigma = np.where(sigma > 0, np.maximum(sigma, 1e-12), np.nan)
    clock = np.full(len(t), np.nan) if view.clock is None else view.clock[order]
    sure = sigma <= 5 * np.median(sigma[np.isfinite(sigma)]) if np.isfinite(sigma).any() else np.ones(len(t), bool)
    axis = Seconds.over(offset[sure])
    known = clock[np.isfinite(clock)]
    moves = len(known) > 1 and np.ptp(known) > 3 * np.median(np.nan_to_num(sigma[sure]))
    panels = figure.subplots(2 if moves else 1, 1, sharex=True, squeeze=False, height_ratios=[1.7, 1] if moves else None)[:, 0]
    _bars(panels[0], t, axis(offset), axis(axis.base + sigma), sure)
    spread = 2 * np.nan_to_num(sigma[sure])
    panels[0].set_ylim(*limits([axis(offset[sure] + spread), axis(offset[sure] - spread), axis(known)], least=1e-3))
    said = ["bars of 2 sigma"]
    if view.bottom is None:
        said.append("this recording does not tell td")
    elif view.clock_line is None or (view.clock_line.skew is None and not view.clock_line.jumps):  # a clock that moves has no mean
        weight = sigma[sure] ** -2.0 if np.isfinite(sigma).any() else np.ones(len(t))
        mean = float(np.average(offset[sure], weights=weight))
        panels[0].axhline(float(axis(np.array(mean))), color="black", lw=0.9, ls=(0, (1, 2)))
        said.append(f"dotted: mean {ms(mean, float(weight.sum() ** -0.5))}")
    if len(known) and view.bottom is not None:
        said.append("line: " + _clock(panels[0], t[np.isfinite(clock)], known, view.clock_line, axis))
    if not sure.all():
        said.append(f"pale: {counted(int(np.sum(~sure)), 'window')} of large sigma")
    panels[0].set(ylabel=axis.label("td"), title="; ".join(said))
    panels[-1].set_xlabel(since(view))
    if moves:
        left = view.raw[order, 0]
        around = Seconds(0.0, axis.unit)
        panels[1].axhline(0, color=ACCENT, lw=1.4)
        _bars(panels[1], t, around(left), around(sigma), sure)
        panels[1].set(ylabel=around.label("td - line"), ylim=limits([around(left[sure] + spread), around(left[sure] - spread)], least=1e-3))


def _bars(panel: Axes, t: Array, value: Array, sigma: Array, sure: "np.ndarray[tuple[int], np.dtype[np.bool_]]") -> None:
    size = 4.5 if len(t) <= 50 else 2.5
    for rows, colour in ((~sure, PALE), (sure, INK)):
        panel.errorbar(t[rows], value[rows], 2 * np.nan_to_num(sigma[rows]), fmt="o", color=colour, ms=size, lw=0.9, capsize=size / 2)


def _clock(panel: Axes, t: Array, clock: Array, told: ClockLine | None, axis: Seconds) -> str:
    """Draw the clock's line (n,), broken and marked at its jumps, and say in words what it does."""
    jumps = [] if told is None else sorted(told.jumps)
    for piece in np.split(np.arange(len(t)), np.searchsorted(t, [at for at, _ in jumps])):
        panel.plot(t[piece], axis(clock[piece]), "-" if len(piece) > 1 else "_", color=ACCENT, lw=1.4, ms=14, zorder=3)
    for at, size in jumps[:MAX_STEPS]:
        panel.axvline(at, color=ACCENT, lw=0.9, ls="--", zorder=0)
        top, text = panel.get_xaxis_transform(), ms(size, 1e-4)
        panel.annotate(text, (at, 1), (5, -2), xycoords=top, textcoords="offset points", va="top", color=ACCENT, fontweight="bold")
    if len(t) < FEWEST:
        return "too few windows to tell whether the clocks drift"
    if told is None:
        return "the clock"
    drift = [] if told.skew is None else [f"the clocks drift apart by {1e6 * told.skew:+.3g} ppm"]
    steps = [f"{counted(len(jumps), 'jump')} (dashed)"] if jumps else []
    return ", with ".join([*drift, *steps]) or "the clocks run alike"


def since(view: View) -> str:
    """Return the label of an axis of time."""
    a, b = names(view)
    return f"s after the first {f'sample of {a}' if view.zeroed else f'turn of {b}'}"


def names(view: View) -> tuple[str, str]:
    """Return a and b of dt_a_b."""
    found = re.fullmatch(r"dt_([^_]+)_([^_]+)", view.sensor)
    return (found[1], found[2]) if found else ("a", "b")


def ms(value: float, resolution: float) -> str:
    """Return seconds as ms to two digits of the resolution (s); from one second on as s."""
    far = abs(value) >= 1
    digits = int(np.clip(1 - floor(log10(resolution if far else 1e3 * resolution)), 0, 9)) if resolution > 0 else 6
    return f"{value:+.{digits}f} s" if far else f"{1e3 * value:+.{digits}f} ms"


def limits(parts: list[Array], least: float = 1e-9) -> tuple[float, float]:
    """Return limits around all finite values with a margin, never narrower than `least`."""
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    margin = 0.12 * max(high - low, least)
    return low - margin, high + margin


def _shown(bottom: Bottom) -> str:
    sigma = (bottom.high - bottom.low) / 4
    second = "" if bottom.second is None else f"; or {ms(bottom.second, sigma)}?"
    return f"td = {ms(bottom.offset, sigma)}, 95 %: {ms(bottom.low, sigma)} to {ms(bottom.high, sigma)}{second}"


def _two_digits(value: float) -> float:
    return float(f"{value:.1e}")
