"""The time offset of two sensors by how they turn: a start at any lag, td over time, the V, and its bottom by maximum likelihood.

t_to = t_of + td: the turns of `of` are looked up at t + td in the orientation track of `to`.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from calibkit.data.observations import ImuSamples, PoseSamples
from calibkit.data.progress import Progress, silent
from calibkit.errors import BadInputError
from calibkit.estimation.alignment import (
    Alignment,
    columns,
    newton,
    noise_information,
    settle,
    stepped,
    sweep,
    turned_alike,
)
from calibkit.estimation.clock import Clock
from calibkit.estimation.clock_windows import Windows
from calibkit.estimation.moving_clock import with_clock
from calibkit.estimation.orientation_track import OrientationTrack, track_of_gyro, track_of_poses
from calibkit.estimation.slow_turns import by_slow_turns, joined_up, turns_in_long_one
from calibkit.estimation.stamps import come_in_bursts
from calibkit.estimation.time_offset_sigma import covariance_of, inflation, interval, sigma_of
from calibkit.estimation.time_offset_start import Start, find_starts
from calibkit.estimation.turn_comparison import FEWEST_TURNS, lost_to_gaps, raw_residuals, split, usable, why_so_few
from calibkit.estimation.turn_noise import NoiseLevels
from calibkit.estimation.turns import Turns
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import SCALES, Covariance

_MAX_REACH_S = 0.8
_MARGIN_S = 0.01
_BIAS = 1e-2  # rad/s; a larger bias is taken out of a gyroscope's track, whose turns it bends: by 1e-5 rad in 50 ms at 4 rad/s
_RIVAL = 10.83  # chi-squared of 1 in 1000: a bottom that is no more than this higher may be the true one
_RIVAL_SHARE = 0.5  # of the stretches must be known at both lags
_AS_LOW = 4.0  # chi-squared; the grid's own step is no reason to look again
_AGAIN = 2
_APART_S = 0.02  # what two starts lead to within is one bottom
_CONTRADICTED = 12.25  # chi-squared of one degree of freedom: 3.5 sigma
_TURNING, _OTHER_UNIT = 0.1, 0.4  # rad/s; of the logarithm


@dataclass(frozen=True)
class Settings:
    """How to look."""

    reach_s: float = 0.05
    step_s: float = 0.0005
    rotation: Array | None = None  # R_of_to (3, 3), where it is known
    free_bias: bool = True
    levels: NoiseLevels | None = None  # None: estimated


@dataclass(frozen=True)
class TimeOffsetFit:
    """The offset and everything that it is judged by; times in s are on the track's axis, from its origin.

    td = coarse_ns 1e-9 + tau, at the clock's reference time where it is not constant.
    """

    alignment: Alignment
    start: Start
    coarse_ns: int
    covariance: Covariance  # (1, 1) of tau
    interval: tuple[float, float]  # 95 % by profile likelihood, as tau
    tau: Array  # (k,) of the V
    cost: Array  # (k,)
    second: float | None  # another offset that fits nearly as well, s
    windows: Windows
    clock: Clock | None
    gyro_bias: Array  # (3,) rad/s in the track's axes: the mean of what the stretches found
    n_turns: int  # in the overlap
    gain: float  # chi-squared that the reference's turns explain, correlation paid for
    noise_share: float  # of the information on tau, that noise pretends
    lost: float = 0.0  # share of the turns within the reference's span that its gaps take
    by_fast_turns: tuple[float, float] | None = None  # td and sigma by turns from stamp to stamp, where they contradict these

    @property
    def td(self) -> float:
        return self.coarse_ns * 1e-9 + self.alignment.tau

    @property
    def sigma(self) -> float:
        """Return one standard deviation, all that `sigma_of` names paid for."""
        return sigma_of(self.alignment, self.covariance, self.noise_share)

    @property
    def depth(self) -> float:
        """How far the V's bottom lies below the lower of its two sides, as chi-squared with correlated residuals paid for."""
        k = int(np.argmin(self.cost))
        sides = (self.cost[: k + 1].max(), self.cost[k:].max())
        return float(min(sides) - self.cost[k]) / inflation(self.covariance)


@contextmanager
def called(first: str, second: str) -> Iterator[None]:
    """Give the two streams that `fit_time_offset` is fed their names in what it refuses."""
    try:
        yield
    except BadInputError as error:
        raise BadInputError(str(error).replace("the first", first).replace("the second", second)) from None


