"""What a time offset is worth: whether the recording tells it at all, what spoils it, and the motion that would mend it."""

from dataclasses import dataclass

import numpy as np

from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.estimation.alignment import axis_offsets, length_of_axis, turned_by
from calibkit.estimation.clock import describe
from calibkit.estimation.slow_turns import LONG_S
from calibkit.estimation.stamps import StampReport
from calibkit.estimation.stamps import describe as stamps_in_words
from calibkit.estimation.time_offset import TimeOffsetFit
from calibkit.estimation.turn_comparison import raw_residuals
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import SCALES, grade

_ALIKE = 60.0  # chi-squared that turns in common must explain; noise alone, searched over every lag and rotation, reaches 40
_PRETENDED = 0.2  # of the information may be noise in the rates
_BOWL = 25.0  # chi-squared of the V's bottom below its sides
_STILL = 0.02  # rad/s; slower is standing still
_UNLIKE = 0.5  # of the turns may be left unexplained
_STRANGERS = 0.9
_SCALE, _OTHER_UNIT = 0.03, 0.2  # of the turns' sizes
_SURE = 10.0  # sigmas
_ALIKE_IN_FORM = 0.5  # squared correlation; of strangers' turns no scale is told
_LOST = 0.1  # of the turns may be outliers
_MOSTLY_LOST = 0.5
_CONTRARY = 1.4  # of an axis' turns is left by a prediction of the wrong sign: 2; by one that has nothing to do with it, 1
_EXPLAINED = 0.3
_TURNING = 0.2  # of the liveliest axis' turns: about one that hardly turns there is noise alone
_MISSING = 0.05  # of the frames
_JITTER_S = 5e-4
_WORSE = 3.0  # sigma over that of independent residuals
_APART = 16.0  # chi-squared of the axes' own offsets about their mean
_SAME_S = 1e-5  # axes may be so far apart: a gyroscope's integration leaves that at 4 rad/s, and a tenth of SCALES["s"] matters to nobody
_GOOD_CHANGE = 4.0  # rad/s^2 rms: 1 rad/s back and forth about every axis at 0.6 Hz
_SPARSE, _SPARSE_HZ = 0.67, 30.0  # of the other's rate
_INVERSE = "poses those of the world seen from the sensor (--inverse-poses)"
_MOTION = "turn the rig back and forth about two or more axes, 30 to 60 deg each way, once or twice a second, for 30 s"


@dataclass(frozen=True)
class Judged:
    """What is known of the offset."""

    status: Status
    reasons: tuple[Reason, ...]
    coarse: bool = False  # not observable only for its sigma: still a start for what else tells it


