"""An IMU's scale, axes and sensitivity beside the trajectory: from the rig file into the fit, and back."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibkit.data.observations import ImuSamples, ImuUnit
from calibkit.data.rig import Covariance, Estimate, Imu, ImuIntrinsics
from calibkit.data.transforms import make_covariance
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.joint_fit import JointFit
from calibkit.estimation.joint_state import A_G, IMU_MODEL, M_A, M_G, PHI, biases
from calibkit.estimation.joint_trust import BIAS_SCALES, EXTRA_SCALES, Trust
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array
from calibkit.models.imu import CORRECTION, EQUATION, PARAMETERS, SENSITIVITY_PARAMETERS, UNITS, ImuModel
from calibkit.solver.trust import grade

_LOOSE = 100.0  # times what it must be known to: a tenth of a scale, 0.1 rad
_BIAS_PARAMETERS = tuple(f"{b}_{axis}" for b in ("b_g", "b_a") for axis in "xyz")  # as they stand on a knot


@dataclass(frozen=True)
class NamedImu:
    """An IMU by its name, with what entered the fit."""

    name: str
    input: "ImuInput"
    before: Imu | None = None  # the rig file's entry


@dataclass(frozen=True)
class ImuInput:
    """Samples as the fit has them, less the known biases and over one gain a sensor: raw counts become SI; and what is known of them."""

    samples: ImuSamples
    model: ImuModel = field(default_factory=ImuModel)  # of these samples
    extras: tuple[str, ...] = ()  # what is free of it, of joint_state.IMU_MODEL
    information: Array | None = None  # about that, where the rig file has it
    gains: tuple[float, float] = (1.0, 1.0)  # accelerometer, gyroscope: what was measured over these samples
    known: ImuModel = field(default_factory=ImuModel)  # of what was measured
    unit: ImuUnit = "SI"  # of what was measured
    given: bool = False  # the rig file has it without a covariance, and it is held

    @property
    def factors(self) -> Array:
        """Return what was measured over these samples for each free parameter of the model, and for the biases of a knot."""
        accel, gyro = self.gains
        of = {M_A: accel, M_G: gyro, PHI: 1.0, A_G: gyro}
        return np.array([*(of[each] for each in self.extras for _ in IMU_MODEL[each]), *np.repeat([gyro, accel], 3)])


def imu_input(name: str, samples: ImuSamples, known: ImuIntrinsics | None, asked: Sequence[str]) -> ImuInput:
    """Return what enters the fit: what is `asked` for is free, the rest as the rig file has it, with its covariance.

    BadInputError where the rig file's intrinsics are incomplete or of another unit.
    """
    asked = tuple(each for each in IMU_MODEL if each in asked)  # in that order
    if known is None or not (samples.has_gyro and samples.has_accel):
        return _with_priors(ImuInput(samples, extras=asked), None)
    values = {key: value.value for key, value in known.parameters.items() if value.value is not None}
    if missing := sorted(known.parameters.keys() - values.keys()):
        raise BadInputError(
            f"{name}: {', '.join(missing)} of its intrinsics are not known: leave them out of the rig file, or calibrate it"
        )
    if samples.unit != known.unit:
        raise BadInputError(f"{name}: its samples are in {samples.unit}, its intrinsics in the rig file for {known.unit}")
    model = ImuModel.of(values)
    gains = (1.0, 1.0) if known.unit == "SI" else (float(np.diag(model.M_a).mean()), float(np.diag(model.M_g).mean()))
    if min(gains) <= 0:
        raise BadInputError(f"{name}: its intrinsics in the rig file have a negative scale")
    nominal = replace(samples, accel=(samples.accel - model.b_a) / gains[0], gyro=(samples.gyro - model.b_g) / gains[1], unit="SI")
    own = ImuModel(M_a=model.M_a / gains[0], M_g=model.M_g / gains[1], C_g_i=model.C_g_i, A_g=model.A_g / gains[1])
    given = known.covariance is None and not {M_A, M_G, PHI} <= set(asked)
    out = ImuInput(nominal, own, asked, None, gains, model, known.unit, given)
    return _with_priors(out, known.covariance)


def _with_priors(imu: ImuInput, covariance: Covariance | None) -> ImuInput:
    """Return the input with what is known of its model: by the covariance, whatever biases it goes with, where it was not asked for.

    What was asked for is an IMU's, a tenth about where it starts: not more than makes it observable, and it keeps to sense where it is not.
    """
    order = [] if covariance is None else covariance.order
    known = [each for each in IMU_MODEL if each not in imu.extras and set(IMU_MODEL[each]) <= set(order)]
    out = replace(imu, extras=tuple(each for each in IMU_MODEL if each in known or each in imu.extras))
    names, to_rig = _in_the_rig_file(out, imu.model)
    information = np.diag([(_LOOSE * EXTRA_SCALES[each]) ** -2 for each in out.extras for _ in IMU_MODEL[each]])
    if covariance is not None and known:
        carried = np.flatnonzero([any(name in IMU_MODEL[each] for each in known) for name in names])
        at = [order.index(names[k]) for k in carried]
        into = np.linalg.inv(to_rig[np.ix_(carried, carried)])
        cov = into @ np.array(covariance.matrix)[np.ix_(at, at)] @ into.T
        information[np.ix_(carried, carried)] = np.linalg.pinv(cov, hermitian=True)
    return replace(out, information=information if out.extras else None)


def intrinsics_of(fit: JointFit, trust: Trust, imu: ImuInput, gravity: float, j: int = 0) -> ImuIntrinsics:
    """Return the rig file's entry of IMU j: the model as found and the mean of the biases, with their joint covariance."""
    names, to_rig = _in_the_rig_file(imu, fit.x.imus[j].model)
    cov, plain = (to_rig @ _with_biases(fit, each, j) @ to_rig.T for each in (trust.cov, trust.covariance.plain))
    scales = np.concatenate([trust.scales[fit.problem.border.of_model(j)], np.repeat(BIAS_SCALES, 3)]) * imu.factors
    statuses = [Status(grade(float(s))) for s in np.sqrt(np.diag(cov)) / scales]
    values = _measured(fit, imu, j).values()
    parameters = {}
    for key in PARAMETERS:
        of = UNITS[imu.unit][key[:3]]
        if key in names:
            k = names.index(key)
            known = statuses[k] is not Status.NOT_OBSERVABLE
            sigma, sigma_plain = (float(np.sqrt(each[k, k])) if known else None for each in (cov, plain))
            value = values[key] if known else None
            parameters[key] = Estimate(value=value, unit=of, sigma=sigma, sigma_plain=sigma_plain, status=statuses[k])
        elif key not in SENSITIVITY_PARAMETERS or np.any(imu.known.A_g):
            parameters[key] = Estimate(value=values[key], unit=of)
    order = [key for key in PARAMETERS if key in names and parameters[key].value is not None]
    at = [names.index(key) for key in order]
    covariance = make_covariance(order, cov[np.ix_(at, at)])
    return ImuIntrinsics(
        equation=EQUATION, correction=CORRECTION, unit=imu.unit, gravity=gravity, parameters=parameters, covariance=covariance
    )


