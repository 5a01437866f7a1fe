"""The rig: every sensor's parameters, the transforms and clock offsets between sensors, each with sigma, status and origin.

This is the schema of the rig file, version 1; `io/rig_file.py` reads and writes it. Unknown keys are refused, and so is
whatever contradicts itself: a quaternion that is not the matrix, a covariance that is none, a sigma beside another variance.
"""

from pathlib import PurePosixPath, PureWindowsPath
from typing import Annotated, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field, model_validator

from calibkit.data.verdict import Status, Verdict
from calibkit.geometry import se3, so3
from calibkit.models import imu
from calibkit.models.cameras import CAMERAS

VERSION = 1
CONVENTIONS = {
    "transform": "T_a_b maps a point given in frame b to frame a: p_a = T_a_b p_b",
    "quaternion": "Hamilton, stored x y z w",
    "time": "dt_a_b is added to b's stamps to give a's: t_a = t_b + dt_a_b (dt_imu_cam is Kalibr's timeshift_cam_imu)",
    "camera": "x right, y down, z forward; pixel (0, 0) is the centre of the top-left pixel; a stamp is mid-exposure of the middle row",
    "perturbation": "on the right, T exp(d), tangent order (rho m, phi rad)",
    "units": "SI, angles in radians, pixels px",
}

_TOLERANCE = 1e-6  # a matrix written with 7 digits
_COVARIANCE_TOLERANCE = 1e-9  # of a correlation
_SIGMA_TOLERANCE = 1e-6  # relative

