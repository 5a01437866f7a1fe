"""Signals: what is injected is found with its size, and noise alone is left in peace."""

from dataclasses import replace

import numpy as np
import pytest
from report_samples import CX, CY, SIZE, residual_set, result

from calibkit.data.verdict import Verdict
from calibkit.report.field import _median_by, cells, over_image, over_radius
from calibkit.report.signals import PROBES, measure, not_good
from calibkit.report.summary import summarise
from calibkit.report.summary_text import text
from calibkit.report.view import views

CENTRE = np.array([CX, CY])


def view_of(**kwargs):
    return views(result(residuals=residual_set(**kwargs), thumbnails=0))[0]


def signals_of(view):
    return {signal.probe.key: signal for signal in measure(view)}


def test_every_signal_of_the_table_is_measured_on_a_camera():
    of_others = {"rate_growth", "over_before", "window_scatter", "pose_turn", "pose_shift", "poses_dropped", "second_axis"}
    of_others |= {"fast_corners", "fast_samples", "autocorrelation"}
    assert [signal.probe.key for signal in measure(view_of())] == [probe.key for probe in PROBES if probe.key not in of_others]


def test_noise_alone_is_good():
    """White noise of 0.2 px over 40 seeds: every signal passes, and what repeats is cleared of noise to 0.02 px."""
    for seed in range(40):
        view = view_of(seed=seed)
        assert not_good(measure(view)) == ()
        assert over_image(view)[0].size < 0.02


def test_significance_of_noise_is_about_one_sigma():
    """The scale of `significance` under white noise, 40 seeds, few and many frames."""
    for frames in (8, 40):
        z = [[part.significance for part in over_radius(view_of(frames=frames, seed=seed))[:2]] for seed in range(40)]
        assert abs(np.mean(z)) < 0.35
        assert 0.6 < np.std(z) < 1.4


@pytest.mark.parametrize("frames", [8, 40])
def test_a_radial_pattern_is_found_with_its_size(frames):
    """Mean of 10 seeds within 4 %: a cell's mean is a little smaller than the field that varies inside it."""
    gain, ratios = 2e-3, []
    for seed in range(10):
        view = view_of(frames=frames, seed=seed, pattern=lambda uv: gain * (uv - CENTRE), outliers=0)
        found = signals_of(view)
        assert found["field"].verdict is found["radial_field"].verdict is found["neighbour_correlation"].verdict is Verdict.CHECK
        assert found["tangential_field"].verdict is Verdict.PASS
        assert over_radius(view)[0].mean[-1, 0] > 0  # outwards
        injected = gain**2 * np.sum((view.uv - CENTRE) ** 2, axis=1)
        grid, shape = over_image(view)
        told = np.isfinite(grid.sigma[cells(view.uv, SIZE, shape), 0])  # a cell that one frame alone has seen tells nothing
        ratios.append([found["field"].value / np.sqrt(injected[told].mean()), found["radial_field"].value / np.sqrt(injected.mean())])
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1, atol=0.04)


def test_a_swirl_is_found_with_its_sign():
    """dx, dy = (-y, x): clockwise as seen with y down."""
    view = view_of(pattern=lambda uv: 1e-3 * np.stack([-(uv - CENTRE)[:, 1], (uv - CENTRE)[:, 0]], -1))
    assert signals_of(view)["tangential_field"].verdict is Verdict.CHECK
    assert signals_of(view)["radial_field"].verdict is Verdict.PASS
    assert np.all(over_radius(view)[1].mean[2:, 0] > 0)


def test_large_structure_fails():
    assert signals_of(view_of(pattern=lambda uv: 5e-3 * (uv - CENTRE)))["field"].verdict is Verdict.FAIL


def test_rms_is_opencv_s_and_counts_dropped_corners_beside():
    view = view_of()
    signal = signals_of(view)["reprojection_rms"]
    assert signal.value == pytest.approx(np.sqrt(np.sum(view.raw[view.kept] ** 2) / view.kept.sum()), rel=1e-12)
    assert f"{np.sqrt(np.sum(view.raw**2) / len(view.raw)):.3g} px with the dropped" in signal.note
    assert signals_of(view)["dropped_corners"].note == f"20 of {len(view.raw)} corners"


