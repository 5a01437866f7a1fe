"""An IMU on a trajectory, with Kalibr's continuous-time noise model (SPEC section 1)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples
from calibkit.simulation.trajectory import GRAVITY_W, State

Array = NDArray[np.float64]
Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class SimImu:
    """An IMU: noise densities of a consumer device (ADIS16448, as EuRoC's), constant biases, topic."""

    rate_hz: float = 200.0
    gyro_noise_density: float = 1.7e-4  # rad/s/sqrt(Hz)
    gyro_random_walk: float = 2.0e-5  # rad/s^2/sqrt(Hz)
    accel_noise_density: float = 2.0e-3  # m/s^2/sqrt(Hz)
    accel_random_walk: float = 3.0e-3  # m/s^3/sqrt(Hz)
    gyro_bias: Vector3 = (0.004, -0.003, 0.002)  # rad/s
    accel_bias: Vector3 = (0.05, -0.03, 0.04)  # m/s^2
    name: str = "imu0"
    topic: str = "/imu0"


@dataclass(frozen=True)
class ImuTruth:
    """The biases that went into each sample."""

    gyro_bias: Array  # (n, 3) rad/s
    accel_bias: Array  # (n, 3) m/s^2


def specific_force(state: State) -> Array:
    """Return f_i = R_world_imu^T (a_w - g_w), (n, 3) m/s^2: what an ideal accelerometer feels."""
    R = state.T_world_imu[:, :3, :3]
    out: Array = ((state.acceleration_w - GRAVITY_W)[:, None] @ R)[:, 0]
    return out


def simulate_imu(imu: SimImu, state: State, t_ns: NDArray[np.int64], rng: np.random.Generator) -> tuple[ImuSamples, ImuTruth]:
    """Return samples: truth + walking bias + white noise, sigma = density sqrt(rate), walk's step = density / sqrt(rate)."""
    root, shape = np.sqrt(imu.rate_hz), (len(t_ns), 3)

    def bias(start: Vector3, walk: float) -> Array:
        steps = rng.standard_normal(shape) * (walk / root)
        steps[:1] = start
        walked: Array = np.cumsum(steps, axis=0)
        return walked

    def white(density: float) -> Array:
        noise: Array = rng.standard_normal(shape) * (density * root)
        return noise

    truth = ImuTruth(bias(imu.gyro_bias, imu.gyro_random_walk), bias(imu.accel_bias, imu.accel_random_walk))
    gyro = state.omega_i + truth.gyro_bias + white(imu.gyro_noise_density)
    accel = specific_force(state) + truth.accel_bias + white(imu.accel_noise_density)
    return ImuSamples(t_ns=t_ns, gyro=gyro, accel=accel), truth
