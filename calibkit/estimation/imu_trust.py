"""How far an IMU's fitted numbers may be trusted: from the problem's unknowns to the model's parameters, with covariance and status."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.imu_fit import Guess, ImuFit
from calibkit.geometry import so3
from calibkit.models.imu import PARAMETERS, SENSITIVITY_PARAMETERS, ImuModel, lower
from calibkit.solver import trust

Array = NDArray[np.float64]

_KNOWN_RATE = 1e-3  # rad/s: what the gyroscope's bias must be known to
_STEP = 1e-6
_MIRRORED = "the gyroscope's axes are a mirror image of the accelerometer's: one axis of one of them has the wrong sign"


@dataclass(frozen=True)
class Number:
    """One parameter; none that is not observable has a value."""

    value: float | None
    sigma: float | None
    sigma_plain: float | None
    status: Status


@dataclass(frozen=True)
class Numbers:
    """All parameters of one fit."""

    values: dict[str, float]  # of all, also of those that are not observable: for residuals only
    parameters: dict[str, Number]
    names: tuple[str, ...]  # of the covariance: those with a value
    cov: Array  # corrected


def numbers_of(fit: ImuFit, gravity: float) -> Numbers:
    """Return the parameters with sigma and status; those that are not observable have no value."""
    names = PARAMETERS if fit.problem.size > 21 else tuple(n for n in PARAMETERS if n not in SENSITIVITY_PARAMETERS)
    values = parameters_of(fit.guess, fit.state.theta, gravity)
    found = _covariance(fit)
    T = _jacobian(fit, names, gravity)
    cov, plain = T @ found.corrected @ T.T, T @ found.plain @ T.T
    sigma, sigma_plain = np.sqrt(np.diag(cov)), np.sqrt(np.diag(plain))
    parameters = {}
    for i, (n, scale) in enumerate(zip(names, _scales(values, names, gravity), strict=True)):
        status = Status(trust.grade(float(sigma[i] / scale)))
        known = status is not Status.NOT_OBSERVABLE
        parameters[n] = Number(values[n], float(sigma[i]), float(sigma_plain[i]), status) if known else Number(None, None, None, status)
    if any(parameters[f"M_a_{k}"].value is None for k in ("xx", "yy", "zz")):
        # The gyroscope's axes are told by gravity's direction as the accelerometer has it: with one axis of that open, a wrong minimum is
        # as good as the right one (seen: phi_z 143 sigma off where up stayed within 5 deg of z)
        unknown = Number(None, None, None, Status.NOT_OBSERVABLE)
        parameters |= {n: unknown for n in names if n.startswith(("M_g", "phi"))}
    known_at = [i for i, n in enumerate(names) if parameters[n].value is not None]
    return Numbers(values, parameters, tuple(names[i] for i in known_at), cov[np.ix_(known_at, known_at)])


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
    C, to_phi = so3.exp(phi), so3.right_jacobian_inverse(phi)
    at_phi = [names.index(f"phi_g_i_{a}") for a in "xyz"]

    def moved(theta: Array) -> Array:
        now = parameters_of(fit.guess, theta, gravity)
        out = np.array([now[name] for name in names])
        now_phi = np.array([now[f"phi_g_i_{a}"] for a in "xyz"])
        out[at_phi] = to_phi @ so3.log(C.T @ so3.exp(now_phi))
        return out

    steps = _STEP * np.eye(len(fit.state.theta))
    return np.stack([(moved(fit.state.theta + d) - moved(fit.state.theta - d)) / (2 * _STEP) for d in steps], axis=1)
