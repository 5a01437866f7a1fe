"""How large a recording's errors are beyond white noise: restricted maximum likelihood (Patterson and Thompson 1971)."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from calibkit.estimation.imu_problem import StandProblem, State, Weights

Array = NDArray[np.float64]

# m/s^2, rad/s, rad/sqrt(rad), m/s^2/sqrt(s), rad/s/sqrt(s): below the first nothing is lost, above the second nothing is an IMU.
_LEAST = np.array([1e-5, 1e-7, 1e-5, 1e-6, 1e-8])
# What a sound device shows, worth one observation each: with few stands, residuals of nothing are no proof of no errors.
USUAL = Weights(misfit=3e-4, wobble=3e-5, turn=3e-4, walk_accel=1e-5, walk_gyro=1e-7)
_MOST = np.array([1.0, 0.1, 0.3, 0.1, 0.01])


def find_weights(problem: StandProblem, x: State) -> Weights:
    """Return the weights that maximise the likelihood of the residuals at x, the parameters and the attitudes integrated out.

    -2 log L = sum log sigma^2 + log det(J^T W J) + min r^T W r; its derivative by the log of a variance component is
    sum q (1 - h) - q r^2, h the row's leverage and q the component's share of its variance. Each has one more observation, USUAL.
    A robust problem's rows count by their robust weights at x.
    """
    rows = problem.rows(x)
    w = np.sqrt(problem.robust_weights(problem.whiten(rows, x)[0])[1])

    def objective(log_variance: Array) -> tuple[float, Array]:
        trial = problem.weighted(Weights(*np.exp(0.5 * log_variance)))
        r, J = trial.whiten(rows, x)
        r, J = r * w, J * w[:, None]
        normal = J.T @ J + np.diag(np.concatenate([np.zeros(problem.core_size), 1 / problem.prior**2]))
        scale = 1 / np.sqrt(np.diag(normal))
        root = cholesky(normal * scale[:, None] * scale, lower=True)
        inverse = dpotri(root, lower=1)[0]
        inverse = scale[:, None] * (np.tril(inverse) + np.tril(inverse, -1).T) * scale
        left = r - J @ (inverse @ (J.T @ r))
        logdet = 2 * np.sum(np.log(np.diag(root))) - 2 * np.sum(np.log(scale))
        usual = np.exp(usual_log - log_variance)
        value = float(_log_variances(trial) + logdet + r @ left + np.sum(log_variance + usual))
        return value, _gradient(trial, left, J, inverse) + 1 - usual

    usual_log = 2 * np.log(list(vars(USUAL).values()))
    start = 2 * np.log(np.clip(np.array(list(vars(problem.weights).values())), 2 * _LEAST, _MOST / 2))
    bounds = list(zip(2 * np.log(_LEAST), 2 * np.log(_MOST), strict=True))
    found = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 25, "ftol": 1e-5})
    return Weights(*np.exp(0.5 * found.x).tolist())


def _log_variances(problem: StandProblem) -> float:
    w, n = problem.weights, problem.stands
    stands = sum(np.linalg.slogdet(cov + s**2 * np.eye(3))[1].sum() for cov, s in _stand_variances(problem))
    turns = 2 * 2 * np.log(problem.turn_sigma()).sum()  # three rows, of which the one along up says nothing
    return float(stands + turns + 3 * (n - 1) * 2 * (np.log(w.walk_accel) + np.log(w.walk_gyro)))


def _stand_variances(problem: StandProblem) -> tuple[tuple[Array, float], tuple[Array, float]]:
    return (problem.cov_accel, problem.weights.misfit), (problem.cov_gyro, problem.weights.wobble)


def _gradient(problem: StandProblem, left: Array, J: Array, inverse: Array) -> Array:
    n, m, w = problem.stands, len(problem.start), problem.weights
    turn, walk = 6 * n, 6 * n + 3 * m
    spread = J[:walk] @ inverse
    stands = []
    for part, (cov, s) in enumerate(_stand_variances(problem)):
        root = np.linalg.inv(np.linalg.cholesky(cov + s**2 * np.eye(3)))
        share = s**2 * root @ np.swapaxes(root, 1, 2)
        at = slice(3 * n * part, 3 * n * (part + 1))
        leverage = J[at].reshape(n, 3, -1) @ np.swapaxes(spread[at].reshape(n, 3, -1), 1, 2)
        r = left[at].reshape(n, 3)
        stands.append(float(np.sum(share * (np.eye(3) - leverage)) - np.einsum("ni,nij,nj->", r, share, r)))
    # A walk's row touches one step alone.
    step = np.arange(2 * n, problem.core_size)
    h_turn = np.einsum("rq,rq->r", J[turn:walk], spread[turn:])
    h_walk = J[walk + step - 2 * n, step] ** 2 * inverse[step, step]
    share_turn = np.repeat(w.turn**2 * problem.angle / problem.turn_sigma() ** 2, 3)
    turning = 2 * np.sum(share_turn) / 3 - np.sum(share_turn * (h_turn + left[turn:walk] ** 2))
    steps = (1 - h_walk - left[walk:] ** 2).reshape(2, -1).sum(axis=1)
    return np.array([*stands, turning, *steps])
