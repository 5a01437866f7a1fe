"""The time offset's equations: SPEC's worked examples exactly, columns against differences, eliminations against dense ones, and signs."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from time_offset_samples import R_OF_TO, SILENT, Sample, any_offset, path, pose_imu, seen_gyro, seen_poses, stamps, told, wheels_imu

from calibkit.data.observations import ImuSamples
from calibkit.data.rig import Estimate, Rig
from calibkit.data.transforms import make_time_offset
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.alignment import Alignment, columns, newton, sweep, weighed
from calibkit.estimation.alignment_axes import axis_offsets
from calibkit.estimation.clock_windows import window_offsets
from calibkit.estimation.orientation_track import OrientationTrack, track_of_gyro
from calibkit.estimation.rough_offset import masked_correlation, rough_offsets
from calibkit.estimation.time_offset import Settings, bootstrap_sigma, fit_time_offset
from calibkit.estimation.time_offset_delay import Delays
from calibkit.estimation.time_offset_result import Pair, early_or_late, smear, time_offset_result
from calibkit.estimation.time_offset_start import find_starts
from calibkit.estimation.turn_comparison import Stretch, Weighed, linearised, moved, residuals, split, usable, weigh
from calibkit.estimation.turn_noise import NoiseLevels, turn_noise
from calibkit.estimation.turns import Turns, turns_of_poses
from calibkit.geometry import so3
from calibkit.simulation.session import START_NS

Array = NDArray[np.float64]
RNG = np.random.default_rng
FOCAL_PX = 500.0
PAIR = Pair("cam0", "imu0", "/cam0/image_raw", "/imu0", "poses of the board", FOCAL_PX)

# SPEC, worked example 2


def gyro_from_rest(omega: float) -> ImuSamples:
    """At rest until t = 0, then turning at omega about one axis; samples to either side of 0, so that the step lies there."""
    t_ns = START_NS + np.arange(-1000, 1000) * 2_000_000 + 1_000_000
    rate = np.where(t_ns > START_NS, omega, 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
    return ImuSamples(t_ns, rate, np.zeros((len(t_ns), 0)))


def one_turn(omega: float, td: float) -> Alignment:
    """One displacement of 1 px noise, from rest to 0.5 s after the start by the camera's clock, against the gyroscope's prediction."""
    track = track_of_gyro(gyro_from_rest(omega))
    ends = START_NS + np.array([-500_000_000, 500_000_000], np.int64)
    turns = Turns(ends, np.array([0]), np.array([1]), np.array([[0.0, 0.0, omega * (0.5 + td)]]), None, np.eye(3)[None] / FOCAL_PX**2)
    stretch = Stretch(turns, track.origin_ns, free_bias=False)
    levels = NoiseLevels(0.0, 1.0)
    part = weigh(stretch, stretch.noise(track, np.eye(3), np.zeros(2), np.ones(3)), levels)
    return Alignment(track, (stretch,), (np.ones(1, bool),), (part,), levels, np.ones(3), np.eye(3), False, 0.0)


def test_worked_example_2_is_exact() -> None:
    tau = np.array([0.0, 0.005, 0.010, 0.015])
    a = one_turn(omega=2.0, td=0.010)
    left = residuals(a.parts[0], a.track, a.R, np.tile(tau, (2, 1)))  # in px: 1 px is one sigma
    np.testing.assert_allclose(np.abs(left[2]), [10, 5, 0, 5], atol=1e-9)
    np.testing.assert_allclose(left[:2], 0, atol=1e-9)
    np.testing.assert_allclose(sweep(a, tau), [100, 25, 0, 25], atol=1e-7)
    assert newton(a).tau == pytest.approx(0.010, abs=1e-12)
    information = float(columns(a)[0][:, 3] @ columns(a)[0][:, 3])
    assert information == pytest.approx((FOCAL_PX * 2.0) ** 2, rel=1e-12)  # (f omega)^2, for displacements


def test_worked_example_2_at_rest_every_offset_costs_the_same() -> None:
    a = one_turn(omega=0.0, td=0.010)
    assert np.ptp(sweep(a, np.linspace(-0.05, 0.05, 21))) == 0.0
    still = pose_imu(path(0, "static"), 0, 0.010, 1e-4, 20.0)
    assert told(still)[1].status is Status.NOT_OBSERVABLE


# SPEC, worked example 3


def test_worked_example_3_is_exact() -> None:
    assert smear(1.0, 0.005, FOCAL_PX) == "2.5 px"
    assert smear(3.0, 0.005, FOCAL_PX) == "7.5 px"
    assert smear(3.0, -0.005, None) == "15 mrad"


def test_what_it_costs_is_told_for_the_recordings_own_rates() -> None:
    fit = pose_imu(path(0), 0, -0.008, 1e-3, 20.0).fitted
    facts = time_offset_result(PAIR, fit, Rig(), {}, Delays(), None).facts["time_offset"]
    assert isinstance(facts, dict)
    of = facts["dt_imu0_cam0"]
    assert of["px_at_median_rate"] == pytest.approx(FOCAL_PX * of["rate_median"] * abs(of["td"]), rel=1e-12)
    assert of["px_at_max_rate"] == pytest.approx(FOCAL_PX * of["rate_max"] * abs(of["td"]), rel=1e-12)


# Signs


@pytest.mark.parametrize("td", [0.025, -0.025])
def test_signs_from_the_estimate_to_words_and_rig(td: float) -> None:
    sample = pose_imu(path(1), 1, td, 1e-3, 30.0)
    fit = sample.fitted
    assert fit.td == pytest.approx(td, abs=5e-4)
    np.testing.assert_allclose(so3.log(fit.alignment.R @ R_OF_TO.T), 0, atol=2e-3)  # omega_of = R omega_to
    result = time_offset_result(PAIR, fit, Rig(), {}, Delays(), None)
    entry = result.rig.time_offsets["dt_imu0_cam0"]
    assert entry.offset.value == fit.td  # t_imu0 = t_cam0 + td
    assert entry.equation.replace(" ", "").startswith("t_imu0=t_cam0+")
    word = "early: add +" if td > 0 else "late: add -"
    assert any(word in str(line) for line in result.facts["lines"])  # type: ignore[attr-defined]


def test_a_rig_that_has_the_pair_the_other_way_round_keeps_it() -> None:
    fit = pose_imu(path(1), 1, 0.025, 1e-3, 20.0).fitted
    base = Rig(time_offsets={"dt_cam0_imu0": make_time_offset("cam0", "imu0", Estimate(value=0.0, unit="s"))})
    found = time_offset_result(PAIR, fit, base, {}, Delays(), None).rig.time_offsets
    assert list(found) == ["dt_cam0_imu0"]
    assert found["dt_cam0_imu0"].offset.value == -fit.td


def test_words() -> None:
    assert early_or_late("cam0", 0.0062) == "cam0's stamps are 6.200 ms early: add +6.200 ms to them"
    assert early_or_late("cam0", -61.7) == "cam0's stamps are 61.700000 s late: add -61.700000 s to them"
    assert early_or_late("cam0", 0.0) == "cam0's stamps are right"


def test_a_low_pass_and_an_exposure_make_the_offset_larger() -> None:
    delays = Delays(gyro_bandwidth_hz=50.0, exposure_s=0.010, readout_s=0.020)
    assert delays.gyro_s == pytest.approx(1 / (100 * np.pi))
    assert delays.camera_s == 0.015
    assert "+3.18 to +4.50 ms by the low-pass of imu0 at 50 Hz, and +15.00 ms" in delays.told("cam0", "imu0", 0.02)[0]
    assert Delays().told("cam0", "imu0", 0.02) == []


# Columns and eliminations


def piece(axes: tuple[bool, bool, bool] = (True, True, True), free_bias: bool = True) -> tuple[Weighed, OrientationTrack, Array, Array]:
    """A stretch of turns with all kinds of noise, its track, a rotation (or an axis) near the truth, and shifts (m,)."""
    rng = RNG(0)
    sample = pose_imu(path(0), 0, 0.02, 2e-3, 8.0)
    assert isinstance(sample.reference, ImuSamples)
    track = track_of_gyro(sample.reference)
    turns = replace(sample.turns, axes=axes)
    stretch = split(turns, track.origin_ns, free_bias)[0]
    R = so3.exp(np.array([0.01, -0.02, 0.015])) @ R_OF_TO
    R = R if all(axes) else R[list(axes)]
    shift = 0.018 + 1e-4 * rng.standard_normal(len(stretch.t))
    part = weigh(stretch, stretch.noise(track, R, shift, np.array([0.8, 1.0, 1.2])), NoiseLevels(4e-6, 1e-7, 1e-7))
    return part, track, R, shift


@pytest.mark.parametrize("axes", [(True, True, True), (False, False, True)])
@pytest.mark.parametrize("free_bias", [True, False])
def test_columns_equal_central_differences(axes: tuple[bool, bool, bool], free_bias: bool) -> None:
    part, track, R, shift = piece(axes, free_bias)
    found, h = linearised(part, track, R, shift), 1e-5

    def left(d: Array, dt: float) -> Array:
        return residuals(part, track, moved(R, d), (shift + dt)[:, None])[:, 0]

    np.testing.assert_allclose(found[:, 4], left(np.zeros(3), 0.0), atol=1e-10)
    for k in range(3):
        d = h * np.eye(3)[k]
        expected = (left(-d, 0.0) - left(d, 0.0)) / (2 * h)  # residual = turn - prediction
        np.testing.assert_allclose(found[:, k], expected, atol=2e-4 * np.abs(expected).max(), err_msg=f"rotation {k}")
    expected = (left(np.zeros(3), -h) - left(np.zeros(3), h)) / (2 * h)
    # The track's rate is a fit of its own, and differs a little from the slope of its orientations.
    np.testing.assert_allclose(found[:, 3], expected, atol=0.05 * np.abs(expected).max(), err_msg="offset")
    assert found[:, 3] @ expected == pytest.approx(expected @ expected, rel=2e-3)


def test_columns_by_axis_add_up_to_the_common_one() -> None:
    part, track, R, shift = piece()
    together, single = linearised(part, track, R, shift), linearised(part, track, R, shift, by_axis=True)
    np.testing.assert_allclose(single[:, 3:6].sum(axis=1), together[:, 3], rtol=1e-9, atol=1e-9)


def test_cleaned_columns_are_whitened_and_know_nothing_of_the_bias() -> None:
    part, track, R, shift = piece()
    n, d = len(part.stretch.turns.first), 3
    assert np.abs(part.clean(part.stretch.turns.duration[:, None, None] * np.eye(d))).max() < 1e-9
    band = part.stretch.noise(track, R, shift, np.array([0.8, 1.0, 1.2])).band(NoiseLevels(4e-6, 1e-7, 1e-7))
    V = np.zeros((n * d, n * d))
    for k, row in enumerate(band):
        V += np.diag(row[: n * d - k], -k)
    W = np.linalg.inv(V + np.tril(V, -1).T)
    B, x = part.stretch.drift, RNG(1).standard_normal(n * d)
    expected = x @ W @ x - x @ W @ B @ np.linalg.solve(B.T @ W @ B, B.T @ W @ x)
    assert float(np.sum(part.clean(x.reshape(n, d)) ** 2)) == pytest.approx(float(expected), rel=1e-8)


def aligned(rotation: Array | None = None) -> Alignment:
    sample = pose_imu(path(0), 0, 0.02, 1e-3, 20.0)
    a = fit_time_offset(sample.turns, sample.reference, Settings(rotation=rotation)).alignment
    return replace(a, clock=None)


def test_the_v_is_the_least_over_rotations_and_biases() -> None:
    a = aligned()
    tau = a.tau + np.array([-0.003, 0.0, 0.001, 0.004])
    cost = sweep(a, tau)
    for t, c in zip(tau, cost, strict=True):
        there, d = replace(a, tau=float(t)), np.zeros(3)
        for _ in range(4):  # the rotation alone
            H = sum(X.T @ X for X in columns(there))
            d = np.linalg.solve(H[:3, :3] + 4 * np.eye(3), H[:3, 4])
            there = replace(there, R=moved(there.R, d))
        least = sum(float(X[:, 4] @ X[:, 4]) for X in columns(there))
        assert c == pytest.approx(least, rel=2e-3)
    fixed = replace(a, free_rotation=False)
    plain = sum(np.sum(residuals(p, a.track, a.R, np.tile(tau, (len(p.stretch.t), 1))) ** 2, axis=0) for p in a.parts)
    np.testing.assert_allclose(sweep(fixed, tau), plain, rtol=1e-12)


def test_the_bottom_is_where_the_gradient_vanishes() -> None:
    a = aligned()
    H = sum(X.T @ X for X in columns(a))
    step = np.linalg.solve(H[:4, :4] + np.diag([4.0, 4.0, 4.0, 0.0]), H[:4, 4])
    assert abs(step[3]) < 1e-3 * np.linalg.inv(H[:4, :4])[3, 3] ** 0.5
    assert np.argmin(sweep(a, a.tau + np.linspace(-0.002, 0.002, 41))) == 20


def test_without_noise_the_truth_comes_out() -> None:
    truth = path(4)
    poses = seen_poses(truth, stamps(20, 28, 1.0123), 0.0, RNG(0), R_OF_TO.T, 0.0371)
    imu = seen_gyro(truth, stamps(200, 30), RNG(0), SILENT)
    fit = fit_time_offset(turns_of_poses(poses), imu, Settings())
    assert fit.td == pytest.approx(0.0371, abs=1e-6)
    np.testing.assert_allclose(so3.log(fit.alignment.R @ R_OF_TO.T), 0, atol=1e-5)


def test_a_rotation_that_is_given_is_kept_and_helps() -> None:
    sample = pose_imu(path(0), 0, 0.02, 1e-3, 20.0)
    levels = NoiseLevels(1e-6, 3e-8)
    free, given = (fit_time_offset(sample.turns, sample.reference, Settings(rotation=R, levels=levels)) for R in (None, R_OF_TO))
    np.testing.assert_array_equal(given.alignment.R, R_OF_TO)
    assert given.covariance.plain[0, 0] <= free.covariance.plain[0, 0]
    assert abs(given.td - 0.02) < 4 * given.sigma


def test_one_axis_needs_no_rotation_but_its_direction() -> None:
    sample = wheels_imu(0, 0.05)
    fit = sample.fitted
    assert fit.alignment.R.shape == (1, 3)
    assert abs(fit.td - 0.05) < 4 * fit.sigma
    axis_of_body = R_OF_TO.T @ np.array([0.0, -1.0, 0.0])  # the yaw axis as the IMU's axes have it
    assert fit.alignment.R[0] @ axis_of_body == pytest.approx(1, abs=0.01)  # across it nothing turns, and nothing is known


def test_offsets_of_single_axes_agree_where_nothing_is_wrong() -> None:
    off, cov = axis_offsets(aligned())
    assert off @ np.linalg.solve(cov, off) < 16
    assert np.all(np.sqrt(np.diag(cov)) < 1e-3)


def test_windows_measure_the_same_offset_each_by_itself() -> None:
    a = aligned()
    windows = window_offsets(a, 0.05)
    assert len(windows.tau) == len(a.parts)
    assert float(np.sum(((windows.tau - a.tau) / windows.sigma) ** 2)) < 20
    assert np.sum(windows.sigma**-2.0) == pytest.approx(sum(float(X[:, 3] @ X[:, 3]) for X in columns(a)), rel=0.05)


def test_the_bootstrap_agrees_with_the_curvature() -> None:
    fit = pose_imu(path(0), 0, 0.02, 1e-3, 60.0).fitted
    assert 0.5 < bootstrap_sigma(fit, 300) / fit.sigma < 1.6


# Starts


def direct_correlation(a: Array, has_a: Array, b: Array, has_b: Array, lag: int) -> tuple[float, int]:
    pairs = [(k + lag, k) for k in range(len(b)) if 0 <= k + lag < len(a) and has_a[k + lag] and has_b[k]]
    if len(pairs) < 3:
        return 0.0, len(pairs)
    x, y = (np.array(v) for v in zip(*((a[i], b[k]) for i, k in pairs), strict=True))
    return float(np.corrcoef(x, y)[0, 1]), len(pairs)


@pytest.mark.parametrize(("n", "m"), [(60, 40), (40, 60), (30, 1), (25, 25)])
def test_masked_correlation_equals_the_loop(n: int, m: int) -> None:
    rng = RNG(n + m)
    a, b = 5 + rng.standard_normal(n), -3 + rng.standard_normal(m)
    has_a, has_b = rng.random(n) > 0.3, rng.random(m) > 0.2
    has_a[0] = has_b[0] = True
    rho, count = masked_correlation(a, has_a, b, has_b)
    assert len(rho) == len(count) == n + m - 1
    for index, lag in enumerate(range(1 - m, n)):
        expected, many = direct_correlation(a, has_a, b, has_b, lag)
        assert count[index] == many
        if many >= 3:
            assert rho[index] == pytest.approx(expected, abs=1e-9), lag


def test_the_right_lag_is_the_first_candidate_with_gaps_and_minutes_between() -> None:
    for seed in range(3):
        sample = pose_imu(path(seed), seed, 321.0 + any_offset(seed), 2e-3)
        rows = np.abs(sample.turns.t_ns[sample.turns.first] - sample.turns.t_ns[600]) > 4e9
        turns = sample.turns.select(rows)
        assert isinstance(sample.reference, ImuSamples)
        track = track_of_gyro(sample.reference)
        best = rough_offsets(turns, track)[0]
        truth = (turns.t_ns[0] - track.origin_ns) * 1e-9 + sample.td
        assert abs(best.lag - truth) < best.uncertainty
        start = find_starts(turns, track, None)[0]
        assert start.coarse_ns * 1e-9 == pytest.approx(sample.td, abs=0.02)
        assert np.linalg.norm(so3.log(start.R @ R_OF_TO.T)) < 0.05


def test_usable_turns_are_those_with_the_track_known_throughout() -> None:
    sample = pose_imu(path(0), 0, 0.0, 1e-3, 20.0)
    assert isinstance(sample.reference, ImuSamples)
    keep = np.abs(sample.reference.t_ns - sample.reference.t_ns[2000]) > 0.1e9
    track = track_of_gyro(sample.reference.select(keep))
    found = usable(sample.turns, track, -0.05, 0.03)
    t = (sample.turns.t_ns - track.origin_ns) * 1e-9
    for k, (first, last) in enumerate(zip(sample.turns.first, sample.turns.last, strict=True)):
        chains = track.chain_at(np.linspace(t[first] - 0.05, t[last] + 0.03, 60))
        assert found[k] == (chains[0] >= 0 and bool(np.all(chains == chains[0]))), k
    assert 0 < np.sum(~found) < 10


def test_stretches_hold_every_turn_once() -> None:
    turns = pose_imu(path(0), 0, 0.0, 1e-3, 32.0).turns
    turns = turns.select(np.abs(turns.t_ns[turns.first] - turns.t_ns[300]) > 2e9)
    stretches = split(turns, START_NS)
    np.testing.assert_array_equal(np.concatenate([s.turns.angle for s in stretches]), turns.angle)
    assert all(len(s.turns.first) >= 8 and np.ptp(s.t) < 11 for s in stretches)


def test_weighing_leaves_out_stretches_of_few_turns() -> None:
    a = aligned()
    few = tuple(np.arange(len(keep)) < (5 if i == 0 else len(keep)) for i, keep in enumerate(a.keep))
    assert len(weighed(replace(a, keep=few)).parts) == len(a.parts) - 1
    assert turn_noise(a.stretches[0].turns, np.zeros((len(a.stretches[0].t), 3)), np.ones(3)).end.shape[0] == 6


def test_both_directions_of_a_pair_agree() -> None:
    """Poses against poses, and the other way round: td changes its sign, no more than both sigmas apart."""
    truth, rng, td = path(2), RNG(2), 0.042
    one, other = seen_poses(truth, stamps(50, 30), 1e-3, rng), seen_poses(truth, stamps(40, 28, 1.003), 1e-3, rng, R_OF_TO.T, td)
    forward = Sample(turns_of_poses(other), other.t_ns, one, td).fitted
    back = Sample(turns_of_poses(one), one.t_ns, other, -td).fitted
    assert abs(forward.td + back.td) < 3 * (forward.sigma + back.sigma)
    np.testing.assert_allclose(so3.log(forward.alignment.R @ back.alignment.R), 0, atol=3e-3)


def test_an_interval_that_holds_zero_lets_the_stamps_be() -> None:
    fit = pose_imu(path(0), 0, 0.01, 1e-3, 10.0).fitted
    pair = Pair("cam0", "imu0", "/cam0", "/imu0", "poses")
    kept = "; the stamps as they are lie within the interval"
    for half, holds in ((1e-3, False), (2e-2, True)):
        wide = replace(fit, interval=(fit.alignment.tau - half, fit.alignment.tau + half))
        lines = time_offset_result(pair, wide, Rig(), {}, Delays(), None).facts["lines"]
        assert isinstance(lines, list)
        assert lines[1].endswith(kept) is holds
        assert re.search(r"once corrected its sigma still costs \S+ mrad at \S+ rad/s$", lines[3])


def test_few_turns_in_a_long_recording_are_no_lack_of_time() -> None:
    sample = pose_imu(path(0), 0, 0.01, 1e-3, 20.0)
    every = np.arange(0, len(sample.turns.first), len(sample.turns.first) // 8)
    turns = sample.turns
    few = Turns(turns.t_ns, turns.first[every], turns.last[every], turns.angle[every])
    with pytest.raises(BadInputError, match=r"only \d turns of the first could be told from its \d+ stamps"):
        fit_time_offset(few, sample.reference, Settings())
