"""Recordings that cannot tell a lens, boards and models that are wrong: said so, never a confident wrong number."""

from dataclasses import replace

import numpy as np
import pytest
from lens_samples import GRID, LENSES, T_CAM1_CAM0, board_views, rig_views

from calibkit.data.observations import BoardViews
from calibkit.data.result import Result
from calibkit.data.verdict import Status, Verdict
from calibkit.estimation import intrinsics
from calibkit.estimation.intrinsics import CameraRequest, calibrate_cameras
from calibkit.estimation.lens_fit import fit_lenses
from calibkit.estimation.lens_trust import lens_covariance
from calibkit.estimation.lens_verdict import judge_lens
from calibkit.geometry import so3
from calibkit.models.board import AprilGrid
from calibkit.models.cameras import CAMERAS
from calibkit.report.summary import look_at
from calibkit.simulation.camera import SimCamera, place_board, random_board_poses
from calibkit.simulation.corners import views_of_poses
from calibkit.simulation.scenarios import SCENARIOS
from calibkit.simulation.session import simulate_session, simulate_views
from calibkit.stages.outputs import with_signals

CAMERA = LENSES["pinhole-radtan"]
SMALL = AprilGrid(4, 4, 0.13, 0.3)


def calibrate(views: BoardViews, model: str | None = None) -> Result:
    """What the command makes of the views, the signals of the residuals included."""
    result = calibrate_cameras([CameraRequest(views, model)])
    return with_signals(result, look_at([result]))


@pytest.fixture
def quick(monkeypatch):
    """Compare no models: a recording that tells nothing tells nothing about them."""
    monkeypatch.setattr(intrinsics, "CAMERAS", {model: CAMERAS[model] for model in ("pinhole-radtan", "pinhole-equi")})


def texts(result: Result, verdict: Verdict | None = None) -> str:
    return "\n".join(reason.text for reason in result.reasons if verdict in (None, reason.verdict))


def held_views(
    seed: int,
    tilt_deg: float,
    x: tuple[float, float] = (-0.45, 0.45),
    y: tuple[float, float] = (-0.25, 0.25),
    distance: tuple[float, float] = (0.6, 1.6),
    frames: int = 20,
    camera: SimCamera = CAMERA,
) -> BoardViews:
    """Boards turned by up to tilt_deg against the image plane, at x, y (per distance) and distance m drawn from these ranges."""
    rng = np.random.default_rng(seed)
    direction, tilt = rng.uniform(0, 2 * np.pi, frames), np.radians(tilt_deg) * np.sqrt(rng.uniform(0, 1, frames))
    turn = np.stack([np.cos(direction) * tilt, np.sin(direction) * tilt, np.zeros(frames)], axis=-1)
    R = so3.exp(turn) @ so3.exp(rng.uniform(-0.5, 0.5, frames)[:, None] * np.array([0, 0, 1.0]))
    z = rng.uniform(*distance, frames)
    centre = np.stack([rng.uniform(*x, frames) * z, rng.uniform(*y, frames) * z, z], axis=-1)
    return views_of_poses(camera, SMALL, place_board(SMALL, R, centre), rng, 0.2)[0]


def never_confidently_wrong(tilt_deg: float, seeds: range) -> int:
    """Assert that every lens is 'not observable' or within its own sigma; return how many were not observable."""
    unknown = 0
    for seed in seeds:
        views = held_views(seed, tilt_deg)
        fit = fit_lenses([views], ["pinhole-radtan"], (np.arange(views.n_frames),))
        covariance = lens_covariance(fit)
        judged = judge_lens(fit, 0, covariance, [])
        z = (fit.state.lenses[0] - CAMERA.params) / np.sqrt(np.diag(covariance.corrected))
        given = np.array([status is not Status.NOT_OBSERVABLE for status in judged.statuses])
        assert not np.any(given & (np.abs(z) > 4.5)), f"tilts up to {tilt_deg} deg, seed {seed}: {z} sigmas off, {judged.statuses}"
        unknown += not given.any()
        assert judged.reasons
    return unknown


@pytest.mark.parametrize("tilt_deg", [1, 2, 3, 5])
def test_fronto_parallel_views_give_no_confident_lens(tilt_deg):
    unknown = never_confidently_wrong(tilt_deg, range(2))
    assert tilt_deg > 2 or unknown == 2


@pytest.mark.slow
@pytest.mark.parametrize("tilt_deg", [0, 1, 2, 3, 5, 8])
def test_fronto_parallel_views_give_no_confident_lens_over_thirty_seeds(tilt_deg):
    unknown = never_confidently_wrong(tilt_deg, range(30))
    print(f"tilts up to {tilt_deg} deg: {unknown} of 30 not observable, the others within 4.5 sigma")
    assert tilt_deg > 2 or unknown == 30


def assert_nothing_known(result: Result, cause: str) -> None:
    assert result.exit_code == 3
    assert result.verdict is Verdict.FAIL
    parameters = result.rig.cameras["cam0"].parameters
    assert all(e.value is None and e.sigma is None and e.status is Status.NOT_OBSERVABLE for e in parameters.values())
    assert result.rig.cameras["cam0"].covariance is None
    assert sorted(result.not_observable) == sorted(f"cam0.{name}" for name in parameters)
    assert cause in texts(result, Verdict.FAIL)


