"""The orientation that others are laid against: exact where it can be, late nowhere, unknown across gaps."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from time_offset_samples import (
    SILENT,
    Sample,
    any_offset,
    constant_rate,
    path,
    pose_imu,
    pose_pose,
    seen_gyro,
    seen_poses,
    stamps,
)

from calibkit.data.observations import ImuSamples, PoseSamples
from calibkit.errors import BadInputError
from calibkit.estimation import orientation_track, time_grid
from calibkit.estimation.orientation_track import OrientationTrack, accumulate, track_of_gyro, track_of_poses
from calibkit.estimation.turn_comparison import lost_to_gaps, usable
from calibkit.estimation.turns import Turns, gyro_steps
from calibkit.geometry import so3
from calibkit.simulation.session import START_NS
from calibkit.simulation.trajectory import Trajectory

Array = NDArray[np.float64]
RNG = np.random.default_rng


def gyro(t_ns: NDArray[np.int64], rate: Array) -> ImuSamples:
    return ImuSamples(t_ns, rate, np.zeros((len(t_ns), 0)))


def poses(t_ns: NDArray[np.int64], q: Array) -> PoseSamples:
    return PoseSamples(t_ns, q, np.zeros((len(t_ns), 3)), "world", "body")


def uneven(rate_hz: float, duration_s: float, seed: int = 0) -> NDArray[np.int64]:
    """Stamps that lie up to a fifth of a period off a regular grid."""
    even = stamps(rate_hz, duration_s)
    return even + np.round(RNG(seed).uniform(-0.2, 0.2, len(even)) * 1e9 / rate_hz).astype(np.int64)


def duration(track: OrientationTrack) -> float:
    return track.step * (len(track.q) - 1)


def inside(track: OrientationTrack, margin: float = 0.2) -> Array:
    """Instants everywhere but at the ends, none of them on the grid."""
    return np.linspace(margin, duration(track) - margin, 1777)


def turned(track: OrientationTrack, t: Array) -> Array:
    q = track.orientation(t)
    out: Array = so3.from_quat(so3.quat_multiply(so3.quat_conjugate(q[:1]), q))
    return out


def errors(track: OrientationTrack, truth: Trajectory, t: Array) -> Array:
    """Rotation vectors from the true turns since t[0] to the track's, in the body's axes."""
    R = truth.at(t + (track.origin_ns - START_NS) * 1e-9).T_world_imu[:, :3, :3]
    out: Array = so3.log(np.swapaxes(R[0].T @ R, 1, 2) @ turned(track, t))
    return out


def delay(track: OrientationTrack, truth: Trajectory, t: Array) -> float:
    """The s by which the track looks late: errors = -omega delay + a constant, by least squares."""
    omega = truth.at(t + (track.origin_ns - START_NS) * 1e-9).omega_i
    error = errors(track, truth, t)
    omega, error = omega - omega.mean(axis=0), error - error.mean(axis=0)
    return -float(np.sum(omega * error) / np.sum(omega**2))


# What is exact


@pytest.mark.parametrize("omega", [[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [2.0, -1.0, 1.5], [1e-9, 0.0, 0.0], [6.0, 6.0, -6.0]])
@pytest.mark.parametrize("sample", [uneven(200, 5), uneven(30, 5), stamps(100, 5)])
def test_a_constant_rate_is_exact_between_samples_too(omega: list[float], sample: NDArray[np.int64]) -> None:
    truth = constant_rate(np.array(omega))
    for track in (
        track_of_gyro(gyro(sample, truth.at((sample - START_NS) * 1e-9).omega_i)),
        track_of_poses(seen_poses(truth, sample, 0.0, RNG(0))),
    ):
        t = inside(track)
        assert np.abs(errors(track, truth, t)).max() < 1e-12 * (1 + 100 * np.linalg.norm(omega))
        assert np.abs(track.rate_at(t) - omega).max() < 1e-9
        assert np.all(track.chain_at(t) == 0)


def test_a_rotation_that_grows_with_the_square_of_time_is_exact() -> None:
    """Local quadratics have nothing to smooth away there, on uneven stamps either."""
    sample = uneven(30, 6)
    s = (sample - START_NS) * 1e-9
    axis = np.array([2.0, -1.0, 2.0]) / 3
    track = track_of_poses(poses(sample, so3.quat_exp((0.2 + 0.5 * s - 0.3 * s**2)[:, None] * axis)))
    t = inside(track)
    s = t + (track.origin_ns - START_NS) * 1e-9
    expected = so3.quat_exp((0.2 + 0.5 * s - 0.3 * s**2)[:, None] * axis)
    assert np.linalg.norm(so3.quat_log(so3.quat_multiply(so3.quat_conjugate(expected), track.orientation(t))), axis=1).max() < 1e-12
    assert np.abs(track.rate_at(t) - (0.5 - 0.6 * s)[:, None] * axis).max() < 1e-10


def test_a_gyroscopes_steps_are_of_fourth_order() -> None:
    """Of a rate that is linear in time about a moving axis each step is right to h^5: half the interval, a sixteenth of the error."""

    def end(n: int, cross: bool = True) -> Array:
        t_ns = np.round(np.linspace(0, 2e9, n + 1)).astype(np.int64)
        rate = np.array([1.0, -2.0, 0.5]) + (t_ns * 1e-9)[:, None] * np.array([-1.5, 1.0, 2.0])
        straight = np.diff(t_ns)[:, None] * 1e-9 * (rate[:-1] + rate[1:]) / 2
        q = accumulate(so3.quat_exp(gyro_steps(t_ns, rate) if cross else straight))
        out: Array = q[-1]
        return out

    def off(q: Array) -> float:
        return float(np.linalg.norm(so3.quat_log(so3.quat_multiply(so3.quat_conjugate(exact), q))))

    exact = end(64_000)
    assert 14 < off(end(20)) / off(end(40)) < 18
    assert off(end(40, cross=False)) > 1000 * off(end(40))


def test_a_gyroscope_adds_up_to_the_orientation_that_it_came_from() -> None:
    truth = path(0)
    for rate_hz, most in ((200, 4e-5), (100, 3e-4)):
        track = track_of_gyro(seen_gyro(truth, stamps(rate_hz, 20), RNG(0), SILENT))
        assert np.abs(errors(track, truth, inside(track))).max() < most


@pytest.mark.parametrize("n", [0, 1, 2, 3, 10, 99, 100, 101, 1000])
def test_accumulated_orientations_equal_one_product_after_the_other(n: int) -> None:
    steps = so3.quat_exp(RNG(n).normal(0, 0.5, (n, 3)))
    expected = [np.array([0.0, 0.0, 0.0, 1.0])]
    for step in steps:
        expected.append(so3.quat_multiply(expected[-1], step))
    np.testing.assert_allclose(accumulate(steps), expected, rtol=0, atol=1e-13)


def test_a_million_steps_stay_unit_quaternions() -> None:
    q = accumulate(so3.quat_exp(RNG(0).normal(0, 0.01, (1_000_000, 3))))
    assert np.abs(np.linalg.norm(q, axis=1) - 1).max() < 1e-12


# Nothing is late


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("speed", [1.0, 4.0])
@pytest.mark.parametrize(("rate_hz", "most_s"), [(200, 3e-7), (50, 4e-6)])
def test_smoothing_delays_nothing(seed: int, speed: float, rate_hz: int, most_s: float) -> None:
    truth = path(seed, speed=speed)
    for sample in (stamps(rate_hz, 20), uneven(rate_hz, 20, seed)):
        track = track_of_poses(seen_poses(truth, sample, 0.0, RNG(0)))
        assert abs(delay(track, truth, inside(track))) < most_s


def test_time_backwards_gives_the_same_track() -> None:
    """Whatever is smoothed, is smoothed alike to both sides, in the very arithmetic."""
    sample = uneven(60, 8)
    q = seen_poses(path(1), sample, 2e-3, RNG(1)).q
    forward = track_of_poses(poses(sample, q))
    backward = track_of_poses(poses(sample[0] + sample[-1] - sample[::-1], q[::-1]))
    # Both grids start at a stamp; only instants that lie on both are smoothed alike.
    last = (sample[-1] - sample[0]) * 1e-9
    t = np.linspace(0.5, 7.5, 401)
    apart = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(forward.orientation(t)), backward.orientation(last - t)))
    assert np.sqrt(np.mean(apart**2)) < 0.1 * 2e-3
    even = stamps(50, 8)
    q = seen_poses(path(1), even, 2e-3, RNG(1)).q
    forward, backward = track_of_poses(poses(even, q)), track_of_poses(poses(even[0] + even[-1] - even[::-1], q[::-1]))
    last = (even[-1] - even[0]) * 1e-9
    apart = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(forward.orientation(t)), backward.orientation(last - t)))
    assert np.abs(apart).max() < 1e-6


def test_the_rate_is_the_derivative_of_the_orientation() -> None:
    truth = path(2)
    track = track_of_gyro(seen_gyro(truth, stamps(200, 10), RNG(0)))
    t, h = inside(track), 1e-4
    before, after = track.orientation(t - h), track.orientation(t + h)
    slope = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(before), after)) / (2 * h)
    assert np.abs(slope - track.rate_at(t)).max() < 0.02 * np.abs(track.rate).max()
    assert np.sqrt(np.mean((slope - track.rate_at(t)) ** 2)) < 1e-3


@pytest.mark.parametrize("rate_hz", [50, 100])
def test_noise_is_the_same_wherever_between_samples_it_is_read(rate_hz: int) -> None:
    """Else every offset would be pulled to where the noise is least: linear interpolation has half the variance half-way."""
    sample = stamps(rate_hz, 120)
    track = track_of_poses(poses(sample, so3.quat_exp(1e-3 * RNG(3).standard_normal((len(sample), 3)))))
    at = 0.5 + np.arange(round(100 * rate_hz)) / rate_hz
    spread = [float(np.std(so3.quat_log(track.orientation(at + f / rate_hz)))) for f in (0.0, 0.25, 0.5, 0.75)]
    assert max(spread) < 1.13 * min(spread)


@pytest.mark.parametrize("speed", [0.0, 1.0])
@pytest.mark.parametrize("rate_hz", [50, 100, 200])
def test_the_noise_of_rates_is_told_whether_or_not_the_rig_moves(speed: float, rate_hz: int) -> None:
    """Never too small: on uneven stamps some motion passes for noise, and a gyroscope's steps average two samples (11 % less)."""
    truth = path(0, speed=speed)
    for sample, most in ((stamps(rate_hz, 60), 1.15), (uneven(rate_hz, 60), 1.6)):
        omega = truth.at((sample - START_NS) * 1e-9).omega_i
        noise = 0.01 * RNG(6).standard_normal(omega.shape)
        for quiet, loud in (
            (track_of_poses(seen_poses(truth, sample, 0.0, RNG(5))), track_of_poses(seen_poses(truth, sample, 1e-3, RNG(5)))),
            (track_of_gyro(gyro(sample, omega)), track_of_gyro(gyro(sample, omega + noise))),
        ):
            measured = np.std((loud.rate - quiet.rate)[loud.chain >= 0], axis=0)
            assert np.all(loud.rate_sigma > 0.92 * measured)
            assert np.all(loud.rate_sigma < most * measured)


