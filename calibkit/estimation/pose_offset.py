"""How far the clocks of two pose streams are apart: as given, by how both turn, or none where they share one clock."""

from dataclasses import dataclass, replace

import numpy as np

from calibkit.data.observations import PoseSamples, Times
from calibkit.data.progress import Progress, silent
from calibkit.data.verdict import Reason, Status
from calibkit.errors import BadInputError
from calibkit.estimation.pose_interpolation import PoseStream, in_time, without_repeats
from calibkit.estimation.pose_jumps import TOLD, jumps
from calibkit.estimation.stamps import check_stamps
from calibkit.estimation.time_offset import Settings as TurnSettings
from calibkit.estimation.time_offset import TimeOffsetFit, fit_time_offset
from calibkit.estimation.time_offset_verdict import judge_time_offset
from calibkit.estimation.turns import turns_of_orientations
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

MOST_PAIRS = 1000
_COARSE_S = 0.02  # an offset that turns tell so well is a start: whole poses tell it better


@dataclass(frozen=True)
class Settings:
    """How to pair."""

    dt: float | None = None  # s, t_P = t_Q + dt, where it is known
    dt_sigma: float = 0.0  # s, of a given offset
    one_clock: bool = False  # an offset that the streams do not tell is 0
    rests: bool | None = None  # True: rests only; False: moving pairs only; None: rests where they are as good
    most: int = MOST_PAIRS  # moving pairs


@dataclass(frozen=True)
class ClockOffset:
    """t_P = t_Q + dt, and how it is known."""

    dt: float  # s; of a clock that drifts or jumps, at its reference time
    sigma: float
    known: str  # "given", "assumed", "turns" or, by the fit of X too, "poses"
    fit: TimeOffsetFit | None = None  # of the slower stream's turns to the faster one
    doubt: Reason | None = None  # that fast and slow turns tell different ones

    def on_fast(self, t_ns: Times, read_P: bool) -> Times:
        """Return the slower stream's stamps on the faster one's clock, P's where `read_P`."""
        dt = self.dt if read_P else -self.dt
        if self.fit is None:
            out: Times = t_ns + np.int64(round(dt * 1e9))
            return out
        a = self.fit.alignment
        coarse = t_ns + np.int64(self.fit.coarse_ns)
        at: Array = np.asarray((coarse - a.track.origin_ns) * 1e-9, np.float64)
        shift = a.shift(at) + (dt - self.fit.td)
        return np.asarray(coarse + np.round(shift * 1e9).astype(np.int64))

    def moved(self, change: float, sigma: float) -> "ClockOffset":
        """Return the offset as whole poses have it."""
        return replace(self, dt=self.dt + change, sigma=sigma, known="poses")

    def told(self, P: str, Q: str) -> str:
        """Return the offset in words."""
        how = {
            "given": "as given",
            "assumed": "assumed, as both have one clock",
            "turns": "by how both turn",
            "poses": "estimated together with the transform",
        }
        return f"t_{P} = t_{Q} + dt, dt = {milliseconds(self.dt, self.sigma)}, {how[self.known]}"


@dataclass(frozen=True)
class Streams:
    """Two streams in time, and the offset of their clocks."""

    P: PoseStream
    Q: PoseStream
    read_P: bool  # P is the faster one
    offset: ClockOffset
    lines: tuple[str, ...]
    reasons: tuple[Reason, ...]

    @property
    def slow(self) -> PoseStream:
        return self.Q if self.read_P else self.P

    @property
    def fast(self) -> PoseStream:
        return self.P if self.read_P else self.Q


def aligned(P: PoseStream, Q: PoseStream, settings: Settings, progress: Progress = silent) -> Streams:
    """Return both streams of one rig in time, with the offset of their clocks, given, by how they turn, or 0 by one clock.

    P and Q are T_w1_1 and T_w2_2 as `hand_eye_world.SETUPS` means them. BadInputError where the offset cannot be had.
    """
    P, Q = in_time(P), in_time(Q)
    read_P = without_repeats(P).interval <= without_repeats(Q).interval
    if settings.dt is not None:
        return Streams(P, Q, read_P, ClockOffset(settings.dt, settings.dt_sigma, "given"), (), ())
    slow, fast = (Q, P) if read_P else (P, Q)
    offset, lines, reasons = offset_by_turns(slow, fast, read_P, settings.one_clock, progress)
    return Streams(P, Q, read_P, offset, tuple(lines), reasons)


