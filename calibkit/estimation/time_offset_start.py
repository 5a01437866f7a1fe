"""A start for the time offset of two sensors without a guess: which lag, and which rotation lies between them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.orientation_track import OrientationTrack
from calibkit.estimation.rough_offset import Candidate, rough_offsets
from calibkit.estimation.turn_comparison import FEWEST_TURNS, Stretch, usable
from calibkit.estimation.turns import Turns
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

_STEP_S = 0.005
_LONGEST_S = 120.0  # of the liveliest part: a clock may drift through a longer one
_MOST_TURNS = 4000
_REACH_S = 0.05


@dataclass(frozen=True)
class Start:
    """Where to begin."""

    coarse_ns: int  # added to the stamps of the turns to give the track's clock, to some ms
    R: Array  # (d, 3): beta of the track, turned into the measured axes of the turns
    correlation: float  # of |omega| at this lag, 0 where it was not looked for by correlation


def find_starts(turns: Turns, track: OrientationTrack, rotation: Array | None) -> list[Start]:
    """Return the peaks of the correlation and the stamps as they are, each with its rotation, the best one first; none without overlap.

    At each trial lag R = argmin sum w |alpha - R beta|^2 in closed form (Wahba 1965 by SVD, Arun 1987); w goes by how well |alpha| and
    |beta| agree, which needs no R, so that wrong turns count little.
    """
    if not len(turns.first):
        return []
    turns = turns.select(slice(None))  # a stamp before the first turn may be wrong by hours
    between = (int(turns.t_ns[0]) - track.origin_ns) * 1e-9
    tried = [*rough_offsets(turns, track), Candidate(between, 0.0, 0.0, _REACH_S)]
    found = [_try(turns, track, rotation, candidate, between) for candidate in tried]
    ranked = sorted((each for each in found if each is not None), key=lambda each: each[0])
    out: list[Start] = []
    for _, start in ranked:
        if all(abs(start.coarse_ns - other.coarse_ns) > _REACH_S * 1e9 for other in out):
            out.append(start)
    return out


def _try(turns: Turns, track: OrientationTrack, rotation: Array | None, candidate: Candidate, between: float) -> tuple[float, Start] | None:
    coarse_ns = round((candidate.lag - between) * 1e9)
    shifted = replace(turns, t_ns=turns.t_ns + coarse_ns)
    reach = max(_REACH_S, candidate.uncertainty)
    part = _liveliest(shifted, usable(shifted, track, -reach, reach))
    if part is None:
        return None
    tau = np.arange(-reach, reach + _STEP_S / 2, _STEP_S)
    stretch = Stretch(part, track.origin_ns)
    beta = stretch.beta(track, np.broadcast_to(tau, (len(part.t_ns), len(tau))))
    alpha = part.angle[:, None, stretch.axes]
    apart = np.abs(np.linalg.norm(alpha, axis=2) - np.linalg.norm(beta, axis=2))
    spread = 1.5 * np.median(apart, axis=0) + 1e-12
    w = 1 / (1 + (apart / (2 * spread)) ** 2)
    duration = part.duration[:, None, None]
    alpha = alpha - duration * _rate(w, alpha, duration)
    beta = beta - duration * _rate(w, beta, duration)
    cross = np.einsum("nk,nki,nkj->kij", w, np.broadcast_to(alpha, (*w.shape, alpha.shape[2])), beta)
    R = _rotations(cross, beta, w) if rotation is None else np.broadcast_to(rotation[stretch.axes], cross.shape)
    left = np.sum(w[:, :, None] * (alpha - np.einsum("kij,nkj->nki", R, beta)) ** 2, axis=(0, 2))
    share = left / np.maximum(np.sum(w[:, :, None] * alpha**2, axis=(0, 2)), 1e-300)
    k = int(np.argmin(share))
    start = Start(coarse_ns + round(tau[k] * 1e9), np.array(R[k]), candidate.correlation)
    return len(part.first) * float(np.log(max(share[k], 1e-12))), start


def _rate(w: Array, turned: Array, duration: Array) -> Array:
    return np.asarray(np.sum(w[:, :, None] * turned, axis=0) / np.sum(w[:, :, None] * duration, axis=0), np.float64)


def _rotations(cross: Array, beta: Array, w: Array) -> Array:
    """Return R (k, d, 3) for sum w alpha beta^T (k, d, 3): rotations, or for one axis its direction, free in length."""
    if cross.shape[1] == 3:
        return so3.project(cross)
    square = np.einsum("nk,nki,nkj->kij", w, beta, beta)
    ridge = 1e-6 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(square + ridge, np.swapaxes(cross, 1, 2)).swapaxes(1, 2), np.float64)


def _liveliest(turns: Turns, keep: NDArray[np.bool_]) -> Turns | None:
    """Return at most 120 s of the usable turns in which the rate changes most, thinned to some thousands."""
    if keep.sum() < FEWEST_TURNS:
        return None
    part = turns.select(keep)
    t = (part.t_ns[part.first] - part.t_ns[part.first[0]]) * 1e-9
    if t[-1] > _LONGEST_S:
        change = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(part.angle / part.duration[:, None], axis=0), axis=1))])
        stop = np.searchsorted(t, t + _LONGEST_S) - 1
        begin = int(np.argmax(np.where(t <= t[-1] - _LONGEST_S, change[stop] - change, -1)))
        part = part.select(slice(begin, int(stop[begin]) + 1))
    every = -(-len(part.first) // _MOST_TURNS)
    return part.select(np.arange(0, len(part.first), every))
