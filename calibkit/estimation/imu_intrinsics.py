"""Scale, axes and biases of an IMU that was put down in many attitudes: one joint maximum likelihood, and how far to trust it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.plural import counted
from calibkit.data.verdict import Reason, Status, Verdict, worst
from calibkit.errors import BadInputError, NotConvergedError
from calibkit.estimation.imu_advice import NEEDED_POSITIONS, positions, positions_to_add, turns_missing, what_is_missing
from calibkit.estimation.imu_fit import Guess, ImuFit, Samples, fit_imu
from calibkit.estimation.static_intervals import MIN_STANDS, find_stands
from calibkit.geometry import so3
from calibkit.models.imu import ACCEL_PARAMETERS, PARAMETERS, SENSITIVITY_PARAMETERS, ImuModel, lower
from calibkit.solver import trust

Array = NDArray[np.float64]

STILL_START_S = 10.0
_KNOWN_RATE = 1e-3  # rad/s: what the gyroscope's bias must be known to
_STEP = 1e-6
_LARGE_MISFIT = 2e-3  # of gravity
_MANY_DROPPED = 0.1
_MIRRORED = "the gyroscope's axes are a mirror image of the accelerometer's: one axis of one of them has the wrong sign"


@dataclass(frozen=True)
class Number:
    """One parameter; none that is not observable has a value."""

    value: float | None
    sigma: float | None
    sigma_plain: float | None
    status: Status


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


def calibrate_imu(t: Array, gyro: Array, accel: Array, gravity: float, sensitivity: bool = False, name: str = "imu0") -> ImuCalibration:
    """Return the calibration of samples at t (n,) s; gyro and accel (n, 3) in SI or in counts; gravity in m/s^2.

    Biases are the means over the stands. Raises BadInputError where there are too few stands to begin with.
    """
    order = np.concatenate([[True], np.diff(t) > 0])
    samples = Samples(t[order] - t[0], gyro[order], accel[order], gravity)
    if len(samples.t) < 100:
        raise BadInputError(
            f"{name}: {counted(len(samples.t), 'sample')} are no recording: put the IMU down, still, in 12 or more attitudes"
        )
    try:
        stands = find_stands(samples.t, samples.gyro, samples.accel, gravity)
    except BadInputError as error:
        raise BadInputError(f"{name}: {error}") from None
    if len(stands) < MIN_STANDS:
        found = f"{counted(len(stands), 'still stand')} in {samples.t[-1]:.0f} s"
        raise BadInputError(f"{name}: only {found}; begin with {STILL_START_S:.0f} s or more at rest, then 12 attitudes, each for 3 s")
    fit = fit_imu(samples, stands, sensitivity)
    return _judge(fit, samples, name)


def parameters_of(guess: Guess, theta: Array, gravity: float) -> dict[str, float]:
    """Return the model's parameters: M_a = M_a0 (I + D), b_a = b_a0 + M_a0 d; M_g C_g_i = G = K^-1 (I + E)^-1, b_g = b_g0 + G k."""
    M_a = guess.M_a @ (np.eye(3) + lower(theta[:6]))
    b_a = guess.b_a + guess.M_a @ theta[6:9]
    G = np.linalg.inv((np.eye(3) + theta[9:18].reshape(3, 3)) @ guess.K)
    Q, R = np.linalg.qr(G.T)
    sign = np.where(np.diag(R) < 0, -1.0, 1.0)
    M_g, C = (R * sign[:, None]).T, (Q * sign).T
    if np.linalg.det(C) < 0:
        raise BadInputError(_MIRRORED)
    A_g = G @ theta[21:].reshape(3, 3) @ C.T / gravity if len(theta) > 21 else np.zeros((3, 3))
    return ImuModel(M_a, b_a, M_g, C, guess.b_g + G @ theta[18:21], A_g).values()


