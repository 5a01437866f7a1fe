"""Lenses and rigs from corners: exact without noise, from no guess, whatever the focal length; wrong corners and frames are found."""

from dataclasses import replace

import numpy as np
import pytest
from lens_samples import GRID, LENSES, T_CAM1_CAM0, board_views, rig_views, scrambled

from calibkit.data.observations import BoardViews
from calibkit.errors import BadInputError, NotConvergedError
from calibkit.estimation import intrinsics, lens_fit
from calibkit.estimation.camera_rig_seed import components, match_instants
from calibkit.estimation.intrinsics import CameraRequest, calibrate_cameras
from calibkit.estimation.lens_fit import LensFit, fit_lenses
from calibkit.estimation.lens_seed import Poses, poses_of_views
from calibkit.estimation.lens_trust import lens_covariance
from calibkit.geometry import se3, so3
from calibkit.models.board import AprilGrid
from calibkit.models.cameras import CAMERAS
from calibkit.simulation.camera import SimCamera

SMALL = AprilGrid(4, 4, 0.13, 0.3)  # fewer corners where many change nothing


def fit(views: BoardViews, model: str, robust: bool = True) -> LensFit:
    return fit_lenses([views], [model], (np.arange(views.n_frames),), robust)


def fit_rig(views: list[BoardViews], models: list[str]) -> LensFit:
    return fit_lenses(views, models, match_instants(views))


@pytest.mark.parametrize("model", CAMERAS)
def test_perfect_corners_give_the_lens_back_from_no_guess(model):
    found = fit(board_views(model, 15, 0, noise_px=0.0), model)
    assert found.converged
    assert not found.dropped
    assert np.array_equal(found.kept[0], found.observed[0])
    truth = LENSES[model].params
    # The eight coefficients of the rational model stand in for each other almost wholly; the pixels below are as exact as the others'.
    np.testing.assert_allclose(found.state.lenses[0], truth, rtol=2e-5 if model == "pinhole-radtan8" else 1e-6)
    np.testing.assert_allclose(found.problem.residuals(found.state, 0).px, 0, atol=1e-9)


def random_lens(seed: int) -> SimCamera:
    """A mild lens with a focal length of 0.3 to 3 image widths and a centre off the middle."""
    rng = np.random.default_rng(seed)
    model = ("pinhole-radtan", "pinhole-equi")[seed % 2]
    focal = 752 * np.exp(rng.uniform(np.log(0.3), np.log(3)))
    bent = {"pinhole-radtan": [rng.uniform(-0.1, 0), rng.uniform(0, 0.02), 1e-4, -1e-4], "pinhole-equi": rng.uniform(-0.02, 0.02, 4)}
    centre = [376 + rng.uniform(-40, 40), 240 + rng.uniform(-40, 40)]
    return SimCamera(CAMERAS[model], np.array([focal, focal * rng.uniform(0.98, 1.02), *centre, *bent[model]]), (752, 480))


@pytest.mark.parametrize("seed", range(10))
def test_any_focal_length_is_found_from_no_guess(seed):
    camera = random_lens(seed)
    found = fit(board_views(camera, 15, seed, board=SMALL), camera.model.name)
    kept = found.kept[0]
    assert found.converged
    assert not found.dropped
    assert np.std(found.problem.residuals(found.state, 0).px[kept]) == pytest.approx(0.2, rel=0.1)
    sigma = np.sqrt(np.diag(lens_covariance(found).corrected))
    z = (found.state.lenses[0] - camera.params) / sigma
    assert np.abs(z).max() < 5, f"focal length {camera.params[0]:.0f} px: {z} sigmas off"


def on_labels(found: LensFit, views: BoardViews) -> np.ndarray:
    """Which rows of the views took part."""
    row = {label: i for i, label in enumerate(found.views[0].labels)}
    return np.array(
        [views.labels[f] in row and found.kept[0][row[views.labels[f]], c] for f, c in zip(views.frame, views.corner, strict=True)]
    )


def with_mixed_ids(views: BoardViews, share: float, seed: int) -> tuple[BoardViews, set[str]]:
    """The corners of a share of the frames in random order, and those frames' names."""
    rng = np.random.default_rng(seed)
    bad = rng.permutation(views.n_frames)[: round(share * views.n_frames)]
    uv = views.uv.copy()
    for frame in bad:
        rows = np.flatnonzero(views.frame == frame)
        uv[rows] = uv[rng.permutation(rows)]
    return replace(views, uv=uv), {views.labels[frame] for frame in bad}


