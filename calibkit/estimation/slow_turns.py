"""The time offset by longer turns: a check on errors of the fast motion, which the short turns of every stamp feel most.

Turns from stamp to stamp are the most exact estimate if the noise is what its model says, turns over some stamps hold even where the
fastest motion is told wrong (a motion capture's filter, blur, vibration). Hausman (1978): where both hold, their difference has the
variance sigma_long^2 - sigma_short^2.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibkit.estimation.alignment import Alignment, weighed
from calibkit.estimation.turn_comparison import LEAST_TURNS, split
from calibkit.estimation.turns import Turns
from calibkit.geometry import so3

LONG_S = 0.3
_MOST_ANGLE = 1.5  # rad; turns near pi have no one rotation vector
_PHASES = 6  # starts of long turns; they overlap, and their scores' correlation is paid for


def turns_in_long_one(parts: Sequence[Turns]) -> int:
    """Return over how many turns a long one goes; below 2 where they are long already."""
    duration = np.concatenate([turns.duration for turns in parts])
    angle = np.concatenate([np.linalg.norm(turns.angle, axis=1) for turns in parts])
    if not len(angle):
        return 0
    fast = float(np.percentile(angle / duration, 99.5))
    return int(min(LONG_S, _MOST_ANGLE / max(fast, 1e-9)) / float(np.median(duration)))


def joined_up(turns: Turns, many: int, phase: int = 0) -> Turns:
    """Return turns each over `many` that follow one another, of each run of them from the `phase`-th on."""
    start = np.flatnonzero(~turns.joined)
    run = np.repeat(np.arange(len(start)), np.diff([*start, len(turns.first)]))
    place, stop = np.arange(len(run)) - start[run], np.append(start[1:], len(run))[run]
    head = np.flatnonzero((place % many == phase) & (np.arange(len(run)) + many <= stop))
    q = so3.quat_exp(turns.angle)
    turned = q[head]
    for k in range(1, many):
        turned = so3.quat_multiply(turned, q[head + k])
    own = None if turns.own_cov is None else sum((turns.own_cov[head + k] for k in range(many)), np.zeros((len(head), 3, 3)))
    return Turns(turns.t_ns, turns.first[head], turns.last[head + many - 1], so3.quat_log(turned), turns.end_cov, own, turns.axes)


@dataclass(frozen=True)
class Slow:
    """Long turns laid beside the track at the offset of the short ones."""

    alignment: Alignment
    many: int  # turns in a long one


def by_slow_turns(a: Alignment) -> Slow | None:
    """Return the long turns (overlapping, of several starts) of what is kept, weighed as the short ones; None where they are too few."""
    kept = [stretch.turns.select(keep) for stretch, keep in zip(a.stretches, a.keep, strict=True) if keep.any()]
    many = turns_in_long_one(kept)
    if many < 2:
        return None
    stretches = []
    for phase in range(0, many, max(1, many // _PHASES)):
        for turns in kept:
            long = joined_up(turns, many, phase)
            if len(long.first) >= LEAST_TURNS:
                stretches += split(long, a.track.origin_ns, a.stretches[0].free_bias)
    if not stretches:
        return None
    keep = tuple(np.ones(len(each.turns.first), bool) for each in stretches)
    return Slow(weighed(replace(a, stretches=tuple(stretches), keep=keep)), many)