def _covariance(fit: ImuFit) -> trust.Covariance:
    """Return the covariance of theta: each stand, with the turn and the walk that follow it, is a block with a score.

    The nuisances are projected out of the whitened Jacobian, J~ = (I - P) J, so that S = sum_b J~_b^T J~_b. No sigma comes out below
    the plain one: the weights are already what the residuals themselves say.
    """
    p, x = fit.problem, fit.state
    r, J = p.whitened(x)
    nuisance, own = J[:, : p.core_size], J[:, p.core_size :]
    scale = np.linalg.norm(nuisance, axis=0)
    normal = (nuisance / scale).T @ (nuisance / scale)
    left = own - nuisance / scale @ np.linalg.solve(normal, (nuisance / scale).T @ own)
    n = p.stands
    steps = np.tile(np.arange(n - 1), 2)
    block = np.repeat(np.concatenate([np.arange(n), np.arange(n), p.start, steps]), 3)
    S, scores = np.zeros((n, p.size, p.size)), np.zeros((n, p.size))
    np.add.at(S, block, left[:, :, None] * left[:, None, :])
    np.add.at(scores, block, left * r[:, None])
    freedom = max(6 * n + 2 * len(p.start) - 2 * n - p.size, 1)
    return trust.covariance(S, scores, float(r @ r) / freedom, np.full(p.size, 1e-3), least=1.0)


def _scales(values: dict[str, float], names: tuple[str, ...], gravity: float) -> Array:
    """Return what each parameter must be known to: 1e-3 of scale, 1 mrad, 1e-3 of gravity, 1e-3 rad/s."""
    accel = np.mean([values[f"M_a_{k}"] for k in ("xx", "yy", "zz")])
    gyro = np.mean([values[f"M_g_{k}"] for k in ("xx", "yy", "zz")])
    of = {
        "M_a": trust.SCALES[""] * accel,
        "b_a": trust.SCALES[""] * gravity * accel,
        "M_g": trust.SCALES[""] * gyro,
        "phi": trust.SCALES["rad"],
        "b_g": _KNOWN_RATE * gyro,
        "A_g": _KNOWN_RATE * gyro / gravity,
    }
    return np.array([of[name[:3]] for name in names])


def _jacobian(fit: ImuFit, names: tuple[str, ...], gravity: float) -> Array:
    """Return d parameters / d theta (k, p) by central differences of a smooth map; rotations through the tangent at the estimate."""
    values = parameters_of(fit.guess, fit.state.theta, gravity)
    phi = np.array([values[f"phi_g_i_{a}"] for a in "xyz"])
    C, to_phi = so3.exp(phi), np.linalg.inv(so3.right_jacobian(phi))
    at_phi = [names.index(f"phi_g_i_{a}") for a in "xyz"]

    def moved(theta: Array) -> Array:
        now = parameters_of(fit.guess, theta, gravity)
        out = np.array([now[name] for name in names])
        now_phi = np.array([now[f"phi_g_i_{a}"] for a in "xyz"])
        out[at_phi] = to_phi @ so3.log(C.T @ so3.exp(now_phi))
        return out

    steps = _STEP * np.eye(len(fit.state.theta))
    return np.stack([(moved(fit.state.theta + d) - moved(fit.state.theta - d)) / (2 * _STEP) for d in steps], axis=1)


