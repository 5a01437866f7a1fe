"""Scale, axes and biases of an IMU that was put down in many attitudes: one joint maximum likelihood, and how far to trust it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.plural import counted
from calibkit.data.progress import Progress, silent
from calibkit.data.verdict import Reason, Verdict, worst
from calibkit.errors import BadInputError, NotConvergedError
from calibkit.estimation.imu_fit import ImuFit, Samples, fit_imu
from calibkit.estimation.imu_trust import Number, numbers_of
from calibkit.estimation.imu_verdict import STILL_START_S, advice_for, reasons_for
from calibkit.estimation.static_intervals import MIN_STANDS, NoStandsError, find_stands
from calibkit.models.imu import ImuModel

Array = NDArray[np.float64]

_FEWEST_SAMPLES = 100


@dataclass(frozen=True)
class StandResult:
    """One stand for the report."""

    start_s: float
    end_s: float
    up: tuple[float, float, float]  # in the IMU's frame, as measured
    misfit: float  # |a| - g, m/s^2
    turn_error: float | None  # rad, of gravity's direction at the end of the turn that led here; None: no such turn
    dropped: str | None  # why; None: used


@dataclass(frozen=True)
class ImuCalibration:
    """What a multi-position recording says of an IMU (models/imu.py has the equations)."""

    model: ImuModel | None  # None where a parameter is not observable
    parameters: dict[str, Number]
    names: tuple[str, ...]  # of the covariance: those with a value
    cov: Array  # corrected
    stands: tuple[StandResult, ...]
    dropped_turns: tuple[tuple[float, float], ...]  # s, begin and end of turns that contradict the others
    multiplier: float  # of the still variance, the threshold that the data chose
    misfit_rms: float  # m/s^2, |a| - g over the stands used
    turn_rms: float  # rad, over the turns used
    advice: tuple[str, ...]
    reasons: tuple[Reason, ...]

    @property
    def verdict(self) -> Verdict:
        return worst(self.reasons)


def calibrate_imu(
    t: Array, gyro: Array, accel: Array, gravity: float, sensitivity: bool = False, name: str = "imu0", progress: Progress = silent
) -> ImuCalibration:
    """Return the calibration of samples at t (n,) s; gyro and accel (n, 3) in SI or in counts; gravity in m/s^2.

    Samples whose stamp does not come after those before are left out. Biases are the means over the stands. Raises BadInputError
    where there are too few stands to begin with, NotConvergedError where no scale and axes fit them.
    """
    try:
        return _calibrate(t, gyro, accel, gravity, sensitivity, name, progress)
    except BadInputError as error:
        raise type(error)(f"{name}: {error}") from None


def _calibrate(t: Array, gyro: Array, accel: Array, gravity: float, sensitivity: bool, name: str, progress: Progress) -> ImuCalibration:
    if not (np.isfinite(t).all() and np.isfinite(gyro).all() and np.isfinite(accel).all()):
        raise BadInputError("holds values that are not finite: remove those samples from the recording")
    for sensor, values in (("gyroscope", gyro), ("accelerometer", accel)):
        for axis, stuck in zip("xyz", np.ptp(values, axis=0) == 0 if len(values) else (), strict=False):
            if stuck:
                raise BadInputError(f"{sensor} {axis} never changes: the axis is dead, or the driver does not fill it")
    later = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]])[: len(t)]
    if np.count_nonzero(later) < _FEWEST_SAMPLES:
        found = counted(int(np.count_nonzero(later)), "sample")
        raise BadInputError(f"{found} with stamps that increase are no recording: put the IMU down, still, in 12 or more attitudes")
    samples = Samples(t[later] - t[0], gyro[later], accel[later], gravity)
    stands = find_stands(samples.t, samples.gyro, samples.accel, gravity)
    if len(stands) < MIN_STANDS:
        found = f"{counted(len(stands), 'still stand')} in {samples.t[-1]:.0f} s"
        raise NoStandsError(f"only {found}; begin with {STILL_START_S:.0f} s or more at rest, then 12 attitudes, each for 3 s")
    return _result(fit_imu(samples, stands, sensitivity, progress), gravity, name)


def _result(fit: ImuFit, gravity: float, name: str) -> ImuCalibration:
    numbers = numbers_of(fit, gravity)
    all_known = len(numbers.names) == len(numbers.parameters)
    if all_known and not fit.converged:
        raise NotConvergedError(f"{name}: no scale and axes fit its stands and turns; are gyroscope and accelerometer one device's?")
    model = ImuModel.of(numbers.values)
    stands, misfit, turn = _stands(fit, model, gravity)
    advice = advice_for(fit, numbers.parameters)
    return ImuCalibration(
        model=model if all_known else None,
        parameters=numbers.parameters,
        names=numbers.names,
        cov=numbers.cov,
        stands=stands,
        dropped_turns=tuple((float(fit.stands.end_s[a]), float(fit.stands.start_s[b])) for a, b in fit.dropped_turns),
        multiplier=fit.stands.multiplier,
        misfit_rms=misfit,
        turn_rms=turn,
        advice=advice,
        reasons=tuple(reasons_for(fit, numbers.parameters, advice, misfit, gravity, name)),
    )


def _stands(fit: ImuFit, model: ImuModel, gravity: float) -> tuple[tuple[StandResult, ...], float, float]:
    a, _ = model.correct(fit.stands.accel, fit.stands.gyro)
    length = np.linalg.norm(a, axis=1)
    rows = fit.problem.rows(fit.state)
    used = np.flatnonzero(fit.used)
    turn = dict(zip(used[fit.problem.end].tolist(), np.linalg.norm(rows.turn, axis=1).tolist(), strict=True))
    out = [
        StandResult(
            float(fit.stands.start_s[i]), float(fit.stands.end_s[i]), tuple((a[i] / length[i]).tolist()), float(length[i] - gravity),
            turn.get(i), fit.why.get(i),
        )
        for i in range(len(a))
    ]  # fmt: skip
    misfit = float(np.sqrt(np.mean((length[used] - gravity) ** 2)))
    return tuple(out), misfit, float(np.sqrt(np.mean(np.square(list(turn.values()))))) if turn else 0.0
