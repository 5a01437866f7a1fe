"""What a turntable adds to a multi-position calibration: M_g of both, each by its covariance, and whether they agree."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from calibkit.data.observations import ImuSamples, TableRates
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.errors import BadInputError
from calibkit.estimation.imu_intrinsics import ImuCalibration
from calibkit.estimation.imu_trust import Number
from calibkit.estimation.imu_turntable import TurntableGyro, TurntableRun, turntable_gyro
from calibkit.models.imu import ACCEL_PARAMETERS, GYRO_PARAMETERS, ImuModel
from calibkit.solver import trust

Array = NDArray[np.float64]

_M_G = GYRO_PARAMETERS[:6]
_B_G = GYRO_PARAMETERS[9:]
_CHANCE = 1e-3  # that honest estimates differ so much
_LOWER = np.tril_indices(3)


def fit_table(samples: ImuSamples, rates: Sequence[TableRates]) -> TurntableGyro:
    """Return the gyroscope's scale and axes from the samples during each run of the table; BadInputError for a run without any."""
    runs = []
    for k, run in enumerate(rates):
        inside = (samples.t_ns >= run.t_ns[0]) & (samples.t_ns <= run.t_ns[-1])
        if inside.sum() < 10:
            raise BadInputError(f"turntable: the IMU has {inside.sum()} samples in run {k + 1}; its times must be on the IMU's clock")
        origin = run.t_ns[0]
        t, t_rate = ((ns - origin) * 1e-9 for ns in (samples.t_ns[inside], run.t_ns))
        runs.append(TurntableRun(np.asarray(t, np.float64), samples.gyro[inside], np.asarray(t_rate, np.float64), run.rate, run.axis))
    table = turntable_gyro(runs)
    if _relative(np.sqrt(np.diag(table.cov)).max(), table) > trust.WEAK * trust.SCALES[""]:
        raise BadInputError("turntable: its rates are too slow or its runs too short to tell the gyroscope's scale; turn it faster")
    return table


def _relative(sigma: float, table: TurntableGyro) -> float:
    """Return a sigma over the gyroscope's scale."""
    return float(sigma) / (float(np.trace(table.M_g)) / 3)


def _status(sigma: float, table: TurntableGyro) -> Status:
    """Return how well a number is known: 1e-3 of scale, or 1e-3 rad/s of bias; what is not observable was refused before."""
    return Status.DETERMINED if _relative(sigma, table) <= trust.DETERMINED * trust.SCALES[""] else Status.WEAK


def table_alone(table: TurntableGyro, name: str) -> ImuCalibration:
    """Return what a turntable tells by itself: the gyroscope's scale, axes' angles and bias; nothing of the accelerometer."""
    bias = np.array([r.bias for r in table.responses])
    sigma = bias.std(axis=0, ddof=1) / np.sqrt(len(bias)) if len(bias) > 1 else np.full(3, np.inf)
    unknown = Number(None, None, None, Status.NOT_OBSERVABLE)
    parameters = dict.fromkeys((*ACCEL_PARAMETERS, *GYRO_PARAMETERS), unknown)
    for key, value, s in zip(_M_G, table.M_g[_LOWER], np.sqrt(np.diag(table.cov)), strict=True):
        parameters[key] = Number(float(value), float(s), None, _status(float(s), table))
    for key, value, s in zip(_B_G, bias.mean(axis=0), sigma, strict=True):
        parameters[key] = Number(float(value), float(s), None, _status(float(s), table)) if np.isfinite(s) else unknown
    cov = np.zeros((9, 9))
    cov[:6, :6], cov[6:, 6:] = table.cov, np.diag(sigma**2) if np.isfinite(sigma).all() else 0
    names = (*_M_G, *_B_G) if np.isfinite(sigma).all() else _M_G
    text = (
        "the accelerometer, and the gyroscope's turn against it (phi_g_i), are not observable from a turntable: put it down in 12 attitudes"
    )
    n = len(names)
    return ImuCalibration(None, parameters, names, cov[:n, :n], (), (), 0.0, 0.0, 0.0, (), (Reason(Verdict.FAIL, f"{name}: {text}"),))


def with_table(found: ImuCalibration, table: TurntableGyro, name: str) -> ImuCalibration:
    """Return the calibration with the turntable's M_g: x' = x + P H^T (H P H^T + R)^-1 (z - H x), a CHECK where the two disagree."""
    z, R = table.M_g[_LOWER], table.cov
    if not set(_M_G) <= set(found.names):
        keep = [i for i, key in enumerate(found.names) if key not in _M_G]
        names = (*(found.names[i] for i in keep), *_M_G)
        cov = np.zeros((len(names), len(names)))
        cov[:-6, :-6], cov[-6:, -6:] = found.cov[np.ix_(keep, keep)], R
        values = {**{key: found.parameters[key].value for key in names[:-6]}, **dict(zip(_M_G, z.tolist(), strict=True))}
        reasons = found.reasons
    else:
        names, at = found.names, [found.names.index(key) for key in _M_G]
        x, P = np.array([found.parameters[key].value for key in names], np.float64), found.cov
        S = P[np.ix_(at, at)] + R
        difference = z - x[at]
        gain = P[:, at] @ np.linalg.inv(S)
        values = dict(zip(names, (x + gain @ difference).tolist(), strict=True))
        cov = P - gain @ P[at]
        odd = float(difference @ np.linalg.solve(S, difference)) > chi2.isf(_CHANCE, 6)
        worst = float(np.abs(difference / np.trace(table.M_g) * 3).max())
        text = f"turntable and stands disagree on the gyroscope's scale by {worst:.2%}, more than chance: check the table's rates and times"
        reasons = (*found.reasons, Reason(Verdict.CHECK, f"{name}: {text}")) if odd else found.reasons
    sigma = np.sqrt(np.diag(cov))
    parameters = dict(found.parameters)
    for key, s in zip(names, sigma, strict=True):
        before = found.parameters[key]
        status = _status(float(s), table) if key in _M_G else before.status
        parameters[key] = Number(values[key], float(s), None if key in _M_G else before.sigma_plain, status)
    complete = {key: number.value for key, number in parameters.items() if number.value is not None}
    model = ImuModel.of(complete) if len(complete) == len(parameters) else None
    return replace(found, model=model, parameters=parameters, names=tuple(names), cov=cov, reasons=reasons)