def _judge(fit: ImuFit, samples: Samples, name: str) -> ImuCalibration:
    names = PARAMETERS if fit.problem.size > 21 else tuple(n for n in PARAMETERS if n not in SENSITIVITY_PARAMETERS)
    values = parameters_of(fit.guess, fit.state.theta, samples.gravity)
    found = _covariance(fit)
    T = _jacobian(fit, names, samples.gravity)
    cov, plain = T @ found.corrected @ T.T, T @ found.plain @ T.T
    sigma = np.sqrt(np.diag(cov))
    statuses = [Status(trust.grade(float(s))) for s in sigma / _scales(values, names, samples.gravity)]
    known = [i for i, status in enumerate(statuses) if status is not Status.NOT_OBSERVABLE]
    if not fit.converged and len(known) == len(names):
        raise NotConvergedError(f"{name}: no scale and axes fit its stands and turns; are gyroscope and accelerometer one device's?")
    parameters = {
        n: Number(values[n], float(sigma[i]), float(np.sqrt(plain[i, i])), statuses[i])
        if i in known
        else Number(None, None, None, Status.NOT_OBSERVABLE)
        for i, n in enumerate(names)
    }
    stands, misfit, turn = _stands(fit, ImuModel.of(values), samples.gravity)
    advice = _advice(fit, parameters)
    return ImuCalibration(
        model=ImuModel.of(values) if len(known) == len(names) else None,
        parameters=parameters,
        names=tuple(names[i] for i in known),
        cov=cov[np.ix_(known, known)],
        stands=stands,
        dropped_turns=tuple((float(fit.stands.end_s[a]), float(fit.stands.start_s[b])) for a, b in fit.dropped_turns),
        multiplier=fit.stands.multiplier,
        misfit_rms=misfit,
        turn_rms=turn,
        advice=advice,
        reasons=tuple(_reasons(fit, parameters, advice, misfit, samples.gravity, name)),
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


def _advice(fit: ImuFit, parameters: dict[str, Number]) -> tuple[str, ...]:
    out = []
    bad = {n for n, number in parameters.items() if number.status is not Status.DETERMINED}
    up = fit.state.up
    if bad & set(ACCEL_PARAMETERS) or len(positions(up)) < NEEDED_POSITIONS:
        add = positions_to_add(up)
        if add:
            out.append(f"{len(add)} more positions: " + "; ".join(add) if len(add) > 1 else f"1 more position: {add[0]}")
    if bad - set(ACCEL_PARAMETERS):
        missing = turns_missing(_turns(fit))
        out.append(
            "turn it by 90 to 180 deg between stands, about each of its axes held level" + (f": {'; '.join(missing)}" if missing else "")
        )
    return tuple(out)


def _turns(fit: ImuFit) -> Array:
    """Return how far each turn went about each axis (m, 3) rad, along the way that gravity can tell."""
    p = fit.problem
    rate = p.turns.rate[:, :3] * p.turns.dt[:, None]
    return np.add.reduceat(rate, p.turns.offset, axis=0) if len(rate) else np.zeros((0, 3))


def spoken(parameter: str) -> str:
    """Return a parameter in words: "z scale of the accelerometer (M_a_zz)"."""
    kind, sensor = parameter[0], "accelerometer" if parameter[2] == "a" else "gyroscope"
    axes = parameter.rsplit("_", 1)[1]
    if kind == "M":
        words = f"{axes[0]} scale" if axes[0] == axes[1] else f"angle between {axes[1]} and {axes[0]} axis"
    else:
        words = {"b": f"{axes} bias", "p": f"rotation about {axes}", "A": f"sensitivity {axes} to acceleration"}[kind]
    return f"{words} of the {sensor} ({parameter})"


def _listed(bad: list[str]) -> str:
    if len(bad) <= 3:
        return ", ".join(spoken(n) for n in bad)
    sensor = "accelerometer" if bad[0] in ACCEL_PARAMETERS else "gyroscope"
    return f"{len(bad)} numbers of the {sensor} ({', '.join(bad)})"


def _too_few(fit: ImuFit, of_accel: bool) -> str:
    if of_accel:
        return f"{fit.problem.stands} stands are too few for errors as large as theirs"
    return f"{counted(len(fit.problem.start), 'turn')} between stands are too few, each tells two numbers"


def _reasons(fit: ImuFit, parameters: dict[str, Number], advice: tuple[str, ...], misfit: float, gravity: float, name: str) -> list[Reason]:
    why = what_is_missing(fit.state.up)
    remedy = f"; add {advice[0]}" if advice else ""
    reasons: list[Reason] = []
    for status, verdict in ((Status.NOT_OBSERVABLE, Verdict.FAIL), (Status.WEAK, Verdict.CHECK)):
        for of_accel in (True, False):
            bad = [n for n, number in parameters.items() if number.status is status and (n in ACCEL_PARAMETERS) == of_accel]
            if not bad:
                continue
            cause = "; ".join(why if of_accel else turns_missing(_turns(fit))) or _too_few(fit, of_accel)
            verb = "is" if len(bad) == 1 else "are"
            reasons.append(Reason(verdict, f"{name}: {_listed(bad)} {verb} {status.value}: {cause}{'' if reasons else remedy}"))
    if len(positions(fit.state.up)) < NEEDED_POSITIONS and not reasons:
        reasons.append(Reason(Verdict.CHECK, f"{name}: {why[-1]}{remedy}"))
    first = fit.stands
    still = float(first.end_s[0] - first.start_s[0]) if first.start_s[0] < 1.0 else 0.0
    if still < STILL_START_S:
        text = f"the gyroscope does not begin with {STILL_START_S:.0f} s at rest (but {still:.0f} s): its bias is the stands' alone"
        reasons.append(Reason(Verdict.CHECK, f"{name}: {text}"))
    if len(fit.why) > _MANY_DROPPED * len(first):
        reasons.append(Reason(Verdict.CHECK, f"{name}: {len(fit.why)} of {len(first)} stands contradict the others and were left out"))
    if misfit > _LARGE_MISFIT * gravity:
        text = f"|a| at rest errs by {misfit:.3f} m/s^2 rms: the scale is not constant, or the IMU was not still"
        reasons.append(Reason(Verdict.CHECK, f"{name}: {text}"))
    return reasons
