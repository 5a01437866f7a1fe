"""The unknowns of the joint estimator: a trajectory with biases on its knots (the core), cameras and gravity (the border)."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.models.imu import ACCEL_PARAMETERS, GYRO_PARAMETERS, SENSITIVITY_PARAMETERS, ImuModel, lower

KNOT = 12  # unknowns of a knot: rotation, position, gyroscope's bias, accelerometer's bias
ROTATION, POSITION, BIASES = slice(0, 3), slice(3, 6), slice(6, 12)


@dataclass(frozen=True)
class CameraState:
    """One camera on the rig: p_cam = T_cam_imu p_imu, t_imu = t_cam + dt."""

    T_cam_imu: Array  # (4, 4)
    dt: float  # s
    lens: Array  # (l,)
    line_delay: float = 0.0  # s from one row to the next; stamps are the middle row's


@dataclass(frozen=True)
class JointState:
    """Control points of T_world_imu, the world being the board's frame; biases are constant over a segment, that of its first knot."""

    R: Array  # (m, 3, 3)
    p: Array  # (m, 3) m
    bias: Array  # (m, 6) rad/s, m/s^2
    cameras: tuple[CameraState, ...]
    gravity: Array  # (3,) m/s^2 in the board's frame, pointing down
    board_scale: float = 1.0  # of the board over what its file says
    imu: ImuModel = field(default_factory=ImuModel)  # its biases are not used: they are on the knots


# What is free on request, and what is suspected where it is not: names with the number of unknowns.
SCALE, M_A, M_G, PHI, A_G, LINE = "board scale", "M_a", "M_g", "phi_g_i", "A_g", "line delay"
EXTRAS = {SCALE: 1, M_A: 6, M_G: 6, PHI: 3, A_G: 9, LINE: 1}
IMU_MODEL = {M_A: ACCEL_PARAMETERS[:6], M_G: GYRO_PARAMETERS[:6], PHI: GYRO_PARAMETERS[6:9], A_G: SENSITIVITY_PARAMETERS}
DRIFTING = 9  # of a camera: T (rho, phi), dt, fx and fy, the first columns of `Border.camera`
LINE_SCALE = 1e-3  # the unknown of a line delay is its delay of a thousand rows


@dataclass(frozen=True)
class Border:
    """Where each calibration parameter stands."""

    lens_sizes: tuple[int, ...]
    extras: tuple[str, ...] = ()
    drifts: tuple[str, ...] = ()  # names of what T, dt and focal length go with

    @property
    def _blocks(self) -> dict[str, slice]:
        sizes = {"gravity": 3, **{name: size for name, size in EXTRAS.items() if name in self.extras and name != LINE}}
        for c, lens in enumerate(self.lens_sizes):
            sizes |= {f"T {c}": 6, f"dt {c}": 1, f"lens {c}": lens, **({f"{LINE} {c}": 1} if LINE in self.extras else {})}
        sizes |= {f"{drift} {c}": DRIFTING for drift in self.drifts for c in range(len(self.lens_sizes))}
        out, start = {}, 0
        for name, size in sizes.items():
            out[name] = slice(start, start := start + size)
        return out

    def __getitem__(self, name: str) -> slice:
        """Return where "gravity", an extra of the IMU, or "T c", "dt c", "lens c", "line delay c", "DRIFT c" of camera c stands."""
        return self._blocks[name]

    def camera(self, c: int) -> slice:
        """Return T_cam_imu (rho, phi), dt, lens and line delay of camera c."""
        last = f"{LINE if LINE in self.extras else 'lens'} {c}"
        return slice(self[f"T {c}"].start, self[last].stop)

    @property
    def of_model(self) -> NDArray[np.int64]:
        """Return where what is free of the IMU's model stands, in the order of IMU_MODEL."""
        return np.array([k for name in IMU_MODEL if name in self.extras for k in range(self[name].start, self[name].stop)], np.int64)

    @property
    def of_imu(self) -> slice:
        """Return gravity and what is free of the IMU and of the board's size."""
        return slice(0, self["T 0"].start)

    @property
    def size(self) -> int:
        return int(max(block.stop for block in self._blocks.values()))


def retract(x: JointState, where: Border, core: Array, border: Array) -> JointState:
    """Return the state moved by steps of the core (m, 12) and the border (p,)."""

    def step(name: str) -> Array:
        return border[where[name]]

    cameras = tuple(
        CameraState(
            se3.retract(camera.T_cam_imu, step(f"T {c}")),
            camera.dt + float(step(f"dt {c}")[0]),
            camera.lens + step(f"lens {c}"),
            camera.line_delay + (LINE_SCALE * float(step(f"{LINE} {c}")[0]) if LINE in where.extras else 0.0),
        )
        for c, camera in enumerate(x.cameras)
    )
    moved = {name: step(name) for name in where.extras if name != LINE}
    imu = replace(
        x.imu,
        M_a=x.imu.M_a + lower(moved.get(M_A, _NO_6)),
        M_g=x.imu.M_g + lower(moved.get(M_G, _NO_6)),
        C_g_i=x.imu.C_g_i @ so3.exp(moved.get(PHI, _NO_3)),
        A_g=x.imu.A_g + moved.get(A_G, _NO_9).reshape(3, 3),
    )
    return JointState(
        R=so3.project(x.R @ so3.exp(core[:, ROTATION])),
        p=x.p + core[:, POSITION],
        bias=x.bias + core[:, BIASES],
        cameras=cameras,
        gravity=x.gravity + step("gravity"),
        board_scale=x.board_scale + float(moved.get(SCALE, _NO_3)[0]),
        imu=imu,
    )


def model_step(a: ImuModel, b: ImuModel) -> dict[str, Array]:
    """Return the step from model a to model b by the names of IMU_MODEL."""
    rows, columns = np.tril_indices(3)
    return {
        M_A: (b.M_a - a.M_a)[rows, columns],
        M_G: (b.M_g - a.M_g)[rows, columns],
        PHI: so3.log(a.C_g_i.T @ b.C_g_i),
        A_G: (b.A_g - a.A_g).ravel(),
    }


_NO_3, _NO_6, _NO_9 = np.zeros(3), np.zeros(6), np.zeros(9)