def fit_time_offset(turns: Turns, reference: ImuSamples | PoseSamples, settings: Settings, progress: Progress = silent) -> TimeOffsetFit:
    """Return the offset that lays the turns best against the reference; by long turns, where those contradict the short ones.

    BadInputError where the two share too little time. What the fit is worth is for `time_offset_verdict` to say.
    """
    fit = _fit(turns, reference, settings, progress)
    moves = fit.clock is not None and fit.clock.kind != "constant"
    slow = by_slow_turns(fit.alignment) if settings.levels is None and not moves else None
    if slow is None or not _contradicts(fit, slow.alignment):
        return fit
    long = _fit(joined_up(turns, slow.many), reference, settings, progress)
    return replace(long, by_fast_turns=(fit.td, fit.sigma)) if abs(long.td - fit.td) > SCALES["s"] else fit


def _contradicts(fit: TimeOffsetFit, slow: Alignment) -> bool:
    """Whether long turns tell another offset, by Hausman's test with half their variance at least: chance may bring it below."""
    apart, parts = stepped(slow, columns(slow))
    variance = float(covariance_of(slow, parts).corrected[0, 0])
    return apart**2 > _CONTRADICTED * max(variance - fit.sigma**2, variance / 2) and abs(apart) > SCALES["s"]


def _fit(turns: Turns, reference: ImuSamples | PoseSamples, settings: Settings, progress: Progress) -> TimeOffsetFit:
    if come_in_bursts(reference.t_ns):
        raise BadInputError("the stamps of the second come in bursts: they are times of arrival; record the sensor's own clock")
    track = track_of_gyro(reference) if isinstance(reference, ImuSamples) else track_of_poses(reference)
    _refuse_other_unit(turns, track)
    starts = find_starts(turns, track, settings.rotation)
    if not starts:
        raise BadInputError(why_so_few(turns, track, settings.reach_s))
    start, reach = starts[0], settings.reach_s
    a = settle(_begin(turns, track, start, settings, reach), settings.levels, progress)
    bias, taken_out = _bias(a), np.zeros(3)
    if isinstance(reference, ImuSamples) and np.linalg.norm(bias) > _BIAS:
        a, taken_out = newton(replace(a, track=track_of_gyro(reference, bias))), bias
    a, windows = with_clock(a, settings.levels, reach)
    again = 0
    while True:
        tau = _grid(a, settings.step_s, reach)
        cost = sweep(a, tau, progress)
        k = int(np.argmin(cost))
        inside = 2 <= k < len(tau) - 2
        lower = float(sweep(a, np.array([a.tau]))[0]) - cost[k]  # than where Gauss-Newton ended; a sharp V is no straight line between
        if inside and (lower < _AS_LOW or (again := again + 1) > _AGAIN):
            break
        if not inside:
            if reach >= _MAX_REACH_S:
                break
            reach = min(2 * reach, _MAX_REACH_S)
        a = replace(_begin(turns, a.track, start, settings, reach), R=a.R, tau=float(tau[k]), clock=a.clock)
        a, windows = with_clock(settle(a, settings.levels), settings.levels, reach)
    parts = columns(a)
    covariance = covariance_of(a, parts)
    noise_share = min(noise_information(a) * float(covariance.plain[0, 0]) / covariance.variance_factor, 1.0)
    fit = TimeOffsetFit(
        alignment=a,
        start=start,
        coarse_ns=start.coarse_ns,
        covariance=covariance,
        interval=interval(a, covariance, noise_share),
        tau=tau,
        cost=cost,
        second=None,
        windows=windows,
        clock=a.clock,
        gyro_bias=taken_out + _bias(a),
        n_turns=sum(len(stretch.turns.first) for stretch in a.stretches),
        gain=turned_alike(a, parts) / inflation(covariance),
        noise_share=noise_share,
        lost=lost_to_gaps(replace(turns, t_ns=turns.t_ns + start.coarse_ns), a.track, -reach - _MARGIN_S, reach + _MARGIN_S),
    )
    return replace(fit, second=_second(fit, starts[1:]))


def _refuse_other_unit(turns: Turns, track: OrientationTrack) -> None:
    """Refuse streams of which one turns as much faster as degrees are more than radians."""
    long = joined_up(turns, max(1, turns_in_long_one([turns])))  # less noisy
    own = float(np.percentile(np.linalg.norm(long.angle, axis=1) / long.duration, 90)) if len(long.first) else 0.0
    other = float(np.percentile(np.linalg.norm(track.rate[track.chain >= 0], axis=1), 90)) if np.any(track.chain >= 0) else 0.0
    if min(own, other) > _TURNING and abs(np.log(max(own, other) / min(own, other) * np.pi / 180)) < _OTHER_UNIT:
        which = ("first", "second") if own > other else ("second", "first")
        raise BadInputError(f"the {which[0]} turns 57 times as fast as the {which[1]}: a gyroscope in deg/s; give --gyro-unit deg/s")