# What is not known


def test_a_gap_parts_a_gyroscopes_chain_and_only_interrupts_poses() -> None:
    truth, sample = path(0), stamps(200, 10)
    keep = np.abs(sample - sample[1000]) > 0.1e9
    of_gyro = track_of_gyro(seen_gyro(truth, sample, RNG(0)).select(keep))
    of_poses = track_of_poses(seen_poses(truth, sample[keep], 0.0, RNG(0)))
    middle = (sample[1000] - sample[0]) * 1e-9
    t = np.array([middle - 1.0, middle - 0.12, middle, middle + 0.12, middle + 1.0])
    assert of_gyro.chain_at(t).tolist() == [0, 0, -1, 1, 1]
    assert of_poses.chain_at(t).tolist() == [0, 0, -1, 0, 0]


def test_outside_nothing_is_known() -> None:
    track = track_of_poses(seen_poses(path(0), stamps(100, 3), 0.0, RNG(0)))
    assert track.chain_at(np.array([-1e-6, -10.0, duration(track) + 1e-6, 1e9])).tolist() == [-1] * 4
    assert track.chain_at(np.array([1.5])).tolist() == [0]


def test_disorder_and_repeats_in_the_stamps_change_nothing() -> None:
    samples = seen_gyro(path(0), stamps(200, 5), RNG(0))
    shuffled = RNG(1).permutation(np.concatenate([np.arange(1000), [17, 500, 999]]))
    first_of_each = track_of_gyro(samples.select(shuffled))
    np.testing.assert_array_equal(first_of_each.q, track_of_gyro(samples).q)