def _measured(fit: JointFit, imu: ImuInput, j: int) -> ImuModel:
    """Return the model of what was measured."""
    x, (accel, gyro) = fit.x.imus[j].model, imu.gains
    bias = fit.x.imus[j].bias[: fit.problem.knots.segments].mean(axis=0)
    return ImuModel(x.M_a * accel, imu.known.b_a + bias[3:] * accel, x.M_g * gyro, x.C_g_i, imu.known.b_g + bias[:3] * gyro, x.A_g * gyro)


def _in_the_rig_file(imu: ImuInput, model: ImuModel) -> tuple[list[str], Array]:
    """Return the names of what is free, biases last, and d (their values) / d (the fit's steps): gains, and phi as a rotation vector."""
    names = [*(key for each in imu.extras for key in IMU_MODEL[each]), *_BIAS_PARAMETERS]
    to_rig = np.diag(imu.factors)
    if PHI in imu.extras:
        phi = slice(k := names.index(IMU_MODEL[PHI][0]), k + 3)
        to_rig[phi, phi] = so3.right_jacobian_inverse(so3.log(model.C_g_i))
    return names, to_rig


def _with_biases(fit: JointFit, cov: Array, j: int) -> Array:
    """Return the covariance of IMU j's model and of the mean bias b = L^T x: cov(b, c) = -L^T A^-1 B cov(c), and its own."""
    core, segments, at = fit.system.core, fit.problem.knots.segments, fit.problem.border.of_model(j)
    L = np.zeros((fit.problem.knots.controls, fit.problem.border.knot, 6))
    L[:segments, biases(j)] = np.eye(6) / segments
    flat = L.reshape(-1, 6)
    answer = flat.T @ fit.drawn.core_answer
    own = flat.T @ core.solve(L).reshape(-1, 6) + answer @ cov @ answer.T
    cross = -answer @ cov[:, at]
    out: Array = np.block([[cov[np.ix_(at, at)], cross.T], [cross, own]])
    return out
