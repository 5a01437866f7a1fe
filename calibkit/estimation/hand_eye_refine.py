"""Joint maximum likelihood of X, each world's Z and every true pose, with noise on both sides whose size the residuals tell.

Unknown are X, Z_w and the true M_i = T_w2_2(i): Q_i = M_i exp(q_i), P_i = Z_w M_i X^-1 exp(p_i). In M_i's right tangent, to first order

    e_i = Ad(X^-1) local(Z_w M_i X^-1, P_i) - local(M_i, Q_i) = -x + Ad(M_i^-1) z_w + noise of covariance C_i = C_P,i + C_Q,i.

Eliminating M_i leaves these 6 equations a pose (Gauss-Helmert). The Jacobians are those at the adjusted poses: at the measured ones, the
noise in them would count as knowledge of X.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from calibkit.estimation.hand_eye_data import HandEyeData, Mask
from calibkit.estimation.hand_eye_robust import Seed
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.solver import trust

_WRONG = 1e-4  # of the good poses lie beyond the limit
ASSUMED_SIGMAS = (1e-3, 1e-3)  # rad, m: where the poses are too few to tell
_FAR = np.array([100.0] * 3 + [10.0] * 3) ** -2.0  # information before any: nothing is farther than 100 m and 10 rad
_NOTHING = 1e-8  # information in 1 mm and 1 mrad: of what is known to 10 m and 10 rad
SCALES = np.array([trust.SCALES["m"]] * 3 + [trust.SCALES["rad"]] * 3)  # what X must be known to
_FACTORS = (1.0, 3.0)  # that a given covariance may be too small by: what corners err by together is not in it
_FEWEST = 3  # poses whose residuals tell of noise
_FINEST = 1e-14  # variance: nothing is known to better than 0.1 urad and 0.1 um
_ROUNDING = 1e-13
_MAX_STEPS = 40
_STILL = 2  # steps without X: what the measured poses' noise tells is not yet told from knowledge
_SETTLED = 1e-4  # sigmas squared
_LONG = 12  # steps: what two sides share of the noise may creep for ever, and says little of X
_NOISE_SETTLED = 5e-3
_MAX_REVERSALS = 5
_ENOUGH_FOR_NOISE = 1000  # poses: sigmas to 1 %


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


@dataclass(frozen=True)
class Normal:
    """Normal equations with the worlds eliminated: S is the information about X."""

    S: Array  # (6, 6)
    gradient: Array  # (6,)
    A: Array  # (n_worlds, 6, 6) information about each Z given X
    follow: Array  # (n_worlds, 6, 6) d z_w / d x
    apart: Array  # (n_worlds, 6) z_w for x = 0
    J_Z: Array  # (n, 6, 6) Ad(M^-1)
    J_X: Array  # (n, 6, 6) d e_i / d x with z_w following
    active: Mask  # (n,) whose world has two kept poses or more
    free: Array  # (6, k) directions of x that the poses tell of, orthonormal in SCALES; the others stay as they are

    @property
    def cov(self) -> Array:
        """The covariance of x along what is free."""
        out: Array = self.free @ np.linalg.inv(self.free.T @ self.S @ self.free) @ self.free.T
        return out

    @property
    def held(self) -> Array:
        """The other directions (6, 6 - k)."""
        out: Array = SCALES[:, None] * np.linalg.svd(self.free / SCALES[:, None])[0][:, self.free.shape[1] :]
        return out

    def spread_parts(self, data: HandEyeData) -> tuple[Array, Array]:
        """Return the covariance (n, 6, 6) of the fitted e_i, by z_w given x and by x."""
        by_world = self.J_Z @ np.linalg.inv(self.A)[data.world] @ np.swapaxes(self.J_Z, 1, 2)
        return by_world, self.J_X @ self.cov @ np.swapaxes(self.J_X, 1, 2)

    def spread(self, data: HandEyeData) -> Array:
        """Return their sum."""
        by_world, by_X = self.spread_parts(data)
        out: Array = by_world + by_X
        return out


def wrong_beyond(freedom: int) -> float:
    """Return the limit of chi2 where the noise is told by as many residuals (Fisher's F)."""
    return 6 * float(special.fdtri(6, freedom, 1 - _WRONG))


def normal(data: HandEyeData, M: Array, C: Array, e: Array, kept: Mask) -> Normal:
    """Return the normal equations of e = -x + Ad(M^-1) z.

    A world with fewer than two kept poses says nothing of X; its Z is that of all its poses.
    """
    W, J_Z = np.linalg.inv(C), se3.adjoint(se3.inverse(M))
    active = (np.bincount(data.world, kept, data.n_worlds) >= 2)[data.world]
    JW = np.swapaxes(J_Z, 1, 2) @ W * (kept | ~active)[:, None, None]
    A = _by_world(data, JW @ J_Z) + np.diag(_FAR)
    right = _by_world(data, np.concatenate([JW, (JW @ e[:, :, None])], axis=2))
    solved = np.asarray(np.linalg.solve(A, right), np.float64)
    follow, apart = solved[:, :, :6], solved[:, :, 6]
    J_X = J_Z @ follow[data.world] - np.eye(6)
    RW = np.swapaxes(J_X, 1, 2) @ W * (kept & active)[:, None, None]
    left = e - (J_Z @ apart[data.world][:, :, None])[:, :, 0]
    S = np.sum(RW @ J_X, axis=0) + np.diag(_FAR)
    return Normal((S + S.T) / 2, np.einsum("nij,nj->i", RW, left), A, follow, apart, J_Z, J_X, active, np.zeros((6, 0)))


def believed(data: HandEyeData, C: Array, C_P: Array, kept: Mask, system: Normal, chance: bool = True) -> tuple[Array, Normal]:
    """Return X's covariance (6, 6) by what the noise in the adjusted poses has not made, and the system with what is free.

    A pose's error d ~ D moves Ad(M) to Ad(M) (I + ad(d)): poses at rest would have sum E[ad(d)^T C^-1 ad(d)] of information. What is more
    than that, and than chance can add (Davidson and Szarek 2001, as in hand_eye_pairs.Spectrum.rank), is knowledge.
    """
    used = np.flatnonzero(kept & system.active)
    worlds = len(np.unique(data.world[used]))
    some = used[:: max(1, len(used) // _ENOUGH_FOR_NOISE)]
    W = np.linalg.inv(C[some])
    D = C_P[some] @ W @ (C - C_P)[some]
    values, vectors = np.linalg.eigh((D + np.swapaxes(D, 1, 2)) / 2)
    roots = np.swapaxes(vectors * np.sqrt(np.maximum(values, 0))[:, None, :], 1, 2)
    ad = np.zeros((*roots.shape, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = so3.hat(roots[..., 3:])
    ad[..., :3, 3:] = so3.hat(roots[..., :3])
    noise = np.einsum("nkai,nab,nkbj->ij", ad, W, ad, optimize=True) * len(used) / max(len(some), 1)
    units = SCALES[:, None] * SCALES
    if chance:
        noise = noise * (1 + (np.sqrt(2) + 3) / np.sqrt(max(len(used) - worlds, 1))) ** 2
    values, vectors = np.linalg.eigh((system.S - noise) * units)
    whole = np.einsum("ij,ik,kj->j", vectors, system.S * units, vectors)
    empty = values < np.maximum(whole / 2, max(_NOTHING, _ROUNDING * values[-1]))
    back = vectors * SCALES[:, None]
    return back / np.where(empty, _NOTHING, values) @ back.T, replace(system, free=vectors[:, ~empty] * SCALES[:, None])


def _by_world(data: HandEyeData, values: Array) -> Array:
    if data.n_worlds == 1:
        return np.asarray(values.sum(axis=0, keepdims=True))
    out = np.zeros((data.n_worlds, *values.shape[1:]))
    np.add.at(out, data.world, values)
    return out


def refine(data: HandEyeData, start: Seed) -> Refined:
    """Return the optimum from a seed: a step, the noise and the choice of poses in turn until none of them changes any more."""
    X, Z, M, kept = start.X, start.Z, data.Q, start.kept
    e, kinds = residuals(data, X, Z, M)
    theta, least, most = _first_noise(data, e[kept])
    system: Normal | None = None
    reversals, converged = 0, False
    for number in range(_MAX_STEPS):
        freedom = _freedom(data, kept)
        before = _mean_diagonal(kinds, theta)
        if freedom and system is not None:
            theta = np.clip(_noise(data, kinds, theta, e, kept, system), least, most)
            theta = np.maximum(theta, _by_reach(data, kept, theta))
        noise_settled = bool(np.all(np.abs(_mean_diagonal(kinds, theta) / before - 1) < _NOISE_SETTLED))
        C, C_P = _sum(kinds, theta), _sum(kinds[:, : _on_P(data)], theta[: _on_P(data)])
        system = normal(data, M, C, e, kept)
        if number >= _STILL:
            system = believed(data, C, C_P, kept, system, chance=False)[1]
        x = system.cov @ system.gradient
        z = system.apart + system.follow @ x
        left = e + x - (system.J_Z @ z[data.world][:, :, None])[:, :, 0]
        chi2 = _chi2(data, C, left, kept, system)
        # A wrong pose is not one to adjust: its M would run away.
        m = se3.local(M, data.Q) + kept[:, None] * ((C - C_P) @ np.linalg.solve(C, left[:, :, None]))[:, :, 0]
        X, Z, M = se3.retract(X, x), se3.retract(Z, z), se3.retract(M, m)
        e, kinds = residuals(data, X, Z, M)
        if number >= _STILL and (noise_settled or number >= _LONG) and float(x @ system.S @ x) < _SETTLED:
            now = chi2 < wrong_beyond(freedom) if freedom else kept
            if np.array_equal(now, kept) or reversals == _MAX_REVERSALS:
                converged = True
                break
            kept, reversals = now, reversals + 1
    names = _names(data)
    sigmas = dict(zip(names, np.sqrt(theta).tolist(), strict=True))
    return Refined(
        X, Z, M, kept, chi2, e, _sum(kinds, theta), _sum(kinds[:, : _on_P(data)], theta[: _on_P(data)]), sigmas, freedom, converged
    )


def residuals(data: HandEyeData, X: Array, Z: Array, M: Array) -> tuple[Array, Array]:
    """Return e (n, 6) and the covariances (n, k, 6, 6) of one unit of each kind of noise, P's first."""
    P = Z[data.world] @ M @ se3.inverse(X)
    on_P = se3.adjoint(se3.inverse(X))
    e = se3.local(P, data.P) @ on_P.T - se3.local(M, data.Q)
    world_P, world_Q = se3.adjoint(se3.inverse(Z[data.world] @ M)), se3.adjoint(se3.inverse(M))
    sides = (
        (data.cov_P, on_P, world_P if data.words.P_at_world else np.broadcast_to(on_P, world_P.shape)),
        (data.cov_Q, np.eye(6), world_Q if data.words.Q_at_world else np.broadcast_to(np.eye(6), world_Q.shape)),
    )
    kinds = []
    for cov, carried, isotropic in sides:
        if cov is not None:
            kinds.append(carried @ cov @ carried.T)
        else:
            kinds += [isotropic[:, :, part] @ np.swapaxes(isotropic[:, :, part], 1, 2) for part in (slice(3, 6), slice(0, 3))]
    return e, np.stack(kinds, axis=1)


def _names(data: HandEyeData) -> tuple[str, ...]:
    """Return what each kind of noise is a sigma of."""
    sides = (("P", data.cov_P), ("Q", data.cov_Q))
    return tuple(f"{s}_{kind}" for s, cov in sides for kind in (("rotation", "translation") if cov is None else ("factor",)))


def _on_P(data: HandEyeData) -> int:
    return 2 if data.cov_P is None else 1


def _first_noise(data: HandEyeData, e: Array) -> tuple[Array, Array, Array]:
    """Return variances to start from, what the seed left over shared by both sides, and the least and the most that they may be."""
    rho, phi = np.mean(e**2, axis=0).reshape(2, 3).mean(axis=1) if len(e) else (0.0, 0.0)
    if len(e) < _FEWEST:
        rho, phi = ASSUMED_SIGMAS[1] ** 2, ASSUMED_SIGMAS[0] ** 2
    bounds = {
        "rotation": (phi / 2, _FINEST, 9 * phi),
        "translation": (rho / 2, _FINEST, 9 * rho),
        "factor": (1.0, _FACTORS[0] ** 2, _FACTORS[1] ** 2),
    }
    first, least, most = np.array([bounds[name.split("_")[1]] for name in _names(data)]).T
    most = np.maximum(most, least)
    return np.clip(first, least, most), least, most


def _by_reach(data: HandEyeData, kept: Mask, theta: Array) -> Array:
    """Return the least variances of an arm: its angle errors move the hand by its reach times as much.

    A choice, not a measurement: residuals of a grid of poses and one lens are not white and may show less. Positions weighed by them then
    turned R of a real arm (28 poses) by 0.07 deg, three of its sigmas, away from every closed form.
    """
    out = np.zeros(len(theta))
    if data.cov_P is None and data.words.arm:
        out[1] = theta[0] * float(np.median(np.sum(data.P[kept, :3, 3] ** 2, axis=1))) if kept.any() else 0.0
    return out


def _freedom(data: HandEyeData, kept: Mask) -> int:
    """Return how many residuals are left over to tell the noise by: none from less than two motions."""
    count = np.bincount(data.world, kept, data.n_worlds)
    motions = int(np.sum(np.maximum(count - 1, 0)))
    return 6 * (motions - 1) if motions > 1 else 0


def _noise(data: HandEyeData, kinds: Array, theta: Array, e: Array, kept: Mask, system: Normal) -> Array:
    """Return the variances after two steps of Horn's (1975) iterated almost unbiased estimator, restricted likelihood's: never negative.

    theta_k <- theta_k (sum e^T C^-1 G_k C^-1 e) / (sum tr(Pi G_k)), Pi = C^-1 - C^-1 J cov J^T C^-1.
    """
    at = np.flatnonzero(system.active & kept)
    at = at[:: max(1, len(at) // _ENOUGH_FOR_NOISE)]
    kinds, e, spread = kinds[at], e[at], system.spread(data)[at]
    W = np.linalg.inv(_sum(kinds, theta))
    # What the fit has not taken: a share that hardly changes, and that is 0 to rounding where a kind of noise is all taken.
    left = np.maximum(np.einsum("nij,nkji->k", W - W @ spread @ W, kinds) / np.einsum("nij,nkji->k", W, kinds), 1e-3)
    for _ in range(2):
        W = np.linalg.inv(_sum(kinds, theta))
        We = W @ e[:, :, None]
        found = np.einsum("nia,nkij,njb->k", We, kinds, We, optimize=True)
        theta = theta * found / (left * np.einsum("nij,nkji->k", W, kinds)) + 1e-3 * _FINEST
    return theta


def _chi2(data: HandEyeData, C: Array, left: Array, kept: Mask, system: Normal) -> Array:
    """Return each pose's residual against its covariance: smaller than C where it took part in the fit, larger where it did not."""
    by_world, by_X = system.spread_parts(data)
    count = np.bincount(data.world, kept, data.n_worlds)[data.world]
    in_world, in_X = kept | (count < 2), kept & (count >= 2)
    V = C + np.where(in_world, -1, 1)[:, None, None] * by_world + np.where(in_X, -1, 1)[:, None, None] * by_X
    # What the fit cannot miss has no residual but rounding.
    out: Array = np.sum(left * np.linalg.solve(V + 1e-6 * C, left[:, :, None])[:, :, 0], axis=1)
    return out


def _sum(kinds: Array, theta: Array) -> Array:
    out: Array = np.einsum("nkij,k->nij", kinds, theta)
    return out


def _mean_diagonal(kinds: Array, theta: Array) -> Array:
    out: Array = np.einsum("nkii,k->i", kinds, theta)
    return out