def test_stamps_that_are_not_set_are_left_out() -> None:
    samples = seen_gyro(path(0), stamps(200, 5), RNG(0))
    for wrong in (0, -(2**63), 2**63 - 1):
        t_ns = samples.t_ns.copy()
        t_ns[400] = wrong
        track = track_of_gyro(gyro(t_ns, samples.gyro))
        assert track.origin_ns == samples.t_ns[0]
        assert duration(track) == pytest.approx(4.995)


HOUR_NS = 3_600_000_000_000


@pytest.mark.parametrize("rows", [[0], [400], [999], [0, 1, 999], [500, 501, 502]])
@pytest.mark.parametrize("hours", [-20, -0.01, 2])
def test_wild_stamps_are_left_out(rows: list[int], hours: float) -> None:
    """Few of them, hours or seconds off all others: the track is that of the others, its origin too, and as small."""
    samples = seen_gyro(path(0), stamps(200, 5), RNG(0))
    others = np.delete(np.arange(1000), rows)
    t_ns = samples.t_ns.copy()
    t_ns[rows] += np.int64(hours * HOUR_NS)
    found, expected = track_of_gyro(gyro(t_ns, samples.gyro)), track_of_gyro(samples.select(others))
    assert found.origin_ns == expected.origin_ns
    np.testing.assert_allclose(found.q, expected.q, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found.chain, expected.chain)
    q = seen_poses(path(0), samples.t_ns, 0.0, RNG(0)).q
    np.testing.assert_array_equal(track_of_poses(poses(t_ns, q)).q, track_of_poses(poses(samples.t_ns[others], q[others])).q)


