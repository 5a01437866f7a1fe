"""What is wrong with a recording before anything is estimated from it: times, units, saturation, images.

Pure functions on arrays; each returns its findings, and `calibkit info` shows them all.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.plural import counted
from calibkit.estimation.stamps import StampReport, check_stamps
from calibkit.geometry import so3
from calibkit.models.imu import STANDARD_GRAVITY

Array = NDArray[np.float64]
Times = NDArray[np.int64]
G = STANDARD_GRAVITY.value

_GAP = 1.75  # periods; above, a sample or more is missing
_DAY_S = 86400  # clocks further apart do not count from the same epoch
_LONG_GAP_S = 0.2  # above, interpolation across a gap is a guess even for a hand-held rig
_MAX_HZ = 1e5  # above, no sensor of a rig
_JITTER, _NOTED = 0.07, 0.02  # of the period; rms of the stamps around a regular grid, above which it is a problem, and worth telling
_NOISY = 0.05  # of the period; above, a single interval that is off may be jitter beside a missing sample
_FAR = 6.0  # sigmas of jitter
_SHARE, _MANY = 0.01, 0.05  # of the samples that are missing: worth telling, a problem
_CLOCKS_S = 0.1  # latencies of two sensors differ by more: one clock is wrong
_FROZEN = 0.01  # share of samples that repeat the one before
_DARK = 0.08  # mean over full scale
_BLURRED = 0.4  # of the sharpest frames' sharpness
_MAD = 1.4826  # sigma of a normal distribution over its median absolute deviation


@dataclass(frozen=True)
class Finding:
    """One thing to know of a topic; `code` and `problem` are for machines."""

    code: str
    problem: bool  # False: a note
    text: str


def rate_hz(t_ns: Times) -> float | None:
    """Return the rate that the sensor ticks at, else that of the median interval; None where times do not advance."""
    steps = np.diff(t_ns)
    steps = steps[steps > 0]
    return check_stamps(t_ns).rate_hz or (float(1e9 / np.median(steps)) if len(steps) else None)


def check_times(t_ns: Times) -> list[Finding]:
    """Find disorder, duplicates, gaps, single wrong stamps, bursts and jitter in the times of one stream."""
    found = []
    report, rate = check_stamps(t_ns), rate_hz(t_ns)
    if rate is not None and rate > _MAX_HZ:
        found.append(Finding("rate", True, f"{rate:.3g} Hz is no sensor's rate: stamps in the wrong unit?"))
    steps = np.diff(t_ns) * 1e-9
    same = int(np.sum(steps == 0))
    if report.backward:
        stamps = counted(report.backward, "stamp goes", "stamps go")
        found.append(Finding("disorder", True, f"{stamps} back in time, by up to {-steps.min():.6g} s"))
    if same:
        found.append(Finding("duplicate", True, f"{counted(same, 'stamp repeats', 'stamps repeat')} the one before"))
    if rate is None or np.sum(steps > 0) < 10:
        return found
    if report.bursts:
        found.append(Finding("bursts", True, "stamps come in bursts: they are times of arrival, not of the sensor"))
    gaps = steps > max(_GAP / rate, 1 / rate + _FAR * 2**0.5 * (report.jitter_s or 0.0))
    return found + _gaps(t_ns, report, 1 / rate, gaps) + _uneven(steps[(steps > 0) & ~gaps], report, 1 / rate)


def _gaps(t_ns: Times, report: StampReport, period: float, gaps: NDArray[np.bool_]) -> list[Finding]:
    steps = np.diff(t_ns) * 1e-9
    if not gaps.any():
        return []
    longest = int(np.argmax(steps))
    at, length = (t_ns[longest] - t_ns[0]) * 1e-9, steps[longest]
    lost = int(np.sum(np.rint(steps[gaps] / period) - 1)) if report.empty is None else report.empty
    text = f"{counted(int(np.sum(gaps)), 'gap', 'gaps')}, about {counted(lost, 'sample')} missing"
    if report.missing_share >= _SHARE:
        text += f" ({100 * report.missing_share:.0f} % of {report.expected}, the rate is {1 / period:.4g} Hz)"
    problem = length > max(_LONG_GAP_S, 5 * period) or report.missing_share >= _MANY
    return [Finding("gap", bool(problem), f"{text}; the longest {length:.3g} s at {at:.3f} s from the start")]


def _uneven(steps: Array, report: StampReport, period: float) -> list[Finding]:
    """Find jitter, and intervals that are off the grid by far more than it."""
    if report.jitter_s is None:
        return []
    jitter, found = report.jitter_s, []
    off = np.abs(steps - period)
    limit = max(_FAR * _MAD * float(np.median(off)) if len(off) else 0.0, 0.25 * period)
    if (odd := int(np.sum(off > limit))) and jitter < _NOISY * period:
        found.append(Finding("irregular", True, f"{counted(odd, 'interval is', 'intervals are')} off by more than {limit:.3g} s"))
    if jitter >= _NOTED * period:
        text = f"stamps jitter by {jitter * 1e3:.2g} ms rms around {period * 1e3:.4g} ms"
        late = jitter >= _JITTER * period
        found.append(Finding("jitter", late, f"{text}: stamped on arrival?" if late else text))
    return found


def latency_s(header_ns: Times, record_ns: Times) -> float | None:
    """Return the median of record time minus header time, over stamps that are set."""
    stamped = header_ns != 0
    return float(np.median((record_ns - header_ns)[stamped]) * 1e-9) if stamped.any() else None


def check_headers(header_ns: Times, record_ns: Times) -> list[Finding]:
    """Find header stamps that are zero, on another clock than the recorder's, or drifting against it."""
    found = []
    zeros = int(np.sum(header_ns == 0))
    if zeros:
        found.append(
            Finding(
                "zero_stamp",
                True,
                f"{zeros} of {counted(len(header_ns), 'header stamp')} {'is' if zeros == 1 else 'are'} zero: record times are used instead",
            )
        )
    latency = latency_s(header_ns, record_ns)
    if latency is None:
        return found
    if -_DAY_S < latency < -1e-3:
        found.append(Finding("future_stamp", True, f"headers are {-latency:.4g} s after record times: stamped in the future"))
    elif abs(latency) > 1:
        found.append(Finding("other_clock", False, f"headers and record times are {abs(latency):.6g} s apart: another clock"))
    late = (record_ns - header_ns)[header_ns != 0] * 1e-9
    third = len(late) // 3
    duration = float(np.ptp(record_ns)) * 1e-9
    if third >= 30 and duration > 10:
        drift = float(np.median(late[-third:]) - np.median(late[:third])) / (duration * 2 / 3)
        scatter = _MAD * float(np.median(np.abs(late - np.median(late))))
        if abs(drift) > 100e-6 and abs(drift) * duration > max(5e-3, 2 * scatter):
            found.append(Finding("clock_drift", True, f"headers drift against record times by {drift * 1e6:.0f} ppm"))
    return found


