"""A first X that survives wrong poses: closed forms of a few poses at a time, the best by quantiles of what the motions leave over."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calibkit.estimation.hand_eye_data import HandEyeData, Index, Mask
from calibkit.estimation.hand_eye_few_axes import SEEDS, no_axis, one_axis
from calibkit.estimation.hand_eye_methods import park
from calibkit.estimation.hand_eye_pairs import motions, spectrum
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

_DRAWS = 150  # of four poses: of 30 % wrong ones 36 draws have none
_SCORED = 300  # motions
_GOOD = 0.4  # of the motions are taken for right: what is left of them where 37 % of the poses are wrong
_POSES = 60
_ROUNDS = 3
FEWEST_OTHERS = 3  # poses that can contradict one more: of fewer none is thrown out
_OUTSIDE = 4.5  # sigmas; chance leaves out 1 in 6000
_MEDIAN_3 = 1.538  # sigmas: the median length of a 3-vector of unit sigmas
_FINEST = 1e-12


@dataclass(frozen=True)
class Seed:
    """Where the refinement starts."""

    X: Array  # (4, 4)
    Z: Array  # (n_worlds, 4, 4)
    kept: Mask  # (n,)
    rank: int  # axes that the kept poses turn about
    sigma_phi: float  # rad a coordinate, of what is left over
    sigma_rho: float  # m


def seed(data: HandEyeData, rng: np.random.Generator) -> Seed:
    """Return X by RANSAC with Park's, the one-axis and the translations' closed form, then twice again by all poses that fit."""
    draws, scored = _draws(data, rng), _scored(data, rng)
    A, B = motions(data.P, draws.reshape(-1, 2)), motions(data.Q, draws.reshape(-1, 2))
    A, B = A.reshape(*draws.shape[:2], 4, 4), B.reshape(*draws.shape[:2], 4, 4)
    some = slice(0, len(draws) // 3)
    X = np.concatenate([park(A, B), one_axis(A[some], B[some]), no_axis(A[some], B[some])])
    best = X[np.argmin(_scores(X, motions(data.P, scored), motions(data.Q, scored)))]
    kept, sigma_phi, sigma_rho = inliers(data, best)
    rank = 0
    for _ in range(_ROUNDS):
        pairs = _some_pairs(data, kept, rng)
        if len(pairs) == 0:
            break
        A, B = motions(data.P, pairs), motions(data.Q, pairs)
        # Pairs share poses: chance adds what it adds to as many motions as there are poses.
        rank = int(spectrum(A).rank(np.sqrt(2) * sigma_phi * (1 + (np.sqrt(2) + 3) / np.sqrt(len(np.unique(pairs))))))
        trial = SEEDS[rank](A, B, None)
        again, phi, rho = inliers(data, trial)
        if again.sum() < 0.9 * kept.sum():
            break
        best, kept, sigma_phi, sigma_rho = trial, again, phi, rho
    return Seed(best, worlds(data, best, kept), kept, rank, sigma_phi, sigma_rho)


def _some_pairs(data: HandEyeData, kept: Mask, rng: np.random.Generator) -> Index:
    """Return pairs (k, 2) of kept poses of one world: all of up to 60 poses."""
    if data.n_worlds == 1:
        at = np.flatnonzero(kept)
        at = np.sort(rng.permutation(at)[:_POSES])
        return at[all_pairs(len(at))]
    pairs = pairs_within(data.slots)
    return pairs[kept[pairs].all(axis=1)]


def all_pairs(n: int) -> Index:
    """Return the pairs (k, 2) of n poses."""
    return np.array(list(combinations(range(n), 2)), np.intp).reshape(-1, 2)


def worlds(data: HandEyeData, X: Array, kept: Mask) -> Array:
    """Return each world's Z (n_worlds, 4, 4): medians of P_i X Q_i^-1 over the kept poses, over all where none is."""
    each = data.P @ X @ se3.inverse(data.Q)
    slots = data.slots
    lonely = np.bincount(data.world, kept, data.n_worlds) < 1
    used = (slots >= 0) & (kept[slots] | lonely[:, None])
    Z = _median(each.reshape(-1, 16)[slots], used).reshape(-1, 4, 4)
    Z = se3.make(so3.project(Z[:, :3, :3]), Z[:, :3, 3])
    for _ in range(2 if slots.shape[1] > 2 else 0):  # of two poses it is their mean already
        Z = se3.retract(Z, _median(se3.local(Z[data.world], each)[slots], used))
    return Z


