"""The signals of a time offset: does the residual grow with the rotation rate, did aligning help, do windows agree (numpy only)."""

import numpy as np

from calibkit.data.plural import counted
from calibkit.report.growth import growth
from calibkit.report.probe import SIGNIFICANT, Measured
from calibkit.report.view import View, given, rms

TURNING = 0.2  # rad/s: rates that differ by less do not show what grows with them
HARMLESS_JITTER_S = 3e-4  # of a stamp: 0.15 px at 500 px and 1 rad/s
HARMLESS_SCATTER_S = 5e-5  # of a time offset: 0.025 px there
_NONE = Measured(float("nan"))  # also of an offset that is not known: none of these would mean anything


def rate_growth(view: View) -> Measured:
    """Return the slope of |residual| on the rotation rate; the slope that stamps with a jitter of sigma give is sigma over the interval."""
    kept = view.kept
    if view.bottom is None:
        return _NONE
    rate = given(view.rate)[kept]
    found = growth(rate, np.linalg.norm(view.raw[kept], axis=1))
    if found is None or found.x[-1] - found.x[0] < TURNING:
        return _NONE
    interval = float(np.median(np.diff(np.sort(given(view.t)))))
    jitter = found.slope * interval
    at_rest, fast = max(found.at_rest, 0.0), found.at_rest + found.slope * found.x[-1]
    note = f"{at_rest:.2g} {view.unit} at rest, {fast:.2g} at {found.x[-1]:.2g} rad/s"
    if found.slope < SIGNIFICANT * found.slope_sigma:
        return Measured(100 * found.slope, "no more than chance", exempt=True)
    if jitter < HARMLESS_JITTER_S:
        return Measured(100 * found.slope, f"{note}; less than stamps with {1e3 * HARMLESS_JITTER_S:.2g} ms of jitter give", exempt=True)
    return Measured(100 * found.slope, note)


def over_before(view: View) -> Measured:
    """Return the rms over that with the stamps as they are, both over the rows that have both."""
    before = given(view.before)
    both = view.kept & np.all(np.isfinite(before), axis=1)
    if view.bottom is None or not both.any():
        return _NONE
    was, now = rms(before[both]), rms(view.raw[both])
    return Measured(now / max(was, 1e-12), f"{was:.3g} {view.unit} with the stamps as they are, {now:.3g} aligned")


def window_scatter(view: View) -> Measured:
    """Return the rms of (td of a window - the clock's) / sigma."""
    sigma = given(view.window_sigma)
    rows = view.kept & (sigma > 0)
    if view.bottom is None or rows.sum() < 3:
        return _NONE
    left = view.raw[rows, 0]
    size = rms(left[:, None])
    note = f"{counted(int(rows.sum()), 'window')}, {1e3 * size:.2g} ms about the clock"
    return Measured(float(np.sqrt(np.mean((left / sigma[rows]) ** 2))), note, exempt=size < HARMLESS_SCATTER_S)
