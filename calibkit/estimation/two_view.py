"""Turns of a camera from feature tracks, without a board: from frame to frame, the translation eliminated.

Pairs never overlap (their errors would not be independent). The step is one frame, and longer where that has too little parallax: over 20 s
at 1 rad/s and 20 Hz, steps of 1, 2, 3, 4 frames give a time offset to 37, 33, 33, 33 us before things 0.9-5 m away (52, 54, 57, 60 with a
tracker that drifts), to 47, 37, 35, 36 us at 2-10 m and to 130, 50, 41, 39 us at 6-30 m.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import FeatureTracks
from calibkit.data.rig import Camera
from calibkit.errors import BadInputError
from calibkit.estimation import epipolar
from calibkit.estimation.epipolar import Array, Mask, Matches
from calibkit.estimation.turns import Turns
from calibkit.geometry import so3
from calibkit.models.cameras import CAMERAS

Rows = NDArray[np.intp]

_CHUNK = 128  # pairs at once: memory stays flat, arrays in the cache
_STARTS = 3
_STEPS = 4
_FEWEST = 25  # points: five unknowns, wrong tracks, and a scatter to be estimated
_FEWEST_SHARE = 0.4  # of the points of a pair; where fewer agree, something else moves
_LEAST_PARALLAX = 2.5  # sigmas; below, the direction of the translation is noise, and the rotation with it
_LEAST_SPREAD = 2e-4  # rad^2: half a degree, each way
_LARGEST_SIGMA = 0.02  # rad, of a turn that tells anything
_ROUNDING = 1e-12  # rad
_OFTEN = 0.05  # of the pairs without parallax: a longer step is tried
_LONGEST_STEP, _LONGEST_S = 4, 0.25  # frames, s: tracks end, and fast motion is averaged away


@dataclass(frozen=True)
class _Lens:
    """The camera's model with its numbers, and what to call it."""

    name: str
    camera: Camera

    def rays(self, uv: Array) -> tuple[Array, Array, Mask]:
        """Return unit rays (n, 3), px per unit of ray (n, 2, 3), and which are valid."""
        model = CAMERAS[self.camera.model]
        params = np.array([self.camera.parameters[name].value for name in model.parameter_names], float)
        rays, valid = model.unproject(uv, params)
        rays = np.where(valid[:, None], rays, [0.0, 0.0, 1.0])
        seen = model.project(rays, params, jacobians=True)
        assert seen.J_point is not None
        return rays, seen.J_point, valid & seen.valid


@dataclass(frozen=True)
class _Solved:
    """What one batch of pairs gives."""

    R: Array  # (p, 3, 3)
    cov: Array  # (p, 3, 3) rad^2
    good: Mask  # (p,)
    still: Mask  # (p,) taken without a translation
    influence: Array  # (p, 3, n) rad per px of the point's residual; 0 where it did not count
    across: Array  # (p, n) px
    normal: Array  # (p, 2, n)
    sigma: Array  # (p,) px


def turns_of_tracks(tracks: FeatureTracks, camera: Camera, plain: bool = False) -> Turns:
    """Return how the camera turned from frame to frame, in its own axes: exp(hat(angle)) = R_w_c(i)^T R_w_c(i + step).

    The lens must be calibrated. `own_cov` and `end_cov` come from the scatter of the points about their epipolar lines, and from how
    much of it two adjacent pairs share (the noise of the frame between them; a tracker's steps share nothing). Left out are pairs of
    which the points do not tell the turn: too few, at odds, or on a plane that has two solutions.

    `plain` takes the points' velocity as that of a rotation alone, u' = A(u) omega, f * gyro near the centre (least squares, robust):
    beside near things it is biased, by 0.3-5 ms of time offset at 0.9 m.
    """
    if tuple(camera.resolution) != tuple(tracks.image_size):
        have, want = ("x".join(map(str, size)) for size in (tracks.image_size, camera.resolution))
        raise BadInputError(
            f"{tracks.camera}: the images are {have}, the camera in the rig file is {want}: give the rig file of this camera"
        )
    if any(value.value is None for value in camera.parameters.values()):
        raise BadInputError(f"{tracks.camera}: the rig file has no full lens for it: run calibkit intrinsics first")
    lens = _Lens(tracks.camera, camera)
    chain = _chain(tracks, lens, _plain if plain else _two_view)
    best, step, period = chain, 2, float(np.median(np.diff(tracks.t_ns))) * 1e-9 if len(tracks.t_ns) > 1 else np.inf
    while not plain and chain.still > _OFTEN and step <= _LONGEST_STEP and step * period <= _LONGEST_S:
        chain = _chain(_every(tracks, step), lens, _two_view)
        best, step = max(best, chain, key=lambda c: c.information), 2 * step
    if not len(best.turns.first):
        raise BadInputError(f"{tracks.camera}: no two frames share enough features to tell a turn: is the scene lit, textured and still?")
    return best.turns