def inliers(data: HandEyeData, X: Array) -> tuple[Mask, float, float]:
    """Return which poses fit X and their world's median Z, and the sigmas of a coordinate, rad and m, by median."""
    Z = worlds(data, X, np.ones(len(data.P), bool))
    left = se3.local(Z[data.world] @ data.Q, data.P @ X)
    rho, phi = np.linalg.norm(left[:, :3], axis=1), np.linalg.norm(left[:, 3:], axis=1)
    sigma_rho, sigma_phi = (max(float(np.median(v)) / _MEDIAN_3, _FINEST) for v in (rho, phi))
    fit = (rho < _OUTSIDE * sigma_rho) & (phi < _OUTSIDE * sigma_phi)
    return fit | (len(fit) <= FEWEST_OTHERS), sigma_phi, sigma_rho


def _draws(data: HandEyeData, rng: np.random.Generator) -> Index:
    """Return draws (d, k, 2) of pairs: all pairs of four poses, or three motions of three worlds."""
    n = len(data.P)
    if data.n_worlds == 1:
        size = min(4, n)
        quads = np.argsort(rng.random((_DRAWS, min(n, 400))), axis=1)[:, :size]
        quads = np.sort(rng.permutation(n)[:400])[quads] if n > 400 else quads
        return quads[:, all_pairs(size)]
    pairs = pairs_within(data.slots)
    return pairs[rng.integers(0, len(pairs), (_DRAWS, min(3, len(pairs))))]


def _scored(data: HandEyeData, rng: np.random.Generator) -> Index:
    """Return pairs (k, 2) by chance: those that turn most are the wrong poses' own."""
    if data.n_worlds > 1:
        pairs = pairs_within(data.slots)
        return pairs[rng.permutation(len(pairs))[:_SCORED]]
    n = len(data.P)
    if n * (n - 1) // 2 <= _SCORED:
        return all_pairs(n)
    i = rng.integers(0, n, _SCORED)
    return np.stack([i, (i + rng.integers(1, n, _SCORED)) % n], axis=1)


def pairs_within(slots: Index) -> Index:
    """Return pairs (k, 2) of poses of one world half and a quarter of its length apart."""
    most = slots.shape[1]
    out = []
    for lag in {max(1, most // 2), max(1, most // 4)}:
        pairs = np.stack([slots[:, :-lag], slots[:, lag:]], axis=-1).reshape(-1, 2)
        out.append(pairs[pairs.min(axis=1) >= 0])
    return np.concatenate(out)


def _scores(X: Array, A: Array, B: Array) -> Array:
    """Return, for X (d, 4, 4), the log of the product of the 40 % quantiles of angle and of distance between A X and X B: free of scale."""
    AX = np.einsum("kab,dbc->dkac", A[:, :3], X, optimize=True)
    XB = np.einsum("dab,kbc->dkac", X[:, :3], B, optimize=True)
    left = AX - XB
    angle = np.sqrt(np.sum(left[..., :3] ** 2, axis=(-1, -2)) / 2)
    distance = np.linalg.norm(left[..., 3], axis=-1)
    at = int(_GOOD * (A.shape[0] - 1))
    quantiles = [np.partition(v, at, axis=1)[:, at] for v in (angle, distance)]
    out: Array = np.log(quantiles[0] + _FINEST) + np.log(quantiles[1] + _FINEST)
    return out


def _median(values: Array, used: Mask) -> Array:
    """Return medians (w, c) of values (w, k, c) where used (w, k): at least one in each row."""
    if used.all():
        return np.asarray(values.mean(axis=1) if values.shape[1] == 2 else np.median(values, axis=1))
    ordered = np.sort(np.where(used[..., None], values, np.inf), axis=1)
    count = used.sum(axis=1)
    at = np.arange(len(values))
    out: Array = (ordered[at, (count - 1) // 2] + ordered[at, count // 2]) / 2
    return out