def test_a_clock_of_its_own_with_one_zero_in_front() -> None:
    samples = seen_gyro(path(0), stamps(200, 5), RNG(0))
    t_ns = samples.t_ns - samples.t_ns[0] + 5 * HOUR_NS
    t_ns[0] = 0
    track = track_of_gyro(gyro(t_ns, samples.gyro))
    assert track.origin_ns == t_ns[1]
    assert len(track.q) == 999


@pytest.mark.parametrize("poses_too", [True, False])
def test_a_grid_goes_with_the_samples_and_not_with_their_span(poses_too: bool) -> None:
    """Three recordings on one clock, hours apart: each as if it were alone, nothing known between them."""
    truth, one = path(0), stamps(200, 4)
    starts = [0.0, 1.7 * 3600, 9.1 * 3600]
    t_ns = np.concatenate([one + np.int64(s * 1e9) for s in starts])
    if poses_too:
        q = seen_poses(truth, one, 0.0, RNG(0)).q
        track, alone = track_of_poses(poses(t_ns, np.tile(q, (3, 1)))), track_of_poses(poses(one, q))
    else:
        rate = seen_gyro(truth, one, RNG(0), SILENT).gyro
        track, alone = track_of_gyro(gyro(t_ns, np.tile(rate, (3, 1)))), track_of_gyro(gyro(one, rate))
    assert len(track.q) < 3 * len(alone.q) + 150
    assert track.duration == pytest.approx(starts[-1] + alone.duration)
    t = inside(alone, 0.05)
    for k, s in enumerate(starts):
        turn, expected = (
            so3.quat_multiply(so3.quat_conjugate(each[:-1]), each[1:]) for each in (track.orientation(s + t), alone.orientation(t))
        )
        np.testing.assert_allclose(turn, expected, rtol=0, atol=1e-7)
        np.testing.assert_allclose(track.rate_at(s + t), alone.rate_at(t), rtol=0, atol=1e-4)
        assert set(track.chain_at(s + t).tolist()) == {0 if poses_too else k}
        points = np.abs(track.grid.t - s - 2) < 1.9
        np.testing.assert_allclose(track.grid.place(track.grid.t[points]), np.flatnonzero(points), rtol=0, atol=1e-6)
    assert set(track.chain_at(np.linspace(4.01, starts[1] - 0.01, 500)).tolist()) == {-1}
    assert set(track.chain_at(np.array([-1.0, track.duration + 0.001, 1e9])).tolist()) == {-1}
    ends = START_NS + np.round(np.array([1.0, 1.3, 3.9, 4.2, 3000.0, 3000.3, starts[1] + 1.0, starts[1] + 1.3]) * 1e9).astype(np.int64)
    turns = Turns(ends, np.arange(7), np.arange(1, 8), np.zeros((7, 3)))
    assert usable(turns, track, -0.01, 0.01).tolist() == [True, True, False, False, False, False, True]
    assert lost_to_gaps(turns, track, -0.01, 0.01) == pytest.approx(4 / 7)


