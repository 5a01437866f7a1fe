"""Motion, level steps and drift of an IMU that should lie still, judged against the recording's own quiet level.

Everything is computed from means and variances over windows of half a second. Honest noise (white, flicker, walks) is Gaussian with
stationary increments: its window variances and its differences of levels have one spread throughout, from which a disturbance stands out.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.findings import Finding

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_WINDOW_S = 0.5
_LEAST = 32  # samples of a window
_SIGMAS = 7.0  # of log variance, or of a level difference, above the quiet ones
_SKEW = 3.0  # at most, upper spread over lower
_LOUDER = 1.3  # times the quiet variance, at least
_JOIN_S = 2.0  # disturbances closer together are one
_SCALES_S = (4.0, 30.0, 240.0)  # over which levels before and after are averaged
_BLOCKS = 16  # of the test for one drift throughout
_T_DRIFT = 8.0  # its t value
_RESTLESS = 5.0  # scatter of window means over what the sample noise makes of them
_MOVING = (1e-2, 0.1)  # rad/s, m/s^2: at least this scatter of half-second means is called motion throughout
_MOVING_SHARE = 0.5  # of the windows
_MAD = 1.4826  # sigma of a normal distribution over its median absolute deviation


@dataclass(frozen=True)
class Windows:
    """Means and variances over windows of equal length, and how each axis is called."""

    t_s: Array  # (k + 1,) where each begins, and where the last ends
    mean: Array  # (k, c)
    variance: Array  # (k, c)
    white: Array  # (c,) variance of one sample's white noise, from first differences
    size: int  # samples of a window
    axes: tuple[str, ...]  # (c,) such as "gyroscope x"
    si: bool

    @property
    def step_s(self) -> float:
        """The typical length of a window."""
        return float(np.median(np.diff(self.t_s)))


class _Change(NamedTuple):
    """A change of a level, in windows."""

    first: int  # of the windows that it is judged from
    last: int
    drifts: bool
    begin: int
    end: int
    axis: int
    size: float


def windows(t_s: Array, values: dict[str, Array], rate_hz: float, si: bool) -> Windows:
    """Cut the samples (axis name -> (n,)) into windows."""
    size = max(round(_WINDOW_S * rate_hz), _LEAST)
    k = len(t_s) // size
    mean, variance = np.empty((k, len(values))), np.empty((k, len(values)))
    white = np.empty(len(values))
    for column, x in enumerate(values.values()):
        cut = x[: k * size].reshape(k, size)
        mean[:, column] = cut.mean(axis=1)
        variance[:, column] = cut.var(axis=1)
        white[column] = np.median(np.mean(np.diff(cut, axis=1) ** 2, axis=1)) / 2
    begins = np.append(t_s[: k * size : size], t_s[min(k * size, len(t_s) - 1)])
    return Windows(begins, mean, variance, white, size, tuple(values), si)


def check_motion(w: Windows) -> tuple[list[Finding], Mask]:
    """Find motion, and tell which windows are disturbed."""
    loud = _loudness(w)
    moved: Mask = np.any(loud > 1, axis=1)
    found = _throughout(w, moved)
    if found:
        return found, moved
    disturbed = _widened(moved, 1)
    for first, last in _runs(disturbed, _JOIN_S / w.step_s):
        axis = int(np.argmax(loud[first:last].max(axis=0)))
        times = float(np.sqrt(w.variance[first:last, axis].max() / np.quantile(w.variance[:, axis], 0.2)))
        text = f"motion: {w.axes[axis]} up to {times:.3g} times its quiet scatter"
        found.append(Finding("motion", text, float(w.t_s[first]), float(w.t_s[last]), cut=True))
        disturbed[first:last] = True
    return found, disturbed


def _loudness(w: Windows) -> Array:
    """Return by how much each window's variance exceeds the quiet ones', (k, c): 1 is the limit.

    Level and spread of the quiet ones are taken from the lower quantiles, which stay clean when most of the recording moves.
    """
    floor = np.maximum(w.variance.max(axis=0), np.finfo(float).tiny) * 1e-12
    log = np.log(np.maximum(w.variance, floor))
    lowest, low, middle, high = np.quantile(log, [0.05, 0.2, 0.5, 0.8], axis=0)
    spread = np.maximum((low - lowest) / 0.803, np.sqrt(2 / w.size))  # normal quantiles -1.645 and -0.842
    upward = np.clip((high - middle) / 0.842, spread, _SKEW * spread)  # noise correlated over the window has a long upper tail
    limit = np.maximum(_SIGMAS * upward, np.log(_LOUDER))
    loudness: Array = (log - (low + 0.842 * spread)) / limit
    return loudness


def _throughout(w: Windows, moved: Mask) -> list[Finding]:
    """Find that nothing is at rest: most windows are disturbed, or the means of all scatter more than the sample noise explains."""
    scatter = _MAD * np.median(np.abs(np.diff(w.mean, axis=0)), axis=0) if len(w.mean) > 1 else np.zeros(len(w.axes))
    restless = scatter > _RESTLESS * np.sqrt(2 * np.maximum(w.white, 1e-30) / w.size)
    if w.si:
        restless &= scatter > [_MOVING[axis.startswith("accel")] for axis in w.axes]
    if not restless.any() and np.mean(moved) <= _MOVING_SHARE:
        return []
    what = f"{w.axes[int(np.argmax(restless))]} never settles" if restless.any() else f"{100 * np.mean(moved):.0f} % of it are disturbed"
    return [Finding("moving", f"the recording is not at rest ({what}): lay the IMU on firm ground and leave it alone", *_ends(w))]


def check_levels(w: Windows, disturbed: Mask) -> list[Finding]:
    """Find steps and ramps of the level that no motion explains, as changes of temperature make them."""
    found: list[_Change] = []
    rounding = 100 * np.finfo(float).eps * np.abs(w.mean).max(axis=0) + 1e-30  # all that a stuck axis shows
    for scale_s in _SCALES_S:
        half = max(round(scale_s / w.step_s), 1)
        change, known = _change(w.mean - w.mean[0], half), ~_any_within(disturbed, 2 * half)
        if np.sum(known) < 20 * half:
            break
        middle = np.median(change[known], axis=0)
        spread = np.maximum(_MAD * np.median(np.abs(change[known] - middle), axis=0), rounding)
        limit = _SIGMAS * (1 + 4 / np.sqrt(np.sum(known) / half)) * spread  # a spread from few is itself uncertain
        excess = np.where(known[:, None], np.abs(change - middle) / limit, 0)
        for first, last in _runs(np.any(excess > 1, axis=1), 2 * half):
            peak, axis = np.unravel_index(int(np.argmax(excess[first:last])), (last - first, len(w.axes)))
            at = first + int(peak)
            begin, end = first if first == 0 else first + half // 2, min(last + 3 * half // 2, len(w.mean))
            drifts = last - first > 3 * half  # a step is seen over 2 half at most
            if not drifts:
                begin = at + _step_within(w.mean[at : at + 2 * half, axis])
                end = begin + 2
            seen = [c for c in found if c.first < last + 2 * half and first < c.last]
            if drifts:  # what a finer scale saw was its steepest part
                found = [c for c in found if c not in seen or not c.drifts]
            if drifts or not seen:
                found.append(_Change(first, last + 2 * half, drifts, begin, end, int(axis), float(change[at, axis])))
    return [_level_finding(w, c) for c in found] + _drift(w)


def _change(level: Array, half: int) -> Array:
    """Return the mean of `half` windows less that of the `half` before them, (k - 2 half + 1, c)."""
    total = np.cumsum(np.vstack([np.zeros(level.shape[1]), level]), axis=0)
    change: Array = (total[2 * half :] - 2 * total[half:-half] + total[: -2 * half]) / half
    return change


def _any_within(mask: Mask, length: int) -> Mask:
    """Tell which stretches of some length hold anything, (k - length + 1,)."""
    total = np.concatenate([[0], np.cumsum(mask)])
    within: Mask = total[length:] > total[:-length]
    return within


def _step_within(x: Array) -> int:
    """Return the window that holds the step in x, by maximum likelihood for white noise."""
    return int(np.argmax(np.abs(np.cumsum(x - x.mean())[:-1])))


def _level_finding(w: Windows, c: _Change) -> Finding:
    kind, verb = ("drift", "drifts") if c.drifts else ("step", "steps")
    text = f"{w.axes[c.axis]} {verb} by {c.size:.3g}{_unit(w, c.axis)}: a change of temperature, or was it touched?"
    # A drift through most of the recording cannot be cut out of it.
    return Finding(kind, text, float(w.t_s[c.begin]), float(w.t_s[c.end]), cut=not c.drifts or c.end - c.begin < len(w.mean) / 3)


def _drift(w: Windows) -> list[Finding]:
    """Find one drift throughout: the mean increment of blocks against the scatter of increments, which walks have too."""
    size = len(w.mean) // _BLOCKS
    if size < 4:
        return []
    blocks = w.mean[: size * _BLOCKS].reshape(_BLOCKS, size, -1).mean(axis=1)
    steps = np.diff(blocks, axis=0)
    t = np.abs(np.mean(steps, axis=0)) / np.maximum(np.std(steps, axis=0, ddof=1) / np.sqrt(len(steps)), 1e-30)
    an_hour = np.mean(steps, axis=0) * _BLOCKS / (w.t_s[-1] - w.t_s[0]) * 3600
    return [
        Finding("drift", f"{w.axes[axis]} drifts by {an_hour[axis]:.3g}{_unit(w, axis)} an hour throughout", *_ends(w))
        for axis in np.flatnonzero(t > _T_DRIFT).tolist()
    ]


def _unit(w: Windows, axis: int) -> str:
    return " counts" if not w.si else " m/s^2" if w.axes[axis].startswith("accel") else " rad/s"


def _ends(w: Windows) -> tuple[float, float]:
    return float(w.t_s[0]), float(w.t_s[-1])


def _widened(mask: Mask, by: int) -> Mask:
    return _any_within(np.pad(mask, by), 2 * by + 1)


def _runs(mask: Mask, join: float) -> list[tuple[int, int]]:
    """Return first and past-the-last of the runs of a mask; runs no more than `join` apart are one."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    runs: list[tuple[int, int]] = []
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if runs and first - runs[-1][1] <= join:
            runs[-1] = runs[-1][0], last
        else:
            runs.append((first, last))
    return runs
