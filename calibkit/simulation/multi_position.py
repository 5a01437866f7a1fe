"""An IMU put down by hand in many attitudes, with truth: what `calibkit imu` calibrates from."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import so3
from calibkit.models.imu import ImuModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MultiPositionPlan:
    """How it is done; noise densities of a consumer device, in SI whatever the model's units."""

    model: ImuModel = field(default_factory=ImuModel)
    up: Array | None = None  # (n, 3) up in the IMU's frame, stand by stand; None: all over the sphere
    stands: int = 36  # where up is None
    still_start_s: float = 40.0
    stand_s: tuple[float, float] = (2.5, 5.0)
    turn_s: tuple[float, float] = (1.5, 3.0)
    hand_m: float = 0.1  # how far the hand carries it aside in a turn
    hand_rad: float = 0.4  # how far it wavers about other axes
    gravity: float = 9.81
    rate_hz: float = 100.0
    gyro_noise_density: float = 1.7e-4  # rad/s/sqrt(Hz)
    gyro_random_walk: float = 1e-5  # rad/s^2/sqrt(Hz)
    accel_noise_density: float = 2e-3  # m/s^2/sqrt(Hz)
    accel_random_walk: float = 1e-4  # m/s^3/sqrt(Hz)
    misfit: float = 5e-4  # m/s^2 per axis: what stays the same in a stand and differs between stands (hysteresis, nonlinearity)
    counts: bool = False  # rounded to integers


@dataclass(frozen=True)
class MultiPosition:
    """The recording and its truth."""

    t: Array  # (n,) s
    gyro: Array  # (n, 3) measured
    accel: Array  # (n, 3)
    model: ImuModel  # its biases the means over the stands
    up: Array  # (k, 3) up in the IMU's frame
    start_s: Array  # (k,) of the stands
    end_s: Array  # (k,)
    omega_i: Array  # (n, 3) rad/s, true


def simulate_multi_position(plan: MultiPositionPlan, seed: int = 0) -> MultiPosition:
    """Return samples of still start, stands and smooth turns between them: R = R_i exp(phi s) exp(psi b), s and b smooth in time."""
    rng = np.random.default_rng(seed)
    R = _attitudes(plan, rng)
    k = len(R)
    stand_s, turn_s = rng.uniform(*plan.stand_s, k), rng.uniform(*plan.turn_s, k - 1)
    stand_s[0] = max(plan.still_start_s, stand_s[0])
    start_s = np.concatenate([[0.0], np.cumsum(stand_s[:-1] + turn_s)])
    end_s = start_s + stand_s
    t = np.arange(int(end_s[-1] * plan.rate_hz)) / plan.rate_hz
    stand = np.searchsorted(start_s, t, side="right") - 1
    length = np.append(turn_s, 1.0)[stand]
    x = np.clip((t - end_s[stand]) / length, 0, 1)
    s, ds = x**3 * (10 - 15 * x + 6 * x * x), 30 * x**2 * (1 - x) ** 2 / length
    b, db = 64 * (x - x * x) ** 3, 192 * (x - x * x) ** 2 * (1 - 2 * x) / length
    ddb = 384 * (x - x * x) * (1 - 5 * x + 5 * x * x) / length**2
    phi = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
    phi, psi, aside = (
        np.append(v, np.zeros((1, 3)), axis=0)[stand] for v in (phi, _waver(plan.hand_rad, k, rng), _waver(plan.hand_m, k, rng))
    )
    wavering = so3.exp(psi * b[:, None])
    attitude = R[stand] @ so3.exp(phi * s[:, None]) @ wavering
    omega = np.einsum("nji,nj->ni", wavering, phi * ds[:, None]) + psi * db[:, None]
    force = np.einsum("nji,nj->ni", attitude, aside * ddb[:, None] + np.array([0, 0, plan.gravity]))

    accel, gyro = plan.model.measure(force, omega)
    noisy, biases = [], []
    scales = (np.abs(np.diag(plan.model.M_g)), np.abs(np.diag(plan.model.M_a)))
    densities = ((plan.gyro_noise_density, plan.gyro_random_walk), (plan.accel_noise_density, plan.accel_random_walk))
    in_stand = t <= end_s[stand]
    share = in_stand / np.bincount(stand[in_stand], minlength=k)[stand] / k
    for clean, scale, (white, walk) in zip((gyro, accel), scales, densities, strict=True):
        bias = np.cumsum(rng.standard_normal(clean.shape), axis=0) * walk / np.sqrt(plan.rate_hz)
        noise = rng.standard_normal(clean.shape) * white * np.sqrt(plan.rate_hz)
        noisy.append(clean + (bias + noise) * scale)
        biases.append(share @ bias * scale)
    noisy[1] += (rng.standard_normal((k, 3)) * plan.misfit)[stand] * scales[1]
    if plan.counts:
        noisy = [np.round(x) for x in noisy]
    truth = replace(plan.model, b_g=plan.model.b_g + biases[0], b_a=plan.model.b_a + biases[1])
    return MultiPosition(t, noisy[0], noisy[1], truth, R[:, 2], start_s, end_s, omega)


def _waver(size: float, k: int, rng: np.random.Generator) -> Array:
    out: Array = size * rng.uniform(-1, 1, (k - 1, 3))
    return out


def _attitudes(plan: MultiPositionPlan, rng: np.random.Generator) -> Array:
    """Return R_world_imu (k, 3, 3), R^T e_z = up, the heading by chance."""
    up = plan.up if plan.up is not None else rng.standard_normal((plan.stands, 3))
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    aside = np.cross(up, rng.standard_normal(up.shape))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    R: Array = np.stack([aside, np.cross(up, aside), up], axis=1)
    return R