ROBUST_SEEDS = 2


@pytest.mark.parametrize("model", ["pinhole-radtan", "pinhole-radtan5", "pinhole-equi"])
def test_gross_outliers_and_bad_frames_are_found_and_cost_little(model):
    clean, with_outliers, with_bad_frames = [], [], []
    for seed in range(ROBUST_SEEDS):
        views = board_views(model, 20, seed, board=SMALL)
        first = fit(views, model)
        sigma, truth = np.sqrt(np.diag(lens_covariance(first).plain))[:4], LENSES[model].params[:4]
        clean.append((first.state.lenses[0][:4] - truth) / sigma)

        dirty, wrong = scrambled(views, 0.2, seed)
        found = fit(dirty, model)
        kept = on_labels(found, views)
        assert not np.any(kept & wrong)
        assert np.mean(kept[~wrong]) > 0.94
        with_outliers.append((found.state.lenses[0][:4] - truth) / sigma)

        dirty, bad = with_mixed_ids(views, 0.1, seed)
        found = fit(dirty, model)
        assert {view.label for view in found.dropped} == bad
        assert all("fit" in view.why and view.camera == "cam0" for view in found.dropped)
        with_bad_frames.append((found.state.lenses[0][:4] - truth) / sigma)
    usual = max(float(np.sqrt(np.mean(np.square(clean)))), 1.0)
    assert np.sqrt(np.mean(np.square(with_outliers))) < 1.5 * usual
    assert np.sqrt(np.mean(np.square(with_bad_frames))) < 1.5 * usual


def test_clean_corners_are_not_taken_for_outliers():
    views = board_views("pinhole-radtan", 60, 0)
    found = fit(views, "pinhole-radtan")
    assert not found.dropped
    assert np.sum(found.observed[0] & ~found.kept[0]) <= 2  # beyond 4.5 sigmas: one in 25 000
    plain = fit(views, "pinhole-radtan", robust=False)
    assert np.array_equal(plain.kept[0], plain.observed[0])


def test_a_blurred_view_is_weighed_down_and_kept():
    views = board_views("pinhole-radtan", 30, 0)
    noise = np.random.default_rng(1).normal(size=views.uv.shape)
    blurred = replace(views, uv=views.uv + np.where((views.frame == 4)[:, None], 0.6 * noise, 0.0))
    found = fit(blurred, "pinhole-radtan")
    assert not found.dropped
    weight = np.array([row[row > 0].mean() for row in found.problem.cameras[0].weight])
    assert weight[4] < 0.6 * np.median(weight)
    assert np.all(np.delete(weight, 4) > 0.9 * np.median(weight))


def only(views: BoardViews, rows: np.ndarray) -> BoardViews:
    return replace(views, frame=views.frame[rows], corner=views.corner[rows], uv=views.uv[rows], sigma_px=views.sigma_px[rows])


def test_views_with_few_corners_are_named():
    views = board_views("pinhole-radtan", 12, 0)
    rank = np.arange(len(views.frame)) - np.searchsorted(views.frame, views.frame)
    poor = only(views, ~np.isin(views.frame, [3, 7]) | (rank < np.where(views.frame == 3, 5, 6)))
    found = fit(poor, "pinhole-radtan")
    assert [(v.camera, v.label, v.why) for v in found.dropped if v.label == views.labels[3]] == [
        ("cam0", views.labels[3], "fewer than 6 corners")
    ]
    assert views.labels[3] not in found.views[0].labels


def test_a_camera_without_a_single_good_view_is_named():
    views = board_views("pinhole-radtan", 5, 0)
    rank = np.arange(len(views.frame)) - np.searchsorted(views.frame, views.frame)
    with pytest.raises(BadInputError, match="cam0: no view has 6 corners"):
        fit(only(views, rank < 5), "pinhole-radtan")


def test_a_seed_that_reaches_no_view_is_one_line(monkeypatch):
    nowhere = Poses(np.tile(np.eye(4), (5, 1, 1)), np.full(5, np.inf))
    monkeypatch.setattr(lens_fit, "seed_camera", lambda *_: (LENSES["pinhole-radtan"].params, nowhere))
    with pytest.raises(NotConvergedError, match="cam0: no board pose fits the corners of any view"):
        fit(board_views("pinhole-radtan", 5, 0), "pinhole-radtan")


