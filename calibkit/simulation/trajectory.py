"""Smooth motions of a rig with exact derivatives: each is a table of sines, so nothing has to be differenced or fitted.

World: z up. The rig rests looking along world +x at the board; displacements are measured in the resting camera's axes
(x right, y down, z forward) in units of the board's distance, so that a motion keeps any board in view.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibkit.geometry import se3, so3

Array = NDArray[np.float64]

R_WORLD_CAM_AT_REST: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
GRAVITY_W: Array = np.array([0.0, 0.0, -9.81])  # m/s^2


@dataclass(frozen=True)
class State:
    """Where the IMU is and how it moves, n instants."""

    T_world_imu: Array  # (n, 4, 4)
    velocity_w: Array  # (n, 3) m/s
    acceleration_w: Array  # (n, 3) m/s^2, gravity not included
    omega_i: Array  # (n, 3) rad/s, body frame


@dataclass(frozen=True)
class Trajectory:
    """T_world_imu(t) = T_0 [exp(phi(t)), x(t)], (x, phi)(t) = velocity t + sum_k amplitude_k sin(omega_k t + phase_k)."""

    T_world_imu_0: Array  # (4, 4)
    omega: Array  # (k,) rad/s
    phase: Array  # (k,)
    amplitude: Array  # (k, 6) m, rad, in the resting IMU's axes
    velocity: Array  # (6,) m/s, rad/s, likewise

    def at(self, t: ArrayLike) -> State:
        """Return pose, velocity, acceleration and body rate w = J_r(phi) dphi/dt (Sola 2018) at times (n,) s."""
        t = np.asarray(t, float)
        angle = t[:, None] * self.omega + self.phase
        y = np.sin(angle) @ self.amplitude + t[:, None] * self.velocity
        dy = (np.cos(angle) * self.omega) @ self.amplitude + self.velocity
        ddy = -(np.sin(angle) * self.omega**2) @ self.amplitude[:, :3]
        R_0 = self.T_world_imu_0[:3, :3]
        omega_i: Array = (so3.right_jacobian(y[:, 3:]) @ dy[:, 3:, None])[..., 0]
        return State(
            T_world_imu=self.T_world_imu_0 @ se3.make(so3.exp(y[:, 3:]), y[:, :3]),
            velocity_w=dy[:, :3] @ R_0.T,
            acceleration_w=ddy @ R_0.T,
            omega_i=omega_i,
        )


@dataclass(frozen=True)
class Motion:
    """A kind of motion: rows of (Hz, x, y, z, pitch, yaw, roll); x, y, z per distance to the board, angles in rad about x, y, z."""

    sines: tuple[tuple[float, float, float, float, float, float, float], ...] = ()
    velocity: tuple[float, float, float, float, float, float] = (0, 0, 0, 0, 0, 0)  # per s

    def at_speed(self, speed: float) -> "Motion":
        """Return the same path taken `speed` times as fast: rates of turn grow with it, accelerations with its square."""
        a, b, c, d, e, f = self.velocity
        return Motion(
            tuple((speed * hz, x, y, z, pitch, yaw, roll) for hz, x, y, z, pitch, yaw, roll in self.sines),
            (speed * a, speed * b, speed * c, speed * d, speed * e, speed * f),
        )


# A step to the right with a turn to the left, by the same angle, keeps the board in view and shows it tilted.
_ORBIT = (
    (0.13, 0.50, 0, 0, 0, -0.50, 0),
    (0.19, 0, 0.42, 0, 0.42, 0, 0),
)
# The board wanders over the whole image, nearer and farther, and turns in it.
_WANDER = (
    (0.11, 0, 0, 0.24, 0, 0, 0),
    (0.23, 0, 0, 0, 0, 0.36, 0),
    (0.17, 0, 0, 0, 0.26, 0, 0),
    (0.21, 0, 0, 0, 0, 0, 0.45),
)
# What the IMU needs: accelerations near 1.5 m/s^2 and rates near 1 rad/s on every axis.
_SHAKE = (
    (0.90, 0.045, 0, 0, 0, 0, 0),
    (1.10, 0, 0.040, 0, 0, 0, 0),
    (0.80, 0, 0, 0.045, 0, 0, 0),
    (0.83, 0, 0, 0, 0.10, 0, 0),
    (0.71, 0, 0, 0, 0, 0.12, 0),
    (0.62, 0, 0, 0, 0, 0, 0.16),
)

MOTIONS: dict[str, Motion] = {
    "rich": Motion(_ORBIT + _WANDER + _SHAKE),
    "static": Motion(),
    "translation": Motion(
        (
            (0.13, 0.30, 0, 0, 0, 0, 0),
            (0.19, 0, 0.22, 0, 0, 0, 0),
            (0.23, 0, 0, 0.25, 0, 0, 0),
            *_SHAKE[:3],
        )
    ),
    # All views are within 3 deg of one attitude: images alone hardly tell the lens.
    "fronto-parallel": Motion(
        (
            (0.13, 0.30, 0, 0, 0, 0, 0),
            (0.19, 0, 0.22, 0, 0, 0, 0),
            (0.23, 0, 0, 0.25, 0, 0, 0),
            *_SHAKE[:3],
            (0.83, 0, 0, 0, 0.02, 0, 0),
            (0.71, 0, 0, 0, 0, 0.02, 0),
            (0.62, 0, 0, 0, 0, 0, 0.02),
        )
    ),
    "single-axis": Motion(((0.23, 0, 0, 0, 0, 0.30, 0), (0.71, 0, 0, 0, 0, 0.12, 0))),
    # About the optical axis, so that the board stays in view: a swing that repeats itself, and a turn at one rate for ever.
    "swing": Motion(((1.0, 0, 0, 0, 0, 0, 0.25),)),
    "constant-rate": Motion(velocity=(0, 0, 0, 0, 0, 1.0)),
    "constant-velocity": Motion(velocity=(0.01, -0.006, 0.008, 0, 0, 0)),
    # A vehicle on flat ground: it moves in its plane and turns about the vertical.
    "planar": Motion((_ORBIT[0], _WANDER[0], _WANDER[1], _SHAKE[0], _SHAKE[2], _SHAKE[4])),
}


def make_trajectory(motion: Motion, distance: float, T_imu_cam: ArrayLike, rng: np.random.Generator) -> Trajectory:
    """Return the motion of a rig whose camera rests `distance` m before the board, at the world's origin.

    Each sine gets a random phase and a frequency within 5 % of its own, so that seeds differ and no two sines lock.
    """
    T_imu_cam = np.asarray(T_imu_cam, float)
    R_imu_cam = T_imu_cam[:3, :3]
    sines = np.array(motion.sines, float).reshape(-1, 7)
    omega = 2 * np.pi * sines[:, 0] * rng.uniform(0.95, 1.05, len(sines))
    phase = rng.uniform(0, 2 * np.pi, len(sines))

    def in_imu_axes(rows: Array) -> Array:
        return np.concatenate([distance * rows[..., :3] @ R_imu_cam.T, rows[..., 3:] @ R_imu_cam.T], axis=-1)

    T_world_imu_0 = se3.make(R_WORLD_CAM_AT_REST, np.zeros(3)) @ se3.inverse(T_imu_cam)
    return Trajectory(T_world_imu_0, omega, phase, in_imu_axes(sines[:, 1:]), in_imu_axes(np.array(motion.velocity, float)))
