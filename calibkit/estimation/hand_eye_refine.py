"""Joint maximum likelihood of X, each world's Z and every true pose, with noise on both sides whose size the residuals tell.

Unknown are X, Z_w and the true M_i = T_w2_2(i): Q_i = M_i exp(q_i), P_i = Z_w M_i X^-1 exp(p_i). In M_i's right tangent, to first order

    e_i = Ad(X^-1) local(Z_w M_i X^-1, P_i) - local(M_i, Q_i) = -x + Ad(M_i^-1) z_w + noise of covariance C_i = C_P,i + C_Q,i.

Eliminating M_i leaves these 6 equations a pose (Gauss-Helmert). The Jacobians are those at the adjusted poses: at the measured ones, the
noise in them would count as knowledge of X.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from calibkit.estimation import hand_eye_noise as noise
from calibkit.estimation.hand_eye_data import HandEyeData, Mask
from calibkit.estimation.hand_eye_images import Corners, Sight
from calibkit.estimation.hand_eye_lens import lens_step
from calibkit.estimation.hand_eye_noise import RobotNoise
from calibkit.estimation.hand_eye_normal import ENOUGH_FOR_NOISE, Normal, believed, inverse, normal
from calibkit.estimation.hand_eye_robust import FEWEST_OTHERS, Seed
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

_WRONG = 1e-4  # of the good poses lie beyond the limit
_MAX_STEPS = 80
_STILL = 2  # steps without X: what the measured poses' noise tells is not yet told from knowledge
_SETTLED = 1e-4  # sigmas squared
_LONG = 12  # steps: what two sides share of the noise may creep for ever, and says little of X
_NOISE_SETTLED = 5e-3
_MAX_REVERSALS = 5
_CHOOSING = 6  # steps in which corners are given up and taken back


@dataclass(frozen=True)
class Refined:
    """The optimum; what belongs to a pose is in M_i's right tangent."""

    X: Array  # (4, 4)
    Z: Array  # (n_worlds, 4, 4)
    M: Array  # (n, 4, 4) adjusted T_w2_2
    kept: Mask  # (n,)
    chi2: Array  # (n,) of 6 degrees of freedom
    e: Array  # (n, 6) residuals
    C: Array  # (n, 6, 6) their covariance before the fit
    C_P: Array  # (n, 6, 6) P's share of it
    noise: dict[str, float]  # sigmas: P_rotation rad, P_translation m, or P_factor of cov_P's; likewise Q
    freedom: int  # residuals left over that told the noise; 0: it is assumed
    converged: bool
    by_reach: bool = False  # an arm's turns and places contradict each other as white noise: see hand_eye_noise.contradicts
    corners: Corners | None = None  # with the lens as it came out
    sight: Sight | None = None  # at M


def wrong_beyond(freedom: int) -> float:
    """Return the limit of chi2 where the noise is told by as many residuals (Fisher's F)."""
    return 6 * float(special.fdtri(6, freedom, 1 - _WRONG))


