"""Pairs of two pose streams: the offset of their clocks, what is read between stamps, rests, and X with an honest covariance."""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from time_offset_samples import path, stamps

from calibkit.data.observations import PoseSamples, Times
from calibkit.errors import BadInputError
from calibkit.estimation import hand_eye
from calibkit.estimation.board_poses import BoardPoses
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_streams import calibrate_streams
from calibkit.estimation.pose_interpolation import (
    PoseStream,
    held,
    in_time,
    interpolate,
    inverted,
    stream_of,
    stream_of_board,
    without_repeats,
)
from calibkit.estimation.pose_jumps import jumps
from calibkit.estimation.pose_offset import ClockOffset, Settings, aligned
from calibkit.estimation.pose_pairing import Pairing, pair_poses
from calibkit.geometry import se3, so3
from calibkit.io.recording import open_recording
from calibkit.simulation.session import START_NS
from calibkit.simulation.trajectory import Trajectory

Array = NDArray[np.float64]

X_TRUE: Array = se3.make(so3.exp(np.array([0.7, -1.9, 1.1])), np.array([0.05, -0.12, 0.08]))
Z_TRUE: Array = se3.make(so3.exp(np.array([-0.3, 0.4, 2.0])), np.array([0.9, 0.2, -0.1]))
PLAIN = hand_eye.Settings(methods=False)
NOISE = np.array([5e-4] * 3 + [1e-3] * 3)  # m, rad: of a board's pose
ROBOT = np.array([1e-4] * 3 + [1e-4] * 3)


def noisy(T: Array, sigma: Array, rng: np.random.Generator) -> Array:
    return se3.retract(T, sigma * rng.standard_normal((len(T), 6)))


def seconds(t_ns: Times) -> Array:
    return np.asarray((t_ns - START_NS) * 1e-9, np.float64)


def camera_of(robot: Array) -> Array:
    """T_target_cam of robot poses T_base_gripper."""
    return se3.inverse(Z_TRUE) @ robot @ X_TRUE


def camera(T: Array, t_ns: Times, rng: np.random.Generator) -> PoseStream:
    cov = np.broadcast_to(np.diag(NOISE**2), (len(T), 6, 6))
    return PoseStream("cam", t_ns, noisy(T, NOISE, rng), cov, tuple(f"{i}.png" for i in range(len(T))))


def moving(seed: int, dt: float, missing: float = 0.0, duration_s: float = 40.0, wrong: float = 0.0) -> tuple[PoseStream, PoseStream]:
    """A robot of 60 Hz and a camera of 20 Hz, t_robot = t_cam + dt; `missing` of both are lost, `wrong` of the camera's are anything."""
    rng, trajectory = np.random.default_rng((seed, 5)), path(seed)
    t_P, t_Q = stamps(60, duration_s), stamps(20, duration_s - 4, 2.0123)
    t_P, t_Q = (t[rng.random(len(t)) >= missing] for t in (t_P, t_Q))
    robot = PoseStream("robot", t_P, noisy(trajectory.at(seconds(t_P)).T_world_imu, ROBOT, rng))
    seen = camera(camera_of(trajectory.at(seconds(t_Q)).T_world_imu), t_Q - round(dt * 1e9), rng)
    if wrong:
        lost = rng.permutation(len(t_Q))[: round(wrong * len(t_Q))]
        seen.T[lost] = se3.make(so3.exp(rng.standard_normal((len(lost), 3))), 0.7 * rng.standard_normal((len(lost), 3)))
    return robot, seen


