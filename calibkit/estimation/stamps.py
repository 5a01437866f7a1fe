"""The stamps of one stream against the regular grid that its sensor ticked on: period, missing ones, repeats, jitter, bursts.

The period is found in the phases of intervals, exp(2 pi i d / P), which neither missing stamps nor jitter of a fifth of it hide; the
jitter is what is left in short blocks, each with a phase of its own, so that a drifting or jumping clock does not count as jitter.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.plural import counted, plain

Array = NDArray[np.float64]
Times = NDArray[np.int64]

_LEAST = 10  # stamps; fewer are no grid
_BLOCK = 32  # stamps that share a phase
_MANY = 20_000  # intervals that are enough to tell the period
_UNSET_S = 1000.0  # a zero stamp so far before all others is none
_ALONE_S, _ALONE = 1.0, 100.0  # seconds and median intervals: few stamps with longer pauses on either side are wrong
_FEW, _FEW_SHARE = 3, 0.01  # at once, and of all
_LONG_S, _LONG = 1.0, 1e-3  # intervals above both, the second a share of the duration, are gaps of the recording
_FINEST, _COARSEST = 1 / 8, 2.0  # of the median interval: periods that are tried
_ALIKE = 0.8  # of the best coherence; a multiple of the best period that is as coherent is the period
_COHERENT = 0.3  # mean resultant length of a block; jitter of a quarter of the period leaves 0.29, no grid 0.16
_BURST, _IN_BURSTS = 0.2, 0.4  # of the mean interval; share of intervals below it
_TOLD = 0.005  # of the period: less jitter is not worth a sentence
_MAD = 1.4826  # sigma of a normal distribution over its median absolute deviation
_FAR = 4.0  # sigmas: stamps further off are wrong, and no jitter


@dataclass(frozen=True)
class StampReport:
    """What the stamps of a stream say of themselves; None where they follow no grid."""

    count: int
    period_s: float | None  # of the sensor, also where most of its frames are missing
    empty: int | None  # ticks of the grid without a stamp, from the first stamp to the last
    duplicates: int  # stamps that another frame has, too
    zeros: int  # stamps that are not set
    far: int  # stamps far off all others, such as those of another clock
    far_s: float  # by how much, at most
    backward: int  # stamps before the one before
    jitter_s: float | None  # rms of the stamps around the grid
    jitter_sigma_s: float | None
    bursts: bool  # several at once, then none: times of arrival
    noun: str = "frame"  # what has a stamp

    @property
    def rate_hz(self) -> float | None:
        return None if self.period_s is None else 1 / self.period_s

    @property
    def missing(self) -> int:
        """Ticks without a frame, 0 where that is not known: a frame with a repeated, zero or wild stamp was one, too."""
        return max(0, (self.empty or 0) - self.duplicates - self.zeros - self.far)

    @property
    def expected(self) -> int:
        """Frames with those that are missing."""
        return self.count + self.missing

    @property
    def missing_share(self) -> float:
        return self.missing / max(self.expected, 1)


def check_stamps(t_ns: Times, noun: str = "frame") -> StampReport:
    """Return what the stamps (n,) of a stream, in the order of the recording, say of themselves; `noun` is what has a stamp."""
    zeros = _unset(t_ns)
    stamps = t_ns[~zeros]
    far, far_s = _far_off(stamps)
    stamps = stamps[~far]
    t_s = _seconds(stamps)
    backward = int(np.sum(np.diff(stamps) < 0))
    bursts = _in_bursts(t_s)
    period = _period(t_s) if len(t_s) >= _LEAST and not bursts else None
    empty = jitter = sigma = None
    if period is not None:
        offset, coherence = _phases(t_s, period)
        ticks = int(np.rint(t_s[-1] / period - offset[-1]) - np.rint(t_s[0] / period - offset[0])) + 1
        if coherence < _COHERENT:
            period = None
        else:
            empty = max(0, ticks - len(t_s))
            jitter, sigma = _jitter(t_s, period, offset)
    return StampReport(
        count=len(t_ns),
        period_s=period,
        empty=empty,
        duplicates=len(stamps) - len(t_s),
        zeros=int(np.sum(zeros)),
        far=int(np.sum(far)),
        far_s=far_s,
        backward=backward,
        jitter_s=jitter,
        jitter_sigma_s=sigma,
        bursts=bursts,
        noun=noun,
    )


def come_in_bursts(t_ns: Times) -> bool:
    """Whether stamps (n,) are times of arrival: several at once, then none."""
    stamps = t_ns[~_unset(t_ns)]
    return _in_bursts(_seconds(stamps[~_far_off(stamps)[0]]))


def _seconds(stamps: Times) -> Array:
    """Return different stamps in order, in s from the first."""
    ordered = np.sort(stamps)
    unique = ordered[np.diff(ordered, prepend=ordered[:1] - 1) != 0]
    return np.asarray((unique - unique[0]) * 1e-9 if len(unique) else np.zeros(0), np.float64)


def _unset(t_ns: Times) -> NDArray[np.bool_]:
    zero = t_ns == 0
    others = t_ns[~zero]
    return zero if len(others) == 0 or np.min(np.abs(others)) > _UNSET_S * 1e9 else np.zeros(len(t_ns), np.bool_)


def _far_off(t_ns: Times) -> tuple[NDArray[np.bool_], float]:
    """Return which stamps (n,) lie alone or nearly so, far off all others, and how far at most, s."""
    order = np.argsort(t_ns, kind="stable")
    steps = np.diff(t_ns[order].astype(float)) * 1e-9  # of any int64 without overflow
    far: NDArray[np.bool_] = np.zeros(len(t_ns), np.bool_)
    if len(t_ns) < _LEAST:
        return far, 0.0
    piece = np.concatenate([[0], np.cumsum(steps > max(_ALONE_S, _ALONE * float(np.median(steps))))])
    size = np.bincount(piece)
    far[order] = (size <= _FEW)[piece]
    if not 0 < far.sum() <= max(_FEW, _FEW_SHARE * len(far)):
        return np.zeros(len(t_ns), np.bool_), 0.0
    wild, others = t_ns[far].astype(float), np.sort(t_ns[~far].astype(float))
    after = np.clip(np.searchsorted(others, wild), 1, len(others) - 1)
    apart = np.minimum(np.abs(wild - others[after - 1]), np.abs(wild - others[after]))
    return far, float(apart.max()) * 1e-9


def _between_gaps(t_s: Array) -> Array:
    steps = np.diff(t_s)
    out: Array = steps[steps <= max(_LONG_S, _LONG * t_s[-1])]
    return out


def _in_bursts(t_s: Array) -> bool:
    if len(t_s) < _LEAST or not len(steps := _between_gaps(t_s)):
        return False
    return bool(np.mean(steps < _BURST * np.mean(steps)) > _IN_BURSTS)


def _period(t_s: Array) -> float:
    """Return the period of the grid: the largest that the intervals are whole multiples of, sharpened over ever longer spans."""
    steps = np.diff(t_s)[:: max(1, len(t_s) // _MANY)]
    typical = float(np.median(steps))
    steps = steps[steps < 8 * typical]
    tried = typical * np.geomspace(_FINEST, _COARSEST, 500)
    coherence = np.array([_coherence(steps, period) for period in tried])
    best = float(tried[np.argmax(coherence)])
    multiples = [
        best * m
        for m in range(1, round(_COARSEST / _FINEST) + 1)
        if best * m <= tried[-1] and _coherence(steps, best * m) >= _ALIKE * coherence.max()
    ]
    period, lag = multiples[-1], 1
    while lag <= min(2 * _BLOCK, len(t_s) // 4):
        first = np.arange(0, len(t_s) - lag, max(1, len(t_s) // _MANY))
        spans = t_s[first + lag] - t_s[first]
        spans = spans[spans < 8 * typical * lag] / period
        turn = np.angle(np.mean(np.exp(2j * np.pi * spans))) / (2 * np.pi)
        off = spans - turn
        off -= np.rint(off)
        apart = np.abs(off - np.median(off))  # spans across a jump are far off, all on one side
        turn += np.mean(off[apart <= _FAR * _MAD * np.median(apart)])
        period *= 1 + float(turn / np.mean(spans))
        lag *= 2
    return period


def _coherence(steps: Array, period: float) -> float:
    """Return 1 where all steps are multiples of the period, 0 for any steps, -1 for halves."""
    return float(np.mean(np.cos(2 * np.pi / period * steps)))


def _phases(t_s: Array, period: float) -> tuple[Array, float]:
    """Return the grid's offset at each stamp in periods (n,), the same within a block, and the mean coherence of a block."""
    block = np.minimum(np.arange(len(t_s)) // _BLOCK, max(len(t_s) // _BLOCK, 1) - 1)
    phasor = np.exp(2j * np.pi * (t_s / period))
    mean = (np.bincount(block, phasor.real) + 1j * np.bincount(block, phasor.imag)) / np.bincount(block)
    offset: Array = np.unwrap(np.angle(mean))[block] / (2 * np.pi)
    return offset, float(np.mean(np.abs(mean)))


def _jitter(t_s: Array, period: float, offset: Array) -> tuple[float, float]:
    """Return the rms of the stamps around the grid in s, and its sigma; wrong stamps and blocks in which the clock jumps apart."""
    off = t_s / period - offset
    off = (off - np.rint(off)) * period
    _, block = np.unique(offset, return_inverse=True)
    square = np.bincount(block, off**2) / np.bincount(block)
    off = off[(square <= _FAR**2 * np.median(square))[block]]
    spread = _MAD * float(np.median(np.abs(off)))
    good = off[np.abs(off) <= _FAR * spread] if spread > 0 else off
    freedom = len(good) * (1 - 1 / _BLOCK)  # each block has a phase of its own
    rms = float(np.sqrt(np.sum(good**2) / max(freedom, 1)))
    return rms, rms / float(np.sqrt(2 * max(freedom, 1)))


def describe(report: StampReport, from_share: float = 0.0, from_jitter_s: float = 0.0) -> list[str]:
    """Return what is wrong with the stamps, in sentences; both sizes are the least that is told."""
    said, noun = [], report.noun
    rate = f", the rate is {report.rate_hz:.4g} Hz" if report.rate_hz else ""
    if report.missing and report.missing_share >= from_share:
        said.append(f"{plain(100 * report.missing_share, 3)} % of the {noun}s are missing ({report.missing} of {report.expected}){rate}")
    if report.duplicates:
        said.append(f"{counted(report.duplicates, f'{noun} has', f'{noun}s have')} the stamp of another")
    if report.zeros:
        said.append(f"{counted(report.zeros, f'{noun} has', f'{noun}s have')} a stamp of zero")
    if report.far:
        said.append(f"{counted(report.far, f'{noun} has a stamp', f'{noun}s have stamps up to')} {_long(report.far_s)} off all others")
    if report.backward:
        said.append(f"{counted(report.backward, 'stamp goes', 'stamps go')} back in time")
    if report.period_s and report.jitter_s and report.jitter_sigma_s and report.jitter_s > max(_TOLD * report.period_s, from_jitter_s):
        size = f"{plain(report.jitter_s * 1e3, 2)} +- {plain(report.jitter_sigma_s * 1e3, 1)}"
        said.append(f"stamps jitter by {size} ms rms around a regular grid{rate if not report.missing else ''}")
    if report.bursts:
        said.append("stamps come in bursts: they are times of arrival, not of the sensor")
    return said


def _long(seconds: float) -> str:
    """Return a duration in the largest unit that it fills."""
    for unit, size in (("years", 365.25 * 86400), ("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= size:
            return f"{plain(seconds / size, 3)} {unit}"
    return f"{plain(seconds, 3)} s"
