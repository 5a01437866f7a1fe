"""The unknowns of the joint estimator: a trajectory with biases on its knots (the core), cameras and gravity (the border)."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.models.imu import ACCEL_PARAMETERS, GYRO_PARAMETERS, SENSITIVITY_PARAMETERS, ImuModel, lower

ROTATION, POSITION = slice(0, 3), slice(3, 6)  # of a knot's unknowns; then each IMU's biases, gyroscope first


def biases(j: int) -> slice:
    """Return where IMU j's biases stand among a knot's unknowns."""
    return slice(6 + 6 * j, 12 + 6 * j)


@dataclass(frozen=True)
class CameraState:
    """One camera on the rig: p_cam = T_cam_imu p_imu, t_imu = t_cam + dt."""

    T_cam_imu: Array  # (4, 4)
    dt: float  # s
    lens: Array  # (l,)
    line_delay: float = 0.0  # s from one row to the next; stamps are the middle row's


@dataclass(frozen=True)
class ImuState:
    """One IMU on the rig: p_imu = T_imu_ref p_ref, t_ref = t_imu + dt, ref being the first IMU, whose way the trajectory is."""

    T_imu_ref: Array  # (4, 4)
    dt: float  # s
    bias: Array  # (m, 6) rad/s, m/s^2
    model: ImuModel = field(default_factory=ImuModel)


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
    beside: tuple[ImuState, ...] = ()  # further IMUs

    @property
    def imus(self) -> tuple[ImuState, ...]:
        return ImuState(np.eye(4), 0.0, self.bias, self.imu), *self.beside


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
    beside: tuple[tuple[str, ...], ...] = ()  # of further IMUs: what is free of the model, of IMU_MODEL

    @cached_property
    def _blocks(self) -> dict[str, slice]:
        sizes = {"gravity": 3, **{name: size for name, size in EXTRAS.items() if name in self.extras and name != LINE}}
        for j, free in enumerate(self.beside, 1):
            sizes |= {f"T_imu {j}": 6, f"dt_imu {j}": 1, **{of_imu(name, j): EXTRAS[name] for name in IMU_MODEL if name in free}}
        for c, lens in enumerate(self.lens_sizes):
            sizes |= {f"T {c}": 6, f"dt {c}": 1, f"lens {c}": lens, **({f"{LINE} {c}": 1} if LINE in self.extras else {})}
        sizes |= {f"{drift} {c}": DRIFTING for drift in self.drifts for c in range(len(self.lens_sizes))}
        out, start = {}, 0
        for name, size in sizes.items():
            out[name] = slice(start, start := start + size)
        return out

    def __getitem__(self, name: str) -> slice:
        """Return where a block stands.

        "gravity"; an extra of the first IMU; "T_imu j", "dt_imu j", `of_imu(NAME, j)` of another; "T c", "dt c", "lens c", "line delay c",
        "DRIFT c" of camera c.
        """
        return self._blocks[name]

    def camera(self, c: int) -> slice:
        """Return T_cam_imu (rho, phi), dt, lens and line delay of camera c."""
        last = f"{LINE if LINE in self.extras else 'lens'} {c}"
        return slice(self[f"T {c}"].start, self[last].stop)

    def at(self, names: Iterable[str]) -> NDArray[np.int64]:
        """Return where blocks stand, one after the other."""
        return np.array([k for name in names for k in range(self[name].start, self[name].stop)], np.int64)

    def free_of(self, j: int) -> tuple[str, ...]:
        """Return what is free of IMU j's model, in the order of IMU_MODEL."""
        free = self.extras if j == 0 else self.beside[j - 1]
        return tuple(name for name in IMU_MODEL if name in free)

    def of_model(self, j: int = 0) -> NDArray[np.int64]:
        """Return where what is free of IMU j's model stands, in the order of IMU_MODEL."""
        return self.at(of_imu(name, j) for name in self.free_of(j))

    @property
    def knot(self) -> int:
        """Return how many unknowns a knot has."""
        return int(biases(len(self.beside)).stop)

    @property
    def size(self) -> int:
        return int(max(block.stop for block in self._blocks.values()))


def of_imu(name: str, j: int) -> str:
    """Return what a block of the border is called for IMU j, which the first one's is called `name`."""
    return name if j == 0 else f"{name} {j}"


def retract(x: JointState, where: Border, core: Array, border: Array) -> JointState:
    """Return the state moved by steps of the core (m, knot) and the border (p,)."""

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
    models = [_moved(each.model, {name: step(of_imu(name, j)) for name in where.free_of(j)}) for j, each in enumerate(x.imus)]
    beside = tuple(
        ImuState(
            se3.retract(imu.T_imu_ref, step(f"T_imu {j}")), imu.dt + float(step(f"dt_imu {j}")[0]), imu.bias + core[:, biases(j)], models[j]
        )
        for j, imu in enumerate(x.beside, 1)
    )
    return JointState(
        R=so3.project(x.R @ so3.exp(core[:, ROTATION])),
        p=x.p + core[:, POSITION],
        bias=x.bias + core[:, biases(0)],
        cameras=cameras,
        gravity=x.gravity + step("gravity"),
        board_scale=x.board_scale + (float(step(SCALE)[0]) if SCALE in where.extras else 0.0),
        imu=models[0],
        beside=beside,
    )


def _moved(model: ImuModel, steps: dict[str, Array]) -> ImuModel:
    return replace(
        model,
        M_a=model.M_a + lower(steps.get(M_A, _NO_6)),
        M_g=model.M_g + lower(steps.get(M_G, _NO_6)),
        C_g_i=model.C_g_i @ so3.exp(steps.get(PHI, _NO_3)),
        A_g=model.A_g + steps.get(A_G, _NO_9).reshape(3, 3),
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
