"""Every way of solving for X beside the refined one: the closed forms on the poses that were kept, and the scatter that each leaves."""

from dataclasses import dataclass

import numpy as np

from calibkit.estimation.hand_eye_data import HandEyeData, Index, Mask
from calibkit.estimation.hand_eye_methods import METHODS
from calibkit.estimation.hand_eye_pairs import choose_pairs, motions
from calibkit.estimation.hand_eye_refine import Refined
from calibkit.estimation.hand_eye_robust import all_pairs, pairs_within
from calibkit.estimation.hand_eye_world import WORLD_METHODS
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

_EVERY_PAIR = 100  # poses: up to as many, all pairs
_PAIRS = 150
_FAR_FROM = 5.0  # sigmas of the refined X, and both limits below: a closed form that is farther has failed
_FAR_TURN, _FAR_SHIFT = np.deg2rad(0.2), 5e-3


@dataclass(frozen=True)
class Scatter:
    """How far P_i X Q_i^-1, which should be one transform, lies from its mean: rms over poses."""

    angle: float  # rad
    distance: float  # m


@dataclass(frozen=True)
class Method:
    """What one way of solving gives, on the poses that the refinement kept."""

    X: Array
    scatter: Scatter
    angle: float  # rad to the refined X
    distance: float  # m
    failed: bool  # far from the refined X by its sigmas and by more than 0.2 deg or 5 mm


def fixed_transforms(data: HandEyeData, X: Array, kept: Mask) -> Array:
    """Return the mean (n_worlds, 4, 4) of P_i X Q_i^-1 over kept poses, identity in a world without."""
    return _means(data, data.P @ X @ se3.inverse(data.Q), kept)


def _means(data: HandEyeData, each: Array, kept: Mask) -> Array:
    sums = data.sum_by_world(each * kept[:, None, None])
    sums[sums[:, 3, 3] == 0] = np.eye(4)
    means = sums / sums[:, 3:, 3:]
    return se3.make(so3.project(means[:, :3, :3]), means[:, :3, 3])


def scatter(data: HandEyeData, X: Array, kept: Mask) -> Scatter:
    """Return how far P_i X Q_i^-1 of kept poses lies from the mean of its world, rms."""
    if not kept.any():
        return Scatter(0.0, 0.0)
    each = data.P @ X @ se3.inverse(data.Q)
    angle, distance = apart(_means(data, each, kept)[data.world], each)
    return Scatter(float(np.sqrt(np.mean(angle[kept] ** 2))), float(np.sqrt(np.mean(distance[kept] ** 2))))


def pairs_of(data: HandEyeData, among: Mask) -> Index:
    """Return pairs (k, 2): all up to 100 poses, beyond that those that turn far about different axes; of many worlds within each."""
    at = np.flatnonzero(among)
    if data.n_worlds > 1:
        pairs = pairs_within(data.slots)
        return pairs[among[pairs].all(axis=1)]
    if len(at) <= _EVERY_PAIR:
        return at[all_pairs(len(at))]
    some = at[:: max(1, len(at) // _PAIRS)]
    return some[choose_pairs(data.P[some], _PAIRS)]


def solve(name: str, data: HandEyeData, kept: Mask, pairs: Index) -> tuple[Array, Array]:
    """Return X (4, 4) and Z (n_worlds, 4, 4) by a closed form on pairs (k, 2) of kept poses; where it has no Z, the mean P X Q^-1."""
    if name in METHODS:
        X = METHODS[name](motions(data.P, pairs), motions(data.Q, pairs), None)
        return X, fixed_transforms(data, X, kept)
    X, Z = WORLD_METHODS[name](data.P[kept], data.Q[kept], None)
    return X, Z[None]


def methods_of(data: HandEyeData, found: Refined, cov: Array, pairs: Index) -> dict[str, Method]:
    """Return every closed form on the poses that were kept, failures too; those of A X = Z B are for one world."""
    sigma_p, sigma_R = (float(np.sqrt(np.linalg.eigvalsh(cov[part, part])[-1])) for part in (slice(0, 3), slice(3, 6)))
    A, B = motions(data.P, pairs), motions(data.Q, pairs)
    out = {}
    for name in (*METHODS, *(WORLD_METHODS if data.n_worlds == 1 else ())):
        X = METHODS[name](A, B, None) if name in METHODS else WORLD_METHODS[name](data.P[found.kept], data.Q[found.kept], None)[0]
        angle, distance = (float(v) for v in apart(found.X, X))
        failed = angle > max(_FAR_TURN, _FAR_FROM * sigma_R) or distance > max(_FAR_SHIFT, _FAR_FROM * sigma_p)
        out[name] = Method(X, scatter(data, X, found.kept), angle, distance, failed)
    return out


def apart(T: Array, other: Array) -> tuple[Array, Array]:
    """Return angle (...) rad and distance (...) m between two poses."""
    angle: Array = np.linalg.norm(so3.log(np.swapaxes(T[..., :3, :3], -1, -2) @ other[..., :3, :3]), axis=-1)
    distance: Array = np.linalg.norm(T[..., :3, 3] - other[..., :3, 3], axis=-1)
    return angle, distance
