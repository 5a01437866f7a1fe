"""The signals of a joint calibration: is what it leaves white, does it grow with the rotation rate (numpy only)."""

import numpy as np

from calibkit.report.growth import growth
from calibkit.report.probe import SIGNIFICANT, Measured
from calibkit.report.view import Array, View, given
from calibkit.report.whiteness import autocorrelation

TURNING = 0.2  # rad/s: rates that differ by less do not show what grows with them
HARMLESS_PX = 0.1
_NONE = Measured(float("nan"))


def alike(view: View) -> Measured:
    """Return the largest autocorrelation of the kept residuals of any axis.

    A negative one is no fault: a spline takes the slow part of white noise along.
    """
    order = np.argsort(given(view.t), kind="stable")
    lags, rho, chance = autocorrelation(given(view.t)[order], np.where(view.kept[order, None], view.raw[order], 0.0))
    lag, axis = np.unravel_index(int(np.argmax(rho)), rho.shape)
    value = float(rho[lag, axis])
    note = f"{'xyz'[axis]}, {1e3 * lags[lag]:.3g} ms apart"
    return Measured(max(value, 0.0), "no more than chance" if value < chance else note, exempt=value < chance)


def corners_fast(view: View) -> Measured:
    """Return a frame's rms at the fastest turns over that at the slowest."""
    frame, squares = given(view.frame)[view.kept], view.frame_rms
    rate = np.full(len(squares), np.nan)
    rate[frame] = given(view.rate)[view.kept]
    return _fast(rate, squares, view.unit, HARMLESS_PX)


def samples_fast(view: View) -> Measured:
    """Return the residual's size at the fastest turns over that at the slowest."""
    return _fast(given(view.rate)[view.kept], np.linalg.norm(view.raw[view.kept], axis=1), view.unit, 0.0)


def _fast(rate: Array, size: Array, unit: str, harmless: float) -> Measured:
    found = growth(rate, size)
    if found is None or found.x[-1] - found.x[0] < TURNING:
        return _NONE
    slow, fast = float(found.median[0]), float(found.median[-1])
    ratio = fast / max(slow, 1e-12)
    if found.slope < SIGNIFICANT * found.slope_sigma:
        return Measured(ratio, "no more than chance", exempt=True)
    note = f"{slow:.2g} {unit} at {found.x[0]:.2g} rad/s, {fast:.2g} at {found.x[-1]:.2g}"
    return Measured(ratio, note, exempt=fast < harmless)
