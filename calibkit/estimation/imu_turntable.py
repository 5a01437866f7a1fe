"""A gyroscope's scale and axes from a turntable's known rates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.errors import BadInputError
from calibkit.models.imu import lower

Array = NDArray[np.float64]

_BLOCK_S = 1.0  # residuals farther apart are taken for independent
_LEAST_S = 10.0  # of a run: a sigma from fewer blocks is too small, from one it is 0
_STEP = 1e-6
_RANK = 1e-3  # smallest singular value over the largest, of what the axes span
_ROWS, _COLUMNS = np.tril_indices(3)


@dataclass(frozen=True)
class TurntableRun:
    """One mounting on the table."""

    t: Array  # (n,) s
    gyro: Array  # (n, 3) measured
    t_rate: Array  # (k,) s, on the same clock
    rate: Array  # (k,) rad/s about the table's axis
    axis: Array | None = None  # (3,) the table's axis in the IMU's frame, where it is known


@dataclass(frozen=True)
class Response:
    """gyro = bias + response rate in one run."""

    response: Array  # (3,) measured unit per rad/s
    bias: Array  # (3,)
    cov: Array  # (3, 3) of the response


@dataclass(frozen=True)
class TurntableGyro:
    """w_meas = M_g C_g_i w_i + b_g."""

    M_g: Array  # (3, 3)
    cov: Array  # (6, 6) of M_g's lower triangle, row by row
    C_g_i: Array | None  # None where the axes were not known
    responses: tuple[Response, ...]


def response(run: TurntableRun) -> Response:
    """Return the response to the known rate, by least squares; its covariance from blocks of a second."""
    inside = (run.t >= run.t_rate[0]) & (run.t <= run.t_rate[-1])
    t, gyro = run.t[inside], run.gyro[inside]
    if len(t) < 10 or t[-1] - t[0] < 0.95 * _LEAST_S:
        raise BadInputError(f"turntable: a run lasts {np.ptp(t) if len(t) else 0:.2g} s; let each last {_LEAST_S:.0f} s or more")
    rate = np.interp(t, run.t_rate, run.rate)
    if np.ptp(rate) == 0:
        raise BadInputError("turntable: its rate never changes, so scale and bias cannot be told apart; use two rates or more")
    J = np.column_stack([rate, np.ones(len(t))])
    inverse = np.linalg.inv(J.T @ J)
    x = inverse @ J.T @ gyro
    block = np.unique(np.floor((t - t[0]) / _BLOCK_S), return_inverse=True)[1]
    scores = np.zeros((int(block.max()) + 1, 3))
    np.add.at(scores, block, (gyro - J @ x) * (J @ inverse[:, 0])[:, None])
    return Response(x[0], x[1], scores.T @ scores * len(scores) / max(len(scores) - 2, 1))


def turntable_gyro(runs: Sequence[TurntableRun]) -> TurntableGyro:
    """Return M_g from the responses s = M_g C_g_i n to rates about unit axes n.

    Known axes: s n^T of three or more that span space. Unknown ones: s^T (M_g M_g^T)^-1 s = 1 of six or more mountings, each in another
    direction (|n| = 1 is all that is asked of them), which leaves C_g_i open.
    """
    found = tuple(response(run) for run in runs)
    axes = [run.axis for run in runs if run.axis is not None]
    S = np.array([r.response for r in found])
    cov = np.zeros((len(found), 3, 3)) + [r.cov for r in found]
    if len(axes) == len(runs):
        return _known(S, cov, np.array(axes), found)
    return _unknown(S, cov, found)


def _known(S: Array, cov: Array, axes: Array, found: tuple[Response, ...]) -> TurntableGyro:
    n = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    singular = np.linalg.svd(n, compute_uv=False)
    if len(n) < 3 or singular[2] < _RANK * singular[0]:
        raise BadInputError("turntable: known axes in three directions are needed, not in one plane")
    back = np.linalg.pinv(n)  # (3, k): G^T = back S
    G = (back @ S).T
    cov_G = np.einsum("ik,kab,jk->aibj", back, cov, back).reshape(9, 9)
    M, C = _split(G)
    J = _numeric(lambda g: _split(g.reshape(3, 3))[0][_ROWS, _COLUMNS], G.ravel())
    return TurntableGyro(M, J @ cov_G @ J.T, C, found)


def _split(G: Array) -> tuple[Array, Array]:
    """Return M lower triangular with a positive diagonal and the rotation C of G = M C."""
    Q, R = np.linalg.qr(G.T)
    sign = np.where(np.diag(R) < 0, -1.0, 1.0)
    return (R * sign[:, None]).T, (Q * sign).T


def _unknown(S: Array, cov: Array, found: tuple[Response, ...]) -> TurntableGyro:
    scale = float(np.mean(np.linalg.norm(S, axis=1)))
    s = S / scale
    twice = np.where(_ROWS == _COLUMNS, 1.0, 2.0)
    J = twice * s[:, _ROWS] * s[:, _COLUMNS]
    singular = np.linalg.svd(J, compute_uv=False)
    if len(s) < 6 or singular[-1] < _RANK * singular[0]:
        raise BadInputError("turntable: give the axes in the IMU's frame, or six mountings or more, each about another direction")
    p = np.asarray(np.linalg.lstsq(J, np.ones(len(s)), rcond=None)[0], np.float64)
    P = lower(p) + np.tril(lower(p), -1).T
    v = 2 * s @ P
    variance = np.einsum("ki,kij,kj->k", v, cov / scale**2, v)
    weighted = J / np.sqrt(np.maximum(variance, 1e-300))[:, None]
    p = np.asarray(np.linalg.lstsq(weighted, 1 / np.sqrt(np.maximum(variance, 1e-300)), rcond=None)[0], np.float64)

    def triangle(p: Array) -> Array:
        try:
            M: Array = scale * np.linalg.cholesky(np.linalg.inv(lower(p) + np.tril(lower(p), -1).T))
        except np.linalg.LinAlgError:
            raise BadInputError("turntable: the responses fit no scale and axes; are all rates in rad/s and of the right run?") from None
        return M[_ROWS, _COLUMNS]

    K = _numeric(triangle, p)
    return TurntableGyro(lower(triangle(p)), K @ np.linalg.inv(weighted.T @ weighted) @ K.T, None, found)


def _numeric(f: Callable[[Array], Array], x: Array) -> Array:
    step = _STEP * float(np.max(np.abs(x)))
    out: Array = np.stack([(f(x + d) - f(x - d)) / (2 * step) for d in step * np.eye(len(x))], axis=1)
    return out
