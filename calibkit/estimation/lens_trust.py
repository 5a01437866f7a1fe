"""How far fitted lenses and camera positions may be trusted: covariance, what the views can tell, projection uncertainty."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.camera_problem import CameraProblem, CameraViews
from calibkit.estimation.lens_fit import LensFit, instant_times, part_of
from calibkit.estimation.pixel_grid import GRID, grid, turned_jacobian
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import SCALES, Covariance, covariance_in_time

_SAME_ORIENTATION = np.deg2rad(5.0)
_OUTERMOST = 99.0  # percentile of an effect over the corners: at the outermost, but for a stray one
_BIAS_INSTANTS = 60
_BIAS_PATCHES = (4, 3)


def lens_covariance(fit: LensFit, least: float = 0.0) -> Covariance:
    """Return the covariance of the border (lenses, then T_cam_cam0 of camera 1, 2, ...), plain and corrected.

    The corrected variance is in no direction below `least` times the plain one.
    """
    S, scores = fit.problem.information(fit.state)
    chi2, corners = 0.0, 0
    for c, camera in enumerate(fit.problem.cameras):
        r = fit.problem.residuals(fit.state, c)
        chi2 += float(np.sum(r.px**2 * camera.weight[..., None] ** 2))
        corners += int(np.sum(camera.weight > 0))
    freedom = max(2 * corners - 6 * len(fit.state.T_cam0_board) - S.shape[-1], 1)
    scales = border_scales(fit.problem, fit.state.lenses)
    found = covariance_in_time(S, scores, instant_times(fit), chi2 / freedom, scales, fit.problem.prior(fit.state.lenses)[1], least)
    return replace(found, corrected=found.corrected + _bias_covariance(fit))


def _bias_covariance(fit: LensFit) -> Array:
    """Return what the detectors' own bias does to the border: sum over patches of d d^T, d = S^-1 g of a patch's corners all shifted.

    No number of frames averages it out, so it does not depend on theirs: it is worked out on a part of them. Each patch of the image
    errs by itself, by sigma_bias_px in x and in y.
    """
    size = fit.problem.border_size
    total = np.zeros((size, size))
    if not any(views.sigma_bias_px for views in fit.views):
        return total
    m = len(fit.state.T_cam0_board)
    some = np.zeros(m, bool)
    some[np.linspace(0, m - 1, min(m, _BIAS_INSTANTS)).astype(int)] = True
    problem, state = part_of(fit, [some[camera.instant] for camera in fit.problem.cameras])
    S, _ = problem.information(state)
    inverse = np.linalg.pinv(S.sum(axis=0) + problem.prior(state.lenses)[1] * np.mean(some), rcond=1e-14, hermitian=True)
    for c, (views, camera) in enumerate(zip(fit.views, problem.cameras, strict=True)):
        predicted = camera.uv - problem.residuals(state, c).px
        silent = tuple(replace(other, uv=other.uv - problem.residuals(state, k).px) for k, other in enumerate(problem.cameras))
        for uv in biased(predicted, camera.image_size, views.sigma_bias_px):
            cameras = (*silent[:c], replace(camera, uv=uv), *silent[c + 1 :])
            _, scores = replace(problem, cameras=cameras).information(state)
            shift = inverse @ scores.sum(axis=0)
            total += np.outer(shift, shift)
    return total


def biased(predicted: Array, image_size: tuple[int, int], sigma_px: float) -> Iterator[Array]:
    """Yield the corners (..., 2) with those of one patch of the image moved in x or y by one sigma of the detector's bias."""
    patch = np.clip(predicted / image_size * _BIAS_PATCHES, 0, np.array(_BIAS_PATCHES) - 1).astype(int)
    patch_number = patch[..., 0] + _BIAS_PATCHES[0] * patch[..., 1]
    for number, axis in product(range(_BIAS_PATCHES[0] * _BIAS_PATCHES[1]), range(2)):
        uv = predicted.copy()
        uv[..., axis] += np.where(patch_number == number, sigma_px, 0.0)
        yield uv


def border_scales(problem: CameraProblem, lenses: tuple[Array, ...]) -> Array:
    """Return what each border parameter must be known to: lenses by `lens_scales`, transforms 1 mm and 1 mrad."""
    scales = np.empty(problem.border_size)
    for views, lens, where in zip(problem.cameras, lenses, problem.lens_slices, strict=True):
        scales[where] = lens_scales(views, lens)
    for c in range(1, len(problem.cameras)):
        scales[problem.rig_slice(c)] = [SCALES["m"]] * 3 + [SCALES["rad"]] * 3
    return scales


