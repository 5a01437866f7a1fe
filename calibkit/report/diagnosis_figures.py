"""The pictures of a diagnosis and of a validation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibkit.report.field import cells, grid
from calibkit.report.look import ACCENT, INK, PALE
from calibkit.report.over_images import image_axes, round_down
from calibkit.report.view import Array

_BINS, _FEWEST = 14, 25
_MOST = 0.95  # of the arrows are to scale with the cells; a few at the image's corners may reach beyond
_EDGE = 0.01  # of the rows at either end are left out


@dataclass(frozen=True)
class Bar:
    """One suspect."""

    name: str
    size: str  # if it were the only cause, with sigma and unit
    alone: float  # share of the excess that it explains by itself
    named: float | None  # what it explains of it beside those named before; None where it is not named


@dataclass(frozen=True)
class Cloud:
    """A sensor's residuals (n,) along one direction of each row, by what the cause predicts to grow."""

    sensor: str
    x_label: str
    y_label: str
    x: Array
    y: Array
    predicted: Array


@dataclass(frozen=True)
class Line:
    """How large a cause is over something that changes."""

    label: str
    x: Array  # (w,)
    size: Array  # (w,)
    sigma: Array  # (w,)
    named: Array  # (w,) what the diagnosis says


@dataclass(frozen=True)
class Speed:
    """One sensor's residuals by the rate of turn."""

    sensor: str
    unit: str
    rate: Array
    rms: Array
    at_rest: float
    slope: float
    slope_sigma: float


def suspects(figure: Figure, bars: Sequence[Bar]) -> None:
    """Draw what each suspect explains of the excess."""
    axes, y = figure.subplots(), np.arange(len(bars))
    axes.barh(y, [100 * max(bar.alone, 0.0) for bar in bars], 0.72, color=PALE, edgecolor=INK, lw=0.5, label="if it were the only cause")
    named = [i for i, bar in enumerate(bars) if bar.named is not None]
    if named:
        shares = [100 * (bars[i].named or 0.0) for i in named]
        axes.barh(named, shares, 0.4, color=ACCENT, edgecolor="black", lw=0.5, hatch="///", label="named, beside those above it")
    for i, bar in enumerate(bars):
        weight = "bold" if bar.named is not None else "normal"
        axes.text(1.01, i, bar.size, transform=axes.get_yaxis_transform(), va="center", fontsize=8, fontweight=weight)
    axes.set_yticks(y, [bar.name for bar in bars], fontsize=8)
    for label, bar in zip(axes.get_yticklabels(), bars, strict=True):
        label.set_fontweight("bold" if bar.named is not None else "normal")
    axes.set(xlim=(0, 100), ylim=(len(bars) - 0.5, -0.5), xlabel="share of the excess that mending it takes away (%)")
    axes.set_title("right: its size, if it were the only cause", loc="right", fontsize=8)
    axes.legend(frameon=False, loc="lower right")


def clouds(figure: Figure, drawn: Sequence[Cloud]) -> None:
    """Draw residuals against what the cause predicts to grow: medians in bins, and the cause's own."""
    for axes, cloud in zip(figure.subplots(1, len(drawn), squeeze=False)[0], drawn, strict=True):
        _cloud(axes, cloud)


