"""From an IMU's fitted noise to a result: what the rig file keeps of it, and the curves of its report."""

from itertools import product

import numpy as np

from calibkit.data.plural import counted
from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import IMU_AXES, Estimate, Imu, ImuAxis, Noise, Rig
from calibkit.data.verdict import Status, Verdict, worst
from calibkit.estimation.imu_noise import AxisNoise, NoiseTerm, model_deviation
from calibkit.estimation.noise_verdict import ALWAYS, DENSITIES, Rest, duration, of_sensor, reasons_for
from calibkit.models.noise import LETTERS, UNITS


def noise_result(found: Rest, before: Imu, cut: bool) -> Result:
    """Return the result of stage `allan`; `before` is what a rig file already says of this IMU, `cut` whether findings were cut out."""
    reasons = reasons_for(found, cut)
    noise = {axis: _as_noise(axis, found.noise[axis]) for axis in found.axes}
    gone = [f"{found.name}.{axis} {key}" for axis, key in product(found.axes, ALWAYS) if getattr(found.noise[axis], key).value is None]
    verdict = Verdict.FAIL if gone else worst(reasons)
    told = [reason.text.removeprefix(f"{found.name}: ") for reason in reasons if reason.verdict is not Verdict.PASS]
    imu = before.model_copy(
        update={
            "topic": before.topic or found.topic,
            "rate_hz": found.rate,
            **_densities(found, noise),
            "noise": {**before.noise, **noise},
            "verdict": verdict,
            "reasons": told,
        }
    )
    return Result(
        stage="allan",
        rig=Rig(imus={found.name: imu}),
        reasons=tuple(reasons),
        residuals=(_residuals(found),),
        facts={
            "lines": _lines(found),
            "imu": found.name,
            "pieces_h": found.hours,
            "axes": {axis: _facts(found.noise[axis]) for axis in found.axes},
        },
        not_observable=tuple(gone),
    )


def _as_noise(axis: ImuAxis, noise: AxisNoise) -> Noise:
    units = UNITS[axis[:-2]]

    def estimate(key: str) -> Estimate | None:
        term: NoiseTerm | None = getattr(noise, key)
        return None if term is None else Estimate(value=term.value, unit=units[key], sigma=term.sigma, status=term.status)

    return Noise.model_validate({key: estimate(key) for key in Noise.model_fields})


def _densities(found: Rest, noise: dict[ImuAxis, Noise]) -> dict[str, Estimate]:
    """Return Kalibr's four values, one for the three axes: their rms, of the axes that have one."""
    out = {}
    for sensor, (key, name) in product(UNITS, DENSITIES.items()):
        all_axes = [getattr(noise[axis], key) for axis in of_sensor(found, sensor)]
        known = [estimate for estimate in all_axes if estimate.value is not None]
        unit = UNITS[sensor][key]
        if not all_axes:
            continue
        if not known:
            out[f"{sensor}_{name}"] = Estimate(value=None, unit=unit, status=Status.NOT_OBSERVABLE)
            continue
        values, sigmas = (np.array([getattr(e, field) or 0.0 for e in known]) for field in ("value", "sigma"))
        rms = float(np.sqrt(np.mean(values**2)))
        sure = len(known) == len(all_axes) and all(e.status is Status.DETERMINED for e in known)
        sigma = float(np.linalg.norm(values * sigmas) / (len(known) * rms))
        out[f"{sensor}_{name}"] = Estimate(value=rms, unit=unit, sigma=sigma, status=Status.DETERMINED if sure else Status.WEAK)
    return out


def _residuals(found: Rest) -> ResidualSet:
    """Return ln(measured / model) at every averaging time and axis, with the curves that a report draws."""
    curve, k, c = found.curve, len(found.curve.tau), len(found.axes)
    fitted = np.stack([model_deviation(found.noise[axis], curve.tau) for axis in found.axes], axis=1)
    safe = np.where((curve.dev > 0) & (fitted > 0), curve.dev / np.where(fitted > 0, fitted, 1), 1)
    sigma = np.where(curve.dev > 0, (curve.upper - curve.lower) / (2 * 1.96 * np.where(curve.dev > 0, curve.dev, 1)), 1)
    columns = {
        "tau": np.repeat(curve.tau, c),
        "deviation": curve.dev.ravel(),
        "fitted": fitted.ravel(),
        "low": curve.lower.ravel(),
        "high": curve.upper.ravel(),
    }
    index = np.array([IMU_AXES.index(axis) for axis in found.axes], np.int32)
    return ResidualSet(
        found.name, "ln", np.zeros(k * c, np.int64), np.log(safe).reshape(-1, 1), sigma.ravel(), {"axis": np.tile(index, k), **columns}
    )


def _lines(found: Rest) -> list[str]:
    whole = sum(found.hours)
    in_pieces = "" if len(found.hours) == 1 else f" in {counted(len(found.hours), 'piece')}"
    return [f"{found.name}: {found.topic}, {found.rate:.4g} Hz; {duration(whole)} at rest{in_pieces} used"]


def _facts(noise: AxisNoise) -> dict[str, object]:
    terms = {key: getattr(noise, key) for key in LETTERS}
    return {
        **{
            key: {"lower95": term.lower95, "upper95": term.upper95, "hours_needed": _finite(term.hours_needed)}
            for key, term in terms.items()
            if term is not None
        },
        "goodness": noise.goodness,
        "discrepancy": noise.discrepancy,
        "gauss_markov": None if noise.markov is None else {"sigma": noise.markov.sigma, "time_s": noise.markov.time_s},
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None
