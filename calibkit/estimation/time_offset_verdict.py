"""What a time offset is worth: whether the recording tells it at all, what spoils it, and the motion that would mend it."""

from dataclasses import dataclass

import numpy as np

from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.estimation.clock import describe
from calibkit.estimation.slow_turns import LONG_S
from calibkit.estimation.stamps import StampReport
from calibkit.estimation.stamps import describe as stamps_in_words
from calibkit.estimation.time_offset import TimeOffsetFit
from calibkit.estimation.time_offset_doubts import INVERSE, axes_apart, contrary, scale, unlike
from calibkit.solver.trust import SCALES, grade

ALIKE = 60.0  # chi-squared that turns in common must explain; noise alone, searched over every lag and rotation, reaches 40
_PRETENDED = 0.2  # of the information may be noise in the rates
_BOWL = 25.0  # chi-squared of the V's bottom below its sides
_STILL = 0.02  # rad/s; slower is standing still
_UNLIKE = 0.5  # of the turns may be left unexplained
_STRANGERS = 0.9
_LOST = 0.1  # of the turns may be outliers
_MOSTLY_LOST = 0.5
_MISSING = 0.05  # of the frames
_JITTER_S = 5e-4
_WORSE = 3.0  # sigma over that of independent residuals
_GOOD_CHANGE = 4.0  # rad/s^2 rms: 1 rad/s back and forth about every axis at 0.6 Hz
_SPARSE, _SPARSE_HZ = 0.67, 30.0  # of the other's rate
_MOTION = "turn the rig back and forth about two or more axes, 30 to 60 deg each way, once or twice a second, for 30 s"


@dataclass(frozen=True)
class Judged:
    """What is known of the offset."""

    status: Status
    size: Reason | None  # why it is weak or not observable
    fast: Reason | None  # that fast and slow motion disagree
    clock: tuple[Reason, ...]  # that it is not one number
    turns: tuple[Reason, ...]  # what else their residuals say
    stamps: tuple[Reason, ...]
    coarse: bool = False  # not observable only for its sigma: still a start for what else tells it

    @property
    def reasons(self) -> tuple[Reason, ...]:
        return (*(reason for reason in (self.size, self.fast) if reason is not None), *self.clock, *self.turns, *self.stamps)


def judge_time_offset(name: str, of: str, to: str, fit: TimeOffsetFit, stamps: dict[str, StampReport]) -> Judged:
    """Return status and reasons of `name` = dt_to_of."""
    found = [(sensor, text) for sensor, report in stamps.items() for text in stamps_in_words(report, _MISSING, _JITTER_S)]
    spoilt = tuple(Reason(Verdict.CHECK, f"{sensor}: {text}") for sensor, text in found)
    sizes = scale(of, to, fit)
    why, known = _not_observable(of, to, fit), Status(grade(fit.sigma / SCALES["s"]))
    coarse = not why and known is Status.NOT_OBSERVABLE
    if coarse:
        why = f"its sigma would be {fit.sigma * 1e3:.2g} ms; {_advice(fit)}"
        if (share := unlike(fit)) > _UNLIKE:
            apart = f"{100 * share:.0f} % of the turns is not common to {of} and {to}"
            why = f"{apart}: are both on one rigid body, in one recording? If so, {why}"
    if why:
        wrong = [text for verdict, text in sizes if verdict is Verdict.FAIL]  # what makes a fit bad is the reason, and no lack of motion
        size = Reason(Verdict.FAIL, f"{name}: not observable: {wrong[0] if wrong else why}")
        return Judged(Status.NOT_OBSERVABLE, size, None, (), (), spoilt, coarse)
    weak = f"{name}: weak: known to {fit.sigma * 1e3:.2g} ms only; {_advice(fit)}"
    frame_hz, to_hz = (stamps[sensor].rate_hz if sensor in stamps else None for sensor in (of, to))
    clock, turns = (
        tuple(Reason(verdict, f"{name}: {text}") for verdict, text in found)
        for found in (_of_clock(to, fit, frame_hz), [*_doubts(of, to, fit), *sizes, *_sparse(of, to, frame_hz, to_hz)])
    )
    return Judged(
        known,
        Reason(Verdict.CHECK, weak) if known is Status.WEAK else None,
        _fast_and_slow(name, of, to, fit),
        clock,
        turns,
        spoilt,
    )


def _fast_and_slow(name: str, of: str, to: str, fit: TimeOffsetFit) -> Reason | None:
    if fit.by_fast_turns is None:
        return None
    fast, sigma = fit.by_fast_turns
    other = f"{fast * 1e3:+.3f} +- {sigma * 1e3:.2g} ms"
    text = f"fast and slow motion disagree: turns of {LONG_S:.1f} s say {fit.td * 1e3:+.3f} ms, those from stamp to stamp {other}"
    return Reason(Verdict.CHECK, f"{name}: {text}: either may be off by as much; look for a filter, blur or vibration in {of} or {to}")


def _sparse(of: str, to: str, frame_hz: float | None, to_hz: float | None) -> list[tuple[Verdict, str]]:
    if not frame_hz or not to_hz or to_hz >= min(_SPARSE * frame_hz, _SPARSE_HZ):
        return []
    text = f"{to} comes at {to_hz:.3g} Hz only: what it does between its samples may bend td by 0.1 ms and more"
    return [(Verdict.CHECK, f"{text}; give it as --of and {of} as --to")]


