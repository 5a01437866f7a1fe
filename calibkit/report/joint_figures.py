"""The pictures of a joint calibration: what the IMU measured beside what the trajectory says, whiteness, biases, the way that it went."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline

from calibkit.report.imu_figures import UNITS
from calibkit.report.look import ACCENT, AXES, INK, PALE
from calibkit.report.view import Array, View, given
from calibkit.report.whiteness import autocorrelation, spectrum

STRETCH_S = 1.5
MAX_POINTS = 3000  # of a cloud
FINE = 4
MAX_BINS = 400  # of a spectrum, neighbouring lines are averaged; and of a curve of biases, which are slow


def imu_fit(figure: Figure, view: View) -> None:
    """Draw each axis as measured and as the trajectory predicts it where it changes most, and what is left over the whole recording."""
    order = np.argsort(given(view.t), kind="stable")
    t, measured, left, kept = given(view.t)[order], given(view.measured)[order], view.raw[order], view.kept[order]
    rows = _busiest(t, measured, kept)
    few = slice(None, None, 1 + int(kept.sum()) // MAX_POINTS)
    unit = _unit(view)
    axes = figure.subplots(3, 2, sharex="col", sharey="col", width_ratios=[1, 1.3])
    for k, (name, *_) in enumerate(AXES):
        near, whole = axes[k]
        near.plot(t[rows], measured[rows, k], "s", color=PALE, ms=3.5, mew=0)
        near.plot(t[rows], (measured - left)[rows, k], "-", color=INK, lw=0.9)
        near.set_ylabel(f"{name} ({unit})")
        sigma = float(np.std(left[kept, k]))
        whole.plot(t[kept][few], left[kept, k][few], ".", color=INK, ms=1.8, mew=0, alpha=0.5, rasterized=True)
        gone = np.clip(left[~kept, k], -6 * sigma, 6 * sigma)
        whole.plot(t[~kept], gone, "x", color=ACCENT, ms=4, rasterized=True)
        for level in (-3, 3):
            whole.axhline(level * sigma, color="black", lw=0.7, ls="--")
        whole.text(1.005, 0.5, f"sigma\n{sigma:.3g}", transform=whole.transAxes, va="center", fontsize=8)
    low, high = float(left[kept].min()), float(left[kept].max())
    axes[0, 1].set_ylim(1.15 * min(low, -high), 1.15 * max(high, -low))
    axes[0, 0].set_title("squares: measured, line: by the trajectory,\nwhere it changes most")
    axes[0, 1].set_title("left over: measured - trajectory; dashed: 3 sigma" + ("" if kept.all() else "; × given up"))
    for panel in axes[2]:
        panel.set_xlabel("s from the start")


def whiteness(figure: Figure, view: View) -> None:
    """Draw the autocorrelation of what is left of each axis, and its spectrum as a noise density."""
    order = np.argsort(given(view.t), kind="stable")
    t, left = given(view.t)[order], np.where(view.kept[order, None], view.raw[order], 0.0)
    lags, rho, chance = autocorrelation(t, left)
    frequency, density = spectrum(t, left)
    near, far = figure.subplots(1, 2)
    near.axhspan(-chance, chance, color=PALE, alpha=0.5, lw=0)
    near.axhline(0, color="black", lw=0.6)
    wide = np.array_split(np.arange(len(frequency)), min(len(frequency), MAX_BINS))
    for k, (name, colour, dash) in enumerate(AXES):
        near.plot(1e3 * lags, rho[:, k], color=colour, lw=1.0, ls=dash, label=name)
        averaged = np.sqrt([np.mean(density[rows, k] ** 2) for rows in wide])
        far.plot([np.mean(frequency[rows]) for rows in wide], averaged, color=colour, lw=1.0, ls=dash, label=name)
    top = max(0.25, 1.15 * float(np.abs(rho).max(initial=0)))
    near.set(xlabel="lag (ms)", ylabel="autocorrelation", ylim=(-top, top), title="band: what white noise gives by chance")
    far.set(xlabel="frequency (Hz)", ylabel=f"{_unit(view)}/√Hz", ylim=(0, None), title="as a noise density: a level line is white")
    far.legend(frameon=False, ncols=3)


def biases(figure: Figure, view: View) -> None:
    """Draw the biases over time with 3 sigma."""
    order = np.argsort(given(view.t), kind="stable")
    order = order[:: 1 + len(order) // MAX_BINS]
    t, bias, sigma = given(view.t)[order], given(view.bias)[order], given(view.bias_sigma)[order]
    for panel, first, title, unit in zip(figure.subplots(1, 2), (0, 3), ("gyroscope", "accelerometer"), UNITS.values(), strict=True):
        for k, (name, colour, dash) in enumerate(AXES, first):
            panel.fill_between(t, bias[:, k] - 3 * sigma[:, k], bias[:, k] + 3 * sigma[:, k], color=colour, alpha=0.2, lw=0)
            panel.plot(t, bias[:, k], color=colour, lw=1.4, ls=dash, label=name)
        panel.set(xlabel="s from the start", ylabel=f"bias ({unit})", title=f"{title}; band: 3 sigma")
        panel.legend(frameon=False, ncols=3)


def way(figure: Figure, view: View) -> None:
    """Draw where the IMU was in the board's frame, from three sides."""
    t, first = np.unique(given(view.t), return_index=True)
    place = given(view.place)[first]
    fine = CubicSpline(t, place)(np.linspace(t[0], t[-1], FINE * len(t))) if len(t) > 3 else place  # one place a knot is coarse
    middle = (place.max(axis=0) + place.min(axis=0)) / 2
    half = 0.56 * (float(np.ptp(place, axis=0).max()) or 1.0)
    for panel, (i, j) in zip(figure.subplots(1, 3), ((0, 1), (2, 1), (0, 2)), strict=True):
        _side(panel, place, fine, i, j)
        panel.set(xlim=(middle[i] - half, middle[i] + half), ylim=(middle[j] - half, middle[j] + half), aspect="equal")
        panel.set(xlabel=f"board's {'xyz'[i]} (m)", ylabel=f"board's {'xyz'[j]} (m)")
    figure.suptitle("the IMU's way; circle: start, square: end", fontsize=9)


def _side(panel: Axes, place: Array, fine: Array, i: int, j: int) -> None:
    panel.plot(fine[:, i], fine[:, j], color=INK, lw=0.9)
    for row, mark in ((0, "o"), (-1, "s")):
        panel.plot(place[row, i], place[row, j], mark, color=ACCENT, ms=6, mec="white", zorder=3)


def _unit(view: View) -> str:
    return view.unit.replace("^2", "²")


def _busiest(
    t: Array, measured: Array, kept: "np.ndarray[tuple[int, ...], np.dtype[np.bool_]]"
) -> "np.ndarray[tuple[int], np.dtype[np.intp]]":
    """Return the kept rows of the STRETCH_S in which the measurements vary most, t in order."""
    at = np.flatnonzero(kept)
    squares = np.concatenate([np.zeros((1, 6)), np.cumsum(np.concatenate([measured[at], measured[at] ** 2], axis=1), axis=0)])
    last = np.searchsorted(t[at], t[at] + STRETCH_S, side="right")
    count = last - np.arange(len(at))
    mean = (squares[last] - squares[:-1]) / count[:, None]
    varied = np.sum(mean[:, 3:] - mean[:, :3] ** 2, axis=1)
    whole = t[at] <= max(float(t[at][-1]) - STRETCH_S, float(t[at][0]))
    first = int(np.argmax(np.where(whole, varied, -np.inf)))
    return at[first : last[first]]