@pytest.mark.parametrize(("focal_px", "seed"), [(120.0, 0), (180.0, 4), (1500.0, 0)])
def test_a_poor_start_costs_no_view(focal_px, seed, monkeypatch):
    def poor(views, points):
        lens = views.model.seed(focal_px, (375.5, 239.5))
        return lens, poses_of_views(views, lens, points)

    monkeypatch.setattr(lens_fit, "seed_camera", poor)
    found = fit(board_views("pinhole-radtan", 25, seed, board=SMALL), "pinhole-radtan")
    assert not found.dropped
    assert found.state.lenses[0][0] == pytest.approx(461.2, abs=1)


def test_corners_that_make_no_sense_do_not_fit():
    views = board_views("pinhole-radtan", 12, 0, board=SMALL)
    rng = np.random.default_rng(0)
    mixed = replace(views, uv=np.concatenate([rng.permutation(views.uv[views.frame == f]) for f in range(views.n_frames)]))
    found = fit(mixed, "pinhole-radtan")
    assert np.sqrt(np.mean(found.residuals(0)[0].px[found.kept[0]] ** 2)) > 20


# Rigs. cam1 lies as T_CAM1_CAM0 says, cam2 beyond it.

PINHOLE, FISHEYE, LONG = (
    LENSES["pinhole-radtan"],
    SimCamera(CAMERAS["pinhole-equi"], np.array([305.4, 304.9, 381.3, 242.6, 0.0035, 0.0007, -0.0021, 0.0002]), (752, 480)),
    SimCamera(CAMERAS["pinhole-radtan"], np.array([601.0, 602.0, 380.0, 236.0, -0.1, 0.02, 1e-4, 2e-4]), (752, 480)),
)
T_CAM2_CAM0 = se3.make(so3.exp(np.array([0.02, -0.03, 0.05])), np.array([-0.05, -0.07, 0.01])) @ T_CAM1_CAM0
RIG = ([PINHOLE, FISHEYE, LONG], [np.eye(4), T_CAM1_CAM0, T_CAM2_CAM0])
MODELS = [camera.model.name for camera in RIG[0]]


def two(frames: int, seed: int = 0, **options) -> list[BoardViews]:
    return rig_views(RIG[0][:2], RIG[1][:2], frames, seed, **options)


def test_two_cameras_without_noise_give_the_transform_from_cam0_to_cam1():
    found = fit_rig(two(20, noise_px=0.0), MODELS[:2])
    np.testing.assert_allclose(found.state.T_cam_cam0[1], T_CAM1_CAM0, atol=1e-8)
    assert np.abs(found.state.T_cam_cam0[1] - se3.inverse(T_CAM1_CAM0)).max() > 0.05
    for lens, camera in zip(found.state.lenses, RIG[0], strict=False):
        np.testing.assert_allclose(lens, camera.params, rtol=1e-6)


def test_the_result_names_both_directions(monkeypatch):
    views = two(10, noise_px=0.0)
    monkeypatch.setattr(intrinsics, "CAMERAS", {model: CAMERAS[model] for model in MODELS})  # no other models to compare
    result = calibrate_cameras([CameraRequest(v, model) for v, model in zip(views, MODELS, strict=False)])
    entry = result.rig.transforms["T_cam1_cam0"]
    assert list(result.rig.transforms) == ["T_cam1_cam0"]
    assert entry.equation == "p_cam1 = T_cam1_cam0 p_cam0"
    np.testing.assert_allclose(entry.matrix, T_CAM1_CAM0, atol=1e-8)
    np.testing.assert_allclose(entry.translation, T_CAM1_CAM0[:3, 3], atol=1e-8)
    np.testing.assert_allclose(entry.inverse_matrix, np.linalg.inv(T_CAM1_CAM0), atol=1e-8)
    assert entry.inverse_name == "T_cam0_cam1"


