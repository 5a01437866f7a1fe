"""Stands found by themselves: where, how well their means are known, and what has none."""

from pathlib import Path

import numpy as np
import pytest

from calibkit.errors import BadInputError
from calibkit.estimation.imu_seed import seed_accel, seed_gyro
from calibkit.estimation.static_intervals import find_stands
from calibkit.models.imu import ImuModel
from calibkit.simulation.multi_position import MultiPositionPlan, simulate_multi_position


def test_every_stand_is_found_and_lies_within_the_true_one() -> None:
    for seed in range(3):
        truth = simulate_multi_position(MultiPositionPlan(), seed)
        stands = find_stands(truth.t, truth.gyro, truth.accel, 9.81)
        assert len(stands) == len(truth.up)
        assert np.all(stands.start_s > truth.start_s - 0.05)
        assert np.all(stands.end_s < truth.end_s + 0.05)
        assert np.sum(stands.end_s - stands.start_s) > 0.85 * np.sum(truth.end_s - truth.start_s)


def test_units_change_nothing() -> None:
    truth = simulate_multi_position(MultiPositionPlan(stands=15), 1)
    a = find_stands(truth.t, truth.gyro, truth.accel, 9.81)
    b = find_stands(truth.t, 4770 * truth.gyro + 32768, 415 * truth.accel + 33000, 9.81)
    np.testing.assert_array_equal(a.first, b.first)
    np.testing.assert_array_equal(a.last, b.last)
    np.testing.assert_allclose(b.cov_accel, 415**2 * a.cov_accel, rtol=1e-6)


def test_the_covariance_of_the_mean_allows_for_correlated_noise() -> None:
    """First-order noise with a memory of 0.1 s: the mean's variance is that of white noise times (1 + phi) / (1 - phi)."""
    rng, rate, phi = np.random.default_rng(0), 100, 0.9
    truth = simulate_multi_position(MultiPositionPlan(stands=40, accel_noise_density=0, accel_random_walk=0, misfit=0), 0)
    noise = np.zeros_like(truth.accel)
    white = 0.01 * rng.standard_normal(noise.shape)
    for i in range(1, len(noise)):
        noise[i] = phi * noise[i - 1] + white[i]
    stands = find_stands(truth.t, truth.gyro, truth.accel + noise, 9.81)
    true = 9.81 * truth.up[np.searchsorted(truth.start_s, stands.middle_s) - 1]
    z = np.linalg.solve(np.linalg.cholesky(stands.cov_accel), (stands.accel - true)[..., None])[..., 0]
    assert 0.85 < np.sqrt(np.mean(z[1:] ** 2)) < 1.25
    length = stands.end_s - stands.start_s
    as_if_white = (0.01**2 / (1 - phi**2)) / (rate * length)
    assert np.median(np.trace(stands.cov_accel, axis1=1, axis2=2) / 3 / as_if_white) > 10  # 19 for stands of any length


def test_the_data_choose_the_threshold(data_dir: Path) -> None:
    """A recording of 50 s at rest and then some 40 attitudes."""
    t, *accel = np.loadtxt(data_dir / "imu_xsens" / "xsens_acc.mat").T
    gyro = np.loadtxt(data_dir / "imu_xsens" / "xsens_gyro.mat")[:, 1:]
    stands = find_stands(t, gyro, np.transpose(accel), 9.81744)
    assert 36 <= len(stands) <= 55
    assert stands.end_s[0] > 48
    assert np.std(seed_accel(stands.accel, 9.81744).misfit) * 9.81744 < 1.2e-3


def test_first_guesses_without_noise() -> None:
    model = ImuModel(M_a=np.array([[415.0, 0, 0], [4, 412, 0], [-6, 8, 418]]), b_a=np.array([33e3, 32e3, 34e3]))
    truth = simulate_multi_position(
        MultiPositionPlan(
            model=model,
            gyro_noise_density=0,
            gyro_random_walk=0,
            accel_noise_density=0,
            accel_random_walk=0,
            misfit=0,
            hand_m=0,
            rate_hz=400.0,
        )
    )
    seed = seed_accel(model.measure(9.81 * truth.up, 0 * truth.up)[0], 9.81)
    np.testing.assert_allclose(seed.M, model.M_a, atol=0.02)
    np.testing.assert_allclose(seed.b, model.b_a, atol=0.5)
    moving = np.linalg.norm(truth.omega_i, axis=1) > 0
    K = seed_gyro(truth.t, truth.gyro, seed.directions(truth.accel), moving)
    np.testing.assert_allclose(K, np.eye(3), atol=0.03)


def _moving() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng, t = np.random.default_rng(0), np.arange(0, 60, 0.01)
    wave = np.stack([np.sin(1.1 * t + k) + 0.5 * np.sin(2.3 * t + k) for k in range(3)], axis=1)
    return t, wave + 0.002 * rng.standard_normal(wave.shape), 9.81 * wave + 0.02 * rng.standard_normal(wave.shape)


def test_a_resting_recording_is_not_called_moving() -> None:
    rng, t = np.random.default_rng(0), np.arange(0, 600, 0.05)
    bias = 0.0004 * np.cumsum(rng.standard_normal((len(t), 3)), axis=0) / np.sqrt(len(t))
    gyro, accel = bias + 2e-5 * rng.standard_normal((len(t), 3)), [0, 0, 9.81] + 0.02 * rng.standard_normal((len(t), 3))
    with pytest.raises(BadInputError, match=r"or never moved.*calibkit allan"):
        find_stands(t, gyro, accel, 9.81)


def test_a_moving_recording_is_told() -> None:
    with pytest.raises(BadInputError, match="never stood still"):
        find_stands(*_moving(), 9.81)