def test_a_grid_beyond_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_grid, "_MOST_POINTS", 900)
    with pytest.raises(BadInputError, match="cut it into parts"):
        track_of_gyro(seen_gyro(path(0), stamps(200, 5), RNG(0)))


# Uneven stamps and lost samples


def turns_at(track: OrientationTrack, t: Array, took: float) -> Array:
    """Return the track's turns from t to t + took."""
    return so3.quat_log(so3.quat_multiply(so3.quat_conjugate(track.orientation(t)), track.orientation(t + took)))


def followed(track: OrientationTrack, truth: Trajectory) -> tuple[float, float]:
    """Return the share of turns of 0.2 s that the track knows, and by how many s they look late."""
    at, took, h = np.arange(0.1, track.duration - 0.2, 0.0073), 0.2044, 1e-4
    first = np.arange(len(at) - 28)
    t_ns = track.origin_ns + np.round(at * 1e9).astype(np.int64)
    known = usable(Turns(t_ns, first, first + 28, np.zeros((len(first), 3))), track, 0.0, 0.0)
    t = at[first[known]]

    def true(at: Array) -> Array:
        R = [truth.at(x + (track.origin_ns - START_NS) * 1e-9).T_world_imu[:, :3, :3] for x in (at, at + took)]
        out: Array = so3.log(np.swapaxes(R[0], 1, 2) @ R[1])
        return out

    slope = (true(t + h) - true(t - h)) / (2 * h)
    return float(np.mean(known)), -float(np.sum(slope * (turns_at(track, t, took) - true(t))) / np.sum(slope**2))


@pytest.mark.parametrize("jitter_s", [0.5e-3, 1e-3, 2e-3])
def test_jitter_of_an_imus_stamps_loses_nothing(jitter_s: float) -> None:
    """The rates are those of a regular clock, the stamps are not: what 4000 of them are off averages out."""
    truth, even = path(1), stamps(200, 20)
    samples = seen_gyro(truth, even, RNG(0), SILENT)
    late = np.round(1e9 * jitter_s * RNG(1).standard_normal(len(even))).astype(np.int64)
    known, delay_s = followed(track_of_gyro(gyro(even + late, samples.gyro)), truth)
    assert known == 1
    assert abs(delay_s) < 4 * jitter_s / np.sqrt(len(even))


@pytest.mark.parametrize(("share", "least"), [(0.1, 1.0), (0.3, 0.9)])
@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_lost_samples_lose_few_turns_and_delay_nothing(share: float, least: float, speed: float) -> None:
    truth = path(2, speed=speed)
    for rate_hz in (100, 200):
        t_ns = stamps(rate_hz, 30)[RNG(7).random(30 * rate_hz) >= share]
        tracks = [track_of_poses(seen_poses(truth, t_ns, 0.0, RNG(0)))]
        tracks += [track_of_gyro(seen_gyro(truth, t_ns, RNG(0), SILENT))] if rate_hz == 200 else []
        for track in tracks:
            known, delay_s = followed(track, truth)
            assert known >= least
            assert abs(delay_s) < 1e-6 * speed**2


