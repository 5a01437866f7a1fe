"""What an IMU measures of true rates, and back.

    a_meas = M_a a_i + b_a                                M_a lower triangular: the accelerometer's x axis is the IMU's
    w_meas = M_g C_g_i w_i + A_g C_g_i a_i + b_g          M_g lower triangular, C_g_i = exp(phi), A_g sensitivity to acceleration

(Rehder et al., "Extending kalibr", ICRA 2016, eq. 6-7, as Kalibr's scale-misalignment model.) M is in measured units per SI unit: about
1 for a device that speaks SI, counts per m/s^2 or rad/s for raw counts; b is in measured units.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import radians, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import so3

Array = NDArray[np.float64]

LOWER = ("xx", "yx", "yy", "zx", "zy", "zz")  # of a lower triangular matrix, row by row
AXES = ("x", "y", "z")
ACCEL_PARAMETERS = (*(f"M_a_{k}" for k in LOWER), *(f"b_a_{k}" for k in AXES))
GYRO_PARAMETERS = (*(f"M_g_{k}" for k in LOWER), *(f"phi_g_i_{k}" for k in AXES), *(f"b_g_{k}" for k in AXES))
SENSITIVITY_PARAMETERS = tuple(f"A_g_{r}{c}" for r in AXES for c in AXES)
PARAMETERS = (*ACCEL_PARAMETERS, *GYRO_PARAMETERS, *SENSITIVITY_PARAMETERS)
EQUATION = "a_meas = M_a a_i + b_a; w_meas = M_g C_g_i w_i + A_g C_g_i a_i + b_g, C_g_i = exp(phi_g_i), M lower triangular"
UNITS: dict[str, dict[str, str]] = {  # by what the IMU speaks and the first three letters of a parameter's name
    "SI": {"M_a": "", "b_a": "m/s^2", "M_g": "", "phi": "rad", "b_g": "rad/s", "A_g": "rad/s/(m/s^2)"},
    "counts": {
        "M_a": "counts/(m/s^2)",
        "b_a": "counts",
        "M_g": "counts/(rad/s)",
        "phi": "rad",
        "b_g": "counts",
        "A_g": "counts/(m/s^2)",
    },
}
CORRECTION = "a_i = M_a^-1 (a_meas - b_a); w_i = C_g_i^T M_g^-1 (w_meas - b_g - A_g C_g_i a_i)"

_ROWS, _COLUMNS = np.tril_indices(3)


def lower(values: Array) -> Array:
    """Return the lower triangular matrix (3, 3) of its six values, row by row."""
    M = np.zeros((3, 3))
    M[_ROWS, _COLUMNS] = values
    return M


@dataclass(frozen=True)
class ImuModel:
    """One IMU's intrinsics; the default is an ideal one that speaks SI."""

    M_a: Array = field(default_factory=lambda: np.eye(3))
    b_a: Array = field(default_factory=lambda: np.zeros(3))
    M_g: Array = field(default_factory=lambda: np.eye(3))
    C_g_i: Array = field(default_factory=lambda: np.eye(3))
    b_g: Array = field(default_factory=lambda: np.zeros(3))
    A_g: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def measure(self, accel_i: Array, omega_i: Array) -> tuple[Array, Array]:
        """Return a_meas, w_meas (..., 3) of specific force (..., 3) m/s^2 and rate (..., 3) rad/s in the IMU's frame."""
        accel_g = accel_i @ self.C_g_i.T
        return accel_i @ self.M_a.T + self.b_a, omega_i @ (self.M_g @ self.C_g_i).T + accel_g @ self.A_g.T + self.b_g

    def correct(self, accel_meas: Array, gyro_meas: Array) -> tuple[Array, Array]:
        """Return a_i m/s^2 and w_i rad/s (..., 3) of measured values, by CORRECTION."""
        accel_i = (accel_meas - self.b_a) @ np.linalg.inv(self.M_a).T
        free = gyro_meas - self.b_g - accel_i @ (self.A_g @ self.C_g_i).T
        return accel_i, free @ (self.C_g_i.T @ np.linalg.inv(self.M_g)).T

    @classmethod
    def of(cls, values: Mapping[str, float]) -> "ImuModel":
        """Return the model of named PARAMETERS; those of A_g may be missing."""

        def pick(names: Sequence[str]) -> Array:
            return np.array([values.get(name, 0.0) if name in SENSITIVITY_PARAMETERS else values[name] for name in names])

        return cls(
            M_a=lower(pick(ACCEL_PARAMETERS[:6])),
            b_a=pick(ACCEL_PARAMETERS[6:]),
            M_g=lower(pick(GYRO_PARAMETERS[:6])),
            C_g_i=so3.exp(pick(GYRO_PARAMETERS[6:9])),
            b_g=pick(GYRO_PARAMETERS[9:]),
            A_g=pick(SENSITIVITY_PARAMETERS).reshape(3, 3),
        )

    def values(self) -> dict[str, float]:
        """Return the values by name of PARAMETERS."""
        parts = (self.M_a[_ROWS, _COLUMNS], self.b_a, self.M_g[_ROWS, _COLUMNS], so3.log(self.C_g_i), self.b_g, self.A_g.ravel())
        return dict(zip(PARAMETERS, np.concatenate(parts).tolist(), strict=True))


@dataclass(frozen=True)
class Gravity:
    """|g| in m/s^2 with what is not known of it: an accelerometer's scale hangs on it."""

    value: float
    sigma: float
    source: str


STANDARD_GRAVITY = Gravity(9.80665, 0.015, "the standard's; on Earth it is 9.78 to 9.83: give --gravity or --latitude")


def gravity_at(latitude_deg: float, altitude_m: float | None = None) -> Gravity:
    """Return normal gravity on the WGS 84 ellipsoid (Somigliana) less 3.086e-6 m/s^2 a metre of altitude.

    g = 9.7803253359 (1 + 0.00193185265241 sin^2 B) / sqrt(1 - 0.00669437999013 sin^2 B) (NIMA TR8350.2, eq. 4-1). Real gravity differs by
    some 2e-4 m/s^2; an altitude that is not given, by half a kilometre.
    """
    s2 = sin(radians(latitude_deg)) ** 2
    normal = 9.7803253359 * (1 + 0.00193185265241 * s2) / sqrt(1 - 0.00669437999013 * s2)
    sigma = 3e-4 if altitude_m is not None else 1.6e-3
    where = f"latitude {latitude_deg:g} deg" + ("" if altitude_m is None else f", {altitude_m:g} m up")
    return Gravity(normal - 3.086e-6 * (altitude_m or 0.0), sigma, where)
