"""Robust poses of a flat board under a known lens, and which of them might be the other one: its two-fold ambiguity.

A flat board that is small or far looks the same tilted towards the camera and away from it; |r|^2 has a minimum at both
(Schweighofer and Pinz 2006), and only perspective tells them apart.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.camera_problem import CameraViews
from calibkit.estimation.flat_views import FlatViews, Weigh
from calibkit.estimation.lens_fit import MIN_CORNERS, OUTLIER
from calibkit.estimation.lens_seed import poses_from_rays
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array

_FINEST = 1e-3  # sigmas: below, |r|^2 is the rounding of its sum
_MEDIAN = np.sqrt(2 * np.log(2))  # of a Rayleigh distribution, in sigmas per coordinate
_PULLS, _CUTS, _MANY_CUTS = 5, 2, 10  # many where a start may be far off
_DRAWS = 24  # a third of the corners may be wrong: one view in 200 has then no draw without one
_PART = 32  # corners of a view that are enough to start from
_SUSPECT = 2.0  # times the views' median noise: seeded anew
_BETTER = 30.0  # chi-squared by which a pose must beat its reflection: exp(-15) of the likelihood is left to that
_FAR = 500.0  # the same before the reflection is refined, which takes most of what can be taken but not nine tenths
_SAME = 9.0  # chi-squared between two poses that the covariance takes for one

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class FlatPoses:
    """The best pose of each view."""

    T_cam_board: Array  # (f, 4, 4)
    scale: Array  # (f,) the view's noise in sigmas per coordinate, by its median residual; inf where there is no pose
    kept: Mask  # (f, n) corners within 4.5 times the noise
    ambiguous: Mask  # (f,) the reflected pose fits as well


def flat_poses(views: CameraViews, lens: Array, points: Array) -> FlatPoses:
    """Return each view's pose by itself; one with fewer than six corners in the lens's domain has none."""
    flat = FlatViews.under(views, lens, points)
    part = flat.corners(slice(None, None, max(1, int(np.median(flat.seen.sum(axis=1))) // _PART)))
    start = poses_from_rays(np.swapaxes(part.ray, 1, 2), part.seen, part.points).T_cam_board
    T, scale = _settle(flat, _pulled(part, start))
    typical = _typical(scale)
    suspect = np.flatnonzero(np.isfinite(scale) & (scale > _SUSPECT * typical))
    if len(suspect):
        rows = flat.rows(suspect)
        again, its_scale = _settle(rows, _pulled(rows, _drawn(rows)), typical, _MANY_CUTS)
        better = its_scale < scale[suspect]
        T[suspect[better]], scale[suspect[better]] = again[better], its_scale[better]
    ambiguous = _choose(flat, T, scale, typical)
    return FlatPoses(T, scale, flat.seen & (flat.squares(T) <= _limit(scale, typical)), ambiguous)


def _choose(flat: FlatViews, T: Array, scale: Array, typical: float) -> Mask:
    """Put the reflected pose in the place of one that fits worse, in T and scale; return where neither is clearly better."""
    noise = np.maximum(scale, typical)
    other, ambiguous = _reflected(flat, T), np.zeros(len(T), bool)
    in_doubt = (_cost(flat, other, noise) - _cost(flat, T, noise) < _FAR) | (scale > _SUSPECT * typical)
    near = np.flatnonzero(in_doubt & np.isfinite(scale))
    if len(near):
        T[near], scale[near], ambiguous[near] = _told_apart(flat.rows(near), T[near], other[near], typical)
    return ambiguous


def _pulled(flat: FlatViews, T: Array) -> Array:
    """Return poses near the least sum of |r| (Weiszfeld 1937), which a few wrong corners do not move far."""
    for _ in range(_PULLS):
        T = flat.step(T, lambda squares: 1 / np.sqrt(np.maximum(squares, 1.0)))
    return T


def _drawn(flat: FlatViews) -> Array:
    """Return for each view the pose of four corners, among some draws of four, that has the least median of |r| (Rousseeuw 1984)."""
    rng = np.random.default_rng(0)
    rays = np.swapaxes(flat.ray, 1, 2)
    T, best = np.tile(np.eye(4), (len(rays), 1, 1)), np.full(len(rays), np.inf)
    for _ in range(_DRAWS):
        lot = np.where(flat.seen, rng.random(flat.seen.shape), np.inf)
        four = lot <= np.partition(lot, 3, axis=1)[:, 3:4]
        drawn = poses_from_rays(rays, four & flat.seen, flat.points).T_cam_board
        scale = _scales(flat, drawn)
        better = scale < best
        T[better], best[better] = drawn[better], scale[better]
    return T


def _settle(flat: FlatViews, T: Array, typical: float | None = None, cuts: int = _CUTS) -> tuple[Array, Array]:
    """Return poses by least squares without what lies beyond 4.5 sigmas, and their scales, from a good start.

    `typical` is the least noise that a view is believed to have: without it, the median of these views' own.
    """
    for _ in range(cuts):
        scale = _scales(flat, T)
        limit = _limit(scale, _typical(scale) if typical is None else typical)
        T = flat.step(T, _within(limit))
    return T, _scales(flat, T)


def _within(limit: Array) -> Weigh:
    """Return the weighing that takes corners up to a limit of |r|^2 for what they are, and others not at all."""
    return lambda squares: np.where(squares <= limit, 1.0, 0.0)


def _scales(flat: FlatViews, T: Array) -> Array:
    """Return each view's noise from the median of |r|, raised by what the six numbers of its pose take from it; inf without a pose."""
    count = flat.seen.sum(axis=1)
    squares = np.sort(np.where(flat.seen, flat.squares(T), np.inf), axis=1)
    middle = np.sqrt(np.take_along_axis(squares, (count // 2)[:, None], axis=1)[:, 0])
    enough = count >= MIN_CORNERS
    return np.where(enough, middle / _MEDIAN / np.sqrt(1 - 3 / np.maximum(count, MIN_CORNERS)), np.inf)


def _typical(scale: Array) -> float:
    finite = scale[np.isfinite(scale)]
    return max(float(np.median(finite)), _FINEST) if len(finite) else _FINEST


def _limit(scale: Array, typical: float) -> Array:
    """Return |r|^2 (f, 1) beyond which a corner is given up."""
    limit: Array = (OUTLIER * np.maximum(scale, typical))[:, None] ** 2
    return limit


def _cost(flat: FlatViews, T: Array, noise: Array) -> Array:
    """Return each view's chi-squared for this noise, a corner beyond 4.5 times it counted as one at it."""
    chi2: Array = np.minimum(flat.squares(T) / noise[:, None] ** 2, OUTLIER**2).sum(axis=1)
    return chi2


def _reflected(flat: FlatViews, T: Array) -> Array:
    """Return a start for the other minimum: the board's directions with their part along the line of sight turned round.

    R' = (I - 2 v v^T) R diag(1, 1, -1), v towards the middle of the seen corners, which stays where it is.
    """
    middle = flat.seen @ flat.points / np.maximum(flat.seen.sum(axis=1), 1)[:, None]
    centre = (T[:, :3, :3] @ middle[:, :, None])[..., 0] + T[:, :3, 3]
    v = centre / np.maximum(np.linalg.norm(centre, axis=1, keepdims=True), 1e-300)
    R = (np.eye(3) - 2 * v[:, :, None] * v[:, None, :]) @ T[:, :3, :3] * np.array([1.0, 1.0, -1.0])
    return se3.make(R, centre - (R @ middle[:, :, None])[..., 0])


def _told_apart(flat: FlatViews, T: Array, other: Array, typical: float) -> tuple[Array, Array, Mask]:
    """Return the better one of two poses of each view, its scale, and whether the other one is as good, and another."""
    T, scale = _settle(flat, T, typical, _MANY_CUTS)
    other, its_scale = _settle(flat, _pulled(flat, other), typical, _MANY_CUTS)
    noise = np.maximum(np.minimum(scale, its_scale), typical)
    gain = _cost(flat, other, noise) - _cost(flat, T, noise)
    swap = gain < 0
    T, other = np.where(swap[:, None, None], other, T), np.where(swap[:, None, None], T, other)
    return T, np.where(swap, its_scale, scale), (np.abs(gain) < _BETTER) & (_between(flat, T, other, noise) > _SAME)


def _between(flat: FlatViews, T: Array, other: Array, noise: Array) -> Array:
    """Return chi-squared (f,) of the step from T to another pose under T's information, which is large where a covariance denies it."""
    information, _ = flat.normal(T, _within((OUTLIER * noise[:, None]) ** 2))
    step = se3.local(T, other)
    chi2: Array = np.einsum("fi,fij,fj->f", step, information, step) / noise**2
    return chi2
