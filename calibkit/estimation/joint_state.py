"""The unknowns of the joint estimator: a trajectory with biases on its knots (the core), cameras and gravity (the border)."""

from dataclasses import dataclass, replace

from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

KNOT = 12  # unknowns of a knot: rotation, position, gyroscope's bias, accelerometer's bias
ROTATION, POSITION, BIASES = slice(0, 3), slice(3, 6), slice(6, 12)
GRAVITY = slice(0, 3)  # of the border


@dataclass(frozen=True)
class CameraState:
    """One camera on the rig: p_cam = T_cam_imu p_imu, t_imu = t_cam + dt."""

    T_cam_imu: Array  # (4, 4)
    dt: float  # s
    lens: Array  # (l,)


@dataclass(frozen=True)
class JointState:
    """Control points of T_world_imu, the world being the board's frame; biases are constant over a segment, that of its first knot."""

    R: Array  # (m, 3, 3)
    p: Array  # (m, 3) m
    bias: Array  # (m, 6) rad/s, m/s^2
    cameras: tuple[CameraState, ...]
    gravity: Array  # (3,) m/s^2 in the board's frame, pointing down


@dataclass(frozen=True)
class Border:
    """Where each calibration parameter stands."""

    lens_sizes: tuple[int, ...]

    def camera(self, c: int) -> slice:
        """Return T_cam_imu (rho, phi), dt and lens of camera c."""
        start = GRAVITY.stop + sum(7 + size for size in self.lens_sizes[:c])
        return slice(start, start + 7 + self.lens_sizes[c])

    def pose(self, c: int) -> slice:
        return slice(self.camera(c).start, self.camera(c).start + 6)

    def dt(self, c: int) -> int:
        return int(self.camera(c).start) + 6

    def lens(self, c: int) -> slice:
        return slice(self.camera(c).start + 7, self.camera(c).stop)

    @property
    def size(self) -> int:
        return int(self.camera(len(self.lens_sizes) - 1).stop)


def retract(x: JointState, core: Array, border: Array) -> JointState:
    """Return the state moved by steps of the core (m, 12) and the border (p,)."""
    where = Border(tuple(len(camera.lens) for camera in x.cameras))
    cameras = tuple(
        CameraState(
            se3.retract(camera.T_cam_imu, border[where.pose(c)]),
            camera.dt + float(border[where.dt(c)]),
            camera.lens + border[where.lens(c)],
        )
        for c, camera in enumerate(x.cameras)
    )
    R = so3.project(x.R @ so3.exp(core[:, ROTATION]))
    return replace(x, R=R, p=x.p + core[:, POSITION], bias=x.bias + core[:, BIASES], cameras=cameras, gravity=x.gravity + border[GRAVITY])
