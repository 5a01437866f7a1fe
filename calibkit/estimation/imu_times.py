"""The stamps of a static IMU recording: its rate, and gaps, jitter, stamps that repeat or run backward."""

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples
from calibkit.data.plural import counted
from calibkit.errors import BadInputError
from calibkit.estimation.findings import Finding

Times = NDArray[np.int64]
Mask = NDArray[np.bool_]
_LEAST = 100  # samples; fewer are no recording to judge
_GAP = 1.75  # typical intervals; above, a sample or more is missing
_SPLIT_S, _SPLIT = 1.0, 1e-3  # a gap above both, the second a share of the duration, splits the recording
_JITTER = 0.1  # robust sigma of the interval over its median
_BURSTS = 2.0  # mean interval between long gaps over the typical one, above which the stamps are no sampling times
_MISSING = 0.01  # share of the samples, above which joining what lies around them changes the noise
_SHORT_S = 600.0  # below, flicker and walks are out of sight
_MAD = 1.4826  # sigma of a normal distribution over its median absolute deviation


def in_order(samples: ImuSamples) -> ImuSamples:
    """Return the samples in the order of their stamps; BadInputError where there is nothing to order."""
    n = len(samples.t_ns)
    if n < _LEAST:
        raise BadInputError(f"the IMU has {counted(n, 'sample')}: at least {_LEAST} are needed, and hours for an Allan deviation")
    if samples.t_ns.min() == samples.t_ns.max():
        raise BadInputError("all stamps of the IMU are the same: record with stamps, or state the rate (--rate HZ) of a text file")
    return samples if np.all(np.diff(samples.t_ns) >= 0) else samples.select(np.argsort(samples.t_ns, kind="stable"))


def rate_hz(t_ns: Times) -> float:
    """Return the samples per second between gaps, from stamps in order."""
    t_s = (t_ns - t_ns[0]) * 1e-9
    typical, bursts = _interval(t_s)
    steps = np.diff(t_s)
    kept = steps[steps <= _GAP * typical]  # repeated stamps count: their samples were taken, too
    return float(1 / typical) if bursts or not np.mean(kept) > 0 else float(1 / np.mean(kept))


def _interval(t_s: NDArray[np.float64]) -> tuple[float, bool]:
    """Return the typical interval in s, and whether it is the mean one: of stamps in bursts the typical one says nothing."""
    steps = np.diff(t_s)
    typical = float(np.median(steps[steps > 0]))
    between = steps[steps <= max(_SPLIT_S, _SPLIT * t_s[-1])]
    mean = float(np.mean(between)) if len(between) else typical
    return (mean, True) if mean > _BURSTS * typical else (typical, False)


def repeated(samples: ImuSamples) -> Mask:
    """Tell which samples repeat both the stamp and the values of the one before."""
    same = np.zeros(len(samples.t_ns), bool)
    same[1:] = np.diff(samples.t_ns) == 0
    for values in (samples.gyro, samples.accel):
        same[1:] &= np.all(values[1:] == values[:-1], axis=1)
    return same


def check_times(samples: ImuSamples, ordered: ImuSamples) -> list[Finding]:
    """Find what is wrong with the stamps; `samples` is as recorded, `ordered` the same in the order of time."""
    t_s = (ordered.t_ns - ordered.t_ns[0]) * 1e-9
    found = [*_backward(samples.t_ns, ordered.t_ns[0]), *_duplicates(ordered, t_s), *_gaps(t_s), *_jitter(t_s)]
    if t_s[-1] < _SHORT_S:
        text = f"lasts {t_s[-1]:.4g} s: enough for white noise at best, hours are needed for bias instability and random walk"
        found.append(Finding("short", text, 0.0, float(t_s[-1])))
    return found


def _backward(t_ns: Times, origin: np.int64) -> list[Finding]:
    at = np.flatnonzero(np.diff(t_ns) < 0)
    if not len(at):
        return []
    back = float(np.max(t_ns[at] - t_ns[at + 1])) * 1e-9
    text = f"{counted(len(at), 'stamp goes', 'stamps go')} back in time, by up to {back:.6g} s: the samples are put in order"
    seconds = (t_ns[at + 1] - origin).astype(np.float64) * 1e-9
    return [Finding("backward", text, *_span(seconds))]


def _duplicates(ordered: ImuSamples, t_s: NDArray[np.float64]) -> list[Finding]:
    again = repeated(ordered)
    same = np.zeros(len(t_s), bool)
    same[1:] = np.diff(t_s) == 0
    found = []
    if again.any():
        text = f"{counted(int(np.sum(again)), 'sample comes', 'samples come')} twice, stamp and values: taken once"
        found.append(Finding("duplicate", text, *_span(t_s[again]), cut=True))
    if (other := same & ~again).any():
        what = counted(int(np.sum(other)), "stamp repeats", "stamps repeat")
        text = f"{what} the one before with other values: a coarse clock, or stamped on arrival?"
        found.append(Finding("same_stamp", text, *_span(t_s[other])))
    return found


def _gaps(t_s: NDArray[np.float64]) -> list[Finding]:
    """A gap of G s in T s adds 3 G / T to a random walk's variance, less to other noise: short ones are kept."""
    steps = np.diff(t_s)
    typical, _ = _interval(t_s)
    spread = _MAD * float(np.median(np.abs(steps - typical)))
    missing = np.flatnonzero(steps > max(_GAP * typical, typical + 8 * spread))
    split = steps[missing] > max(_SPLIT_S, _SPLIT * t_s[-1])
    found = []
    for i in missing[split].tolist():
        text = f"a gap of {steps[i]:.3g} s, about {round(steps[i] / typical) - 1} samples missing"
        found.append(Finding("gap", text, float(t_s[i]), float(t_s[i + 1]), cut=True))
    if len(small := missing[~split]):
        lost = int(np.sum(np.rint(steps[small] / typical) - 1))
        share = lost / (len(t_s) + lost)
        gaps = counted(len(small), "short gap", "short gaps")
        text = f"{gaps} of up to {steps[small].max():.3g} s, about {counted(lost, 'sample')} missing: what lies around is joined"
        if share > _MISSING:  # the time of the whole is shorter by that share, so a walk seems faster
            text += f", which makes K some {1 / np.sqrt(1 - share) - 1:.1%} too large: record without losses"
        found.append(Finding("missing" if share > _MISSING else "short_gap", text, *_span(t_s[small])))
    return found


def _jitter(t_s: NDArray[np.float64]) -> list[Finding]:
    steps = np.diff(t_s)
    mean, bursts = _interval(t_s)
    if bursts:
        text = f"stamps come in bursts, or most samples are missing: the mean rate, {1 / mean:.4g} Hz, is taken for that of sampling"
        return [Finding("bursts", text, 0.0, float(t_s[-1]))]
    typical = float(np.median(steps))
    spread = _MAD * float(np.median(np.abs(steps - typical)))
    if spread < _JITTER * typical:
        return []
    text = f"stamps jitter: intervals scatter by {spread * 1e3:.3g} ms around {typical * 1e3:.4g} ms; even sampling is assumed"
    return [Finding("jitter", text, 0.0, float(t_s[-1]))]


def _span(t_s: NDArray[np.float64]) -> tuple[float, float]:
    return float(t_s.min()), float(t_s.max())