def check_clocks(latencies: dict[str, float]) -> list[Finding]:
    """Find streams whose header clocks disagree, judged by their latencies against the one recorder."""
    if len(latencies) < 2:
        return []
    low, high = min(latencies, key=latencies.__getitem__), max(latencies, key=latencies.__getitem__)
    apart = latencies[high] - latencies[low]
    if apart < _CLOCKS_S:
        return []
    text = f"stamps of {high} lie {apart:.4g} s before those of {low}, both against record times: a wrong clock, or a slow driver"
    return [Finding("clocks_apart", True, text)]


def check_overlap(spans: dict[str, tuple[int, int]]) -> list[Finding]:
    """Find streams (name -> first and last time in ns) that share no time with the longest one."""
    if not spans:
        return []
    longest = max(spans, key=lambda name: spans[name][1] - spans[name][0])
    begin, end = spans[longest]
    apart = [name for name, (first, last) in spans.items() if last < begin or first > end]
    return [Finding("no_overlap", True, f"{name} shares no time with {longest}: another clock, or another recording") for name in apart]


def check_accel(accel: Array) -> list[Finding]:
    """Find accelerations that are not in m/s^2: at rest or on average |a| is g = 9.81 m/s^2."""
    norm = float(np.median(np.linalg.norm(accel, axis=1)))
    text = f"median |a| = {norm:.4g}"
    for unit, one_g in (("m/s^2", G), ("g", 1.0), ("mg", 1000.0)):
        if 0.8 * one_g < norm < 1.25 * one_g:
            if unit == "m/s^2":
                return [Finding("gravity", False, f"{text} m/s^2")]
            return [Finding("accel_unit", True, f"{text}: the accelerometer is in {unit}, not m/s^2")]
    if norm < 0.05 * G:
        return [Finding("no_gravity", True, f"{text}: gravity is missing (removed by the driver, or no accelerometer)")]
    return [Finding("accel_unit", True, f"{text}: neither m/s^2 (9.81) nor g (1): wrong unit or scale")]


