"""Which further board view would help a lens most: tried out on the model before anyone lifts the board."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from calibkit.estimation.camera_problem import CameraViews, LensState
from calibkit.estimation.lens_fit import LensFit
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

REGIONS = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)
_TILT = np.deg2rad(40.0)
_GRAZING = 0.2  # cosine; a board seen from so flat an angle, or from behind, shows no corners
_TILTS = {
    "facing the camera": (0.0, 0.0),
    "tilted 40 deg about the image's x axis": (_TILT, 0.0),
    "tilted 40 deg about the image's y axis": (0.0, _TILT),
}


@dataclass(frozen=True)
class Advice:
    """A view to add and what it would do."""

    text: str  # "the board tilted 40 deg about the image's x axis, in the lower right"
    sigma_ratio: float  # sigma along the weak direction after ten such views, over today's


def region_of(uv: Array, size: tuple[int, int]) -> str:
    """Name the ninth of the image that a pixel (2,) lies in."""
    column, row = np.clip((np.asarray(uv) + 0.5) / size * 3, 0, 2).astype(int)
    return REGIONS[row][column]


def seen_regions(views: CameraViews, lens: Array) -> dict[str, Array]:
    """Return the ray (3,) of the middle of every ninth of the image that the lens sees: a fisheye's circle may leave the corners out."""
    width, height = views.image_size
    centres = np.array([[(i + 0.5) * width / 3, (j + 0.5) * height / 3] for j, i in product(range(3), range(3))]) - 0.5
    rays, valid = views.model.unproject(centres, lens)
    return {region_of(centre, views.image_size): ray for centre, ray, ok in zip(centres, rays, valid, strict=True) if ok}


def best_view(fit: LensFit, c: int, cov: Array, weak: Array, variance_factor: float) -> Advice | None:
    """Return the view that lowers the variance of weak . lens most, None when no view could be placed.

    Ten views add information: Sigma' = (Sigma^-1 + 10 S_view / s^2)^-1, S_view from the same Jacobians at the present lens.
    """
    views, lens = fit.problem.cameras[c], fit.state.lenses[c]
    width, height = views.image_size
    distance = float(np.median(np.linalg.norm(fit.state.T_cam0_board[:, :3, 3], axis=-1)))
    usual = np.median(views.weight[views.weight > 0])
    facing = _usual_orientation(fit, c)
    middle = fit.problem.points.mean(axis=0)
    best: Advice | None = None
    prior = np.linalg.pinv(cov, hermitian=True)
    today = float(np.sqrt(weak @ cov @ weak))
    for (name, tilt), (region, ray) in product(_TILTS.items(), seen_regions(views, lens).items()):
        R = so3.exp(np.array([*tilt, 0.0])) @ facing
        if facing[2, 2] * (R[:, 2] @ ray) < _GRAZING:
            continue
        T = se3.make(R, ray * distance - R @ middle)
        p = views.model.project(se3.transform(T, fit.problem.points), lens)
        inside = p.valid & np.all((p.uv > 0) & (p.uv < np.array([width, height]) - 1.0), axis=-1)
        if inside.sum() < 8:
            continue
        one = CameraViews(views.model, np.zeros(1, np.int64), p.uv[None], np.where(inside, usual, 0.0)[None], views.image_size)
        problem = replace(fit.problem, cameras=(one,))
        S, _ = problem.information(LensState((lens,), np.eye(4)[None], T[None]))
        after = float(np.sqrt(weak @ np.linalg.inv(prior + 10 * S[0] / variance_factor) @ weak))
        if best is None or after / today < best.sigma_ratio:
            best = Advice(f"the board {name}, in the {region} of the image", after / today)
    return best


def _usual_orientation(fit: LensFit, c: int) -> Array:
    """Return R_cam_board of a board that faces the camera, turned in its plane as it usually was."""
    R = (fit.state.T_cam_cam0[c] @ fit.state.T_cam0_board[fit.problem.cameras[c].instant])[:, :3, :3]
    side = np.sign(np.median(R[:, 2, 2])) or 1.0
    x = np.median(R[:, :, 0], axis=0) * [1, 1, 0]
    if np.linalg.norm(x) < 1e-6:
        x = np.array([1.0, 0, 0])
    x = x / np.linalg.norm(x)
    z = np.array([0, 0, side])
    return np.stack([x, np.cross(z, x), z], axis=-1)