Finite = Annotated[float, Field(ge=-1e100, le=1e100, allow_inf_nan=False, strict=True)]  # strict: neither true nor "1.0" is a number
Sigma = Annotated[float, Field(ge=0, le=1e100, allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(gt=0, le=1e100, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=0, strict=True)]
Pixels = Annotated[int, Field(gt=0, le=100000, strict=True)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9]*$", max_length=40)]
Text = Annotated[str, Field(max_length=2000)]
Texts = Annotated[list[Text], Field(max_length=1000)]
Row = Annotated[list[Finite], Field(max_length=400)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[Finite], Field(min_length=4, max_length=4)]
ImuAxis = Literal["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
IMU_AXES: tuple[ImuAxis, ...] = get_args(ImuAxis)
TransformParameter = Literal["p_x", "p_y", "p_z", "r_x", "r_y", "r_z"]  # p_a_b in a's axes, m, and r = log R_a_b, rad
TRANSFORM_PARAMETERS: tuple[TransformParameter, ...] = get_args(TransformParameter)
Matrix4 = Annotated[list[Vector4], Field(min_length=4, max_length=4)]


def _near(a: ArrayLike, b: ArrayLike) -> bool:
    return bool(np.allclose(a, b, rtol=_TOLERANCE, atol=_TOLERANCE))


class Record(BaseModel):
    """A part of the rig file: frozen, unknown keys refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class Estimate(Record):
    """One number with its trust. A parameter that is not observable has no value."""

    value: Finite | None
    unit: Annotated[str, Field(max_length=40)] = ""
    sigma: Sigma | None = None  # corrected for correlated residuals; None: not known (given) or not observable
    sigma_plain: Sigma | None = None  # as if the residuals were white
    status: Status = Status.GIVEN

    @model_validator(mode="after")
    def _no_number_without_observability(self) -> "Estimate":
        if self.status is Status.NOT_OBSERVABLE and self.value is not None:
            raise ValueError("a parameter marked 'not observable' must have value null")
        if self.status is not Status.NOT_OBSERVABLE and self.value is None:
            raise ValueError("a value is missing; only a parameter marked 'not observable' may be null")
        return self


class Covariance(Record):
    """Covariance of the named parameters, in that order, corrected for correlated residuals."""

    order: Annotated[list[Annotated[str, Field(max_length=80)]], Field(max_length=400)]
    matrix: Annotated[list[Row], Field(max_length=400)]

    @model_validator(mode="after")
    def _square(self) -> "Covariance":
        n = len(self.order)
        if len(self.matrix) != n or any(len(row) != n for row in self.matrix):
            raise ValueError(f"matrix must be {n} x {n}, as long as order")
        if len(set(self.order)) != n:
            raise ValueError("order names a parameter twice")
        if any(self.matrix[i][i] < 0 for i in range(n)):
            raise ValueError("a variance on the diagonal is negative")
        return self

    @model_validator(mode="after")
    def _symmetric_and_positive(self) -> "Covariance":
        if self.order:
            C = np.array(self.matrix)
            scale = np.sqrt(np.diag(C))
            scale[scale == 0] = 1
            with np.errstate(over="ignore"):
                correlation = C / scale / scale[:, None]
            if not np.abs(correlation).max() <= 1 + _COVARIANCE_TOLERANCE:
                raise ValueError("matrix has a correlation beyond 1, so it is no covariance")
            if not np.allclose(correlation, correlation.T, rtol=0, atol=_COVARIANCE_TOLERANCE):
                raise ValueError("matrix is not symmetric, so it is no covariance")
            if np.linalg.eigvalsh(correlation)[0] < -_COVARIANCE_TOLERANCE * len(C):
                raise ValueError("matrix has a negative eigenvalue, so it is no covariance")
        return self


class Reprojection(Record):
    """How well the corners were met: rms = sqrt(sum(du^2 + dv^2) / N) over N corners."""

    rms_px: Sigma
    rms_all_px: Sigma  # dropped corners included
    held_out_rms_px: Sigma | None = None
    corners: Count = 0
    corners_dropped: Count = 0
    frames: Count = 0
    frames_dropped: Count = 0


class Camera(Record):
    """One camera: uv = model(p_cam; parameters)."""

    topic: Text | None = None
    resolution: tuple[Pixels, Pixels]  # width, height
    model: Annotated[str, Field(max_length=40)]
    equation: Text = ""
    parameters: dict[str, Estimate]
    covariance: Covariance | None = None
    line_delay: Estimate | None = None  # s from one row to the next of a rolling shutter; None: all rows at once, as far as is known
    reprojection: Reprojection | None = None
    verdict: Verdict | None = None  # None: given, not judged
    reasons: Texts = []

    @model_validator(mode="after")
    def _as_the_model_has_it(self) -> "Camera":
        model = CAMERAS.get(self.model)
        if model is None:
            raise ValueError(f"the camera model '{self.model}' is not known; it may be one of {', '.join(CAMERAS)}")
        if self.parameters.keys() != set(model.parameter_names):
            raise ValueError(f"the parameters of {self.model} are {', '.join(model.parameter_names)}")
        _same_sigmas(self.parameters, self.covariance)
        return self


def _same_sigmas(parameters: dict[str, Estimate], covariance: Covariance | None) -> None:
    if covariance is None:
        return
    for i, name in enumerate(covariance.order):
        if name not in parameters:
            raise ValueError(f"covariance.order names '{name}', which is no parameter here")
        sigma, variance = parameters[name].sigma, covariance.matrix[i][i]
        if sigma is not None and abs(sigma - variance**0.5) > _SIGMA_TOLERANCE * max(sigma, variance**0.5):
            raise ValueError(f"the sigma of {name} is {sigma:.6g}, but its covariance says {variance**0.5:.6g}")


class Noise(Record):
    """One axis' noise: sigma^2(tau) = 3 Q^2 / tau^2 + N^2 / tau + 2 ln 2 / pi B^2 + K^2 tau / 3 + R^2 tau^2 / 2 (IEEE Std 952, annex C).

    Units are of x = rad/s or m/s^2.
    """

    quantisation: Estimate | None = None  # Q, x s
    white: Estimate  # N, x / sqrt(Hz)
    flicker: Estimate  # B, x; the Allan deviation's floor is B sqrt(2 ln 2 / pi) = 0.664 B
    walk: Estimate  # K, x / s / sqrt(Hz)
    ramp: Estimate | None = None  # R, x / s


class ImuIntrinsics(Record):
    """Scale, misalignment and bias; `models/imu.py` has the equations, the names of the parameters and the correction in one call."""

    equation: Text = ""
    correction: Text = ""
    unit: Literal["SI", "counts"] = "SI"  # of what the IMU measures
    gravity: Positive  # m/s^2, what the scale hangs on
    parameters: dict[str, Estimate]
    covariance: Covariance | None = None
    verdict: Verdict | None = None
    reasons: Texts = []

    @model_validator(mode="after")
    def _as_the_model_has_it(self) -> "ImuIntrinsics":
        needed = {*imu.ACCEL_PARAMETERS, *imu.GYRO_PARAMETERS}
        if not needed <= self.parameters.keys() <= set(imu.PARAMETERS):
            raise ValueError(
                f"the parameters of an IMU are {', '.join((*imu.ACCEL_PARAMETERS, *imu.GYRO_PARAMETERS))}, and A_g_xx ... A_g_zz"
            )
        _same_sigmas(self.parameters, self.covariance)
        return self


class Imu(Record):
    """One IMU; noise densities are continuous-time: white sigma = density sqrt(rate), a walk's step = density / sqrt(rate)."""

    topic: Text | None = None
    rate_hz: Positive | None = None
    gyro_noise_density: Estimate | None = None  # rad/s/sqrt(Hz)
    gyro_random_walk: Estimate | None = None  # rad/s^2/sqrt(Hz)
    accel_noise_density: Estimate | None = None  # m/s^2/sqrt(Hz)
    accel_random_walk: Estimate | None = None  # m/s^3/sqrt(Hz)
    noise: dict[ImuAxis, Noise] = {}  # by axis; the four densities above are what an estimator with one value for all axes should take
    intrinsics: ImuIntrinsics | None = None
    verdict: Verdict | None = None  # of the noise; None: given, not judged
    reasons: Texts = []


class Transform(Record):
    """T_a_b and its inverse, under the key `T_a_b`: p_a = T_a_b p_b."""

    equation: Text = ""
    matrix: Matrix4  # T_a_b
    rotation_xyzw: Vector4
    translation: Vector3  # m, b's origin in a
    inverse_name: Annotated[str, Field(max_length=90)]  # T_b_a
    inverse_matrix: Matrix4
    covariance: Covariance | None = None  # order rho_x rho_y rho_z phi_x phi_y phi_z, in b's frame
    status: Status = Status.GIVEN
    statuses: dict[TransformParameter, Status] = {}  # each by itself; {}: all as `status`
    verdict: Verdict | None = None
    reasons: Texts = []

    @model_validator(mode="after")
    def _one_motion(self) -> "Transform":
        T, R, q = np.array(self.matrix), np.array(self.matrix)[:3, :3], np.array(self.rotation_xyzw)
        if not np.array_equal(T[3], [0, 0, 0, 1]):
            raise ValueError("the last row of matrix is not 0 0 0 1")
        if not _near(R @ R.T, np.eye(3)) or np.linalg.det(R) < 0:
            raise ValueError("the upper left 3 x 3 of matrix is not a rotation")
        if not _near(q @ q, 1) or not _near(so3.from_quat(q), R):
            raise ValueError("rotation_xyzw is not the rotation of matrix (order x y z w)")
        if not _near(self.translation, T[:3, 3]):
            raise ValueError("translation is not the last column of matrix")
        if not _near(self.inverse_matrix, se3.inverse(T)):
            raise ValueError("inverse_matrix is not the inverse of matrix")
        if self.covariance is not None and len(self.covariance.order) != 6:
            raise ValueError("the covariance of a transform is 6 x 6")
        if self.statuses and self.statuses.keys() != set(TRANSFORM_PARAMETERS):
            raise ValueError(f"statuses must name {', '.join(TRANSFORM_PARAMETERS)}")
        if self.statuses and (Status.NOT_OBSERVABLE in self.statuses.values()) != (self.status is Status.NOT_OBSERVABLE):
            raise ValueError("status must be 'not observable' where one of statuses is, and only there")
        return self


class TimeOffset(Record):
    """dt_a_b under the key `dt_a_b`: t_a = t_b + dt_a_b."""

    equation: Text = ""
    offset: Estimate  # s
    verdict: Verdict | None = None
    reasons: Texts = []


class InputFile(Record):
    """A file that a stage read: its name (not its path) and what it held."""

    name: Text
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None


class StageRun(Record):
    """How a part of this file was made."""

    stage: Annotated[str, Field(max_length=40)]
    command: Text
    calibkit: Annotated[str, Field(max_length=40)]
    inputs: list[InputFile] = []
    options: dict[str, str | Finite | int | bool | None] = {}
    made: Texts = []  # the entries that it made or changed: cameras.cam0, imus.imu0.noise
    residual_file: Text | None = None  # a bare name: the file lies beside the rig file
    residual_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None

    @model_validator(mode="after")
    def _stays_in_its_folder(self) -> "StageRun":
        name = self.residual_file
        if name is not None and (name in ("", ".", "..") or {PurePosixPath(name).name, PureWindowsPath(name).name} != {name}):
            raise ValueError("residual_file must be the bare name of a file beside the rig file")
        return self


class Rig(Record):
    """All that is known of one rig."""

    format: Literal["calibkit-rig"] = "calibkit-rig"
    version: Literal[1] = 1
    conventions: dict[str, str] = CONVENTIONS
    cameras: dict[Name, Camera] = {}
    imus: dict[Name, Imu] = {}
    transforms: dict[Annotated[str, Field(pattern=r"^T_[A-Za-z0-9]+_[A-Za-z0-9]+$")], Transform] = {}
    time_offsets: dict[Annotated[str, Field(pattern=r"^dt_[A-Za-z0-9]+_[A-Za-z0-9]+$")], TimeOffset] = {}
    provenance: Annotated[list[StageRun], Field(max_length=200)] = []

    @model_validator(mode="after")
    def _means_what_it_says(self) -> "Rig":
        for key, text in self.conventions.items():
            if CONVENTIONS.get(key) != text:
                raise ValueError(f"conventions.{key} is not the convention of this version; a file in other conventions must be imported")
        for name, entry in self.transforms.items():
            _, a, b = name.split("_")
            if entry.inverse_name != f"T_{b}_{a}":
                raise ValueError(f"transforms.{name} has the inverse T_{b}_{a}, which inverse_name must say")
        for names in (self.transforms, self.time_offsets):
            for name in names:
                kind, a, b = name.split("_")
                if a == b:
                    raise ValueError(f"{name} is of one sensor; it needs two")
                if f"{kind}_{b}_{a}" in names:
                    raise ValueError(f"{name} and {kind}_{b}_{a} are both given; keep one")
        return self
