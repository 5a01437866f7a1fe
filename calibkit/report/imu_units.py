"""IMU noise as datasheets print it, beside SI: deg/sqrt(h), deg/h, ug/sqrt(Hz), ug."""

from math import pi

from calibkit.models.imu import STANDARD_GRAVITY
from calibkit.models.noise import FLOOR

_G = STANDARD_GRAVITY.value
_DEG = 180 / pi

# What a noise coefficient of a gyroscope or an accelerometer is multiplied by, and the unit that it then has.
_PEOPLE = {
    ("gyro", "quantisation"): (_DEG * 3600, "arcsec"),
    ("gyro", "white"): (_DEG * 60, "deg/sqrt(h)"),
    ("gyro", "flicker"): (_DEG * 3600, "deg/h"),
    ("gyro", "walk"): (_DEG * 3600 * 60, "deg/h/sqrt(h)"),
    ("gyro", "ramp"): (_DEG * 3600 * 3600, "deg/h/h"),
    ("accel", "quantisation"): (1e3, "mm/s"),
    ("accel", "white"): (1e6 / _G, "ug/sqrt(Hz)"),
    ("accel", "flicker"): (1e6 / _G, "ug"),
    ("accel", "walk"): (1e6 / _G * 60, "ug/sqrt(h)"),
    ("accel", "ramp"): (1e6 / _G * 3600, "ug/h"),
}


def for_people(sensor: str, coefficient: str, value: float) -> str:
    """Return a coefficient of `data.rig.Noise` in SI, of "gyro" or "accel", as datasheets have it."""
    factor, unit = _PEOPLE[sensor, coefficient]
    floor = (
        f", Allan floor {FLOOR * value * factor:.3g}" if coefficient == "flicker" else ""
    )  # many datasheets mean that by bias instability
    return f"{value * factor:.3g} {unit}{floor}"
