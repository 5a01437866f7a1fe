"""Intrinsics of real recordings against the figures in data/README.md. Corners are found once and shared by the tests."""

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from calibkit.data.observations import BoardViews
from calibkit.data.progress import silent
from calibkit.data.verdict import Status, Verdict
from calibkit.estimation.intrinsics import CameraRequest, calibrate_cameras
from calibkit.estimation.lens_fit import LensFit, fit_lenses
from calibkit.estimation.lens_trust import lens_covariance
from calibkit.estimation.lens_verdict import judge_lens
from calibkit.estimation.model_choice import compare_models
from calibkit.io.recording import open_recording
from calibkit.models.board import AprilGrid, Board, Checkerboard
from calibkit.models.cameras import CAMERAS
from calibkit.report.signals import measure
from calibkit.report.view import views
from calibkit.stages.intrinsics import Options, name_cameras, observe

KUKA2, MEI = Checkerboard(24, 17, 0.015, 0.015), Checkerboard(9, 6, 0.12, 0.12)
EUROC, EUROC_SIZE = AprilGrid(6, 6, 0.088, 0.3), (752, 480)


@lru_cache
def board_views(source: Path, board: Board, resolution: tuple[int, int] | None = None) -> BoardViews:
    recording = open_recording([source])
    return observe(recording, name_cameras(recording, ()), board, Options(resolution=resolution, cache=False), silent)[0]


def fit(views: BoardViews, model: str, robust: bool = True) -> LensFit:
    return fit_lenses([views], [model], (np.arange(views.n_frames),), robust)


def rms(found: LensFit) -> float:
    return float(np.sqrt(np.mean(np.sum(found.residuals(0)[0].px[found.kept[0]] ** 2, axis=-1))))


def test_kuka2_from_images_to_a_lens(data_dir):
    found = board_views(data_dir / "kuka2", KUKA2)
    assert (found.n_images, found.n_frames) == (28, 28)
    result = calibrate_cameras([CameraRequest(found, "pinhole-radtan5")])
    camera = result.rig.cameras["cam0"]
    value = {name: e.value for name, e in camera.parameters.items()}
    assert result.exit_code == 0
    assert camera.reprojection.frames == 28
    assert camera.reprojection.rms_all_px <= 0.104
    assert [value["fx"], value["fy"]] == pytest.approx([1056.18, 1056.26], abs=0.5)
    assert [value["cx"], value["cy"]] == pytest.approx([958.95, 587.09], abs=1.0)
    assert rms(fit(found, "pinhole-radtan5", robust=False)) <= 0.104


@pytest.mark.slow
def test_kuka2_without_distortion_coefficients_is_told_to_be_wrong_by_its_radial_field(data_dir):
    result = calibrate_cameras([CameraRequest(board_views(data_dir / "kuka2", KUKA2), "pinhole-none")])
    assert result.exit_code == 1
    first, *others = [reason for reason in result.reasons if reason.verdict is Verdict.FAIL]
    assert not others
    assert "pinhole-none is the wrong model for this lens: it has no distortion coefficients" in first.text
    assert "one radial pattern around the image's centre" in first.text
    assert "use --model pinhole-radtan5" in first.text
    signals = {signal.probe.key: signal.verdict for view in views(result) for signal in measure(view)}
    assert (signals["radial_field"], signals["tangential_field"]) == (Verdict.FAIL, Verdict.PASS)


def test_mei_fisheye_from_no_guess_and_a_pinhole_is_told_to_be_wrong(data_dir):
    seen = board_views(data_dir / "mei_fisheye", MEI)
    assert seen.n_images == 63
    scores = compare_models(seen, list(CAMERAS))
    assert scores[0].model == "pinhole-equi"

    found = fit(seen, "pinhole-equi")
    assert found.views[0].n_frames >= 61
    assert rms(found) <= 0.50
    assert found.state.lenses[0][:4] == pytest.approx([383.46, 384.49, 638.64, 477.51], abs=1.5)
    verdicts = [reason.verdict for reason in judge_lens(found, 0, lens_covariance(found), scores).reasons]
    assert Verdict.FAIL not in verdicts

    wrong = fit(seen, "pinhole-radtan")
    reasons = judge_lens(wrong, 0, lens_covariance(wrong), scores).reasons
    assert any(r.verdict is Verdict.FAIL and "wrong model" in r.text and "use --model pinhole-equi" in r.text for r in reasons)


def test_both_halves_of_euroc_agree_and_its_wrong_corners_are_given_up(data_dir):
    seen = board_views(data_dir / "euroc_imu_april" / "cam0_corners.csv", EUROC, EUROC_SIZE)
    first = np.arange(seen.n_frames) < seen.n_frames // 2
    halves = [fit(seen.select(rows), "pinhole-radtan") for rows in (first, ~first)]
    lens = [half.state.lenses[0] for half in halves]
    variance = sum(np.diag(lens_covariance(half).corrected) for half in halves)
    published = np.array([458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05])
    print("halves", *np.round(lens, 5), "sigma of their difference", np.round(np.sqrt(variance), 5), "to published", lens - published)
    assert np.all(np.abs(lens[0] - lens[1]) < 3 * np.sqrt(variance))
    assert max(half.residuals(0)[1].px.max() for half in halves) > 15  # the file holds a corner 21 px off
    for half in halves:
        assert half.views[0].n_frames > 700
        given_up = half.observed[0] & ~half.kept[0]
        assert 0 < given_up.sum() < 0.05 * half.observed[0].sum()
        assert np.linalg.norm(half.residuals(0)[0].px[half.kept[0]], axis=-1).max() < 5


def test_a_second_and_a_half_of_euroc_is_told_to_be_not_enough(data_dir):
    seen = board_views(data_dir / "euroc_imu_april" / "cam0_intrinsics_corners.csv", EUROC, EUROC_SIZE)
    result = calibrate_cameras([CameraRequest(seen)])
    assert result.exit_code == 3
    parameters = result.rig.cameras["cam0"].parameters
    assert all(e.value is None and e.status is Status.NOT_OBSERVABLE for e in parameters.values())
    assert result.rig.cameras["cam0"].covariance is None
    assert "30 views within 2 s are 2 independent looks" in result.reasons[0].text
