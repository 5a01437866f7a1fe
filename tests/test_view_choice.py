"""Views chosen for information: fewer of them, nearly as much known; and advice that keeps its promise."""

import re
from dataclasses import replace

import numpy as np
from lens_samples import LENSES, T_CAM1_CAM0, rig_views

from calibkit.data.observations import BoardViews
from calibkit.estimation.camera_rig_seed import match_instants
from calibkit.estimation.lens_fit import LensFit, fit_lenses
from calibkit.estimation.lens_trust import lens_covariance
from calibkit.estimation.lens_verdict import judge_lens
from calibkit.estimation.view_advice import best_view, region_of, seen_regions
from calibkit.estimation.view_choice import choose_views, greedy_log_det
from calibkit.geometry import se3
from calibkit.models.board import AprilGrid
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import SimCamera, random_board_poses
from calibkit.simulation.corners import simulate_board_views, views_of_poses

MODEL = "pinhole-radtan"
CAMERA = SimCamera(CAMERAS[MODEL], np.array([458.6, 457.3, 367.2, 248.4, -0.283, 0.074, 2e-4, 2e-5]), (752, 480))
BOARD = AprilGrid(6, 6, 0.088, 0.3)


def _fit(views: BoardViews) -> LensFit:
    return fit_lenses([views], [MODEL], (np.arange(views.n_frames),), robust=False)


def test_few_views_are_left_alone() -> None:
    views, _ = simulate_board_views(CAMERA, BOARD, 12, seed=0)
    chosen, _ = choose_views([views], [MODEL], (np.arange(12),), 12)
    assert chosen[0] is views


def test_chosen_views_know_more_than_evenly_spread_ones() -> None:
    rng = np.random.default_rng(1)
    # Nine tenths of the recording shows one pose over and over, as a tripod or a slow start does.
    still = np.repeat(random_board_poses(CAMERA, BOARD, 1, rng), 180, axis=0)
    moving = random_board_poses(CAMERA, BOARD, 20, rng)
    views, _ = views_of_poses(CAMERA, BOARD, np.concatenate([still, moving]), rng)
    (chosen,), _ = choose_views([views], [MODEL], (np.arange(views.n_frames),), 40)
    spread = views.select(np.linspace(0, views.n_frames - 1, 40).astype(int))
    assert chosen.n_frames == 40
    assert len(set(chosen.labels) & {f"frame {k}" for k in range(180, 200)}) == 20
    sigma_chosen, sigma_spread = (np.sqrt(np.diag(lens_covariance(_fit(v)).plain)) for v in (chosen, spread))
    assert np.all(sigma_chosen < 0.7 * sigma_spread)


def test_moments_that_cameras_share_are_kept() -> None:
    """Each camera sees the board 100 times, both at once in 12 of these: the transform between them stands on the twelve."""
    cameras = [CAMERA, replace(CAMERA, name="cam1")]
    first, second = rig_views(cameras, [np.eye(4), T_CAM1_CAM0], 200, seed=3)
    together = np.arange(0, 200, 17)
    first = first.select(np.union1d(np.arange(94), together))
    second = second.select(np.union1d(np.arange(106, 200), together))
    instants = match_instants([first, second])
    shared = np.intersect1d(*instants)
    (a, b), (at_a, at_b) = choose_views([first, second], [MODEL, MODEL], instants, 40)
    assert len(np.union1d(at_a, at_b)) == 40
    assert len(np.intersect1d(at_a, at_b)) >= 0.9 * len(shared)
    assert (a.n_frames, b.n_frames) == (len(at_a), len(at_b))
    fit = fit_lenses([a, b], [MODEL, MODEL], (at_a, at_b))
    assert np.linalg.norm(se3.local(T_CAM1_CAM0, fit.state.T_cam_cam0[1])) < 2e-3


def test_greedy_choice_takes_every_direction_before_doubling_one() -> None:
    S = np.zeros((40, 3, 3))
    S[:, 0, 0] = 1.0
    S[7, 1, 1], S[33, 2, 2] = 1e-3, 1e-5
    assert {7, 33} <= set(greedy_log_det(S, 5).tolist())


def test_the_advised_views_lower_sigma_as_promised() -> None:
    rng = np.random.default_rng(2)
    poses = random_board_poses(CAMERA, BOARD, 40, rng, max_tilt=np.deg2rad(12), max_roll=0.2)
    fit = _fit(views_of_poses(CAMERA, BOARD, poses, rng)[0])
    covariance = lens_covariance(fit)
    weak = np.array([1.0, 0, 0, 0, 0, 0, 0, 0])  # fx
    advice = best_view(fit, 0, covariance.plain, weak, covariance.variance_factor)
    assert advice is not None
    assert "tilted 40 deg" in advice.text
    tilted = random_board_poses(CAMERA, BOARD, 60, rng, max_tilt=np.deg2rad(50))
    after = lens_covariance(_fit(views_of_poses(CAMERA, BOARD, np.concatenate([poses, tilted[:10]]), rng)[0]))
    real = np.sqrt(after.plain[0, 0] / covariance.plain[0, 0])
    assert advice.sigma_ratio < real * 1.2  # the advised view is no worse than ten chance ones
    assert advice.sigma_ratio < 0.8


def test_advice_names_no_place_outside_the_image_circle() -> None:
    """The circle of a fisheye leaves the image's corners and sides dark; its rim alone reaches into the ninths there."""
    camera = LENSES["pinhole-equi"]
    camera = replace(camera, params=camera.params * [0.62, 0.62, 1, 1, 1, 1, 1, 1])
    board, rng = AprilGrid(4, 4, 0.13, 0.3), np.random.default_rng(3)
    poses = random_board_poses(camera, board, 80, rng, max_tilt=0.6, fill=(0.1, 0.3))
    off_axis = np.arctan2(np.linalg.norm(poses[:, :2, 3], axis=1), poses[:, 2, 3])
    views, _ = views_of_poses(camera, board, poses[off_axis < 0.6], rng)  # nothing near the rim
    fit = fit_lenses([views], ["pinhole-equi"], (np.arange(views.n_frames),))
    covariance = lens_covariance(fit)
    regions = seen_regions(fit.problem.cameras[0], fit.state.lenses[0])
    assert set(regions) == {"top", "middle", "bottom"}
    told = [reason.text for reason in judge_lens(fit, 0, covariance, []).reasons if "of the image" in reason.text]
    assert told
    for text in told:
        assert not re.search(r"\b(left|right) of the image", text), text


def test_no_advised_board_is_seen_from_behind() -> None:
    camera, board, rng = LENSES["pinhole-equi"], AprilGrid(4, 4, 0.13, 0.3), np.random.default_rng(0)
    fit = fit_lenses(
        [views_of_poses(camera, board, random_board_poses(camera, board, 20, rng), rng)[0]], ["pinhole-equi"], (np.arange(20),)
    )
    covariance = lens_covariance(fit)
    for weak in np.eye(8):
        advice = best_view(fit, 0, covariance.plain, weak, covariance.variance_factor)
        assert advice is not None
        assert not ("lower" in advice.text and "x axis" in advice.text), advice  # its printed side looks down there, past the camera


def test_regions_are_named_as_seen() -> None:
    assert region_of(np.array([10, 10]), (752, 480)) == "upper left"
    assert region_of(np.array([700, 470]), (752, 480)) == "lower right"
    assert region_of(np.array([376, 240]), (752, 480)) == "middle"
