"""The values of a static IMU recording: quantisation, clipping, repeated samples, units, and lines in the spectrum."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.stats import chi2

from calibkit.data.plural import counted
from calibkit.estimation.findings import Finding
from calibkit.models.imu import STANDARD_GRAVITY

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
G = STANDARD_GRAVITY.value
_SAMPLE = 2**16  # values that a step is looked for in
_TOLD = 0.05  # noise sigmas; smaller steps do not matter
_RESOLVED = 0.5  # steps of noise; below, the noise cannot carry what lies between two steps
_EVEN = 0.05  # steps; how far differences may lie from whole steps, as decimals of a text file round them
_REPEATED = 0.01  # share of samples, beyond chance
_LOUD_GYRO = 3e-3  # rad/s/sqrt(Hz): 4 times the loudest gyroscopes'
_SEGMENT = 4096  # samples of a spectrum
_LEAST_SEGMENTS = 4
_LOW = 8  # bins; below, flicker noise is too steep for a level around each bin
_AROUND = 32  # bins on each side, for the level around a line
_LINE = 3.0  # times the level around, at least
_CHANCE = 1e-12  # that noise makes a bin a line
_LINES = 5  # at most


def step_of(x: Array) -> float | None:
    """Return the step between the values; None where they lie on no even grid."""
    levels = np.unique(x[:_SAMPLE])
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * max(float(np.abs(levels).max()), 1e-300)]  # not the last bit of one level
    if len(gaps) < 2:
        return float(gaps[0]) if len(gaps) else None
    smallest = float(np.quantile(gaps, 0.01))
    steps = np.rint(gaps / smallest)
    step = float(np.sum(gaps) / np.sum(steps))
    even = np.abs(gaps / step - np.rint(gaps / step)) < _EVEN * np.maximum(1, np.rint(gaps / step))
    # Chance makes any gaps look even once the smallest is small beside them all.
    return step if np.mean(even) > 0.99 and np.median(steps) <= 3 else None


def check_quantisation(name: str, unit: str, axes: dict[str, Array], end_s: float) -> list[Finding]:
    """Find the step of a sensor's values, and whether its noise resolves it."""
    found = []
    for axis, x in axes.items():
        if x.min() == x.max():
            found.append(Finding("frozen", f"{axis} never changes ({x[0]:.6g}{unit})", 0.0, end_s))
    steps = {axis: step for axis, x in axes.items() if (step := step_of(x)) is not None}
    told = {axis: (step, noise / step) for axis, step in steps.items() if step > _TOLD * (noise := _white(axes[axis]))}
    if told:
        step = float(np.median([step for step, _ in told.values()]))
        least = min(ratio for _, ratio in told.values())
        where = name if len(told) == len(axes) else ", ".join(told)
        kind, verdict = ("quantisation", "which resolves them") if least >= _RESOLVED else ("unresolved", "NOT resolved: less is hidden")
        text = f"{where}: values come in steps of {step:.5g}{unit}; the noise is {least:.2g} steps, {verdict}"
        found.append(Finding(kind, text, 0.0, end_s))
    return found


def _white(x: Array) -> float:
    """Return the sigma of a sample's white noise, by first differences."""
    return float(np.std(np.diff(x[:_SAMPLE])) / np.sqrt(2))


def check_saturation(axes: dict[str, Array], t_s: Array) -> list[Finding]:
    """Find axes clipped at an end: its value comes 5 times as often as any of the next three inside, thrice in a row or more.

    The rounded top of a smooth, quantised peak holds at most 1 / (sqrt(2) - 1) = 2.4 times as many as the level below it.
    """
    found = []
    for axis, x in axes.items():
        for sign in (1.0, -1.0):
            y = x if sign > 0 else -x
            top = y.max()
            at = np.flatnonzero(y == top)
            if len(at) < 3 or len(at) == len(y) or not np.any(at[2:] - at[:-2] == 2):
                continue
            inside, counts = top, []
            for _ in range(3):
                below = y[y < inside]
                if not len(below):
                    break
                inside = below.max()
                counts.append(int(np.sum(y == inside)))
            if len(counts) == 3 and len(at) >= 5 * max(counts):
                text = f"{axis} is clipped at {sign * top:.6g} ({counted(len(at), 'sample')}): choose a larger range"
                found.append(Finding("saturation", text, float(t_s[at[0]]), float(t_s[at[-1]])))
    return found


def check_repeats(axes: dict[str, Array], end_s: float) -> list[Finding]:
    """Find a driver that runs faster than its sensor: all axes repeat at once more often than each by itself explains."""
    again = [x[1:] == x[:-1] for x in axes.values()]
    together = float(np.mean(np.logical_and.reduce(again)))
    chance = float(np.prod([np.mean(axis) for axis in again]))
    if together < _REPEATED + 10 * chance:
        return []
    text = f"{100 * together:.1f} % of the samples repeat the one before: the driver runs faster than the sensor"
    return [Finding("repeated", text, 0.0, end_s)]


