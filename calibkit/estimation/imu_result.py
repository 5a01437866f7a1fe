"""From an IMU's calibration to a result: what the rig file keeps of it, and the stands that its report draws."""

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuUnit
from calibkit.data.plural import counted
from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Covariance, Estimate, Imu, ImuIntrinsics, Rig
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.estimation.imu_intrinsics import ImuCalibration
from calibkit.models.imu import CORRECTION, EQUATION, STANDARD_GRAVITY, UNITS, Gravity

Array = NDArray[np.float64]

_ODD = 1.25  # a scale farther from 1 is no sensor's error
_UNITS_LIKELY = (  # sensor, its scales, its option, and what each likely unit is worth in SI
    ("accelerometer", "M_a", "accel-unit", {"g": STANDARD_GRAVITY.value, "mg": STANDARD_GRAVITY.value / 1000}),
    ("gyroscope", "M_g", "gyro-unit", {"deg/s": np.pi / 180, "mdeg/s": np.pi / 180e3, "mrad/s": 1e-3}),
)


def imu_result(
    name: str, topic: str, found: ImuCalibration, unit: ImuUnit, gravity: Gravity, rate_hz: float, start_ns: int, before: Imu
) -> Result:
    """Return the result of stage `imu`; `before` is what a rig file already says of this IMU."""
    of_gravity = _by_gravity(found, gravity)
    cov = found.cov + np.outer(of_gravity, of_gravity)
    shared = dict(zip(found.names, of_gravity.tolist(), strict=True))
    reasons = (*found.reasons, *(_about_units(name, found) if unit == "SI" else ()))
    sigma = dict(zip(found.names, np.sqrt(np.diag(cov)).tolist(), strict=True))
    parameters = {
        key: Estimate(
            value=number.value,
            unit=UNITS[unit][key[:3]],
            sigma=sigma.get(key),
            sigma_plain=_plain(number.sigma_plain, shared.get(key, 0.0)),
            status=number.status,
        )
        for key, number in found.parameters.items()
    }
    intrinsics = ImuIntrinsics(
        equation=EQUATION,
        correction=CORRECTION,
        unit=unit,
        gravity=gravity.value,
        parameters=parameters,
        covariance=Covariance(order=list(found.names), matrix=cov.tolist()) if found.names else None,
        verdict=worst(reasons),
        reasons=[reason.text.removeprefix(f"{name}: ") for reason in reasons],
    )
    imu = before.model_copy(update={"topic": before.topic or topic, "rate_hz": before.rate_hz or rate_hz, "intrinsics": intrinsics})
    return Result(
        stage="imu",
        rig=Rig(imus={name: imu}),
        reasons=reasons,
        residuals=(_residuals(name, found, start_ns),),
        facts={
            "lines": _lines(name, topic, found, rate_hz, gravity),
            "imu": name,
            "advice": list(found.advice),
            "threshold": found.multiplier,
        },
        not_observable=tuple(f"{name}.{key}" for key, number in found.parameters.items() if number.status is Status.NOT_OBSERVABLE),
    )


def _about_units(name: str, found: ImuCalibration) -> list[Reason]:
    """Return a reason for each sensor whose scale is far from 1, as only another unit makes it."""
    out = []
    for sensor, key, option, units in _UNITS_LIKELY:
        known = [value for axis in "xyz" if (value := found.parameters[f"{key}_{axis}{axis}"].value) is not None]
        scale = float(np.median(np.abs(known))) if known else 1.0
        if 1 / _ODD < scale < _ODD:
            continue
        guess = next((unit for unit, worth in units.items() if 1 / _ODD < scale * worth < _ODD), None)
        what = "another unit, or raw counts?" if guess is None else f"is it in {guess}? then add --{option} {guess}"
        out.append(Reason(Verdict.CHECK, f"{name}: the {sensor}'s scale is {scale:.4g}, not about 1: {what}"))
    return out


def _plain(sigma: float | None, of_gravity: float) -> float | None:
    """Return sigma as if residuals were white, gravity's share in it as in the corrected one: no residual tells of gravity."""
    return None if sigma is None else float(np.hypot(sigma, of_gravity))


def _by_gravity(found: ImuCalibration, gravity: Gravity) -> Array:
    """Return the sigma of each parameter, signed, by what is not known of gravity: M_a goes as 1 / g, all of it together."""
    slope = np.array([(found.parameters[key].value or 0.0) / gravity.value if key.startswith("M_a") else 0.0 for key in found.names])
    out: Array = gravity.sigma * slope
    return out


def _residuals(name: str, found: ImuCalibration, start_ns: int) -> ResidualSet:
    stands = found.stands
    middle = np.array([(stand.start_s + stand.end_s) / 2 for stand in stands])
    return ResidualSet(
        sensor=name,
        unit="m/s²",
        t_ns=start_ns + np.round(middle * 1e9).astype(np.int64),
        raw=np.array([stand.misfit for stand in stands], float).reshape(-1, 1),
        sigma=np.full(len(stands), max(found.misfit_rms, 1e-12)),
        context={
            "kept": np.array([stand.dropped is None for stand in stands], bool),
            "attitude": np.array([stand.up for stand in stands], float).reshape(-1, 3),
        },
    )


def _lines(name: str, topic: str, found: ImuCalibration, rate_hz: float, gravity: Gravity) -> list[str]:
    used = sum(stand.dropped is None for stand in found.stands)
    lines = [
        f"{name}: {topic}, {rate_hz:.4g} Hz; {counted(len(found.stands), 'stand')} found, {used} used; "
        f"|a| - g {found.misfit_rms:.2g} m/s^2 rms, gravity's direction after a turn {np.degrees(found.turn_rms):.2g} deg rms",
        f"  gravity {gravity.value:.5f} +- {gravity.sigma:.2g} m/s^2 ({gravity.source})",
        f"  model: {EQUATION}",
        f"  correction: {CORRECTION}",
    ]
    lines += [f"  left out: stand at {stand.start_s:.1f} s, {stand.dropped}" for stand in found.stands if stand.dropped]
    lines += [f"  left out: turn at {begin:.1f} to {end:.1f} s, it contradicts the others" for begin, end in found.dropped_turns]
    return lines
