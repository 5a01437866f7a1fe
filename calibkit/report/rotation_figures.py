"""The pictures of two sensors' rotation rates, with the stamps as they are and aligned: over time, and what is left of them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibkit.report.growth import growth
from calibkit.report.look import ACCENT, INK
from calibkit.report.time_offset_figures import limits, names, since
from calibkit.report.view import Array, Index, View, given

BUSIEST_S = 6.0
MAX_POINTS = 3000  # of a cloud
LEAST_REACH = 0.05  # of an axis of rates in rad/s and of their change in rad/s^2: a rig at rest must look at rest


def rates(figure: Figure, view: View) -> None:
    """Draw both rotation rates and their difference where they change fastest, with the stamps as they are and aligned."""
    a, b = names(view)
    order = np.argsort(given(view.t), kind="stable")
    t, of, after, kept = given(view.t)[order], given(view.of_rate)[order], given(view.rate)[order], view.kept[order]
    panels = [(after, f"aligned: stamps of {b} + td")]
    known = np.isfinite(of) & np.isfinite(after)
    if view.rate_before is not None and np.any(both := known & np.isfinite(view.rate_before[order])):
        panels.insert(0, (view.rate_before[order], "stamps as they are"))
        known = both
    rows = _busiest(t, after, known & kept)
    good = rows[(known & kept)[rows]]
    low, high = limits([of[good], *(rate[good] for rate, _ in panels)])
    high += 0.2 * (high - low)  # room for the legend
    dropped = rows[~kept[rows] & (of[rows] > low) & (of[rows] < high)]
    axes = figure.subplots(2, len(panels), sharex=True, sharey="row", height_ratios=[1.7, 1], squeeze=False)
    for (upper, lower), (rate, title) in zip(axes.T, panels, strict=True):
        difference = np.where(kept, of - rate, np.nan)
        x, lines = _broken(t[rows], np.stack([rate[rows], difference[rows]], axis=1))
        upper.plot(x, lines[:, 0], "-", color=INK, lw=1.2, label=a)
        upper.plot(t[good], of[good], "s", color=ACCENT, ms=3, mew=0, label=b)
        if len(dropped):
            upper.plot(t[dropped], of[dropped], "x", color=ACCENT, ms=5, label=f"{b}, given up")
        lower.axhline(0, color="black", lw=0.7)
        lower.plot(x, lines[:, 1], ".-", color=INK, ms=3.5, lw=0.8)
        upper.set_title(title)
        lower.set_xlabel(since(view))
    axes[0, 0].set(ylabel="|ω| (rad/s)", ylim=(low, high))
    differences = [of[good] - rate[good] for rate, _ in panels]
    axes[1, 0].set(ylabel=f"{b} - {a} (rad/s)", ylim=limits([*differences, *(-d for d in differences)]))
    axes[0, -1].legend(frameon=False, ncols=3, loc="upper right", borderaxespad=0)
    if len(panels) == 1:
        axes[0, 0].set_title(f"{panels[0][1]}; with the stamps as they are, {a} has nothing at these times")


def residual_rate(figure: Figure, view: View) -> None:
    """Draw |residual| against the rotation rate and against its change, before and after: points, medians, fitted lines."""
    order = np.argsort(given(view.t), kind="stable")
    order = order[view.kept[order]]
    rate, t = given(view.rate)[order], given(view.t)[order]
    label = "kept" if view.of_rate is None else "after: aligned"
    sizes = [(np.linalg.norm(view.raw[order], axis=1), label, INK, "o", "-")]
    if view.before is not None:
        sizes.insert(0, (np.linalg.norm(view.before[order], axis=1), "before: stamps as they are", ACCENT, "s", "--"))
    axes = figure.subplots(1, 2, sharey=True)
    tops = []
    for panel, x in zip(axes, (rate, change(t, rate)), strict=True):
        for size, label, *look in sizes:
            tops.append(_cloud(panel, x, size, label, *look))
        reach = float(np.quantile(x[np.isfinite(x)], 0.995)) if np.isfinite(x).any() else 0
        panel.set_xlim(0, max(1.02 * reach, LEAST_REACH))
        panel.legend(frameon=False, loc="upper left", markerscale=1.0)
    axes[0].set(xlabel="rotation rate |ω| (rad/s)", ylabel=f"|residual| ({view.unit})", ylim=(0, max(tops) or 1))
    axes[1].set_xlabel("change of the rotation rate |d|ω|/dt| (rad/s²)")
    axes[0].set_title("against how fast it turns")
    axes[1].set_title("against how fast that changes; medians with bars of 2 sigma")


def _cloud(panel: Axes, x: Array, size: Array, label: str, colour: str, marker: str, dash: str) -> float:
    """Draw points, their medians and the line through them; return how high the panel should reach."""
    known = np.isfinite(x) & np.isfinite(size)
    x, size = x[known], size[known]
    few = slice(None, None, 1 + len(x) // MAX_POINTS)
    alpha = float(np.clip(300 / max(len(x[few]), 1), 0.1, 0.3))
    panel.plot(x[few], size[few], marker, color=colour, alpha=alpha, ms=2.2, mew=0, rasterized=True)
    found = growth(x, size)
    if found is None:
        panel.plot([], [], marker, color=colour, ms=4, label=label)
        return 3 * float(np.median(size)) if len(size) else 0.0
    reach = np.array([0, found.x[-1]])
    panel.plot(reach, found.at_rest + found.slope * reach, color=colour, lw=1.2, ls=dash)
    panel.errorbar(
        found.x, found.median, 2 * found.sigma, fmt=marker, color=colour, mec="white", ms=5.5, lw=1, capsize=2, label=label, zorder=3
    )
    return 2.2 * float(found.median.max())


def change(t: Array, rate: Array) -> Array:
    """Return |d rate / dt| (n,) from the moments beside each row's, in order of time; NaN at both ends and beside a gap."""
    t, first, moment = np.unique(t, return_index=True, return_inverse=True)  # the corners of a frame share theirs
    rate = rate[first]
    found = np.full(len(t), np.nan)
    if len(t) > 2:
        step = np.diff(t)
        joined = (step > 0) & (step < 3 * np.median(step))
        fine = joined[1:] & joined[:-1]
        found[1:-1][fine] = np.abs(rate[2:] - rate[:-2])[fine] / (t[2:] - t[:-2])[fine]
    out: Array = found[moment]
    return out


def _busiest(t: Array, rate: Array, known: "np.ndarray[tuple[int], np.dtype[np.bool_]]") -> Index:
    """Return the rows of the BUSIEST_S seconds in which the known rates change most, t in order."""
    at = np.flatnonzero(known)
    if not len(at):
        return np.zeros(0, np.intp)
    walked = np.concatenate([[0], np.cumsum(np.abs(np.diff(rate[at])))])
    last = np.searchsorted(t[at], t[at] + BUSIEST_S, side="right") - 1
    first = int(np.argmax(walked[last] - walked))
    return np.flatnonzero((t >= t[at[first]]) & (t <= t[at[last[first]]]))


def _broken(t: Array, lines: Array) -> tuple[Array, Array]:
    """Return curves (n, k) over t (n,) with a NaN in each gap, so that no line is drawn across it."""
    step = np.diff(t)
    gaps = np.flatnonzero(step > 3 * np.median(step)) + 1 if len(step) else np.zeros(0, np.intp)
    return np.insert(t, gaps, np.nan), np.insert(lines, gaps, np.nan, axis=0)