def check_gravity(accel: Array, end_s: float) -> list[Finding]:
    """Find an accelerometer at rest that does not feel 9.8 m/s^2."""
    norm = float(np.linalg.norm(np.median(accel, axis=0)))
    if 0.8 * G < norm < 1.25 * G:
        return []
    guess = next((unit for unit, one_g in (("g", 1.0), ("mg", 1000.0)) if 0.8 * one_g < norm < 1.25 * one_g), None)
    if guess:
        text = f"|a| at rest is {norm:.4g}, not 9.81 m/s^2: is it in {guess}? then add --accel-unit {guess}"
    elif norm < 0.05 * G:
        text = f"|a| at rest is {norm:.3g} m/s^2: gravity is missing (removed by the driver?)"
    else:
        text = f"|a| at rest is {norm:.4g}, neither 9.81 m/s^2 nor 1 g: another unit, a wrong scale, or raw counts (--accel-unit)"
    return [Finding("accel_unit", text, 0.0, end_s)]


def check_gyro_noise(axes: dict[str, Array], rate_hz: float, end_s: float) -> list[Finding]:
    """Find a gyroscope so loud that its values can hardly be rad/s."""
    density = float(np.median([_white(x) for x in axes.values()])) / np.sqrt(rate_hz)
    if density < _LOUD_GYRO:
        return []
    text = f"the gyroscope's noise, {density:.2g} rad/s/sqrt(Hz), is that of none: is it in deg/s? then add --gyro-unit deg/s"
    return [Finding("gyro_unit", text, 0.0, end_s)]


def check_vibration(axes: dict[str, Array], t_s: Array, rate_hz: float, quiet: Mask, unit: dict[str, str]) -> list[Finding]:
    """Find lines in the spectrum: frequency, amplitude and axes; `quiet` tells which samples are undisturbed."""
    segments = len(t_s) // _SEGMENT
    use = quiet[: segments * _SEGMENT].reshape(segments, _SEGMENT).all(axis=1)
    if np.sum(use) < _LEAST_SEGMENTS:
        return []
    hann = np.hanning(_SEGMENT)
    limit = max(float(chi2.isf(_CHANCE, 2 * np.sum(use))) / (2 * float(np.sum(use))), _LINE)
    lines: list[tuple[float, float, float, str]] = []  # strength, bin, amplitude, axis
    for axis, x in axes.items():
        cut = x[: segments * _SEGMENT].reshape(segments, _SEGMENT)[use]
        power = np.zeros(_SEGMENT // 2 + 1)
        for some in np.array_split(cut, max(1, len(cut) // 64)):
            power += np.sum(np.abs(np.fft.rfft((some - some.mean(axis=1, keepdims=True)) * hann, axis=1)) ** 2, axis=0)
        power /= len(cut)
        below, above = _around(power)
        ratio = np.where(np.arange(len(power)) < _LOW, 0, power / np.maximum(np.maximum(below, above), 1e-300))  # a slope is no line
        ratio[-2:] = 0  # the Nyquist frequency has half the degrees of freedom
        for peak in np.flatnonzero((ratio > limit) & (ratio >= np.roll(ratio, 1)) & (ratio > np.roll(ratio, -1))).tolist():
            near = slice(max(peak - 3, 0), peak + 4)
            excess = np.maximum(power[near] - (below[near] + above[near]) / 2, 0)
            # A line of amplitude A leaves (A / 2)^2 sum(hann)^2 in its bin, and A^2 / 4 N sum(hann^2) in all of them.
            amplitude = float(np.sqrt(4 * np.sum(excess) / (_SEGMENT * np.sum(hann**2))))
            centre = float(np.sum(excess * np.arange(near.start, near.stop)[: len(excess)]) / np.sum(excess))
            lines.append((float(ratio[peak]), centre, amplitude, axis))
    return _told_lines(sorted(lines, reverse=True), rate_hz / _SEGMENT, float(t_s[-1]), unit)


def _around(power: Array) -> tuple[Array, Array]:
    """Return the level below and above each bin, as medians."""
    flat = power.copy()
    flat[:2] = flat[2]  # what subtracting the mean took away
    half, apart = _AROUND // 2, 3  # a line itself fills the bins nearest to it
    medians = median_filter(flat, _AROUND, mode="nearest")  # over k - half .. k + half - 1
    at = np.arange(len(flat))
    return medians[np.maximum(at - half - apart, 0)], medians[np.minimum(at + half + apart, len(flat) - 1)]


def _told_lines(lines: list[tuple[float, float, float, str]], bin_hz: float, end_s: float, unit: dict[str, str]) -> list[Finding]:
    """Gather each frequency's axes; the strongest frequencies first."""
    found: list[Finding] = []
    while lines and len(found) < _LINES:
        centre = lines[0][1]
        same = [line for line in lines if abs(line[1] - centre) < 4]
        lines = [line for line in lines if abs(line[1] - centre) >= 4]
        best: dict[str, float] = {}
        for _, _, amplitude, axis in same:
            best.setdefault(axis, amplitude)
        listed = ", ".join(f"{axis} {amplitude:.3g}{unit[axis]}" for axis, amplitude in best.items())
        found.append(Finding("vibration", f"vibration at {centre * bin_hz:.2f} Hz, amplitude {listed}", 0.0, end_s))
    return found