def lens_scales(views: CameraViews, lens: Array) -> Array:
    """Return what each parameter of a lens must be known to.

    1 px of focal length and centre; of each coefficient what moves a pixel by 1 px where the outermost corners were (at the edge of
    what was seen: the 99th percentile of |duv/dk| over the corners).
    """
    J = _corner_jacobians(views, lens)
    effect = np.percentile(np.linalg.norm(J, axis=-2), _OUTERMOST, axis=0) if len(J) else np.ones(len(lens))
    effect[:4] = 1.0
    scales: Array = SCALES["px"] / np.maximum(effect, 1e-9)
    return scales


def _corner_jacobians(views: CameraViews, lens: Array) -> Array:
    """Return duv/dlens (k, 2, p) at a few thousand of the corners."""
    uv = views.uv[views.weight > 0]
    rays, valid = views.model.unproject(uv[:: max(1, len(uv) // 5000)], lens)
    J = views.model.project(rays[valid], lens, jacobians=True).J_params
    assert J is not None
    return J


@dataclass(frozen=True)
class PixelEffect:
    """What a lens's uncertainty moves where corners were: the 99th percentile over the corners, px."""

    parameters: Array  # (p,) by one sigma of each parameter, the others following it as they are correlated
    weakest: Array  # (p,) the motion of one sigma that moves the corners most
    weakest_px: float


def pixel_effect(views: CameraViews, lens: Array, cov_lens: Array) -> PixelEffect:
    """Return how far one sigma moves pixels: J cov[:, i] / sigma_i by parameter, J F w for the motion that moves them most.

    Coefficients that make up for each other are each uncertain by far more than any pixel is; what counts is the pixel. F F^T = cov, w is
    the top eigenvector of the mean of (J F)^T J F.
    """
    J = _corner_jacobians(views, lens)
    sigma = np.sqrt(np.diag(cov_lens))
    values, vectors = np.linalg.eigh(cov_lens / sigma[:, None] / sigma)
    F = sigma[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    moved = J @ F
    motion = F @ np.linalg.eigh(np.mean(np.swapaxes(moved, 1, 2) @ moved, axis=0))[1][:, -1]
    by_parameter = np.percentile(np.linalg.norm(J @ (cov_lens / sigma), axis=-2), _OUTERMOST, axis=0)
    return PixelEffect(by_parameter, motion, float(np.percentile(np.linalg.norm(J @ motion, axis=-1), _OUTERMOST)))


@dataclass(frozen=True)
class Orientations:
    """How many different board orientations a camera saw."""

    count: int  # directions of the board's normal that differ by 5 degrees or more
    spread: float  # rad, the largest angle between two of them
    tilt: float  # rad, the largest angle between the normal and the viewing direction


def orientations(problem: CameraProblem, fit: LensFit, c: int) -> Orientations:
    """Count the board's orientations: one plane's image fixes two of fx fy cx cy, a parallel plane adds nothing (Zhang 2000, 3.2)."""
    normals = problem.residuals(fit.state, c).board_normal
    cosine = normals @ normals.T
    kept: list[int] = []
    for i in range(len(normals)):
        if all(cosine[i, k] < np.cos(_SAME_ORIENTATION) for k in kept):
            kept.append(i)
    tilt = np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1)).max()
    return Orientations(len(kept), float(np.arccos(np.clip(cosine.min(), -1, 1))), float(tilt))


@dataclass(frozen=True)
class ProjectionSigma:
    """Uncertainty of projected far points over the image, the freedom of turning the whole camera taken out."""

    uv: Array  # (g, 2) px
    sigma: Array  # (g,) px, larger axis; NaN outside the model's domain
    seen: NDArray[np.bool_]  # (g,) corners were observed in this cell


def projection_sigma(views: CameraViews, lens: Array, cov_lens: Array) -> ProjectionSigma:
    """Return sigma of the pixel of a far point where the lens is uncertain, as mrcal draws it (Kogan 2021).

    du = J dlens + J_R phi, with phi the common rotation that best absorbs the first over the observed part of the image.
    """
    width, height = views.image_size
    uv = grid(views.image_size)
    observed = views.uv[views.weight > 0]
    cell = np.clip((observed + 0.5) / [width, height] * GRID, 0, np.array(GRID) - 1).astype(int)
    seen = np.zeros(GRID[::-1], bool)
    seen[cell[:, 1], cell[:, 0]] = True
    rays, valid = views.model.unproject(uv, lens)
    fit_at = seen.ravel() & valid if (seen.ravel() & valid).any() else valid
    J = turned_jacobian(views.model, lens, rays, fit_at)
    cov = J @ cov_lens @ np.swapaxes(J, -1, -2)
    sigma = np.full(len(uv), np.nan)
    sigma[valid] = np.sqrt(np.maximum(np.linalg.eigvalsh(cov[valid])[:, -1], 0))
    return ProjectionSigma(uv, sigma, seen.ravel())
