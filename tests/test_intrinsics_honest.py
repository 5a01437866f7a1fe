"""Sigmas that mean what they say: errors over many seeds in units of the claimed sigma, and OpenCV's sigmas on the same corners.

`pytest -m slow -s tests/test_intrinsics_honest.py` prints the figures of docs/figures.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from lens_samples import LENSES, T_CAM1_CAM0, board_views, rig_views
from scipy.stats import chi2

from calibkit.data.observations import BoardViews
from calibkit.data.verdict import Status
from calibkit.estimation.camera_rig_seed import match_instants
from calibkit.estimation.lens_fit import fit_lenses
from calibkit.estimation.lens_trust import lens_covariance
from calibkit.estimation.lens_verdict import judge_lens
from calibkit.geometry import se3
from calibkit.models.board import AprilGrid
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.simulation.camera import SimCamera
from calibkit.simulation.scenarios import SCENARIOS
from calibkit.simulation.session import simulate_session, simulate_views

FRAMES = 40


@dataclass(frozen=True)
class Case:
    """Cameras, cam0 first, and how a seed makes their views."""

    cameras: tuple[SimCamera, ...]
    views: Callable[[int], list[BoardViews]]
    has_prior: bool = False  # what the corners do not tell has a prior's sigma, and an error below it


def alone(model: str) -> Case:
    return Case((LENSES[model],), lambda seed: [board_views(model, FRAMES, seed)])


def rational() -> Case:
    """A small board: the corners do not tell the eight coefficients apart, and a pole could settle beside a zero."""
    model = "pinhole-radtan8"
    return Case((LENSES[model],), lambda seed: [board_views(model, 30, seed, board=AprilGrid(4, 4, 0.13, 0.3))], has_prior=True)


def moving() -> Case:
    """30 s at 4 Hz before the board: neighbouring views are alike, and blocks of seconds hold several of them."""
    camera = replace(SCENARIOS["aprilgrid"].cameras[0], rate_hz=4.0)
    scenario = replace(SCENARIOS["aprilgrid"], cameras=(camera,))
    return Case(scenario.cameras, lambda seed: [simulate_views(simulate_session(scenario, seed))[0]])


def pair() -> Case:
    cameras = (LENSES["pinhole-radtan"], SCENARIOS["fisheye-imu"].cameras[0])
    return Case(cameras, lambda seed: rig_views(list(cameras), [np.eye(4), T_CAM1_CAM0], FRAMES, seed))


CASES = {
    **{model: alone(model) for model in ("pinhole-radtan", "pinhole-radtan5", "pinhole-equi")},
    "pinhole-radtan8": rational(),
    "pinhole-radtan in motion": moving(),
    "pinhole-radtan and pinhole-equi": pair(),
}


def normalised_errors(case: Case, seed: int) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return names, (estimate - truth) / corrected sigma, and the same whitened by the full covariance, of one run."""
    views = case.views(seed)
    fit = fit_lenses(views, [camera.model.name for camera in case.cameras], match_instants(views))
    names = [f"cam{c}.{name}" for c, camera in enumerate(case.cameras) for name in camera.model.parameter_names]
    errors = [lens - camera.params for lens, camera in zip(fit.state.lenses, case.cameras, strict=True)]
    if len(case.cameras) == 2:
        names += [f"T_cam1_cam0.{axis}" for axis in ("rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z")]
        errors.append(se3.local(T_CAM1_CAM0, fit.state.T_cam_cam0[1]))
    error, cov = np.concatenate(errors), lens_covariance(fit).corrected
    sigma = np.sqrt(np.diag(cov))
    return names, error / sigma, np.linalg.solve(np.linalg.cholesky(cov / sigma / sigma[:, None]), error / sigma)


def band(n: int) -> tuple[float, float]:
    """Return the 99.9 % band of the rms of n normalised errors."""
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], n) / n)
    return float(low), float(high)


def check(name: str, seeds: int, pooled_band: tuple[float, float]) -> None:
    runs = [normalised_errors(CASES[name], seed) for seed in range(seeds)]
    names, z, white = runs[0][0], np.array([run[1] for run in runs]), np.array([run[2] for run in runs])
    rms, pooled = np.sqrt(np.mean(z**2, axis=0)), float(np.sqrt(np.mean(white**2)))
    low, high = band(seeds)
    low = 0.0 if CASES[name].has_prior else low
    each = " ".join(f"{n} {value:.2f}" for n, value in zip(names, rms, strict=True))
    told = f"{name}, {seeds} seeds: pooled {pooled:.3f}; per parameter {rms.min():.2f} to {rms.max():.2f} of {low:.2f}-{high:.2f}: {each}"
    print(told)
    assert np.all((rms > low) & (rms < high)), told
    assert pooled_band[0] < pooled < pooled_band[1], told


@pytest.mark.parametrize("name", CASES)
def test_sigmas_are_honest_over_a_few_seeds(name: str) -> None:
    count = 5 * sum(len(camera.params) for camera in CASES[name].cameras)
    check(name, 5, band(count))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_sigmas_are_honest_over_thirty_seeds(name: str) -> None:
    check(name, 30, (0.8, 1.25))


