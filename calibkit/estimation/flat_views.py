"""Poses of a flat board under a known lens, each view by itself: the lens is linearised once, at the measured pixels.

With J = duv/dp at the measured ray, where J ray = 0, a corner's residual under p = R X + t is J p / |p| to first order, so that
|r|^2 = p^T Q p / |p|^2 with Q = J^T J / sigma^2. X = (x, y, 0) makes p linear in (1, x, y), and the normal equations of a view follow
from the sums of Q, weighted, times the six products of (1, x, y): no Jacobian is ever made.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.camera_problem import CameraViews
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

_ROWS, _COLUMNS = np.array([0, 1, 2, 1, 0, 0]), np.array([0, 1, 2, 2, 2, 1])  # where the six entries of a symmetric matrix stand
_ENTRY = np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]])  # and which of them each place holds
_TIMES = np.array([1.0, 1, 1, 2, 2, 2])  # and in how many
_BEHIND = 1e12  # squared sigmas of a corner that is predicted opposite to where it was seen
_LONGEST_TURN, _LONGEST_WAY = 0.5, 0.5  # of one step: rad, and of the distance

Mask = NDArray[np.bool_]
Weigh = Callable[[Array], Array]


def _motion() -> Array:
    """Return E (9, 6): the coefficients of 1, x, y in [I, -hat(X)], one 3 x 6 block above the other."""
    axes = np.eye(3)
    rows = [np.hstack([axes, np.zeros((3, 3))]), *(np.hstack([np.zeros((3, 3)), -so3.hat(axes[k])]) for k in (0, 1))]
    out: Array = np.concatenate(rows)
    return out


_MOTION = _motion()


@dataclass(frozen=True)
class FlatViews:
    """Corners of a flat board in f views, linearised; n corners each, absent ones not `seen`."""

    points: Array  # (n, 3) m, z = 0
    ray: Array  # (f, 3, n) unit
    Q: Array  # (f, 6, n) in squared sigmas per squared rad, 0 where not seen
    seen: Mask  # (f, n) found, and inside the lens model's domain

    @classmethod
    def under(cls, views: CameraViews, lens: Array, points: Array) -> "FlatViews":
        """Return the views as seen through a known lens."""
        ray, valid = views.model.unproject(views.uv, lens)
        projection = views.model.project(ray, lens, jacobians=True)
        assert projection.J_point is not None
        seen = valid & projection.valid & (views.weight > 0)
        J = np.moveaxis(projection.J_point, (-2, -1), (0, 1)) * np.where(seen, views.weight, 0.0)
        Q = np.empty((len(ray), 6, len(points)))
        for k, (i, j) in enumerate(zip(_ROWS, _COLUMNS, strict=True)):
            Q[:, k] = J[0, i] * J[0, j] + J[1, i] * J[1, j]
        return cls(points, np.ascontiguousarray(np.swapaxes(ray, 1, 2)), Q, seen)

    def rows(self, views: NDArray[np.generic]) -> "FlatViews":
        """Return some of the views (a mask or indices)."""
        return replace(self, ray=self.ray[views], Q=self.Q[views], seen=self.seen[views])

    def corners(self, some: slice) -> "FlatViews":
        """Return the views with some of their corners only."""
        return FlatViews(self.points[some], self.ray[..., some], self.Q[..., some], self.seen[:, some])

    @property
    def _monomials(self) -> Array:
        return np.stack([np.ones(len(self.points)), self.points[:, 0], self.points[:, 1]])

    def _look(self, T: Array) -> tuple[Array, Array]:
        """Return |r|^2 and 1 / |p|^2, both (f, n)."""
        p = T[:, :3, [3, 0, 1]] @ self._monomials
        products = np.empty_like(self.Q)
        for k, (i, j) in enumerate(zip(_ROWS, _COLUMNS, strict=True)):
            np.multiply(p[:, i], p[:, j], out=products[:, k])
        inverse = 1 / np.maximum(products[:, 0] + products[:, 1] + products[:, 2], 1e-24)
        squares = np.maximum(np.einsum("k,fkn,fkn->fn", _TIMES, self.Q, products), 0.0) * inverse  # rounding can make it negative
        behind = (np.einsum("fin,fin->fn", p, self.ray) <= 0) & self.seen
        return np.where(behind, _BEHIND, squares), inverse

    def squares(self, T: Array) -> Array:
        """Return |r|^2 (f, n) in squared sigmas under T_cam_board (f, 4, 4), 0 where not seen."""
        return self._look(T)[0]

    def normal(self, T: Array, weigh: Weigh) -> tuple[Array, Array]:
        """Return A (f, 6, 6) and g (f, 6) of the step's equations A d = g for T exp(d), tangent order (rho, phi).

        Each corner is weighted by weigh(|r|^2). The gradient of p^T Q p / |p|^2 is 2 (Q - |r|^2 I) p / |p|^2: the second part is |p|'s own.
        """
        squares, inverse = self._look(T)
        share = np.where(self.seen, weigh(squares), 0.0) * inverse
        W = np.empty((len(T), 7, len(self.points)))
        np.multiply(self.Q, share[:, None], out=W[:, :6])
        np.multiply(np.where(squares < _BEHIND, squares, 0.0), share, out=W[:, 6])
        m = self._monomials
        sums = W @ (m[_ROWS] * m[_COLUMNS]).T
        # N[(a, i), (b, j)] = sum of w Q_ij m_a m_b, a and b over 1, x, y
        a, i = np.divmod(np.arange(9), 3)
        N = sums[:, _ENTRY[i[:, None], i], _ENTRY[a[:, None], a]]
        h = np.swapaxes(T[:, :3, [3, 0, 1]], 1, 2).reshape(-1, 9)
        D = (T[:, None, :3, :3] @ _MOTION.reshape(3, 3, 6)).reshape(-1, 9, 6)
        radial = sums[:, 6][:, _ENTRY] @ h.reshape(-1, 3, 3)
        pull = (N @ h[:, :, None])[:, :, 0] - radial.reshape(-1, 9)
        Dt = np.swapaxes(D, 1, 2)
        return Dt @ N @ D, -(Dt @ pull[:, :, None])[:, :, 0]

    def step(self, T: Array, weigh: Weigh) -> Array:
        """Return T after one Gauss-Newton step, each corner weighted by weigh(|r|^2); a step is cut where it would go too far."""
        A, g = self.normal(T, weigh)
        step = np.linalg.solve(regular(A), g[:, :, None])[:, :, 0]
        way, turn = np.linalg.norm(step[:, :3], axis=1), np.linalg.norm(step[:, 3:], axis=1)
        far = np.maximum(way / (_LONGEST_WAY * np.linalg.norm(T[:, :3, 3], axis=1) + 1e-12), turn / _LONGEST_TURN)
        return se3.retract(T, step / np.maximum(far, 1.0)[:, None])


def regular(A: Array) -> Array:
    """Return normal matrices (f, 6, 6) with so much added to the diagonals that a view without corners is no singular one."""
    scale = np.einsum("fii->f", A)
    ridge = 1e-12 * scale + np.where(scale > 0, 0.0, 1.0)
    whole: Array = A + ridge[:, None, None] * np.eye(6)
    return whole