def milliseconds(dt: float, sigma: float) -> str:
    """Return an offset with its sigma, in ms or, where it is long, in s."""
    text = f"{dt * 1e3:+.3f} ms" if abs(dt) < 1 else f"{dt:+.6f} s"
    return f"{text} +- {sigma * 1e3:.2g} ms" if sigma else text


def offset_by_turns(
    slow: PoseStream, fast: PoseStream, read_P: bool, one_clock: bool, progress: Progress = silent
) -> tuple[ClockOffset, list[str], tuple[Reason, ...]]:
    """Return the offset, what is to be said of it, and its verdict's reasons; a weak one is none: its sigma goes into what follows.

    Poses that jump away from their neighbours and back are left out: one in 300 has made an offset seconds off.
    BadInputError where the streams do not tell it and have clocks of their own.
    """
    P, Q = (fast, slow) if read_P else (slow, fast)
    wrong = [jumps(each) for each in (slow, fast)]
    many = [f"{np.mean(w):.0%} of {each.name}'s" for each, w in zip((slow, fast), wrong, strict=True) if np.mean(w) > TOLD]
    said = f"{' and '.join(many)} poses jump away from their neighbours and back, as where a tracker loses its target" if many else ""
    told = _told_by(slow.select(~wrong[0]), fast.select(~wrong[1]), read_P, progress)
    if told.offset is not None:
        return told.offset, [f"{said}: the clocks are aligned without them"] if said else [], told.reasons
    if not one_clock:
        remedy = f"give dt_{fast.name}_{slow.name} in a rig file"
        why = f"{said}: remove these, or {remedy} ({told.why})" if said else f"{told.why}; or {remedy}"
        raise BadInputError(f"{P.name} and {Q.name}: the offset of their clocks is not known: {why}")
    return ClockOffset(0.0, 0.0, "assumed"), [f"the poses do not tell the offset of {P.name} and {Q.name}: {told.why}"], told.reasons


@dataclass(frozen=True)
class _Told:
    """The offset by turns, or why there is none."""

    offset: ClockOffset | None
    why: str
    reasons: tuple[Reason, ...] = ()


def _told_by(slow: PoseStream, fast: PoseStream, read_P: bool, progress: Progress) -> _Told:
    P, Q = (fast, slow) if read_P else (slow, fast)
    name = f"dt_{fast.name}_{slow.name}"
    try:
        fit = _fit(slow, fast, progress)
    except BadInputError as error:
        return _Told(None, str(error))
    judged = judge_time_offset(name, slow.name, fast.name, fit, {each.name: check_stamps(each.t_ns, "pose") for each in (P, Q)})
    if judged.status is not Status.NOT_OBSERVABLE or (judged.coarse and fit.sigma < _COARSE_S):
        offset = ClockOffset(fit.td if read_P else -fit.td, fit.sigma, "turns", fit, judged.fast)
        return _Told(offset, "", tuple(reason for reason in judged.reasons if reason is not judged.size))
    assert judged.size is not None
    return _Told(None, judged.size.text.removeprefix(f"{name}: not observable: "), (*judged.clock, *judged.turns, *judged.stamps))


def _fit(slow: PoseStream, fast: PoseStream, progress: Progress) -> TimeOffsetFit:
    moves = without_repeats(slow)
    turns = turns_of_orientations(moves.t_ns, so3.to_quat(moves.T[:, :3, :3]), None if moves.cov is None else moves.cov[:, 3:, 3:])
    fast = without_repeats(fast)
    reference = PoseSamples(fast.t_ns, so3.to_quat(fast.T[:, :3, :3]), fast.T[:, :3, 3], "world", fast.name)
    return fit_time_offset(turns, reference, TurnSettings(), progress)