@pytest.mark.parametrize("seed", range(5))
def test_a_rational_lens_has_no_pole_where_corners_are(seed: int) -> None:
    """Numerator and denominator that nearly cancel put cx 14 of its own sigmas off (seed 4)."""
    _, z, _ = normalised_errors(CASES["pinhole-radtan8"], seed)
    assert np.abs(z).max() < 4, z


# A wide lens and one like a depth camera's from its maker: denominators far from 1 all over the image.
@pytest.mark.parametrize(
    ("params", "size"),
    [
        ([610.0, 612.0, 640.0, 360.0, 0.4, -0.2, 1e-4, -3e-4, 0.05, 0.7, -0.1, 0.02], (1280, 720)),
        ([910.0, 909.0, 956.0, 549.0, 0.5, -2.7, 4e-4, -1e-4, 1.6, 0.38, -2.5, 1.5], (1920, 1080)),
    ],
)
def test_the_prior_does_not_move_a_rational_lens_that_corners_tell(params: list[float], size: tuple[int, int], monkeypatch) -> None:
    model = CAMERAS["pinhole-radtan8"]
    views = board_views(SimCamera(model, np.array(params), size), 60, 0)
    fit = fit_lenses([views], [model.name], (np.arange(views.n_frames),))
    sigma = np.sqrt(np.diag(lens_covariance(fit).corrected))
    monkeypatch.setattr(type(model), "prior", lambda self, lens, reach: (np.zeros(0), np.zeros((0, len(lens)))))
    without = fit_lenses([views], [model.name], (np.arange(views.n_frames),))
    assert np.abs((fit.state.lenses[0] - without.state.lenses[0]) / sigma).max() < 0.15
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(lens_covariance(without).corrected)), rtol=0.1)


def pooled_of_few_images(frames: int, seeds: int) -> float:
    """Return the rms of (estimate - truth) / sigma over all parameters of pinhole-radtan lenses that are called determined or weak."""
    z = []
    for seed in range(seeds):
        views = board_views("pinhole-radtan", frames, seed)
        fit = fit_lenses([views], ["pinhole-radtan"], (np.arange(views.n_frames),))
        covariance = lens_covariance(fit)
        if Status.NOT_OBSERVABLE not in judge_lens(fit, 0, covariance, []).statuses:
            z.append((fit.state.lenses[0] - LENSES["pinhole-radtan"].params) / np.sqrt(np.diag(covariance.corrected)))
    print(f"{frames} images: {len(z)} of {seeds} seeds give a lens, pooled {np.sqrt(np.mean(np.square(z))):.3f}")
    return float(np.sqrt(np.mean(np.square(z))))


@pytest.mark.parametrize("frames", [3, 4])
def test_few_images_do_not_give_small_sigmas(frames: int) -> None:
    assert 0.7 < pooled_of_few_images(frames, 15) < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("frames", [3, 4, 6, 10, 20, 40])
def test_few_images_do_not_give_small_sigmas_over_sixty_seeds(frames: int) -> None:
    assert 0.8 < pooled_of_few_images(frames, 60) < 1.25


@pytest.mark.parametrize(("model", "flags"), [("pinhole-radtan", cv2.CALIB_FIX_K3), ("pinhole-radtan5", 0)])
def test_plain_sigmas_are_those_of_opencv(model: str, flags: int) -> None:
    """cv2.calibrateCameraExtended says sqrt(diag((J^T J)^-1) s^2), s^2 = sum r^2 / (2 N - p) over N corners and p unknowns, as we do."""
    views = board_views(model, 30, 0)
    of_frame = [views.frame == f for f in range(views.n_frames)]
    corners = [views.uv[rows].astype(np.float32) for rows in of_frame]
    points = [views.board.points[views.corner[rows]].astype(np.float32) for rows in of_frame]
    rms, K, distortion, _, _, deviations, *_ = cv2.calibrateCameraExtended(points, corners, views.image_size, None, None, flags=flags)
    count = len(LENSES[model].params)
    theirs, theirs_sigma = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion.ravel()])[:count], deviations.ravel()[:count]

    fit = fit_lenses([views], [model], (np.arange(views.n_frames),), robust=False)
    covariance = lens_covariance(fit)
    ours_sigma = np.sqrt(np.diag(covariance.plain))
    unknowns = count + 6 * views.n_frames
    assert np.abs((fit.state.lenses[0] - theirs) / ours_sigma).max() < 0.02
    # Each divided by its own variance factor: the sigmas of corners of 1 px.
    factor = rms**2 * len(views.uv) / (2 * len(views.uv) - unknowns)
    unit_of_ours = ours_sigma / np.sqrt(covariance.variance_factor) / views.sigma_px[0]
    np.testing.assert_allclose(theirs_sigma / np.sqrt(factor), unit_of_ours, rtol=0.02)
    np.testing.assert_allclose(theirs_sigma, ours_sigma, rtol=0.02)
