"""What the residuals say of a time offset between the two sides, and of the scale of their lengths, with X and every Z following it."""

from dataclasses import dataclass

import numpy as np

from calibkit.estimation.hand_eye_data import HandEyeData, Mask
from calibkit.estimation.hand_eye_normal import believed, normal
from calibkit.estimation.hand_eye_refine import Refined
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array

_SIGMAS = 5.0
_NEIGHBOURS = 0.5  # s, between whose poses there is a velocity
_FEWEST = 10  # poses with a velocity
_LEAST_STRETCH = 0.005  # that is told
_MOST_STRETCH = 0.3  # that its first order means anything for


@dataclass(frozen=True)
class Lag:
    """dt_1_2, t_1 = t_2 + dt_1_2, that the residuals call for: they grow with speed."""

    dt: float  # s
    sigma: float
    share: float  # of chi-squared that it explains
    x: Array  # (6,) by how much it moves X, in its right tangent: told and not corrected, it counts as one more sigma
    z: Array  # (6,) by how much the first Z


@dataclass(frozen=True)
class Stretch:
    """Side 2's lengths times `factor` fit better."""

    factor: float
    sigma: float
    moves: Array  # (6,) X's right tangent (m, rad): how far X is off where the lengths are


@dataclass(frozen=True)
class Column:
    """What remains of a column g = d e / d dt once X and the worlds have followed: least squares of e + g dt."""

    used: Mask  # (n,)
    tells: Array  # (k,) g^T C^-1 g of the k poses used, g what remains: the information about dt
    pull: Array  # (k,) g^T C^-1 e
    x: Array  # (6,) d x / d dt, in X's right tangent
    z: Array  # (6,) of the first world

    @property
    def whole(self) -> float:
        return max(float(self.tells.sum()), 1e-300)

    @property
    def dt(self) -> float:
        return -float(self.pull.sum()) / self.whole


def eliminated(data: HandEyeData, fit: Refined, g: Array, rows: Mask) -> Column:
    """Return the column g (n, 6) of e, in those rows, with x and z eliminated."""
    system = believed(data, fit.C, fit.C_P, rows, normal(data, fit.M, fit.C, g, rows))[1]
    x = system.cov @ system.gradient
    z = system.apart + system.follow @ x
    used = rows & system.active
    left = (g + x - (system.J_Z @ z[data.world][:, :, None])[:, :, 0])[used]
    weighed = np.linalg.solve(fit.C[used], left[:, :, None])[:, :, 0]
    return Column(used, np.sum(weighed * left, axis=1), np.sum(weighed * fit.e[used], axis=1), x, z[0])


def lag(data: HandEyeData, fit: Refined, inflation: float) -> Lag | None:
    """Return the time offset that the residuals show, where they do by five sigmas.

    P stamped dt early is P(t) = P(t + dt) exp(-v dt): e gains -v dt, v the twist of M in its right tangent.
    """
    if data.t_s is None:
        return None
    order = np.lexsort([data.t_s, data.world])
    before, here, after = order[:-2], order[1:-1], order[2:]
    span = data.t_s[after] - data.t_s[before]
    near = (span > 0) & (span < 2 * _NEIGHBOURS) & (data.world[before] == data.world[after]) & fit.kept[before] & fit.kept[after]
    v, known = np.zeros((len(data.P), 6)), np.zeros(len(data.P), bool)
    v[here[near]] = se3.local(fit.M[before[near]], fit.M[after[near]]) / span[near, None]
    known[here[near]] = True
    known &= fit.kept
    if known.sum() < _FEWEST:
        return None
    column = eliminated(data, fit, v, known)
    sigma = float(np.sqrt(inflation / column.whole))
    share = column.dt**2 * column.whole / max(float(np.sum(fit.chi2[column.used])), 1e-300)
    told = abs(column.dt) > _SIGMAS * sigma
    return Lag(column.dt, sigma, share, column.dt * column.x, column.dt * column.z) if told else None


def stretch(data: HandEyeData, fit: Refined, inflation: float) -> Stretch | None:
    """Return the factor on side 2's lengths that the residuals call for, where they do by five sigmas: a board of another size.

    Q's lengths times 1 + s move local(M, Q) by s R_M^T p_M, so e by -s of it.
    """
    if not fit.freedom:
        return None
    g = np.zeros((len(fit.M), 6))
    g[:, :3] = np.einsum("nji,nj->ni", fit.M[:, :3, :3], fit.M[:, :3, 3])
    column = eliminated(data, fit, g, fit.kept)
    sigma = float(np.sqrt(inflation / column.whole))
    told = max(_SIGMAS * sigma, _LEAST_STRETCH) < abs(column.dt) < _MOST_STRETCH
    return Stretch(1 - column.dt, sigma, column.dt * column.x) if told else None
