"""The pictures of an IMU: Allan deviations with their fit and its slopes, and the stands of a multi-position recording."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from calibkit.data.rig import IMU_AXES, ImuAxis, Noise
from calibkit.models.noise import FLOOR
from calibkit.report.imu_units import for_people
from calibkit.report.view import Array, Index, View, given

UNITS = {"gyro": "rad/s", "accel": "m/s²"}
_LOOK = {"x": ("#1f3b57", "o"), "y": ("#c1440e", "s"), "z": ("#3f7d58", "^")}


def allan(figure: Figure, view: View) -> None:
    """Draw each sensor's axes log-log: measured with its 95 % interval, the fit, and N, B and K where they are read off."""
    axis = given(view.axis)
    sensors = [(name, first) for name, first in (("gyro", 0), ("accel", 3)) if np.any((axis >= first) & (axis < first + 3))]
    for panel, (sensor, first) in zip(np.ravel(figure.subplots(1, len(sensors), squeeze=False)), sensors, strict=True):
        for k, name in enumerate(IMU_AXES):
            rows = np.flatnonzero(axis == k)
            if name.startswith(sensor) and len(rows):
                _curve(panel, view, rows, name)
        panel.set(xscale="log", yscale="log", xlabel="averaging time tau (s)", ylabel=f"Allan deviation ({UNITS[sensor]})")
        shown = given(view.deviation)[(axis >= first) & (axis < first + 3)]
        panel.set_ylim(0.5 * shown[shown > 0].min(initial=np.inf), 2 * shown.max())
        for ticks in (panel.xaxis, panel.yaxis):
            ticks.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            ticks.set_minor_formatter(NullFormatter())
        panel.grid(which="major", lw=0.4, color="#cccccc")
        panel.set_title({"gyro": "gyroscope", "accel": "accelerometer"}[sensor])
        handles, _ = panel.get_legend_handles_labels()
        marks = [("N", "*"), ("B", "_"), ("K", "x")]
        handles += [Line2D([], [], color="black", ls="", marker=mark, label=label) for label, mark in marks]
        panel.legend(handles=handles, frameon=False, fontsize=8, ncols=2)


def _curve(panel: Axes, view: View, rows: Index, name: ImuAxis) -> None:
    colour, marker = _LOOK[name[-1]]
    tau, deviation, fitted, low, high = (given(column)[rows] for column in (view.tau, view.deviation, view.fitted, view.low, view.high))
    noise = view.noise.get(name)
    label = name[-1] if noise is None or noise.white.value is None else f"{name[-1]}  N {for_people(name[:-2], 'white', noise.white.value)}"
    panel.fill_between(tau, low, high, color=colour, alpha=0.18, lw=0)
    panel.plot(tau, deviation, color=colour, marker=marker, ms=3, lw=0, label=label)
    panel.plot(tau, fitted, color=colour, lw=1.1)
    if noise is not None:
        _slopes(panel, noise, colour, tau)


def _slopes(panel: Axes, noise: Noise, colour: str, tau: Array) -> None:
    """Mark N at tau = 1 s on its slope -1/2, B on its flat floor, K on its slope +1/2 at the longest tau (3 s lies far below)."""
    reach = np.array([tau.min(), tau.max()])
    for estimate, slope, at, factor, mark in (
        (noise.white, -0.5, 1.0, 1.0, "*"),
        (noise.flicker, 0.0, 1.0, FLOOR, "_"),
        (noise.walk, 0.5, 3.0, 1.0, "x"),
    ):
        if estimate.value is not None:
            panel.plot(reach, factor * estimate.value * (reach / at) ** slope, color=colour, lw=0.6, ls=(0, (1, 3)), scaley=False)
            seen = at if slope <= 0 else reach[1]  # K's own place, 3 s, lies far below the curve
            panel.plot([seen], [factor * estimate.value * (seen / at) ** slope], color="black", marker=mark, ms=6, lw=0, scalex=False)


def stands(figure: Figure, view: View) -> None:
    """Draw the stands' residuals in their order, and where gravity pointed in the IMU's frame, seen from both sides."""
    left, up, down = figure.subplots(1, 3, width_ratios=[1.6, 1, 1])
    value, kept, attitude = view.raw[:, 0], view.kept, given(view.attitude)
    at = np.arange(len(value))
    left.axhline(0, color="black", lw=0.6)
    left.plot(at[kept], value[kept], "o", color=_LOOK["x"][0], ms=4)
    left.plot(at[~kept], value[~kept], "x", color=_LOOK["y"][0], ms=5)
    left.set(xlabel="stand", ylabel=f"|a| - g ({view.unit})")
    left.set_title("residual of each stand" + ("" if kept.all() else ", × given up"))
    turn = np.linspace(0, 2 * np.pi, 100)
    for panel, sign, title in ((up, 1, "z up"), (down, -1, "z down")):
        side = sign * attitude[:, 2] >= 0
        for angle in (30, 60, 90):
            panel.plot(np.sin(np.radians(angle)) * np.cos(turn), np.sin(np.radians(angle)) * np.sin(turn), color="#bbbbbb", lw=0.6)
        panel.plot(*attitude[side & kept, :2].T, "o", color=_LOOK["x"][0], ms=4)
        panel.plot(*attitude[side & ~kept, :2].T, "x", color=_LOOK["y"][0], ms=5)
        panel.set(aspect="equal", xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), xticks=[], yticks=[], xlabel="x", ylabel="y")
        panel.set_title(f"{title}, rings at 30, 60, 90 deg")