def bootstrap_sigma(fit: TimeOffsetFit, draws: int, seed: int = 0) -> float:
    """Return the standard deviation of the offset over draws of the stretches with replacement, one Gauss-Newton step each."""
    grams = np.stack([X.T @ X for X in columns(fit.alignment)])
    free = fit.alignment.free
    drawn = np.random.default_rng(seed).multinomial(len(grams), np.full(len(grams), 1 / len(grams)), draws)
    total = np.einsum("db,bij->dij", drawn, grams)
    A = total[:, free[:, None], free] + 1e-9 * np.trace(total[0]) / 5 * np.eye(len(free))
    steps = np.linalg.solve(A, total[:, free, 4:])[:, -1, 0]
    return float(np.std(steps))


def _begin(turns: Turns, track: OrientationTrack, start: Start, settings: Settings, reach: float) -> Alignment:
    whole = replace(turns, t_ns=turns.t_ns + start.coarse_ns)
    keep = usable(whole, track, -reach - _MARGIN_S, reach + _MARGIN_S)
    if keep.sum() < FEWEST_TURNS:
        raise BadInputError(why_so_few(turns, track, reach))
    stretches = split(whole.select(keep), track.origin_ns, settings.free_bias)
    return Alignment(
        track=track,
        stretches=tuple(stretches),
        keep=tuple(np.ones(len(stretch.turns.first), bool) for stretch in stretches),
        parts=(),
        levels=settings.levels or NoiseLevels(1.0, 1.0),
        shape=np.ones(3),
        R=start.R,
        free_rotation=settings.rotation is None,
        tau=0.0,
    )


def _grid(a: Alignment, step: float, reach: float) -> Array:
    """Return the offsets (k,) of the V: around the start, or where a clock that moves has left that, around its reference time's."""
    moves = a.clock is not None and a.clock.kind != "constant"
    many, middle = round(reach / step), round(a.tau / step) if moves else 0
    return np.asarray(step * np.arange(middle - many, middle + many + 1), np.float64)


def _bias(a: Alignment) -> Array:
    """Return the bias of the track's gyroscope, whose turns are beta + b duration: c = -R b."""
    found = [raw_residuals(part, a.track, a.R, a.shift(part.stretch.t))[1] for part in a.parts]
    return np.asarray(-a.R.T @ np.mean(found, axis=0), np.float64) if found and len(a.R) == 3 else np.zeros(3)


def _second(fit: TimeOffsetFit, others: Sequence[Start]) -> float | None:
    """Return another offset that the turns may as well have: a bottom of the V, or another peak of the correlation."""
    allowed = _RIVAL * inflation(fit.covariance)
    k = int(np.argmin(fit.cost))
    lows = 1 + np.flatnonzero((fit.cost[1:-1] < fit.cost[:-2]) & (fit.cost[1:-1] <= fit.cost[2:]))
    for low in lows[np.argsort(fit.cost[lows])]:
        wall = fit.cost[min(low, k) : max(low, k) + 1].max() - fit.cost[low]
        if low != k and wall > allowed and fit.cost[low] - fit.cost[k] < allowed:
            return fit.coarse_ns * 1e-9 + float(fit.tau[low])
    for other in others if fit.clock is None or fit.clock.kind == "constant" else ():
        rival = _rival(fit.alignment, other, other.coarse_ns - fit.coarse_ns)
        if rival is not None and rival[0] < allowed:
            found = other.coarse_ns * 1e-9 + rival[1]
            if abs(found - fit.td) > _APART_S:
                return found
    return None


def _rival(a: Alignment, other: Start, further_ns: int) -> tuple[float, float] | None:
    """Return by how much chi-squared is higher at another start's bottom, and its tau; None where too little is known at both."""
    known = [usable(replace(part.stretch.turns, t_ns=part.stretch.turns.t_ns + further_ns), a.track, -0.1, 0.1).all() for part in a.parts]
    if sum(known) < max(2, _RIVAL_SHARE * len(known)):
        return None
    parts = tuple(part for part, there in zip(a.parts, known, strict=True) if there)
    shifted = tuple(replace(part, stretch=replace(part.stretch, origin_ns=a.track.origin_ns - further_ns)) for part in parts)
    there = newton(replace(a, parts=shifted, R=other.R, tau=0.0, clock=None))
    costs = [sum(float(np.sum(X[:, -1] ** 2)) for X in columns(each)) for each in (replace(a, parts=parts), there)]
    return costs[1] - costs[0], there.tau