@dataclass(frozen=True)
class _Chain:
    """The turns of one step."""

    turns: Turns
    still: float  # share of pairs without parallax
    information: float  # about a time offset, to a factor: the rate changes in proportion to the time that a turn takes


def _every(tracks: FeatureTracks, step: int) -> FeatureTracks:
    """Return the tracks as if only every step-th image had been taken."""
    keep = tracks.frame % step == 0
    return replace(
        tracks,
        t_ns=tracks.t_ns[::step],
        labels=tracks.labels[::step],
        frame=(tracks.frame[keep] // step).astype(np.int32),
        track=tracks.track[keep],
        uv=tracks.uv[keep],
    )


def _chain(tracks: FeatureTracks, lens: _Lens, solve: Callable[[Matches], _Solved]) -> _Chain:
    """Return the turns between neighbouring frames, chunk by chunk."""
    n_pairs = max(len(tracks.t_ns) - 1, 0)
    angle, cov = np.zeros((n_pairs, 3)), np.zeros((n_pairs, 3, 3))
    good, still = np.zeros((2, n_pairs), bool)
    shared, weight = np.zeros((n_pairs + 1, 3, 3)), np.zeros(2)
    for low in range(0, n_pairs, _CHUNK):
        # One pair more than is kept: the frame between two chunks is shared too.
        batch = _batch(tracks, lens, low, min(low + _CHUNK + 1, n_pairs))
        solved = solve(batch.matches)
        keep = slice(low, min(low + _CHUNK, n_pairs))
        kept = slice(0, keep.stop - keep.start)
        angle[keep], cov[keep] = so3.log(solved.R[kept]), solved.cov[kept] + _ROUNDING**2 * np.eye(3)
        good[keep], still[keep] = solved.good[kept], solved.still[kept]
        ends, moments = _shared(batch, solved)
        shared[low + 1 : low + 1 + len(ends)] = ends
        weight += moments
    both = np.flatnonzero(good[1:] & good[:-1]) + 1
    end_cov = np.zeros_like(shared)
    end_cov[both] = shared[both] * np.clip(-weight[0] / max(weight[1], 1e-300), 0, 1)
    values, vectors = np.linalg.eigh(end_cov)
    end_cov = (vectors * np.maximum(values, 0)[:, None]) @ np.swapaxes(vectors, -1, -2)
    first = np.flatnonzero(good)
    own = _own(cov[first], end_cov[first] + end_cov[first + 1])
    turns = Turns(tracks.t_ns, first, first + 1, angle[first], end_cov[: len(tracks.t_ns)], own)
    information = np.sum(turns.duration**2 * np.trace(np.linalg.inv(cov[first]), axis1=-2, axis2=-1))
    return _Chain(turns, float(still.mean()) if n_pairs else 0.0, float(information))


@dataclass(frozen=True)
class _Batch:
    """The points that consecutive frames low .. high share, pair by pair."""

    matches: Matches
    pair: Rows  # (k,) of each match
    place: Rows  # (k,) where it stands in the pair
    row: Rows  # (k,) its observation in the pair's first frame, into the chunk's rows
    next_row: Rows  # (k,) and in the last


def _batch(tracks: FeatureTracks, lens: _Lens, low: int, high: int) -> _Batch:
    """Return the matches of the pairs low .. high - 1 (frames low .. high)."""
    rows = slice(*np.searchsorted(tracks.frame, [low, high + 1]))
    frame, track = tracks.frame[rows], tracks.track[rows]
    rays, J, valid = lens.rays(tracks.uv[rows])
    order = np.lexsort((frame, track))
    a, b = order[:-1], order[1:]
    same = (track[a] == track[b]) & (frame[b] == frame[a] + 1) & valid[a] & valid[b]
    row, next_row = a[same], b[same]
    by_pair = np.argsort(row, kind="stable")
    row, next_row = row[by_pair], next_row[by_pair]
    pair = (frame[row] - low).astype(np.intp)
    count = np.bincount(pair, minlength=high - low)
    place = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    p, n = high - low, max(int(count.max(initial=0)), 1)
    first, last, jacobian, given = np.zeros((p, 3, n)), np.zeros((p, 3, n)), np.zeros((p, 2, 3, n)), np.zeros((p, n))
    first[pair, :, place], last[pair, :, place], jacobian[pair, :, :, place], given[pair, place] = rays[row], rays[next_row], J[row], 1
    whose = np.zeros((p, n), np.intp)
    whose[pair, place] = np.unique(track[row], return_inverse=True)[1]
    return _Batch(Matches(first, last, jacobian, given, whose), pair, place, row, next_row)


def _two_view(m: Matches) -> _Solved:
    """Return the turns of pairs: rotation alone for a start, the best of several translations, then least squares on what agrees."""
    R_0, cov_0, weights = epipolar.rotation_only(m)
    R_s, t_s = epipolar.starts(m, R_0, weights, _STARTS)
    candidates = [epipolar.refine(m, R, t, _STEPS) for R, t in zip(R_s, t_s, strict=True)]
    R, t = epipolar.choose(m, candidates)
    keep = epipolar.agreeing(m, R, t)
    R, t = epipolar.refine(m, R, t, 3, keep)
    fit = epipolar.trust(m, R, t, keep)
    n = keep.sum(axis=-1)
    certain = ~epipolar.two_fold(m, R, t, keep)
    good = (n >= _FEWEST) & (n >= _FEWEST_SHARE * m.given.sum(axis=-1))
    # Without parallax the translation drops out: the rotation alone, with what the rest of parallax may do to it.
    still = fit.parallax < _LEAST_PARALLAX * fit.sigma
    R[still] = R_0[still]
    cov, influence = fit.cov, fit.influence
    cov[still] = cov_0[still] + epipolar.parallax_cov(m, fit.parallax)[still]
    influence[still] = 0
    largest = np.linalg.eigvalsh(cov)[:, -1]
    return _Solved(
        R,
        cov,
        good & (certain | still) & (epipolar.spread(m) > _LEAST_SPREAD) & (largest < _LARGEST_SIGMA**2),
        still,
        influence,
        fit.across,
        fit.normal,
        fit.sigma,
    )


def _plain(m: Matches) -> _Solved:
    """Return the turns of pairs as if nothing translated."""
    R, cov, _ = epipolar.rotation_only(m)
    enough = (m.given.sum(axis=-1) >= _FEWEST) & (epipolar.spread(m) > _LEAST_SPREAD)
    none = np.zeros_like(m.given)
    return _Solved(R, cov, enough, ~enough, np.zeros_like(m.first), none, np.zeros_like(m.J[:, :, 0]), np.ones(len(R)))


def _shared(batch: _Batch, solved: _Solved) -> tuple[Array, Array]:
    """Return the covariance of each inner frame's part in the turns before and after it, were all noise the frames' own; and two moments.

    A point's residuals before and after, s = h . (n_last - n_first) / sqrt 2 with h across the line, share the middle frame's noise:
    E[s s'] = -lambda sigma^2 h . h' / 2; the moments are sum s s' c and sum c^2 with c = sigma sigma' h . h' / 2, so lambda = -ratio.
    """
    count = int(max(batch.row.max(initial=-1), batch.next_row.max(initial=-1))) + 1
    at = np.full(count, -1)
    at[batch.row] = np.arange(len(batch.row))
    after = at[batch.next_row]
    before = np.flatnonzero(after >= 0)
    after = after[before]
    k, i = batch.pair[before], batch.place[before]
    after_k, j = batch.pair[after], batch.place[after]
    G, G_next = solved.influence[k, :, i], solved.influence[after_k, :, j]
    c = 0.5 * solved.sigma[k] * solved.sigma[after_k] * np.sum(solved.normal[k, :, i] * solved.normal[after_k, :, j], axis=-1)
    c *= np.any(G != 0, axis=-1) & np.any(G_next != 0, axis=-1) & solved.good[k] & solved.good[after_k]
    product = solved.across[k, i] * solved.across[after_k, j]
    p = len(solved.R)
    ends = np.zeros((p, 3, 3))
    np.add.at(ends, k, c[:, None, None] * G[:, :, None] * G_next[:, None, :])
    ends = (ends + np.swapaxes(ends, -1, -2)) / 2
    return ends[: max(p - 1, 0)], np.array([np.sum(product * c), np.sum(c * c)])


def _own(cov: Array, ends: Array) -> Array:
    """Return what of a turn's covariance its ends do not explain, at least a tenth of it in every direction."""
    L = np.linalg.cholesky(cov)
    inverse = np.linalg.inv(L)
    values, vectors = np.linalg.eigh(np.eye(3) - inverse @ ends @ np.swapaxes(inverse, -1, -2))
    half = L @ (vectors * np.sqrt(np.maximum(values, 0.1))[:, None])
    out: Array = half @ np.swapaxes(half, -1, -2)
    return out
