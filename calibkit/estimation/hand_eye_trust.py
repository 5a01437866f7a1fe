"""How far X may be trusted: its covariance by the residuals as they are, what the poses leave open, and what more of them would bring."""

from dataclasses import dataclass

import numpy as np

from calibkit.estimation.hand_eye_advice import Advice, advise, with_more
from calibkit.estimation.hand_eye_data import HandEyeData
from calibkit.estimation.hand_eye_normal import SCALES, Normal, believed, normal
from calibkit.estimation.hand_eye_open import Open, open_directions
from calibkit.estimation.hand_eye_refine import Refined
from calibkit.geometry.so3 import Array
from calibkit.solver import trust

_MOST_BLOCKS = 200
_LITTLE = 1e-12  # information that keeps what no pose tells of finite


@dataclass(frozen=True)
class Trust:
    """All that the information says."""

    cov_X: Array  # (6, 6) right tangent, corrected
    plain_X: Array
    cov_Z: Array  # of the first world
    plain_Z: Array
    open: tuple[Open, ...]  # the weakest first
    advice: tuple[Advice, ...]
    both: Array  # (12, 12) covariance of (x, z of the largest world)
    inflation: float  # mean of corrected over plain variance

    def predict(self, poses: Array) -> Array:
        """Return X's covariance (6, 6) with more poses of information (12, 12)."""
        return with_more(self.both, poses)[:6, :6] * self.inflation


def judge(data: HandEyeData, fit: Refined) -> Trust:
    """Return the covariance and what follows from it; along what is not told apart from noise it is that of 10 m and 10 rad."""
    known, system = believed(data, fit.C, fit.C_P, fit.kept, normal(data, fit.M, fit.C, fit.e, fit.kept))
    white, corrected = _sandwich(data, fit, system)
    corrected = corrected * _few(fit.freedom)
    follow = np.concatenate([np.eye(6), system.follow[0]])
    extra = follow @ (known - system.cov) @ follow.T
    plain, cov = white + extra, corrected + extra
    X, Z = slice(0, 6), slice(6, 12)
    k = system.free.shape[1]
    inflation = float(np.trace(system.S @ corrected[X, X])) / k if k else 1.0
    largest = int(np.argmax(np.bincount(data.world, fit.kept, data.n_worlds)))
    follow = np.concatenate([np.eye(6), system.follow[largest]])
    both = follow @ known @ follow.T
    both[6:, 6:] += system.cov_Z[largest]
    leaves_open = open_directions(data, fit.X, cov[X, X])
    advice = advise(data, fit, both, largest) if leaves_open else ()
    return Trust(cov[X, X], plain[X, X], cov[Z, Z], plain[Z, Z], leaves_open, advice, both, inflation)


def _few(freedom: int) -> float:
    """Return the variance of Student's t for either kind of noise, rotation and translation, told by half of the residuals."""
    return freedom / (freedom - 4) if freedom > 4 else 1.0


def _sandwich(data: HandEyeData, fit: Refined, system: Normal) -> tuple[Array, Array]:
    """Return the covariance (12, 12) of what is free of x, and of the first z, for white residuals and for residuals as they are.

    Of more worlds than one, each is a block about x alone.
    """
    used = np.flatnonzero(fit.kept & system.active)
    one, free = data.n_worlds == 1, system.free
    k = free.shape[1]
    given_x = np.zeros((12, 12))
    if one:
        J = np.concatenate([-np.broadcast_to(free, (len(used), 6, k)), system.J_Z[used] * SCALES], axis=2)
        back = np.block([[free, np.zeros((6, 6))], [np.zeros((6, k)), np.diag(SCALES)]])
    else:
        J, back = system.J_X[used] @ free, np.concatenate([free, system.follow[0] @ free])
        given_x[6:, 6:] = system.cov_Z[0]
    if J.shape[2] == 0 or len(used) == 0:
        return given_x, given_x
    JW = np.swapaxes(J, 1, 2) @ system.W[used]
    S, scores = JW @ J, (JW @ fit.e[used][:, :, None])[:, :, 0]
    units, prior = np.ones(J.shape[2]), _LITTLE * np.eye(J.shape[2])
    if data.t_s is not None and one:
        found = trust.covariance_in_time(S, scores, data.t_s[used], 1.0, units, prior)
    else:
        block = np.arange(len(used)) if one else np.unique(data.world[used], return_inverse=True)[1]
        count = int(block.max()) + 1
        block = block * min(count, _MOST_BLOCKS) // count
        count = int(block.max()) + 1
        S_blocks, g_blocks = np.zeros((count, *S.shape[1:])), np.zeros((count, S.shape[-1]))
        np.add.at(S_blocks, block, S)
        np.add.at(g_blocks, block, scores)
        found = trust.covariance(S_blocks, g_blocks, 1.0, units, prior, least=min(1.0, trust.FEW_BLOCKS / count))
    return back @ found.plain @ back.T + given_x, back @ found.corrected @ back.T + given_x