def refine(data: HandEyeData, start: Seed, corners: Corners | None = None, robot: RobotNoise | None = None) -> Refined:
    """Return the optimum from a seed: a step, the noise and the choice of poses in turn until none of them changes any more.

    With corners, Q and its covariance are what they say at the adjusted poses, so that the optimum is that of the reprojection error.
    """
    X, Z, M, kept = start.X, start.Z, data.Q, start.kept
    data, sight = _seen(data, corners, M)
    exact = robot is not None and robot.exact
    e, away, kinds = residuals(data, X, Z, M)
    theta, least, most = noise.first(data, e[kept], robot, sight is not None)
    system: Normal | None = None
    reversals, converged, by_reach, lens_open = 0, False, False, 0.0
    on_P = noise.on_P(data)
    for number in range(_MAX_STEPS):
        freedom = noise.freedom(data, kept)
        before = noise.mean_diagonal(kinds, theta)
        if freedom and system is not None:
            at = np.flatnonzero(system.active & kept)
            at = at[:: max(1, len(at) // ENOUGH_FOR_NOISE)]
            beside = None if sight is None or exact else (sight.chi2, sight.freedom)
            theta = np.clip(noise.told(kinds[at], theta, e[at], np.add(*system.spread_parts(data, at)), beside), least, most)
            theta = noise.by_reach(data, kept, theta) if by_reach else theta
        noise_settled = bool(np.all(np.abs(noise.mean_diagonal(kinds, theta) / before - 1) < _NOISE_SETTLED))
        C, C_P = noise.weighed(kinds, theta), noise.weighed(kinds[:, :on_P], theta[:on_P])
        system = normal(data, M, C, e, kept)
        if number >= _STILL:
            system = believed(data, C, C_P, kept, system, chance=False)[1]
        x, z, left = system.step(data, e)
        if corners is not None and sight is not None and corners.free:
            lens = lens_step(data, system, M, C, left, kept, corners, sight, theta[-1])
            x, z, left = x + lens.X @ lens.d, z + lens.Z @ lens.d, left + lens.left @ lens.d
            away = away - sight.K @ lens.d
            corners = replace(corners, lens=corners.lens + lens.d)
            lens_open = float(lens.d @ lens.information @ lens.d)
        # A wrong pose is not one to adjust: its M would run away.
        m = away + kept[:, None] * ((C - C_P) @ (system.W @ left[:, :, None]))[:, :, 0]
        still = float(x @ system.S @ x) + lens_open < _SETTLED
        settled = number >= _STILL and (noise_settled or number >= _LONG) and still
        if settled or number == _MAX_STEPS - 1:
            chi2 = _chi2(data, C, left, kept, system)
        if settled:
            now = chi2 < wrong_beyond(freedom) if freedom and len(kept) > FEWEST_OTHERS else kept
            converged = np.array_equal(now, kept) or reversals == _MAX_REVERSALS
            if converged and robot is None and not by_reach:
                # Only of poses whose choice is settled: wrong ones contradict everything.
                by_reach = noise.contradicts(data, M, e, kinds, theta, kept, freedom)
                converged = not by_reach
            elif not converged:
                kept, reversals = now, reversals + 1
        X, Z, M = se3.retract(X, x), se3.retract(Z, z), se3.retract(M, m)
        corners = corners.without_outliers(M) if corners is not None and number < _CHOOSING else corners
        data, sight = _seen(data, corners, M)
        e, away, kinds = residuals(data, X, Z, M)
        if converged:
            break
    sigmas = dict(zip(noise.names(data), np.sqrt(theta).tolist(), strict=True))
    C, C_P = noise.weighed(kinds, theta), noise.weighed(kinds[:, :on_P], theta[:on_P])
    return Refined(X, Z, M, kept, chi2, e, C, C_P, sigmas, freedom, converged, by_reach, corners, sight)


def _seen(data: HandEyeData, corners: Corners | None, M: Array) -> tuple[HandEyeData, Sight | None]:
    """Return the problem with Q as the corners have it at M."""
    if corners is None:
        return data, None
    sight = corners.at(M)
    return replace(data, Q=sight.Q, cov_Q=sight.cov), sight


def residuals(data: HandEyeData, X: Array, Z: Array, M: Array) -> tuple[Array, Array, Array]:
    """Return e (n, 6), local(M, Q) (n, 6), and the covariances (n, k, 6, 6) of one unit of each kind of noise, P's first."""
    ZM, to_2 = Z[data.world] @ M, se3.inverse(X)
    on_P = se3.adjoint(to_2)
    away = se3.local(M, data.Q)
    e = se3.local(ZM @ to_2, data.P) @ on_P.T - away
    kinds: list[Array] = []
    if data.cov_P is None:
        kinds += _isotropic(se3.inverse(ZM) if data.words.P_at_world else to_2)
    else:
        kinds.append(on_P @ data.cov_P @ on_P.T)
    if data.cov_Q is None:
        kinds += _isotropic(se3.inverse(M) if data.words.Q_at_world else np.eye(4))
    else:
        kinds.append(data.cov_Q)
    if all(kind.ndim == 2 for kind in kinds):
        return e, away, np.broadcast_to(np.array(kinds), (len(M), len(kinds), 6, 6))
    out = np.empty((len(M), len(kinds), 6, 6))
    for k, kind in enumerate(kinds):
        out[:, k] = kind
    return e, away, out


def _isotropic(T: Array) -> tuple[Array, Array]:
    """Return Ad(T) Ad(T)^T (..., 6, 6) of turns alone and of shifts alone: only where T's right end lies from its left counts."""
    turns = np.concatenate([so3.hat(T[..., :3, 3]), np.broadcast_to(np.eye(3), (*T.shape[:-2], 3, 3))], axis=-2)
    return turns @ np.swapaxes(turns, -1, -2), np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


def _chi2(data: HandEyeData, C: Array, left: Array, kept: Mask, system: Normal) -> Array:
    """Return each pose's residual against its covariance: smaller than C where it took part in the fit, larger where it did not."""
    by_world, by_X = system.spread_parts(data)
    count = np.bincount(data.world, kept, data.n_worlds)[data.world]
    in_world, in_X = kept | (count < 2), kept & (count >= 2)
    V = C + np.where(in_world, -1, 1)[:, None, None] * by_world + np.where(in_X, -1, 1)[:, None, None] * by_X
    # What the fit cannot miss has no residual but rounding.
    out: Array = np.sum(left * (inverse(V + 1e-6 * C) @ left[:, :, None])[:, :, 0], axis=1)
    return out
