"""The orientation that others are laid against: exact where it can be, late nowhere, unknown across gaps."""

import numpy as np
import pytest
from numpy.typing import NDArray
from time_offset_samples import SILENT, constant_rate, path, seen_gyro, seen_poses, stamps

from calibkit.data.observations import ImuSamples, PoseSamples
from calibkit.errors import BadInputError
from calibkit.estimation import orientation_track
from calibkit.estimation.orientation_track import OrientationTrack, accumulate, track_of_gyro, track_of_poses
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
        h = np.diff(t_ns)[:, None] * 1e-9
        steps = h * (rate[:-1] + rate[1:]) / 2
        q = accumulate(so3.quat_exp(steps + cross * h**2 * np.cross(rate[:-1], rate[1:]) / 12))
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


def test_a_grid_beyond_memory_is_refused() -> None:
    t_ns = np.concatenate([stamps(400, 1), stamps(400, 1) + np.int64(40 * 3600e9)])
    with pytest.raises(BadInputError, match="span 40 h"):
        track_of_gyro(gyro(t_ns, np.ones((len(t_ns), 3))))


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