def judge_time_offset(name: str, of: str, to: str, fit: TimeOffsetFit, stamps: dict[str, StampReport]) -> Judged:
    """Return status and reasons of `name` = dt_to_of."""
    why = _not_observable(of, to, fit)
    found = [(sensor, text) for sensor, report in stamps.items() for text in stamps_in_words(report, _MISSING, _JITTER_S)]
    spoilt = [Reason(Verdict.CHECK, f"{sensor}: {text}") for sensor, text in found]
    scale = _scale(of, to, fit)
    known = grade(fit.sigma / SCALES["s"])
    coarse = not why and known == "not observable"
    if coarse:
        why = f"its sigma would be {fit.sigma * 1e3:.2g} ms; {_advice(fit)}"
    if why:
        other = [text for verdict, text in scale if verdict is Verdict.FAIL]  # what makes a fit bad is the reason, and no lack of motion
        return Judged(
            Status.NOT_OBSERVABLE, (Reason(Verdict.FAIL, f"{name}: not observable: {other[0] if other else why}"), *spoilt), coarse
        )
    reasons = []
    if known == "weak":
        reasons.append(Reason(Verdict.CHECK, f"{name}: weak: known to {fit.sigma * 1e3:.2g} ms only; {_advice(fit)}"))
    frame_hz = stamps[of].rate_hz if of in stamps else None
    reasons += [Reason(verdict, f"{name}: {text}") for verdict, text in (*_doubts(of, to, fit, frame_hz), *scale)]
    to_hz = stamps[to].rate_hz if to in stamps else None
    if frame_hz and to_hz and to_hz < min(_SPARSE * frame_hz, _SPARSE_HZ):
        text = f"{to} comes at {to_hz:.3g} Hz only: what it does between its samples may bend td by 0.1 ms and more"
        reasons.append(Reason(Verdict.CHECK, f"{name}: {text}; give it as --of and {of} as --to"))
    return Judged(Status(known), (*reasons, *spoilt))


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
    if fit.gain >= _ALIKE and fit.depth >= _BOWL and fit.noise_share > _PRETENDED:
        return (
            f"{100 * fit.noise_share:.0f} % of what seems to tell it is the noise of {to}'s rates: turn faster, or give less noisy ones "
            f"(--of {to} --to {of} if {of} is less noisy)"
        )
    if fit.gain < _ALIKE or fit.noise_share > _PRETENDED or fit.depth < _BOWL:
        if fast < _STILL or float(np.median(np.linalg.norm(known, axis=1))) < _STILL:
            return f"the rig hardly turns ({middle:.2g} rad/s in the middle): at rest every offset fits alike; {_MOTION}"
        if change > 0.3 and (fit.gain < _ALIKE or _unlike(fit) > _UNLIKE):
            return (
                f"{of} and {to} never turn alike at any offset: are both on one rigid body, do they overlap in time, is a topic wrong, "
                f"or are {_INVERSE}?"
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


def _doubts(of: str, to: str, fit: TimeOffsetFit, frame_hz: float | None) -> list[tuple[Verdict, str]]:
    found = []
    td = fit.td * 1e3
    if fit.by_fast_turns is not None:
        fast, sigma = fit.by_fast_turns
        other = f"{fast * 1e3:+.3f} +- {sigma * 1e3:.2g} ms"
        text = f"fast and slow motion disagree: turns of {LONG_S:.1f} s say {td:+.3f} ms, those from stamp to stamp {other}"
        found.append((Verdict.CHECK, f"{text}: either may be off by as much; look for a filter, blur or vibration in {of} or {to}"))
    clock = fit.clock
    if clock is not None and clock.kind != "constant":
        verdict = Verdict.FAIL if clock.jumps else Verdict.CHECK
        found += [(verdict, f"{text}; one number does not hold throughout") for text in describe(clock, to, frame_hz)]
    if fit.alignment.levels.jitter > _JITTER_S**2:
        jitter = float(np.sqrt(fit.alignment.levels.jitter)) * 1e3
        text = f"the residuals of {of} grow with the rate as if its stamps jittered by {jitter:.2g} ms"
        found.append((Verdict.CHECK, f"{text}; or those of {to} do, or it is worse in fast motion"))
    if (unlike := _unlike(fit)) > _UNLIKE:
        verdict = Verdict.FAIL if unlike > _STRANGERS else Verdict.CHECK
        found.append((verdict, f"{of} and {to} turn only partly alike: {100 * unlike:.0f} % of the turns is noise, or {_INVERSE}"))
    lost = 1 - sum(int(keep.sum()) for keep in fit.alignment.keep) / max(fit.n_turns, 1)
    if lost > _LOST:
        verdict = Verdict.FAIL if lost > _MOSTLY_LOST else Verdict.CHECK
        found.append((verdict, f"{100 * lost:.0f} % of the turns of {of} contradict {to} and were given up: look at its poses"))
    if fit.lost > _LOST:
        found.append((Verdict.CHECK, f"{100 * fit.lost:.0f} % of the turns of {of} fall into gaps of {to} and tell nothing"))
    if not fit.alignment.converged:
        found.append((Verdict.FAIL, "the fit did not settle: the two streams do not fit together"))
    found += [(Verdict.FAIL, text) for text in _contrary(of, to, fit)]
    factor = float(fit.covariance.factors[0]) * float(np.sqrt(fit.covariance.variance_factor))
    if factor > _WORSE:
        text = f"it wanders by more than its noise within the recording (sigma {factor:.1f} times that of independent residuals, paid for)"
        found.append((Verdict.CHECK, text))
    found += [(Verdict.CHECK, text) for text in _axes(of, fit)]
    return found


def _unlike(fit: TimeOffsetFit) -> float:
    """Return the share of the turns, their mean rate apart, that the fit leaves."""
    left, turned = _left_of_turns(fit)
    return float(np.sum(left**2) / max(np.sum(turned**2), 1e-300))


def _left_of_turns(fit: TimeOffsetFit) -> tuple[Array, Array]:
    """Return what the fit leaves of the kept turns, and the turns less their stretch's median (n, d) rad."""
    a = fit.alignment
    left = [raw_residuals(part, a.track, a.R, a.shift(part.stretch.t))[0] for part in a.parts]
    angles = [part.stretch.turns.angle[:, part.stretch.axes] for part in a.parts]
    return np.concatenate(left), np.concatenate([angle - np.median(angle, axis=0) for angle in angles])


def _scale(of: str, to: str, fit: TimeOffsetFit) -> list[tuple[Verdict, str]]:
    """Say so where one turns by more than the other: s = sum alpha . R beta / sum |R beta|^2 of whitened turns, for one axis |R|."""
    own, other = turned_by(fit.alignment)
    information = max(float(np.sum(other**2)), 1e-300)
    scale = float(np.sum(own * other)) / information if len(fit.alignment.R) == 3 else length_of_axis(fit.alignment)
    sigma = np.sqrt(fit.covariance.variance_factor / information)
    alike = scale**2 * information > _ALIKE_IN_FORM * float(np.sum(own**2)) or len(fit.alignment.R) == 1
    if not alike or scale < _SURE * sigma or abs(scale - 1) < max(_SCALE, _SURE * sigma, fit.noise_share):
        return []
    verdict = Verdict.FAIL if abs(np.log(scale)) > _OTHER_UNIT else Verdict.CHECK
    degrees = abs(abs(np.log(scale)) - np.log(180 / np.pi)) < _OTHER_UNIT
    cause = (
        "degrees taken for radians, or the other way round: check --gyro-unit"
        if degrees
        else "a gyroscope's scale or unit, or a wrong focal length; calibrate that first"
    )
    return [(verdict, f"{of} turns {scale:.3g} times as far as {to}: {cause}")]


def _contrary(of: str, to: str, fit: TimeOffsetFit) -> list[str]:
    """Say which axes the prediction makes worse while it explains others: a flipped sign that no rotation makes."""
    left, turned = _left_of_turns(fit)
    size = np.sqrt(np.maximum(np.mean(turned**2, axis=0), 1e-300))
    share = np.sqrt(np.mean(left**2, axis=0)) / size
    turning = size > _TURNING * size.max()
    worse = [axis for axis, each, turns in zip("xyz", share, turning, strict=False) if each > _CONTRARY and turns]
    if len(share) < 3 or not worse or share.min() > _EXPLAINED:
        return []
    axes = f"about {' and '.join(worse)} while it goes with it about the others"
    return [f"{of} turns against {to} {axes}: one axis or all three with a flipped sign, a left-handed frame, or {_INVERSE}"]


def by_axis(fit: TimeOffsetFit) -> tuple[Array, Array]:
    """Return the offset that each measured axis of the turns has less the common one (d,) s, and their covariance (d, d) s^2."""
    off, cov = axis_offsets(fit.alignment)
    return off, cov * float(fit.covariance.corrected[0, 0] / fit.covariance.plain[0, 0]) * fit.covariance.variance_factor


def _axes(of: str, fit: TimeOffsetFit) -> list[str]:
    """Say so where the axes disagree: a rolling shutter, or poses that are wrong in a way that goes with the motion."""
    off, cov = by_axis(fit)
    information = np.linalg.inv(cov + _SAME_S**2 * np.eye(len(off)))
    apart = off - information.sum(axis=0) @ off / information.sum()
    if len(off) < 2 or float(apart @ information @ apart) < _APART:
        return []
    sigma = np.sqrt(np.diag(cov))
    each = ", ".join(f"{axis} {1e3 * (fit.td + d):+.2f} +- {1e3 * s:.2g}" for axis, d, s in zip("xyz", off, sigma, strict=True))
    return [f"the axes of {of} disagree: {each} ms: a rolling shutter, or poses whose errors go with the motion"]