def test_fronto_parallel_views_end_with_code_3_and_say_what_to_do(quick):
    result = calibrate(held_views(0, 2), "pinhole-radtan")
    assert_nothing_known(result, "always seen from nearly one side")
    assert "tilt the board 30 to 45 deg" in texts(result)


def test_one_pose_repeated(quick):
    rng = np.random.default_rng(0)
    pose = random_board_poses(CAMERA, SMALL, 1, rng)
    assert_nothing_known(calibrate(views_of_poses(CAMERA, SMALL, np.repeat(pose, 15, axis=0), rng)[0]), "always seen from nearly one side")


@pytest.mark.parametrize("frames", [1, 2])
def test_one_or_two_views(frames, quick):
    assert_nothing_known(calibrate(board_views(CAMERA, frames, 0)), "at least 3 are needed")


@pytest.mark.parametrize(("frames", "told"), [(4, True), (9, True), (10, False)])
def test_fewer_than_ten_looks_are_told(frames, told, quick):
    result = calibrate(board_views(CAMERA, frames, 0), "pinhole-radtan")
    assert (f"{frames} views are {frames} independent looks at the board, too few" in texts(result, Verdict.CHECK)) == told


def test_one_view_is_one_look(quick):
    assert "1 view is 1 independent look at the board," in texts(calibrate(board_views(CAMERA, 1, 0)))


def hasty(duration_s: float) -> BoardViews:
    scenario = SCENARIOS["aprilgrid"]
    camera = replace(scenario.cameras[0], rate_hz=20.0)
    return simulate_views(simulate_session(replace(scenario, cameras=(camera,), duration_s=duration_s)))[0]


def test_thirty_frames_within_a_second_and_a_half(quick):
    views = hasty(1.5)
    assert views.n_frames == 30
    assert_nothing_known(calibrate(views), "30 views within 2 s are 2 independent looks")


def test_a_transform_from_a_second_and_a_half_is_not_known_either(quick):
    """Two blocks of data have nothing to check each other by: their scores cancel, and a sandwich of nothing says sigma 0."""
    views = rig_views([CAMERA, SCENARIOS["fisheye-imu"].cameras[0]], [np.eye(4), T_CAM1_CAM0], 12, seed=0)
    hurried = [replace(v, t_ns=10**9 + v.t_ns // 10) for v in views]
    result = calibrate_cameras([CameraRequest(v, model) for v, model in zip(hurried, ("pinhole-radtan", "pinhole-equi"), strict=True)])
    assert result.exit_code == 3
    assert result.rig.transforms["T_cam1_cam0"].status is Status.NOT_OBSERVABLE
    assert "T_cam1_cam0" in result.not_observable
    assert "T_cam1_cam0 is not observable" in texts(result, Verdict.FAIL)


def test_a_board_in_one_corner_only_is_extrapolated_elsewhere():
    result = calibrate(held_views(1, 40, x=(-0.7, -0.35), y=(-0.45, -0.2), distance=(1.4, 2.0)), "pinhole-radtan")
    assert result.verdict is Verdict.CHECK
    assert "lower right of the image (no board was seen there)" in texts(result)
    assert any("no corners in the upper right" in line and "in the lower right" in line for line in texts(result).splitlines())
    assert "wrong model" not in texts(result)


@pytest.mark.parametrize("seed", range(3))
def test_boards_at_one_distance_are_enough_when_tilted(seed):
    views = held_views(seed, 40, distance=(0.9, 0.9))
    fit = fit_lenses([views], ["pinhole-radtan"], (np.arange(views.n_frames),))
    covariance = lens_covariance(fit)
    z = (fit.state.lenses[0] - CAMERA.params) / np.sqrt(np.diag(covariance.corrected))
    assert np.abs(z).max() < 4.5
    assert set(judge_lens(fit, 0, covariance, []).statuses) == {Status.DETERMINED}


def test_a_wrong_tag_spacing_does_not_pass():
    views = board_views(CAMERA, 15, 0)
    result = calibrate(replace(views, board=replace(GRID, spacing=0.2)))
    assert result.verdict is Verdict.FAIL
    assert result.exit_code in (1, 3)
    assert "wrong board size" in texts(result, Verdict.FAIL)


def test_a_pinhole_on_a_fisheye_fails_and_names_the_model_that_fits():
    result = calibrate(board_views("pinhole-equi", 15, 0, board=SMALL), "pinhole-radtan")
    assert result.verdict is Verdict.FAIL
    assert result.exit_code in (1, 3)
    assert "pinhole-radtan is the wrong model for this lens" in texts(result, Verdict.FAIL)
    assert "use --model pinhole-equi" in texts(result, Verdict.FAIL)


@pytest.mark.parametrize("model", ["pinhole-radtan", "pinhole-radtan5", "pinhole-radtan8", "pinhole-equi"])
def test_auto_picks_the_family_of_the_lens(model):
    result = calibrate(board_views(model, 20, 2, board=SMALL))
    chosen = result.rig.cameras["cam0"].model
    assert chosen.startswith("pinhole-radtan") == model.startswith("pinhole-radtan")
    assert result.verdict is not Verdict.FAIL
    assert result.rig.cameras["cam0"].reprojection.rms_px == pytest.approx(0.2 * np.sqrt(2), rel=0.1)