def check_gyro_unit(t_ns: Times, gyro: Array, accel: Array, window_s: float = 0.25) -> list[Finding]:
    """Find a gyroscope in deg/s by how gravity's direction turns: |g x dg| over |integral of w across g| is 1 in rad/s, pi/180 in deg/s.

    Means over windows keep linear acceleration small; windows that turn too little or too much are left out.
    """
    seconds = (t_ns - t_ns[0]) * 1e-9 if len(t_ns) else np.zeros(0)
    window = np.maximum(seconds / window_s, 0).astype(np.int64)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    if len(starts) < 20 or np.any(np.diff(seconds) < 0):
        return []
    counts = np.diff(starts, append=len(window))[:, None]
    rate, down = np.add.reduceat(gyro, starts) / counts, np.add.reduceat(accel, starts) / counts
    down /= np.maximum(np.linalg.norm(down, axis=1, keepdims=True), 1e-12)
    middle = seconds[starts] + window_s / 2
    # Two windows on: the mean rate between their middles is that of the three, the outer ones by half.
    turn = np.linalg.norm(np.cross(down[:-2], down[2:]), axis=1)
    mean_rate = (rate[:-2] + 2 * rate[1:-1] + rate[2:]) / 4
    swept = np.linalg.norm(np.einsum("nij,nj->ni", so3.hat(down[1:-1]), mean_rate), axis=1) * (middle[2:] - middle[:-2])
    usable = (turn > 0.05) & (turn < 0.8) & (swept > 0)
    if np.sum(usable) < 10:
        return []
    ratio = float(np.median(turn[usable] / swept[usable]))
    if abs(np.log(ratio * 180 / np.pi)) < np.log(2.5):
        return [
            Finding("gyro_unit", True, f"gravity turns {1 / ratio:.0f} times slower than the gyroscope says: it is in deg/s, not rad/s")
        ]
    if not 0.4 < ratio < 2.5:
        return [Finding("gyro_scale", True, f"gravity turns {ratio:.3g} times as fast as the gyroscope says: wrong unit, axes or clock")]
    return []


def _clipped(column: Array, top: float) -> int:
    """Return how many samples sit at the extreme `top`, where that is clipping; else 0.

    Clipped: runs of 3 or more, and 5 times as many as at any of the next three values inside. The rounded top of a smooth,
    quantised peak holds at most 1 / (sqrt(2) - 1) = 2.4 times as many as the level below it.
    """
    levels, counts = np.unique(-np.abs(column - top), return_counts=True)
    at = column == top
    runs = np.diff(np.flatnonzero(np.diff(at, prepend=False, append=False)))[::2]
    clear = len(levels) > 3 and counts[-1] >= 5 * counts[-4:-1].max()
    return int(counts[-1]) if clear and runs.max() >= 3 else 0


def check_saturation(name: str, values: Array) -> list[Finding]:
    """Find axes that are clipped at their highest or lowest value."""
    if not len(values):
        return []
    ends = [(axis, column, top) for axis, column in zip("xyz", values.T, strict=True) for top in (column.min(), column.max())]
    clipped = [f"{axis} at {top:.6g} ({counted(count, 'sample')})" for axis, column, top in ends if (count := _clipped(column, top))]
    return [Finding("saturation", True, f"{name} is clipped: {', '.join(clipped)}")] if clipped else []


def check_frozen(values: Array) -> list[Finding]:
    """Find a sensor that repeats its last sample, as drivers do that run faster than their sensor."""
    repeated = np.all(values[1:] == values[:-1], axis=1)
    if len(repeated) < 10 or np.mean(repeated) < _FROZEN:
        return []
    return [
        Finding(
            "repeated",
            True,
            f"{100 * np.mean(repeated):.1f} % of the samples repeat the one before: the driver runs faster than the sensor",
        )
    ]


def sharpness(gray: NDArray[np.generic]) -> float:
    """Return the mean square of the Laplacian over that of the gradient: it falls with blur, and contrast cancels in it."""
    image = gray.astype(np.float32)
    across, down = np.diff(image, axis=1), np.diff(image, axis=0)
    gradient = float(np.mean(across**2) + np.mean(down**2))
    laplacian = np.diff(across, axis=1)[1:-1] + np.diff(down, axis=0)[:, 1:-1]
    return float(np.mean(laplacian**2)) / gradient if gradient > 0 else 0.0


def brightness(gray: NDArray[np.generic]) -> float:
    """Return the mean gray over full scale; of 16-bit images with 12 or fewer bits used, over the scale in use."""
    top = 255 if gray.dtype == np.uint8 else 2 ** max(8, int(gray.max(initial=0)).bit_length()) - 1
    return float(gray.mean()) / top


def _sampled(n: int, sample: Array) -> str:
    return f"{n} of {counted(len(sample), 'sampled image')} {'is' if n == 1 else 'are'}"


def check_images(bright: Array, sharp: Array) -> list[Finding]:
    """Find dark, overexposed and blurred images in a sample (brightness and sharpness of each)."""
    found = []
    dark, blown = int(np.sum(bright < _DARK)), int(np.sum(bright > 1 - _DARK))
    blurred = int(np.sum(sharp < _BLURRED * np.quantile(sharp, 0.9)))
    if dark:
        found.append(Finding("dark", bool(dark > len(bright) / 2), f"{_sampled(dark, bright)} dark (mean below {100 * _DARK:.0f} %)"))
    if blown:
        found.append(Finding("overexposed", bool(blown > len(bright) / 2), f"{_sampled(blown, bright)} overexposed"))
    if blurred:
        text = f"{_sampled(blurred, sharp)} blurred, by the measure of the sharpest"
        found.append(Finding("blur", bool(blurred > len(sharp) / 3), text))
    return found