def test_three_cameras_overlapping_in_a_chain_only():
    """cam0 and cam2 never see the board at once: T_cam2_cam0 comes by way of cam1."""
    cam0, cam1, cam2 = rig_views(*RIG, frames=40, seed=1)
    second = cam0.t_ns // 10**9
    assert np.array_equal(second, np.arange(1, 41))
    views = [cam0.select(second <= 24), cam1.select(cam1.t_ns // 10**9 > 8), cam2.select(cam2.t_ns // 10**9 > 24)]
    assert components(match_instants(views)) == [[0, 1, 2]]
    found = fit_rig(views, MODELS)
    cov = lens_covariance(found).corrected
    for c, truth in enumerate(RIG[1][1:], start=1):
        where = found.problem.rig_slice(c)
        z = se3.local(truth, found.state.T_cam_cam0[c]) / np.sqrt(np.diag(cov)[where])
        assert np.abs(z).max() < 4.5, f"T_cam{c}_cam0 is {z} sigmas off"
        assert np.sqrt(np.diag(cov)[where])[:3].max() < 1e-3


def test_the_order_of_the_cameras_does_not_matter():
    cam0, cam1 = two(25, seed=2)
    first, second = fit_rig([cam0, cam1], MODELS[:2]), fit_rig([cam1, cam0], MODELS[1::-1])
    np.testing.assert_allclose(se3.inverse(second.state.T_cam_cam0[1]), first.state.T_cam_cam0[1], atol=1e-6)
    np.testing.assert_allclose(second.state.lenses[1], first.state.lenses[0], rtol=1e-5)


def test_cameras_that_never_look_together_are_calibrated_apart_and_said_to_be_so(monkeypatch):
    monkeypatch.setattr(intrinsics, "CAMERAS", {model: CAMERAS[model] for model in MODELS})
    cam0, cam1 = two(30)
    views = [cam0.select(cam0.t_ns < 15.5e9), cam1.select(cam1.t_ns > 15.5e9)]
    assert components(match_instants(views)) == [[0], [1]]
    result = calibrate_cameras([CameraRequest(v, model) for v, model in zip(views, MODELS, strict=False)])
    assert not result.rig.transforms
    assert list(result.rig.cameras) == ["cam0", "cam1"]
    (apart,) = [r for r in result.reasons if "never sees the board at the same moment as cam0" in r.text]
    assert apart.verdict.value == "CHECK"
    assert apart.text.endswith("not known; hold the board where both see it at once, with stamps of one clock")
    assert result.exit_code == 0  # the lenses were asked for, and are known
    for name, camera in zip(("cam0", "cam1"), RIG[0], strict=False):
        parameters = result.rig.cameras[name].parameters
        assert [parameters[k].value for k in ("fx", "fy", "cx", "cy")] == pytest.approx(camera.params[:4], abs=1.5)


def test_stamps_that_jitter_by_a_millisecond_are_one_instant():
    exact, jittered = two(25, seed=3), two(25, seed=3, jitter_s=0.001)
    found = fit_rig(jittered, MODELS[:2])
    assert len(np.unique(np.concatenate(match_instants(jittered)))) == 25
    np.testing.assert_allclose(se3.local(T_CAM1_CAM0, found.state.T_cam_cam0[1]), 0, atol=2e-3)
    assert len(np.unique(np.concatenate(match_instants(exact)))) == 25


def stamped(t_ms: list[float], camera: str, labels: list[str] | None = None) -> BoardViews:
    """Views with nothing but stamps."""
    none = np.zeros(0)
    return BoardViews(
        GRID,
        (752, 480),
        np.array([round(t * 1e6) for t in t_ms], np.int64),
        tuple(labels or (str(t) for t in t_ms)),
        none.astype(np.int32),
        none.astype(np.int32),
        none.reshape(0, 2),
        none,
        camera,
    )


def test_instants_are_shared_within_5_ms_and_a_quarter_of_the_period():
    def shared(a: list[float], b: list[float]) -> list[tuple[int, int]]:
        first, second = match_instants([stamped(a, "cam0"), stamped(b, "cam1")])
        return [(i, j) for i, x in enumerate(first) for j, y in enumerate(second) if x == y]

    assert shared([1000, 1100, 1200], [1004.9, 1105.1, 1195.1]) == [(0, 0), (2, 2)]
    assert shared([1000, 1008, 1016], [1003, 1009.9, 1019]) == [(1, 1)]  # 125 Hz: a quarter of the period is 2 ms
    assert shared([1000, 1100], [5000, 5100]) == []
    assert shared([1000, 1100, 1200], [1200, 1000]) == [(0, 1), (2, 0)]  # out of order
    assert shared([1000, 1000], [1000]) in ([(0, 0)], [(1, 0)])  # a repeated stamp is two views of one camera, never one


def test_without_stamps_equal_file_names_are_one_instant():
    first, second = match_instants([stamped([0, 0, 0], "cam0", ["a.png", "b.png", "c.png"]), stamped([0, 0], "cam1", ["c.png", "a.png"])])
    assert first[2] == second[0]
    assert first[0] == second[1]
    assert len({*first, *second}) == 3