def test_rows_without_a_prediction_count_as_dropped():
    residuals = residual_set(outliers=0)
    residuals.raw[:7] = np.nan
    found = signals_of(views(result(residuals=residuals, thumbnails=0))[0])
    assert found["dropped_corners"].note.startswith("7 of ")
    assert np.isfinite(found["reprojection_rms"].value)


def _subset(residuals, rows):
    context = {key: values[rows] for key, values in residuals.context.items()}
    return replace(residuals, t_ns=residuals.t_ns[rows], raw=residuals.raw[rows], sigma=residuals.sigma[rows], context=context)


def test_an_empty_part_of_the_image_is_named():
    residuals = residual_set()
    u, v = residuals.context["uv"].T
    found = signals_of(views(result(residuals=_subset(residuals, (u < SIZE[0] * 0.6) | (v < SIZE[1] * 0.6)), thumbnails=0))[0])
    assert found["image_coverage"].note == "no corners in the lower right"
    left = signals_of(views(result(residuals=_subset(residuals, u < SIZE[0] * 0.45), thumbnails=0))[0])["image_coverage"]
    assert left.verdict is Verdict.CHECK
    assert "on the right" in left.reason.text


def test_boards_that_face_the_camera_are_named():
    residuals = residual_set()
    flat = replace(residuals, context={**residuals.context, "tilt": residuals.context["tilt"] * 0.2})
    signal = signals_of(views(result(residuals=flat, thumbnails=0))[0])["tilt_range"]
    assert signal.verdict is Verdict.CHECK
    assert "tilt the board" in signal.reason.text


def test_one_bad_frame_is_named():
    residuals = residual_set()
    residuals.raw[residuals.context["frame"] == 7] *= 5
    signal = signals_of(views(result(residuals=residuals, thumbnails=0))[0])["worst_frame_ratio"]
    assert signal.verdict is Verdict.CHECK
    assert signal.note.startswith("1500000000.350000: ")


def test_a_value_beyond_its_limit_that_tells_nothing_is_not_stamped_pass():
    residuals = residual_set(noise=0.01, outliers=0)
    residuals.raw[residuals.context["frame"] == 7] *= 5
    made = result(residuals=residuals, thumbnails=0)
    signal = signals_of(views(made)[0])["worst_frame_ratio"]
    assert signal.value > signal.probe.good
    assert (signal.verdict, signal.mark) == (Verdict.PASS, "-")
    (line,) = [line for line in text(summarise(made.rig, [made])).splitlines() if signal.probe.title in line]
    assert line.endswith(f" -     {signal.note}")


def test_what_was_not_recorded_is_not_judged():
    residuals = residual_set()
    bare = replace(residuals, context={"uv": residuals.context["uv"]})
    found = signals_of(views(result(residuals=residual_set(), thumbnails=0))[0])
    bare_found = signals_of(views(replace(result(thumbnails=0), residuals=(bare,)))[0])
    assert set(bare_found) == {"reprojection_rms", "held_out_ratio", "dropped_corners", "image_coverage"} < set(found)
    gyro = replace(residuals, raw=np.zeros((len(residuals.raw), 3)), context={})
    assert measure(views(replace(result(thumbnails=0), residuals=(gyro,)))[0]) == []


def test_limits_read_both_ways():
    by_key = {probe.key: probe for probe in PROBES}
    assert by_key["reprojection_rms"].limit == "≤ 0.3 px (FAIL > 1 px)"
    assert [by_key["reprojection_rms"].judge(value) for value in (0.3, 0.31, 1.0, 1.01)] == ["PASS", "CHECK", "CHECK", "FAIL"]
    assert by_key["image_coverage"].limit == "≥ 60 %"
    assert [by_key["image_coverage"].judge(value) for value in (60, 59, 0)] == ["PASS", "CHECK", "CHECK"]


def test_lower_median_by_group():
    got = _median_by(np.array([0, 0, 0, 2, 2]), np.array([3.0, 1, 2, 5, 4]), 3)
    np.testing.assert_array_equal(got, [2, np.nan, 4])