def stops(t: Array, seed: int, n: int, move_s: float = 1.0, rest_s: float = 1.0) -> Array:
    """T_base_gripper that goes from stop to stop by minimum jerk: 10 u^3 - 15 u^4 + 6 u^5 (Flash and Hogan 1985)."""
    rng = np.random.default_rng((seed, 6))
    at = np.concatenate([rng.uniform(-0.15, 0.15, (n, 3)), rng.uniform(-0.5, 0.5, (n, 3))], axis=1)
    leg = np.clip((t // (move_s + rest_s)).astype(int), 0, n - 2)
    u = np.clip((t - leg * (move_s + rest_s) - rest_s) / move_s, 0, 1)[:, None]
    y = at[leg] + (at[leg + 1] - at[leg]) * u**3 * (10 - 15 * u + 6 * u**2)
    return se3.make(so3.exp(y[:, 3:]), y[:, :3])


def stop_and_go(seed: int, dt: float, camera_hz: float = 15.0, n: int = 16, exact: bool = False) -> tuple[PoseStream, PoseStream]:
    """A robot of 100 Hz, `exact` without any noise, that stops 15 times for a second each."""
    rng, duration = np.random.default_rng((seed, 7)), 2.0 * (n - 1) + 1
    t_P, t_Q = stamps(100, duration), stamps(camera_hz, duration - 0.5, 0.2123)
    T_P = stops(seconds(t_P), seed, n)
    robot = PoseStream("robot", t_P, T_P if exact else noisy(T_P, ROBOT, rng))
    return robot, camera(camera_of(stops(seconds(t_Q), seed, n)), t_Q - round(dt * 1e9), rng)


def normalised(fit: HandEyeFit) -> Array:
    return np.asarray(se3.local(fit.X, X_TRUE) / np.sqrt(np.diag(fit.cov_X)))


def pairs(P: PoseStream, Q: PoseStream, settings: Settings) -> Pairing:
    return pair_poses(aligned(P, Q, settings), settings)


# Between stamps.


def test_a_held_pose_is_none_and_a_rest_is_kept() -> None:
    t, T = stamps(20, 2), np.tile(np.eye(4), (40, 1, 1))
    T[:, 0, 3] = np.arange(40)
    T[5], T[20:30] = T[4], T[20]
    stream = PoseStream("s", t, T)
    assert np.flatnonzero(held(stream)).tolist() == [5]
    assert len(without_repeats(stream).t_ns) == 39


def uneven(trajectory: Trajectory, rate_hz: float, seed: int, missing: float = 0.3) -> PoseStream:
    rng = np.random.default_rng(seed)
    t = stamps(rate_hz, 20)
    t = t[rng.random(len(t)) >= missing] + 0
    return PoseStream("s", t, trajectory.at(seconds(t)).T_world_imu)


def test_interpolated_pose_and_twist_are_those_of_the_motion() -> None:
    trajectory = path(1)
    stream = uneven(trajectory, 100, 1)
    t_ns = stamps(22, 18, 1.0037)
    got, truth = interpolate(stream, t_ns), trajectory.at(seconds(t_ns))
    assert got.known.mean() > 0.9
    off = np.abs(se3.local(truth.T_world_imu, got.T))[got.known]
    assert np.sqrt(np.mean(off**2)) < 2e-5
    assert off.max() < 1e-3
    body = np.einsum("nji,nj->ni", truth.T_world_imu[:, :3, :3], truth.velocity_w)
    speed = np.concatenate([body, truth.omega_i], axis=1)
    assert np.sqrt(np.mean((got.twist - speed)[got.known] ** 2)) < 0.01 * np.sqrt(np.mean(speed**2))


def test_the_curves_covariance_covers_its_error_at_a_coarse_rate() -> None:
    ratios = []
    for seed in range(5):
        trajectory = path(seed)
        t_ns = stamps(31, 18, 1.0037)
        got = interpolate(uneven(trajectory, 12, seed), t_ns)
        off = se3.local(trajectory.at(seconds(t_ns)).T_world_imu, got.T)[got.known]
        sigma = np.sqrt(np.einsum("nii->ni", got.curve_cov[got.known]))
        ratios.append(np.median(np.linalg.norm(off, axis=1) / np.linalg.norm(sigma, axis=1)))
        assert np.mean(np.linalg.norm(off, axis=1) < 3 * np.linalg.norm(sigma, axis=1)) > 0.9
    assert 0.05 < np.median(ratios) < 1.5


def test_nothing_is_read_outside_nor_across_a_gap_and_a_stamp_there_is_the_pose_itself() -> None:
    trajectory = path(2)
    t = stamps(50, 10)
    t = t[(seconds(t) < 4) | (seconds(t) > 4.2)]
    stream = PoseStream("s", t, trajectory.at(seconds(t)).T_world_imu)
    asked = START_NS + np.round(np.array([-0.001, 0.0, 3.99, 4.1, 4.19, 4.25, 9.98, 9.99, 20]) * 1e9).astype(np.int64)
    got = interpolate(stream, asked)
    assert got.known.tolist() == [False, True, False, False, False, True, True, False, False]
    assert np.array_equal(got.T[1], stream.T[0])
    assert np.all(got.twist[~got.known] == 0)


def test_repeats_duplicate_stamps_disorder_and_sign_flips_change_nothing() -> None:
    trajectory, rng = path(3), np.random.default_rng(3)
    t = stamps(50, 10)
    T = trajectory.at(seconds(t)).T_world_imu
    q = so3.to_quat(T[:, :3, :3])
    clean = stream_of("s", PoseSamples(t, q, T[:, :3, 3], "w", "s"))
    again = rng.integers(1, len(t), 30)
    spoilt_t = np.concatenate([t, t[again], t[again] + 7_000_000])
    spoilt_q = np.concatenate([q * rng.choice([-1.0, 1.0], (len(q), 1)), so3.quat_exp(rng.standard_normal((30, 3))), q[again]])
    spoilt_p = np.concatenate([T[:, :3, 3], rng.standard_normal((30, 3)), T[again, :3, 3]])
    order = np.concatenate([rng.permutation(len(t)), np.arange(len(t), len(spoilt_t))])  # the wrong ones come second
    spoilt_q[len(t) + 30 :] = spoilt_q[again]  # to the last digit
    spoilt = stream_of("s", PoseSamples(spoilt_t[order], spoilt_q[order], spoilt_p[order], "w", "s"))
    asked = stamps(17, 9, 0.5)
    a, b = (interpolate(without_repeats(in_time(s)), asked) for s in (clean, spoilt))
    assert a.known.all()
    assert b.known.all()
    np.testing.assert_allclose(b.T, a.T, atol=1e-12)


def board_stream(s: PoseStream) -> PoseStream:
    assert s.cov is not None
    rows, none = np.zeros(1, np.intp), np.zeros(0, bool)
    return stream_of_board(BoardPoses("s", s.t_ns, (), rows, s.T, s.cov, np.ones(1), rows, none, (), 0.1))


@pytest.mark.parametrize("turn", [inverted, board_stream])
def test_an_inverted_streams_covariance_is_that_of_its_poses(turn: Callable[[PoseStream], PoseStream]) -> None:
    rng = np.random.default_rng(4)
    L = 1e-4 * rng.standard_normal((6, 6))
    T = np.broadcast_to(X_TRUE, (20000, 4, 4))
    sampled = se3.retract(T, rng.standard_normal((20000, 6)) @ L.T)
    stream = PoseStream("s", np.arange(1), T[:1], (L @ L.T)[None])
    got = turn(stream)
    assert got.cov is not None
    np.testing.assert_allclose(got.T[0], se3.inverse(X_TRUE), atol=1e-12)
    d = se3.local(got.T, se3.inverse(sampled))
    ratio = np.linalg.solve(np.linalg.cholesky(got.cov[0]), d.T)
    np.testing.assert_allclose(np.cov(ratio), np.eye(6), atol=0.06)


# Moving.


def check_honest(errors: list[Array], low: float, high: float) -> None:
    rms = np.sqrt(np.mean(np.square(errors)))
    assert low < rms < high, rms


def moving_fits(seeds: int) -> list[tuple[Pairing, HandEyeFit]]:
    found = []
    for seed in range(seeds):
        P, Q = moving(seed, 0.05, missing=0.3)
        pairing, fit = calibrate_streams(P, Q, "motion", Settings(most=250), replace(PLAIN, drift=False))
        assert pairing.kind == "moving"
        assert pairing.read_P
        assert pairing.offset.known == "poses"
        assert fit.converged
        found.append((pairing, fit))
    return found


def of_offset(found: list[tuple[Pairing, HandEyeFit]]) -> Array:
    return np.array([(pairing.offset.dt - 0.05) / pairing.offset.sigma for pairing, _ in found])


def test_a_moving_robot_with_lag_and_30_percent_gaps() -> None:
    found = moving_fits(2)
    check_honest([normalised(fit) for _, fit in found], 0.4, 1.6)
    assert np.abs(of_offset(found)).max() < 3.5
    for pairing, fit in found:
        assert all(re.search("poses are missing|fall into gaps", reason.text) for reason in pairing.reasons)
        assert pairing.offset.sigma < 5e-4
        assert np.sqrt(np.diag(fit.cov_X)[:3]).max() < 2e-3


def assert_all_seeds_honest(fits: list[HandEyeFit]) -> None:
    """STYLE's bands for 100 seeds."""
    of_X = np.array([normalised(fit) for fit in fits])
    each = np.sqrt(np.mean(of_X**2, axis=0))
    errors = [se3.local(X_TRUE, fit.X) for fit in fits]
    pooled = np.sqrt(np.mean([e @ np.linalg.solve(fit.cov_X, e) / 6 for e, fit in zip(errors, fits, strict=True)]))
    print(f"error / sigma of X {each.round(2)}, pooled {pooled:.3f}")
    assert np.all((each > 0.77) & (each < 1.24))
    assert 0.8 < pooled < 1.25


@pytest.mark.slow
def test_a_moving_robots_covariances_are_honest() -> None:
    found = moving_fits(100)
    dt = np.sqrt(np.mean(of_offset(found) ** 2))
    print(f"of dt {dt:.2f}")
    assert 0.77 < dt < 1.24
    assert_all_seeds_honest([fit for _, fit in found])


@pytest.mark.slow
def test_30_percent_wrong_poses_of_a_moving_camera_add_less_than_half_to_the_error() -> None:
    """By one clock: half of the turns are wrong then, which the offset does not survive."""
    fits: dict[float, list[HandEyeFit]] = {0.0: [], 0.3: []}
    for wrong, those in fits.items():
        for seed in range(100):
            P, Q = moving(seed, 0.0, missing=0.3, wrong=wrong)
            fit = calibrate_streams(P, Q, "motion", Settings(dt=0.0, most=250), replace(PLAIN, drift=False))[1]
            assert fit.converged
            those.append(fit)
        assert_all_seeds_honest(those)
    rms = [np.sqrt(np.mean(np.square([se3.local(X_TRUE, fit.X) for fit in those]), axis=0)) for those in fits.values()]
    print("30 % wrong ones: rms error over that without", rms[1] / rms[0])
    assert np.all(rms[1] < 1.5 * rms[0])


@pytest.mark.slow
def test_an_offset_from_turns_of_which_half_are_wrong_is_right_or_refused() -> None:
    told: list[ClockOffset] = []
    for seed in range(20):
        P, Q = moving(seed, 0.05, missing=0.3, wrong=0.3)
        with suppress(BadInputError):
            told.append(aligned(P, Q, Settings()).offset)
    print(f"told in {len(told)} of 20")
    assert all(abs(offset.dt - 0.05) < 4 * offset.sigma for offset in told)


def test_poses_that_jump_and_come_back_do_not_hide_the_offset() -> None:
    """A tracker that loses its target for single poses; of streams without such none is taken for one."""
    for seed in range(3):
        P, Q = moving(seed, 3.2, wrong=0.3)
        assert np.mean(jumps(P)) == 0
        assert np.mean(jumps(moving(seed, 3.2)[1])) == 0
        both = aligned(P, Q, Settings())
        assert abs(both.offset.dt - 3.2) < 4 * both.offset.sigma
        assert re.search("(2.|30|31)% of cam's poses jump away .*: the clocks are aligned without them", both.lines[0])
    lost, whole = moving(0, 3.2, wrong=0.45)[1], moving(1, 3.2)[0]  # of another body
    with pytest.raises(BadInputError, match=r"% of cam's poses jump away .*: remove these, or give dt_robot_cam in a rig file"):
        aligned(whole, lost, Settings())


def test_the_slower_stream_may_be_either_and_the_offset_keeps_its_sign() -> None:
    P, Q = moving(4, -130.0)
    one, two = pairs(P, Q, Settings()), pairs(Q, P, Settings())
    assert one.read_P
    assert not two.read_P
    assert one.offset.dt == pytest.approx(-130, abs=4 * one.offset.sigma)
    assert two.offset.dt == -one.offset.dt
    np.testing.assert_allclose(two.P, one.Q)
    np.testing.assert_allclose(two.Q, one.P)
    assert one.labels == two.labels
    assert one.labels[0].endswith(".png")
    assert np.all(np.diff(one.t_Q_ns) > 0)
    off = se3.local(Z_TRUE @ one.Q, one.P @ X_TRUE)
    assert np.median(np.abs(off)) < 2e-3


def test_the_offsets_sigma_enters_along_the_motion() -> None:
    P, Q = moving(5, 0.0)
    P = replace(P, cov=np.broadcast_to(np.diag(ROBOT**2), (len(P.t_ns), 6, 6)))
    known, vague = (pairs(P, Q, Settings(dt=0.0, dt_sigma=s)) for s in (0.0, 0.01))
    np.testing.assert_allclose(vague.extra - known.extra, 1e-4 * vague.twist[:, :, None] * vague.twist[:, None, :], atol=1e-15)
    cov_P = vague.data("motion").cov_P
    assert cov_P is not None
    assert vague.cov_P is not None
    assert np.allclose(cov_P, vague.cov_P + vague.extra)


def test_a_long_recording_is_thinned_over_time_and_turning() -> None:
    P, Q = moving(6, 0.0)
    resting = PoseStream("cam", stamps(20, 60, 38.5), np.broadcast_to(Q.T[-1], (1200, 4, 4)), None)
    held = noisy(resting.T, NOISE, np.random.default_rng(6))
    Q = PoseStream("cam", np.concatenate([Q.t_ns, resting.t_ns]), np.concatenate([Q.T, held]))
    still = noisy(np.broadcast_to(P.T[-1], (3600, 4, 4)), ROBOT, np.random.default_rng(7))
    P = PoseStream("robot", np.concatenate([P.t_ns, stamps(60, 60, 40)]), np.concatenate([P.T, still]))
    found = pairs(P, Q, Settings(dt=0.0, most=200))
    t = seconds(found.t_Q_ns)
    assert 150 <= len(t) <= 200
    assert 0.5 < np.mean(t < 38) < 0.8  # a third of the time, nearly all of the turning
    assert np.diff(t).max() < 2
    assert "thinned out" in " ".join(found.lines)


# Stop and go.


def rest_errors(seeds: int, camera_hz: float = 15.0) -> list[Array]:
    errors = []
    for seed in range(seeds):
        P, Q = stop_and_go(seed, 0.2, camera_hz, exact=seed % 2 == 1)
        pairing, fit = calibrate_streams(P, Q, "motion", None, PLAIN)
        assert pairing.kind == "rests"
        assert 14 <= len(pairing.P) <= 16
        assert pairing.offset.dt == pytest.approx(0.2, abs=max(4 * pairing.offset.sigma, 2e-3))
        errors.append(normalised(fit))
        # the average is better than a pose, and no rest has motion in it
        off = se3.local(Z_TRUE @ pairing.Q, pairing.P @ X_TRUE)
        assert np.sqrt(np.mean(off[:, 3:] ** 2)) < 0.5 * NOISE[3]
        assert np.abs(off[:, 3:]).max() < 1.5 * NOISE[3]
    return errors


def test_stop_and_go_with_a_lag_is_averaged_at_its_rests() -> None:
    check_honest(rest_errors(3), 0.4, 1.6)


@pytest.mark.slow
def test_rests_covariances_are_honest() -> None:
    rms = np.sqrt(np.mean(np.square(rest_errors(50)), axis=0))
    assert np.all((rms > 0.68) & (rms < 1.34)), rms


def test_a_camera_too_slow_to_show_stillness_takes_the_robots_word() -> None:
    P, Q = stop_and_go(1, 0.0, camera_hz=2.5)
    found = pairs(P, Q, Settings(one_clock=True))
    assert found.kind == "rests"
    assert len(found.P) >= 14
    assert found.offset.known in ("turns", "assumed")
    off = se3.local(Z_TRUE @ found.Q, found.P @ X_TRUE)
    assert np.abs(off).max() < 5 * NOISE.max()


def test_few_rests_are_told_and_moving_pairs_taken_and_either_may_be_forced() -> None:
    P, Q = stop_and_go(2, 0.05, n=5)
    found = pairs(P, Q, Settings())
    assert found.kind == "moving"
    assert any("rests are not enough" in line for line in found.lines)
    forced = pairs(P, Q, Settings(rests=True))
    assert forced.kind == "rests"
    assert len(forced.P) == 5
    P, Q = stop_and_go(2, 0.05)
    assert pairs(P, Q, Settings()).kind == "rests"
    assert pairs(P, Q, Settings(rests=False)).kind == "moving"
    P, Q = moving(1, 0.0)
    with pytest.raises(BadInputError, match="robot and cam: 0 rests in common are too few"):
        pairs(P, Q, Settings(rests=True))


# What cannot be.


def test_an_offset_that_no_motion_tells_is_zero_by_one_clock_or_refused() -> None:
    rng = np.random.default_rng(8)
    t_P, t_Q = stamps(50, 30), stamps(20, 28, 1.0)
    still = np.eye(4)
    P = PoseStream("robot", t_P, noisy(np.broadcast_to(still, (len(t_P), 4, 4)), ROBOT, rng))
    Q = PoseStream("cam", t_Q, noisy(np.broadcast_to(still, (len(t_Q), 4, 4)), NOISE, rng))
    with pytest.raises(BadInputError, match="offset of their clocks is not known: the rig hardly turns"):
        pairs(P, Q, Settings())
    found = pairs(P, Q, Settings(one_clock=True))
    assert found.offset.known == "assumed"
    assert found.offset.dt == 0
    assert any("assumed" in line for line in found.lines)
    assert any("hardly turns" in line for line in found.lines)


def test_streams_without_common_time_or_stamps_are_refused() -> None:
    P, Q = moving(1, 0.0)
    with pytest.raises(BadInputError, match=r"robot and cam share no time at dt = 500 s"):
        pairs(P, Q, Settings(dt=500.0))
    with pytest.raises(BadInputError, match="robot: 1 poses with stamps"):
        pairs(P.select(np.arange(1)), Q, Settings(dt=0.0))


# Real recordings.


def read(data_dir: Path, name: str) -> PoseStream:
    return stream_of(name, open_recording([data_dir / "pose_streams" / f"{name}.csv"]).poses(name))


@pytest.mark.slow
def test_motion_capture_and_camera(data_dir: Path) -> None:
    hand, cam = read(data_dir, "vicon_hand"), read(data_dir, "camera_in_target")
    half = len(cam.t_ns) // 2
    found = []
    for part in (np.arange(half), np.arange(half, 2 * half)):
        found.append(calibrate_streams(hand, cam.select(part), "motion", Settings(most=300), replace(PLAIN, drift=False)))
        pairing, fit = found[-1]
        assert 0.015 < pairing.offset.dt < 0.023
        assert 2e-4 < pairing.offset.sigma < 4e-3
        assert fit.kept.mean() > 0.8
    # Turns alone say 31 ms of the whole; of a half, their own sigma may be too large to contradict.
    assert any("whole poses have" in reason.text for pairing, _ in found for reason in pairing.reasons)
    X = [fit.X for _, fit in found]
    apart = se3.local(X[0], X[1]) / np.sqrt(sum(np.diag(fit.cov_X) for _, fit in found))
    assert np.abs(apart).max() < 3


@pytest.mark.slow
def test_motion_capture_and_camera_have_one_world(data_dir: Path) -> None:
    pairing, fit = calibrate_streams(read(data_dir, "vicon_hand"), read(data_dir, "camera_in_target"), "motion", None, PLAIN)
    assert fit.n_worlds == 1
    assert 0.016 < pairing.offset.dt < 0.022


@pytest.mark.slow
def test_three_phones_offsets_of_minutes_close_to_a_loop(data_dir: Path) -> None:
    phone = {name: read(data_dir, f"tango_{name}") for name in ("CALIGULA", "MARS", "NERO")}
    found = [
        calibrate_streams(phone[a], phone[b], "motion", None, PLAIN)
        for a, b in (("CALIGULA", "MARS"), ("MARS", "NERO"), ("CALIGULA", "NERO"))
    ]
    dt = [pairing.offset.dt for pairing, _ in found]
    np.testing.assert_allclose(dt, [-125.15, -4458.26, -4583.41], atol=0.01)
    assert abs(dt[0] + dt[1] - dt[2]) < 0.002
    X = [fit.X for _, fit in found]
    apart = se3.local(X[0] @ X[1], X[2])
    assert np.linalg.norm(apart[3:]) < np.radians(0.5)
    assert np.linalg.norm(apart[:3]) < 0.03
    assert all(fit.n_worlds > 1 for _, fit in found)  # odometries drift