def _cloud(axes: Axes, cloud: Cloud) -> None:
    low, high = np.quantile(cloud.x, [_EDGE, 1 - _EDGE])
    inside = (cloud.x >= low) & (cloud.x <= high)
    x, y, predicted = cloud.x[inside], cloud.y[inside], cloud.predicted[inside]
    some = slice(None, None, 1 + len(x) // 4000)
    axes.plot(x[some], y[some], ".", color=PALE, ms=2, mew=0, alpha=0.5, rasterized=True)
    order = np.array_split(np.argsort(x, kind="stable"), max(min(_BINS, len(x) // _FEWEST), 1))
    at = np.array([x[rows].mean() for rows in order])
    mean = np.array([y[rows].mean() for rows in order])
    error = np.array([y[rows].std() / np.sqrt(len(rows)) for rows in order])
    cause = np.array([predicted[rows].mean() for rows in order])
    axes.plot(at, cause, "-", color=ACCENT, lw=1.6, label="what the cause predicts")
    axes.errorbar(at, mean, 2 * error, fmt="o", color=INK, ms=4, lw=1, capsize=2, label="residual, mean and 2 sigma", zorder=3)
    axes.axhline(0, color="black", lw=0.7)
    ends = np.concatenate([mean, cause, np.quantile(y, [0.02, 0.98]), [0.0]])
    squares = max(float(np.sum(predicted**2)), 1e-300)
    slope = float(np.sum(predicted * y)) / squares
    slope_sigma = float(np.std(y - slope * predicted)) / np.sqrt(squares)
    axes.set(ylim=(float(ends.min()) - 0.1 * np.ptp(ends), float(ends.max()) + 0.4 * np.ptp(ends)))
    axes.set_xlabel(cloud.x_label, fontsize=8)
    axes.set_ylabel(cloud.y_label, fontsize=8)
    axes.set_title(f"{cloud.sensor}\n{slope:.2f} ± {slope_sigma:.2f} times what is predicted")
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def courses(figure: Figure, lines: Sequence[Line], what: str) -> None:
    """Draw how large a cause is in windows."""
    for axes, line in zip(figure.subplots(1, len(lines), squeeze=False, sharey=True)[0], lines, strict=True):
        order = np.argsort(line.x, kind="stable")
        axes.axhline(0, color="black", lw=0.7)
        axes.plot(line.x[order], line.named[order], "-", color=ACCENT, lw=1.6, label="as named")
        axes.errorbar(line.x, line.size, 2 * line.sigma, fmt="o", color=INK, ms=4, lw=1, capsize=2, label="windows, 2 sigma", zorder=3)
        axes.set_xlabel(line.label)
        axes.legend(frameon=False)
        sure = line.sigma < 3 * np.median(line.sigma)  # a window that tells next to nothing must not set the scale
        ends = np.concatenate([(line.size - 2 * line.sigma)[sure], (line.size + 2 * line.sigma)[sure], line.named, [0.0]])
        axes.set_ylim(float(ends.min()) - 0.08 * np.ptp(ends), float(ends.max()) + 0.08 * np.ptp(ends))
    figure.axes[0].set_ylabel(what)


def fields(figure: Figure, uv: Array, fields_of: Sequence[tuple[str, Array]], size: tuple[int, int]) -> None:
    """Draw mean residuals of each cell of the image beside what the cause predicts, to one scale."""
    columns, rows = grid(size, 12)
    cell = cells(uv, size, (columns, rows))
    count = np.bincount(cell, minlength=columns * rows)
    seen = count >= _FEWEST
    x, y = np.meshgrid((np.arange(columns) + 0.5) * size[0] / columns - 0.5, (np.arange(rows) + 0.5) * size[1] / rows - 0.5)
    means = []
    for _, values in fields_of:
        sums = np.stack([np.bincount(cell, values[:, k], columns * rows) for k in range(2)], axis=1)
        means.append(sums / np.maximum(count, 1)[:, None])
    lengths = np.concatenate([np.linalg.norm(mean[seen], axis=1) for mean in means])
    longest = (float(np.quantile(lengths, _MOST)) if len(lengths) else 0.0) or 1.0
    scale = longest / (1.1 * size[0] / columns)
    for axes, (title, _), mean in zip(figure.subplots(1, len(means)), fields_of, means, strict=True):
        at = x.ravel()[seen], y.ravel()[seen]
        arrows = axes.quiver(*at, *mean[seen].T, angles="xy", scale_units="xy", scale=scale, color=INK, width=0.004, pivot="mid")
        key = round_down(longest)
        axes.quiverkey(arrows, 0.93, -0.17, key, f"{key:g} px", labelpos="W", color=INK)
        image_axes(axes, size)
        axes.set_title(title)


def sweeps(figure: Figure, speeds: Sequence[Speed]) -> None:
    """Draw rms by bins of the rotation rate, and the curve through them with its value at rest."""
    for axes, speed in zip(figure.subplots(1, len(speeds), squeeze=False)[0], speeds, strict=True):
        rate = np.linspace(0, float(speed.rate[-1]) * 1.05, 100)
        curve = np.sqrt(np.maximum(speed.at_rest**2 + np.sign(speed.slope) * (speed.slope * rate) ** 2, 0.0))
        axes.bar(speed.rate, speed.rms, 0.6 * float(np.diff(speed.rate).min()), color=PALE, edgecolor=INK, lw=0.5)
        axes.plot(rate, curve, "-", color=ACCENT, lw=1.6)
        axes.axhline(speed.at_rest, color="black", lw=0.8, ls="--")
        axes.set(xlabel="rate of turn (rad/s)", ylabel=f"rms ({speed.unit})", ylim=(0, None), xlim=(0, rate[-1]))
        growth = f"growth {speed.slope:.2g} ± {speed.slope_sigma:.1g} per rad/s"
        axes.set_title(f"{speed.sensor}\nat rest {speed.at_rest:.3g} {speed.unit} (dashed)\n{growth}", fontsize=8)


def halves(figure: Figure, names: Sequence[str], z: Array, limit: float) -> None:
    """Draw the difference of the halves' calibrations in sigmas."""
    axes, y = figure.subplots(), np.arange(len(names))
    far = np.abs(z) > limit
    bars = axes.barh(y, z, 0.7, color=[ACCENT if wrong else PALE for wrong in far], edgecolor=INK, lw=0.5)
    for bar, wrong in zip(bars, far, strict=True):
        bar.set_hatch("///" if wrong else "")
    for level in (-limit, limit):
        axes.axvline(level, color="black", lw=0.8, ls="--")
    axes.axvline(0, color="black", lw=0.7)
    reach = 1.1 * max(limit, float(np.abs(z).max(initial=0.0)))
    axes.set_yticks(y, names, fontsize=8)
    axes.set(xlim=(-reach, reach), ylim=(len(names) - 0.5, -0.5), xlabel="second half less first half (sigma of the difference)")
    axes.set_title(f"dashed: {limit:g} sigma")
