"""The rig: every sensor's parameters, the transforms and clock offsets between sensors, each with sigma, status and origin.

This is the schema of the rig file, version 1; `io/rig_file.py` reads and writes it. Unknown keys are refused.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from calibkit.data.verdict import Status, Verdict

VERSION = 1
CONVENTIONS = {
    "transform": "T_a_b maps a point given in frame b to frame a: p_a = T_a_b p_b",
    "quaternion": "Hamilton, stored x y z w",
    "time": "dt_a_b is added to b's stamps to give a's: t_a = t_b + dt_a_b (dt_imu_cam is Kalibr's timeshift_cam_imu)",
    "camera": "x right, y down, z forward; pixel (0, 0) is the centre of the top-left pixel; a stamp is mid-exposure of the middle row",
    "perturbation": "on the right, T exp(d), tangent order (rho m, phi rad)",
    "units": "SI, angles in radians, pixels px",
}

Finite = Annotated[float, Field(allow_inf_nan=False)]
Sigma = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9]*$", max_length=40)]
Text = Annotated[str, Field(max_length=2000)]
Row = Annotated[list[Finite], Field(max_length=400)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[Finite], Field(min_length=4, max_length=4)]
Matrix4 = Annotated[list[Vector4], Field(min_length=4, max_length=4)]


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
        if any(self.matrix[i][i] < 0 for i in range(n)):
            raise ValueError("a variance on the diagonal is negative")
        return self


class Reprojection(Record):
    """How well the corners were met: rms = sqrt(sum(du^2 + dv^2) / N) over N corners."""

    rms_px: Sigma
    rms_all_px: Sigma  # dropped corners included
    held_out_rms_px: Sigma | None = None
    corners: int = 0
    corners_dropped: int = 0
    frames: int = 0
    frames_dropped: int = 0


class Camera(Record):
    """One camera: uv = model(p_cam; parameters)."""

    topic: Text | None = None
    resolution: tuple[Annotated[int, Field(gt=0, le=100000)], Annotated[int, Field(gt=0, le=100000)]]  # width, height px
    model: Annotated[str, Field(max_length=40)]
    equation: Text = ""
    parameters: dict[str, Estimate]
    covariance: Covariance | None = None
    reprojection: Reprojection | None = None
    verdict: Verdict | None = None  # None: given, not judged
    reasons: list[Text] = []


class Imu(Record):
    """One IMU; noise densities are continuous-time: white sigma = density sqrt(rate), a walk's step = density / sqrt(rate)."""

    topic: Text | None = None
    rate_hz: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    gyro_noise_density: Estimate | None = None  # rad/s/sqrt(Hz)
    gyro_random_walk: Estimate | None = None  # rad/s^2/sqrt(Hz)
    accel_noise_density: Estimate | None = None  # m/s^2/sqrt(Hz)
    accel_random_walk: Estimate | None = None  # m/s^3/sqrt(Hz)


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
    verdict: Verdict | None = None
    reasons: list[Text] = []


class TimeOffset(Record):
    """dt_a_b under the key `dt_a_b`: t_a = t_b + dt_a_b."""

    equation: Text = ""
    offset: Estimate  # s
    verdict: Verdict | None = None
    reasons: list[Text] = []


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
    options: dict[str, str | float | int | bool | None] = {}
    residual_file: Text | None = None  # beside the rig file
    residual_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None


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
