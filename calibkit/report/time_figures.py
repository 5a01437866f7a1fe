"""The picture of a camera's residuals over time and, where it was measured, over temperature: does anything creep."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibkit.report.look import ACCENT, INK, PALE
from calibkit.report.view import Array, View, given

_BINS, _FEWEST = 20, 3  # frames of a bin
_MANY = 200  # points that are cheaper as pixels


def over_time(figure: Figure, view: View) -> None:
    """Draw each frame's rms, and the mean residual in x, y and away from the centre, over time and temperature."""
    kept, frame = view.kept, given(view.frame)
    count = np.bincount(frame[kept], minlength=len(view.labels))
    some = count > 0

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(frame[kept], values, len(view.labels))[some] / count[some], np.float64)

    arm = given(view.uv)[kept] - given(view.centre)
    radial = np.sum(view.raw[kept] * arm, axis=1) / np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
    means = [mean(values) for values in (view.raw[kept, 0], view.raw[kept, 1], radial)]
    axis = [("s from the start", mean(given(view.moments)[kept]))]
    if view.temperature is not None:
        axis.append(("temperature (°C)", mean(view.temperature[kept])))
    panels = figure.subplots(2, len(axis), squeeze=False, sharex="col", sharey="row")
    for column, (label, x) in enumerate(axis):
        top, bottom = panels[:, column]
        top.plot(x, view.frame_rms[some], ".", color=PALE, ms=3.5, mew=0, rasterized=len(x) > _MANY)
        _means(top, x, view.frame_rms[some], "", INK, "o", 0.0)
        top.set(ylim=(0, None))
        for k, (values, name, colour, mark) in enumerate(zip(means, ("x", "y", "outwards"), (INK, ACCENT, "#3f7d58"), "os^", strict=True)):
            _means(bottom, x, values, name, colour, mark, 0.12 * (k - 1))
        bottom.axhline(0, color="black", lw=0.7)
        bottom.set_xlabel(label)
    panels[0, 0].set(ylabel=f"rms of a frame ({view.unit})", title="points: frames; bars: means of neighbouring ones with 2 sigma")
    panels[1, 0].set_ylabel(f"mean residual ({view.unit})")
    low, high = panels[1, 0].get_ylim()
    panels[1, 0].set_ylim(low, high + 0.25 * (high - low))
    panels[1, 0].legend(frameon=False, ncols=3, loc="upper left", fontsize=8)


def _means(axes: Axes, x: Array, values: Array, label: str, colour: str, mark: str, shift: float) -> None:
    """Draw means of neighbours along x with bars of 2 sigma, beside others' by a share of their spacing."""
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(x))
    bins = np.array_split(known[np.argsort(x[known], kind="stable")], int(np.clip(len(known) // _FEWEST, 1, _BINS)))
    at = np.array([x[rows].mean() for rows in bins]) + shift * np.ptp(x[known]) / len(bins)
    error = [2 * values[rows].std(ddof=1) / np.sqrt(len(rows)) if len(rows) > 1 else 0.0 for rows in bins]
    axes.errorbar(
        at, [values[rows].mean() for rows in bins], error, fmt=f"{mark}-", color=colour, ms=3.5, lw=0.8, capsize=2, label=label or None
    )
