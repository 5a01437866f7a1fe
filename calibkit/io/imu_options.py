"""What a person knows of an IMU's recording and its files do not say: the rate, and the units of its numbers."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibkit.data.observations import ImuUnit
from calibkit.errors import BadInputError, one_line
from calibkit.models.imu import STANDARD_GRAVITY

G = STANDARD_GRAVITY.value
COUNTS = ("counts", "count", "raw", "lsb")
# Units as headers write them, lower case, and what they are worth in SI; of none SI is meant. Raw counts stay as they are.
_RAW = dict.fromkeys(COUNTS, 1.0)
_DEG = np.pi / 180
GYRO_UNITS: Mapping[str, float] = {
    **dict.fromkeys(("", "rad/s", "rad s^-1"), 1.0),
    **dict.fromkeys(("deg/s", "deg s^-1", "dps", "°/s"), _DEG),
    **dict.fromkeys(("mdeg/s", "mdps"), _DEG / 1000),
    "deg/h": _DEG / 3600,
    "mrad/s": 1e-3,
    **_RAW,
}
ACCEL_UNITS: Mapping[str, float] = {
    **dict.fromkeys(("", "m/s^2", "m s^-2", "m/s2", "m/s²", "m/s/s"), 1.0),
    "g": G,
    "mg": G / 1000,
    **_RAW,
}
_MAX_HZ = 1e6


@dataclass(frozen=True)
class ImuOptions:
    """None: as the files have it."""

    rate_hz: float | None = None
    gyro_unit: str | None = None  # a key of GYRO_UNITS
    accel_unit: str | None = None  # a key of ACCEL_UNITS

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not (math.isfinite(self.rate_hz) and 0 < self.rate_hz <= _MAX_HZ):
            raise BadInputError(f"--rate {self.rate_hz:g} is no rate: give the samples per second, such as 200")
        for option, unit, known in (("--gyro-unit", self.gyro_unit, GYRO_UNITS), ("--accel-unit", self.accel_unit, ACCEL_UNITS)):
            if unit is not None and unit.lower() not in known:
                raise BadInputError(f"{option} {one_line(unit, 40)} is not known: use one of {', '.join(filter(None, known))}")

    @property
    def gyro_scale(self) -> float:
        """What the stated unit of the gyroscope is worth in rad/s."""
        return GYRO_UNITS[(self.gyro_unit or "").lower()]

    @property
    def accel_scale(self) -> float:
        """What the stated unit of the accelerometer is worth in m/s^2."""
        return ACCEL_UNITS[(self.accel_unit or "").lower()]

    @property
    def unit(self) -> ImuUnit:
        """What samples in the stated units hold; BadInputError where only one of the two is in counts."""
        return unit_of("the options", [u.lower() for u in (self.gyro_unit, self.accel_unit) if u is not None])


def unit_of(name: str, units: list[str]) -> ImuUnit:
    """Return what samples whose columns have these units hold; counts and SI may not be mixed."""
    raw = {unit in COUNTS for unit in units}
    if len(raw) == 2:
        raise BadInputError(f"{name}: one sensor is in raw counts and the other is not: state both in counts, or both in units")
    return "counts" if True in raw else "SI"
