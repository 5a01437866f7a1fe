"""When a clock jumped: windows know it to some seconds, turns to a frame or so."""

from dataclasses import replace

import numpy as np

from calibkit.estimation.alignment import Alignment
from calibkit.estimation.clock import Clock, Jump
from calibkit.estimation.turn_comparison import Stretch, raw_residuals
from calibkit.geometry.so3 import Array

_WORST = 25.0  # typical squares that one turn may speak for or against a place: some are wrong anyway
_AS_GOOD = 4.0  # typical squares, within which a place is as likely


def placed(a: Alignment, clock: Clock) -> Clock:
    """Return the clock with each jump between the two stamps that explain the turns around it best; td elsewhere stays."""
    bias = np.mean([raw_residuals(part, a.track, a.R, a.shift(part.stretch.t))[1] for part in a.parts], axis=0)
    for i in range(len(clock.jumps)):
        found = _place(a, clock, i, bias)
        if found is not None:
            clock = _with_jump(clock, i, found)
    return clock


def _with_jump(clock: Clock, i: int, jump: Jump) -> Clock:
    """Return the clock with one jump replaced: td is the same at times that it does not cross."""
    jumps = (*clock.jumps[:i], jump, *clock.jumps[i + 1 :])
    crossed = float(clock.t_ref_s >= jump.t_s) - float(clock.t_ref_s >= clock.jumps[i].t_s)
    return replace(clock, jumps=jumps, offset_s=clock.offset_s + crossed * jump.size_s)


def _place(a: Alignment, clock: Clock, i: int, bias: Array) -> Jump | None:
    """Return the jump at its best place: the turns that end before it as if it came never, those that begin after it as if always."""
    jump = clock.jumps[i]
    around = jump.t_s + np.array([-1, 1]) * np.sqrt(12) * jump.t_sigma_s  # twice as far as it may lie
    others = np.array([-np.inf, *(other.t_s for other in clock.jumps[:i]), *(other.t_s for other in clock.jumps[i + 1 :]), np.inf])
    low = max(around[0], (others[i] + jump.t_s) / 2)
    high = min(around[1], (others[i + 1] + jump.t_s) / 2)
    near = [stretch for stretch in a.stretches if stretch.t[-1] > low and stretch.t[0] < high]
    stamps = np.concatenate([stretch.t for stretch in near]) if near else np.zeros(0)
    tried = (stamps[1:] + stamps[:-1]) / 2
    tried = tried[(tried > low) & (tried < high) & (np.diff(stamps) > 0)]
    if not len(tried):
        return None
    ends = [_with_jump(clock, i, replace(jump, t_s=at)) for at in (np.inf, -np.inf)]
    never, always = (np.concatenate([_squares(a, stretch, each, bias) for stretch in near]) for each in ends)
    typical = max(float(np.median(np.minimum(never, always))), 1e-300)
    never, always = (np.minimum(each / typical, _WORST) for each in (never, always))
    first, last = (np.concatenate([stretch.t[getattr(stretch.turns, end)] for stretch in near]) for end in ("first", "last"))
    before, after = np.argsort(last, kind="stable"), np.argsort(first, kind="stable")
    ended = np.concatenate([[0], np.cumsum(never[before])])[np.searchsorted(last[before], tried)]
    begun = np.concatenate([np.cumsum(always[after][::-1])[::-1], [0]])[np.searchsorted(first[after], tried)]
    cost = ended + begun
    as_good = tried[cost <= cost.min() + _AS_GOOD]
    spread = float(np.ptp(as_good)) + float(np.median(np.diff(stamps)))
    return replace(jump, t_s=float(tried[np.argmin(cost)]), t_sigma_s=spread / float(np.sqrt(12)))


def _squares(a: Alignment, stretch: Stretch, clock: Clock, bias: Array) -> Array:
    """Return |alpha - R beta - bias duration|^2 (n,) of every turn of a stretch, those that were given up included."""
    left = stretch.left(a.track, a.R, clock.at(stretch.t)[:, None])[:, 0] - stretch.turns.duration[:, None] * bias
    return np.asarray(np.sum(left**2, axis=1), np.float64)
