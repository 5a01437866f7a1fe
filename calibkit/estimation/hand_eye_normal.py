"""The normal equations of a hand-eye problem, e = -x + Ad(M^-1) z with noise of covariance C, and what of x they really tell."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calibkit.estimation.hand_eye_data import HandEyeData, Index, Mask
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.solver import trust

SCALES = np.array([trust.SCALES["m"]] * 3 + [trust.SCALES["rad"]] * 3)  # what X must be known to
ENOUGH_FOR_NOISE = 1000  # poses: sigmas to 1 %
_FAR = np.array([100.0] * 3 + [10.0] * 3) ** -2.0  # information before any: nothing is farther than 100 m and 10 rad
_NOTHING = 1e-8  # information in 1 mm and 1 mrad: of what is known to 10 m and 10 rad
_ROUNDING = 1e-13
# ad(d) = d_k _AD[k], the derivative of Ad(retract(I, d)).
_AD = np.zeros((6, 6, 6))
_AD[3:, :3, :3] = _AD[3:, 3:, 3:] = _AD[:3, :3, 3:] = so3.hat(np.eye(3))


@dataclass(frozen=True)
class Normal:
    """Normal equations with the worlds eliminated: S is the information about X."""

    S: Array  # (6, 6)
    gradient: Array  # (6,)
    cov_Z: Array  # (n_worlds, 6, 6) of each Z given X
    follow: Array  # (n_worlds, 6, 6) d z_w / d x
    apart: Array  # (n_worlds, 6) z_w for x = 0
    J_Z: Array  # (n, 6, 6) Ad(M^-1)
    J_X: Array  # (n, 6, 6) d e_i / d x with z_w following
    W: Array  # (n, 6, 6) C^-1
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

    def spread_parts(self, data: HandEyeData, at: Index | slice = slice(None)) -> tuple[Array, Array]:
        """Return the covariance (k, 6, 6) of the fitted e_i of the poses `at`, by z_w given x and by x."""
        J_Z, J_X = self.J_Z[at], self.J_X[at]
        by_world = J_Z @ self.cov_Z[data.world[at]] @ np.swapaxes(J_Z, 1, 2)
        return by_world, J_X @ self.cov @ np.swapaxes(J_X, 1, 2)

    def step(self, data: HandEyeData, e: Array) -> tuple[Array, Array, Array]:
        """Return x (6,) and z (n_worlds, 6) of least squares, and what is left of e (n, 6), which the equations are of."""
        x: Array = self.cov @ self.gradient
        z: Array = self.apart + self.follow @ x
        left: Array = e + x - (self.J_Z @ z[data.world][:, :, None])[:, :, 0]
        return x, z, left

    def respond(self, data: HandEyeData, M: Array, C: Array, e: Array, kept: Mask) -> tuple[Array, Array, Array]:
        """Return the step that another e (n, 6) would bring under these equations' C and kept."""
        return replace(normal(data, M, C, e, kept), free=self.free).step(data, e)


def each(f: Callable[[Array], Array], values: Array) -> Array:
    """Return f of matrices (n, ...), one by one or, where they are a view of one n times, of that."""
    if len(values) > 1 and values.strides[0] == 0:
        one = f(values[:1])
        return np.broadcast_to(one, (len(values), *one.shape[1:]))
    return f(values)


def inverse(C: Array) -> Array:
    """Return the inverses of covariances (n, k, k) by Gauss and Jordan, all at once: a third of the time of as many calls of LAPACK.

    It takes the diagonal's pivots, which is stable where a matrix is positive definite (Higham 2002, section 14.4).
    """
    W = np.array(np.moveaxis(C, 0, -1), order="C")
    for k in range(len(W)):
        column, pivot = W[:, k].copy(), W[k, k].copy()
        if not pivot.all():
            raise np.linalg.LinAlgError("Singular matrix")
        row = W[k] / pivot
        W -= column[:, None] * row
        W[k], W[:, k], W[k, k] = row, -column / pivot, 1 / pivot
    return np.ascontiguousarray(np.moveaxis(W, -1, 0))


def normal(data: HandEyeData, M: Array, C: Array, e: Array, kept: Mask) -> Normal:
    """Return the normal equations of e = -x + Ad(M^-1) z.

    A world with fewer than two kept poses says nothing of X; its Z is that of all its poses.
    """
    W = each(inverse, C)
    J_Z = se3.adjoint(se3.inverse(M))
    active = (np.bincount(data.world, kept, data.n_worlds) >= 2)[data.world]
    WJ = W @ J_Z * (kept | ~active)[:, None, None]
    cov_Z = inverse(data.sum_by_world(np.swapaxes(J_Z, 1, 2) @ WJ) + np.diag(_FAR))
    follow = cov_Z @ np.swapaxes(data.sum_by_world(WJ), 1, 2)
    apart = (cov_Z @ data.sum_by_world(np.swapaxes(WJ, 1, 2) @ e[:, :, None]))[:, :, 0]
    J_X = J_Z @ follow[data.world] - np.eye(6)
    WJ = (W @ J_X * (kept & active)[:, None, None]).reshape(-1, 6)
    left = e - (J_Z @ apart[data.world][:, :, None])[:, :, 0]
    S = WJ.T @ J_X.reshape(-1, 6) + np.diag(_FAR)
    return Normal((S + S.T) / 2, WJ.T @ left.reshape(-1), cov_Z, follow, apart, J_Z, J_X, W, active, np.zeros((6, 0)))


def believed(data: HandEyeData, C: Array, C_P: Array, kept: Mask, system: Normal, chance: bool = True) -> tuple[Array, Normal]:
    """Return X's covariance (6, 6) by what the noise in the adjusted poses has not made, and the system with what is free.

    A pose's error d ~ D moves Ad(M) to Ad(M) (I + ad(d)): poses at rest would have sum E[ad(d)^T C^-1 ad(d)] of information. What is more
    than that, and than chance can add (Davidson and Szarek 2001, as in hand_eye_pairs.Spectrum.rank), is knowledge.
    """
    used = np.flatnonzero(kept & system.active)
    worlds = len(np.unique(data.world[used]))
    some = used[:: max(1, len(used) // ENOUGH_FOR_NOISE)]
    W = system.W[some]
    D = C_P[some] @ W @ (C[some] - C_P[some])
    by_chance = np.einsum("klab,kai,lbj->ij", np.einsum("nkl,nab->klab", D, W), _AD, _AD, optimize=True) * len(used) / max(len(some), 1)
    by_chance = (by_chance + by_chance.T) / 2
    units = SCALES[:, None] * SCALES
    if chance:
        by_chance = by_chance * (1 + (np.sqrt(2) + 3) / np.sqrt(max(len(used) - worlds, 1))) ** 2
    values, vectors = np.linalg.eigh((system.S - by_chance) * units)
    whole = np.einsum("ij,ik,kj->j", vectors, system.S * units, vectors)
    empty = values < np.maximum(whole / 2, max(2 * _NOTHING, _ROUNDING * values[-1]))  # twice: without a pose R's is that of _FAR alone
    back = vectors * SCALES[:, None]
    return back / np.where(empty, _NOTHING, values) @ back.T, replace(system, free=vectors[:, ~empty] * SCALES[:, None])