def rates(fit: TimeOffsetFit) -> tuple[float, float]:
    """Return the median and the greatest rate of the turns, rad/s (99.5th percentile: not an outlier's)."""
    turns = [part.stretch.turns for part in fit.alignment.parts]
    rate = np.concatenate([np.linalg.norm(each.angle, axis=1) / each.duration for each in turns])
    return float(np.median(rate)), float(np.percentile(rate, 99.5))


def _not_observable(of: str, to: str, fit: TimeOffsetFit) -> str:
    """Say why the recording does not tell the offset, or nothing."""
    track = fit.alignment.track
    known = track.rate[track.chain >= 0]
    middle, fast = rates(fit)
    change = _change(fit)
    if fit.gain >= ALIKE and fit.depth >= _BOWL and fit.noise_share > _PRETENDED:
        return (
            f"{100 * fit.noise_share:.0f} % of what seems to tell it is the noise of {to}'s rates: turn faster, or give less noisy ones "
            f"(--of {to} --to {of} if {of} is less noisy)"
        )
    if fit.gain < ALIKE or fit.depth < _BOWL:
        if fast < _STILL or float(np.median(np.linalg.norm(known, axis=1))) < _STILL:
            return f"the rig hardly turns ({middle:.2g} rad/s in the middle): at rest every offset fits alike; {_MOTION}"
        if change > 0.3 and (fit.gain < ALIKE or unlike(fit) > _UNLIKE):
            return (
                f"{of} and {to} never turn alike at any offset: are both on one rigid body, do they overlap in time, is a topic wrong, "
                f"or are {INVERSE}?"
            )
        return f"the rate of turn hardly changes (about {middle:.2g} rad/s): a constant rate fits every offset alike; {_MOTION}"
    if not 1 < int(np.argmin(fit.cost)) < len(fit.cost) - 2:
        return f"the V has no bottom within {np.ptp(fit.tau) * 500:.0f} ms of {fit.td * 1e3:+.1f} ms: the two streams do not fit together"
    if fit.second is not None:
        both = f"{fit.second * 1e3:+.3f} ms fits as well as {fit.td * 1e3:+.3f} ms"
        return f"{both}: the motion repeats itself; turn irregularly, about several axes"
    return ""


def _change(fit: TimeOffsetFit) -> float:
    """Return the rms of d omega / dt over the track, rad/s^2, its noise included."""
    track = fit.alignment.track
    every = max(1, round(0.1 / track.step))
    rate, there = track.rate[::every], track.chain[::every] >= 0
    steps = np.diff(rate, axis=0)[there[1:] & there[:-1]] / (every * track.step)
    return float(np.sqrt(np.mean(np.sum(steps**2, axis=1)))) if len(steps) else 0.0


def _advice(fit: TimeOffsetFit) -> str:
    """Name the motion to add, and what it would bring: sigma goes with 1 / (rms of d omega / dt)."""
    better = fit.sigma * min(1.0, _change(fit) / _GOOD_CHANGE)
    return (
        f"{_MOTION}; that would tell it to about {better * 1e3:.1g} ms"
        if better < 0.7 * fit.sigma
        else f"record longer: four times as long halves it; {_MOTION}"
    )


def _of_clock(to: str, fit: TimeOffsetFit, frame_hz: float | None) -> list[tuple[Verdict, str]]:
    clock = fit.clock
    if clock is None or clock.kind == "constant":
        return []
    verdict = Verdict.FAIL if clock.jumps else Verdict.CHECK
    return [(verdict, f"{text}; one number does not hold throughout") for text in describe(clock, to, frame_hz)]


def _doubts(of: str, to: str, fit: TimeOffsetFit) -> list[tuple[Verdict, str]]:
    found = []
    if fit.alignment.levels.jitter > _JITTER_S**2:
        jitter = float(np.sqrt(fit.alignment.levels.jitter)) * 1e3
        text = f"the residuals of {of} grow with the rate as if its stamps jittered by {jitter:.2g} ms"
        found.append((Verdict.CHECK, f"{text}; or those of {to} do, or it is worse in fast motion"))
    if (share := unlike(fit)) > _UNLIKE:
        verdict = Verdict.FAIL if share > _STRANGERS else Verdict.CHECK
        found.append((verdict, f"{of} and {to} turn only partly alike: {100 * share:.0f} % of the turns is noise, or {INVERSE}"))
    lost = 1 - sum(int(keep.sum()) for keep in fit.alignment.keep) / max(fit.n_turns, 1)
    if lost > _LOST:
        verdict = Verdict.FAIL if lost > _MOSTLY_LOST else Verdict.CHECK
        found.append((verdict, f"{100 * lost:.0f} % of the turns of {of} contradict {to} and were given up: look at its poses"))
    if fit.lost > _LOST:
        found.append((Verdict.CHECK, f"{100 * fit.lost:.0f} % of the turns of {of} fall into gaps of {to} and tell nothing"))
    if not fit.alignment.converged:
        found.append((Verdict.FAIL, "the fit did not settle: the two streams do not fit together"))
    found += [(Verdict.FAIL, text) for text in contrary(of, to, fit)]
    factor = float(fit.covariance.factors[0]) * float(np.sqrt(fit.covariance.variance_factor))
    if factor > _WORSE:
        text = f"it wanders within the recording by more than noise explains: its sigma is {factor:.1f} times that of independent residuals"
        found.append((Verdict.CHECK, text))
    found += [(Verdict.CHECK, text) for text in axes_apart(of, fit)]
    return found