@pytest.mark.parametrize("share", [0.3, 0.5])
@pytest.mark.parametrize("speed", [0.0, 4.0])
def test_the_noise_of_rates_is_told_where_samples_are_lost(share: float, speed: float) -> None:
    """Plain differences of uneven samples would hold motion, and gaps make some rates noisier than most."""
    truth, t_ns = path(0, speed=speed), stamps(100, 60)[RNG(3).random(6000) >= share]
    quiet, loud = (track_of_poses(seen_poses(truth, t_ns, noise, RNG(5))) for noise in (0.0, 1e-3))
    measured = np.std((loud.rate - quiet.rate)[loud.chain >= 0], axis=0)
    np.testing.assert_allclose(loud.rate_sigma, measured, rtol=0.1)


def spoilt(seed: int, kind: str) -> Sample:
    if kind == "jitter":
        sample, rng = pose_imu(path(seed), seed, any_offset(seed), 1e-3), RNG((seed, 77))
        assert isinstance(sample.reference, ImuSamples)
        late = np.round(2e6 * rng.standard_normal(len(sample.reference.t_ns))).astype(np.int64)
        return replace(sample, reference=replace(sample.reference, t_ns=sample.reference.t_ns + late))
    sample, rng = pose_pose(path(seed), seed, any_offset(seed)), RNG((seed, 78))
    assert isinstance(sample.reference, PoseSamples)
    kept = rng.random(len(sample.reference.t_ns)) >= 0.3
    return replace(sample, reference=poses(sample.reference.t_ns[kept], sample.reference.q[kept]))


@pytest.mark.parametrize("kind", ["jitter", "drops"])
@pytest.mark.parametrize("seeds", [2, pytest.param(30, marks=pytest.mark.slow)])
def test_an_offset_against_a_spoilt_stream_is_honest(kind: str, seeds: int) -> None:
    """2 ms of jitter in an IMU's stamps, or 30 % of 100 Hz poses lost: nearly all turns count, and sigma means what it says."""
    off = []
    for seed in range(seeds):
        sample = spoilt(seed, kind)
        fit = sample.fitted
        assert fit.lost < 0.05
        assert fit.sigma < 1.3e-4
        off.append((fit.td - sample.td) / fit.sigma)
    print(f"{kind}, {seeds} seeds: error over sigma {np.sqrt(np.mean(np.square(off))):.2f}")
    low, high = np.sqrt(chi2.ppf([0.0005, 0.9995], seeds) / seeds)
    assert low < np.sqrt(np.mean(np.square(off))) < high


def test_a_reference_too_uneven_is_said_to_be() -> None:
    """Both were recorded at once: 'they share too little time' would send people to record the same again."""
    sample = pose_pose(path(0), 0, 0.02)
    assert isinstance(sample.reference, PoseSamples)
    t_ns, q = sample.reference.t_ns, sample.reference.q
    kept = np.arange(len(t_ns)) % 15 < 7  # nothing for 0.09 s, again and again
    with pytest.raises(BadInputError, match="second come too unevenly"):
        _ = replace(sample, reference=poses(t_ns[kept], q[kept])).fitted
    threes = np.flatnonzero(np.arange(1500) % 50 < 3)
    with pytest.raises(BadInputError, match="90 poses come too unevenly to follow"):
        track_of_poses(poses(t_ns[threes], q[threes]))


def test_too_few_samples_are_refused() -> None:
    few = stamps(100, 0.09)
    with pytest.raises(BadInputError, match="9 gyroscope samples are too few"):
        track_of_gyro(gyro(few, np.zeros((9, 3))))
    with pytest.raises(BadInputError, match="9 poses are too few"):
        track_of_poses(poses(few, so3.quat_exp(np.zeros((9, 3)))))


def test_chunks_of_the_grid_have_no_seams(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = seen_gyro(path(0), uneven(200, 3), RNG(0))
    whole = track_of_gyro(samples)
    monkeypatch.setattr(orientation_track, "_CHUNK", 7)
    parts = track_of_gyro(samples)
    np.testing.assert_allclose(parts.q, whole.q, rtol=0, atol=1e-15)
    np.testing.assert_allclose(parts.rate, whole.rate, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(parts.chain, whole.chain)
