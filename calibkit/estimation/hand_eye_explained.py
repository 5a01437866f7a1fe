"""Whether a pattern explains what hand-eye poses leave over: weighed least squares of the residuals with and without it, and an F-test."""

from dataclasses import dataclass

import numpy as np
from scipy import special

from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_data import Index
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array

FEWEST = 10  # poses
_MOST = 300
_APART_S = 1.0  # errors of a moving arm that are nearer in time are alike
_FREEDOM = 6
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Explained:
    """What a pattern explains of the residuals of some poses."""

    b: Array  # (c,) its size
    distance: float  # m, rms over poses, as far as X and Z have not taken it up
    angle: float  # rad
    chance: float  # that white noise has as much of it


@dataclass(frozen=True)
class Left:
    """What kept poses of one arm leave, and how X and Z move it."""

    fit: HandEyeFit
    rows: Index
    J: Array  # (n, 6, 12)
    whiten: Array  # (n, 6, 6)

    def by(self, pattern: Array) -> Explained | None:
        """Return what a pattern (n, 6, c) explains beside X and Z; None where nothing is left to tell it by."""
        e = self.fit.refined.e[self.rows]
        both = np.concatenate([self.J, pattern], axis=2)
        (without, rank, _), (left, full, b) = (self._solve(columns, e) for columns in (self.J, both))
        more, freedom, number = full - rank, 6 * len(e) - full, 6 * len(e) - rank
        squares = [float(np.sum((self.whiten @ part[:, :, None]) ** 2)) for part in (without, left)]
        if more == 0 or freedom < _FREEDOM or squares[1] <= 0:
            return None
        chance = float(special.fdtrc(more, freedom, (squares[0] - squares[1]) / more / (squares[1] / freedom)))
        # Mean squares by as many residuals as each fit has over: chance adds nothing.
        size = [np.sum(part**2, axis=0).reshape(2, 3).sum(axis=1) * 6 / over for part, over in ((without, number), (left, freedom))]
        distance, angle = np.sqrt(np.maximum(size[0] - size[1], 0.0))
        return Explained(b[12:], float(distance), float(angle), chance)

    def _solve(self, columns: Array, e: Array) -> tuple[Array, int, Array]:
        A = (self.whiten @ columns).reshape(-1, columns.shape[2])
        units = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        b, _, rank, _ = np.linalg.lstsq(A / units, (self.whiten @ e[:, :, None]).ravel(), rcond=_ROUNDING)
        b = b / units
        return e - columns @ b, int(rank), b


def left_of(fit: HandEyeFit) -> Left | None:
    """Return what an arm's kept poses leave, in time, of a moving one at one pose a second; None of two sensors and of few poses."""
    if not fit.data.words.arm or fit.n_worlds > 1:
        return None
    rows, t_s = np.flatnonzero(fit.kept), fit.data.t_s
    if t_s is not None:
        rows = rows[np.unique(np.floor(t_s[rows] / _APART_S), return_index=True)[1]]
    rows = rows[:: max(1, -(-len(rows) // _MOST))]
    if len(rows) < FEWEST:
        return None
    found = fit.refined
    J = np.concatenate([np.broadcast_to(-np.eye(6), (len(rows), 6, 6)), se3.adjoint(se3.inverse(found.M[rows]))], axis=2)
    return Left(fit, rows, J, np.linalg.inv(np.linalg.cholesky(found.C[rows])))
