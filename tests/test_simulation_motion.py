"""Simulated motion and IMU: derivatives against differences, gravity's sign, noise densities as stated."""

import numpy as np
import pytest

from calibkit.geometry import se3, so3
from calibkit.simulation.imu import SimImu, simulate_imu, specific_force
from calibkit.simulation.trajectory import MOTIONS, Trajectory, make_trajectory

T_IMU_CAM = se3.make(so3.exp([0.02, -0.01, 1.55]), [-0.02, -0.065, 0.01])
SILENT = SimImu(
    gyro_noise_density=0, gyro_random_walk=0, accel_noise_density=0, accel_random_walk=0, gyro_bias=(0, 0, 0), accel_bias=(0, 0, 0)
)


def trajectory(name: str, seed: int = 0) -> Trajectory:
    return make_trajectory(MOTIONS[name], 0.9, T_IMU_CAM, np.random.default_rng(seed))


@pytest.mark.parametrize("name", MOTIONS)
def test_derivatives_equal_central_differences(name: str) -> None:
    motion, t, h = trajectory(name), np.linspace(0, 60, 301), 1e-4
    before, here, after = motion.at(t - h), motion.at(t), motion.at(t + h)
    velocity = (after.T_world_imu[:, :3, 3] - before.T_world_imu[:, :3, 3]) / (2 * h)
    acceleration = (after.velocity_w - before.velocity_w) / (2 * h)
    omega = se3.local(before.T_world_imu, after.T_world_imu)[:, 3:] / (2 * h)
    assert np.abs(velocity - here.velocity_w).max() < 1e-6
    assert np.abs(acceleration - here.acceleration_w).max() < 1e-6
    assert np.abs(omega - here.omega_i).max() < 1e-6


def test_at_rest_the_accelerometer_points_up() -> None:
    state = trajectory("static").at(np.zeros(1))
    up_c = T_IMU_CAM[:3, :3].T @ specific_force(state)[0]  # the resting camera is level: up is -y
    assert np.allclose(up_c, [0, -9.81, 0], atol=1e-12)


def test_the_rich_motion_excites_every_axis() -> None:
    for seed in range(3):
        state = trajectory("rich", seed).at(np.arange(0, 15, 0.005))
        assert np.all(state.omega_i.std(axis=0) > 0.25)
        assert np.all(state.acceleration_w.std(axis=0) > 0.5)


def test_special_motions_lack_what_their_names_say() -> None:
    t = np.linspace(0, 30, 601)
    assert np.ptp(trajectory("static").at(t).T_world_imu, axis=0).max() == 0
    assert np.abs(trajectory("translation").at(t).omega_i).max() == 0
    uniform = trajectory("constant-velocity").at(t)
    assert np.abs(uniform.acceleration_w).max() == 0
    assert np.linalg.norm(uniform.velocity_w, axis=1).min() > 0.005
    rates = np.linalg.svd(trajectory("single-axis").at(t).omega_i, compute_uv=False)
    assert rates[1] < 1e-12 * rates[0]
    planar = trajectory("planar").at(t)
    assert np.abs(planar.velocity_w[:, 2]).max() < 1e-12
    turning_w = (planar.T_world_imu[:, :3, :3] @ planar.omega_i[..., None])[..., 0]
    assert np.abs(turning_w[:, :2]).max() < 1e-12


def test_imu_noise_has_the_stated_densities() -> None:
    imu, n = SimImu(rate_hz=100.0), 200_000
    t_ns = np.arange(n) * 10_000_000
    state = trajectory("static").at(t_ns * 1e-9)
    samples, truth = simulate_imu(imu, state, t_ns, np.random.default_rng(0))
    four_sigma = 4 / np.sqrt(2 * 3 * n)
    white = samples.gyro - truth.gyro_bias - state.omega_i
    assert white.std() == pytest.approx(imu.gyro_noise_density * np.sqrt(imu.rate_hz), rel=four_sigma)
    white = samples.accel - truth.accel_bias - specific_force(state)
    assert white.std() == pytest.approx(imu.accel_noise_density * np.sqrt(imu.rate_hz), rel=four_sigma)
    assert np.diff(truth.gyro_bias, axis=0).std() == pytest.approx(imu.gyro_random_walk / np.sqrt(imu.rate_hz), rel=four_sigma)
    assert np.diff(truth.accel_bias, axis=0).std() == pytest.approx(imu.accel_random_walk / np.sqrt(imu.rate_hz), rel=four_sigma)
    assert np.allclose(truth.gyro_bias[0], imu.gyro_bias)


def test_integrating_a_noise_free_gyro_returns_the_orientation() -> None:
    t_ns = np.arange(0, 5_000_000_000, 1_000_000)
    state = trajectory("rich").at(t_ns * 1e-9)
    samples, _ = simulate_imu(SILENT, state, t_ns, np.random.default_rng(0))
    R = state.T_world_imu[0, :3, :3]
    for step in so3.exp((samples.gyro[1:] + samples.gyro[:-1]) / 2 * 1e-3):
        R = R @ step
    assert np.linalg.norm(so3.log(R.T @ state.T_world_imu[-1, :3, :3])) < 1e-5
