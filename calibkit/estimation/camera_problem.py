"""Reprojection of board corners as an arrowhead problem: board poses are the core, lenses and camera positions the border.

r = (uv - project(T_c_cam0 T_cam0_board p_board; lens_c)) / sigma
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CameraModel
from calibkit.solver.arrowhead import Arrowhead, BlockDiagonal
from calibkit.solver.robust import cauchy

_CHUNK_POINTS = 8192  # points a chunk: its planes stay in the second-level cache
_THREADED_POINTS = 4 * _CHUNK_POINTS

A = TypeVar("A")


@dataclass(frozen=True)
class CameraViews:
    """One camera's corners on a dense grid (view, corner); an absent corner has weight 0."""

    model: CameraModel
    instant: NDArray[np.int64]  # (f,) which board pose each view belongs to
    uv: Array  # (f, n, 2) px
    weight: Array  # (f, n) 1/sigma in 1/px, 0: absent
    image_size: tuple[int, int]
    reach: float = 1.0  # tan^2 of the outermost angle that was seen, for the lens's prior


@dataclass(frozen=True)
class LensState:
    """The unknowns: a lens per camera, each camera's T_cam_cam0, each instant's T_cam0_board."""

    lenses: tuple[Array, ...]
    T_cam_cam0: Array  # (c, 4, 4), the first is the identity
    T_cam0_board: Array  # (m, 4, 4)


@dataclass(frozen=True)
class Residuals:
    """Residuals of one camera at a state."""

    px: Array  # (f, n, 2) measured minus predicted, 0 where absent
    seen: NDArray[np.bool_]  # (f, n) observed and inside the model's domain
    distance: Array  # (f, n) m from the camera
    board_normal: Array  # (f, 3) in the camera frame


@dataclass(frozen=True)
class _Parts:
    """Normal equations by instant: A (m, 6, 6), B (m, 6, p), C (m, p, p) and the gradients."""

    A: Array
    B: Array
    C: Array
    g_x: Array
    g_c: Array


@dataclass(frozen=True)
class CameraProblem:
    """Joint calibration of one or several cameras that look at one board."""

    points: Array  # (n, 3) m
    cameras: tuple[CameraViews, ...]
    loss_scale: float = np.inf  # Cauchy's, in sigmas
    noise: float = 1.0  # what a sigma of the weights really is: a prior counts as much as the corners' information does
    free_lens: bool = True
    free_rig: bool = True

    @cached_property
    def lens_slices(self) -> tuple[slice, ...]:
        """Where each camera's lens stands in the border."""
        ends = np.cumsum([len(c.model.parameter_names) for c in self.cameras])
        return tuple(slice(int(end) - len(c.model.parameter_names), int(end)) for c, end in zip(self.cameras, ends, strict=True))

    def rig_slice(self, camera: int) -> slice:
        """Where T_cam_cam0's tangent (rho, phi) of camera 1, 2, ... stands in the border."""
        start = self.lens_slices[-1].stop + 6 * (camera - 1)
        return slice(start, start + 6)

    def has_prior(self, lenses: Sequence[Array]) -> bool:
        """Whether any of the lenses has a prior."""
        return any(len(camera.model.prior(lens, camera.reach)[0]) > 0 for camera, lens in zip(self.cameras, lenses, strict=True))

    def prior(self, lenses: Sequence[Array]) -> tuple[float, Array, Array]:
        """Return what the lenses' priors add to the cost, to the information (p, p) about the border and to its gradient (p,)."""
        cost, C, g = 0.0, np.zeros((self.border_size, self.border_size)), np.zeros(self.border_size)
        for camera, lens, where in zip(self.cameras, lenses, self.lens_slices, strict=True):
            r, J = camera.model.prior(lens, camera.reach)
            r, J = self.noise * r, self.noise * J
            cost, C[where, where], g[where] = cost + float(r @ r), J.T @ J, -J.T @ r
        return cost, C, g

    @cached_property
    def border_size(self) -> int:
        return int(self.lens_slices[-1].stop + 6 * (len(self.cameras) - 1))

    def retract(self, x: LensState, core: Array, border: Array) -> LensState:
        T_cam_cam0 = x.T_cam_cam0.copy()
        for c in range(1, len(self.cameras)):
            T_cam_cam0[c] = se3.retract(T_cam_cam0[c], border[self.rig_slice(c)])
        lenses = tuple(lens + border[s] for lens, s in zip(x.lenses, self.lens_slices, strict=True))
        return LensState(lenses, T_cam_cam0, se3.retract(x.T_cam0_board, core))

    def linearize(self, x: LensState) -> tuple[float, Arrowhead]:
        cost, parts = self._normal_parts(x)
        prior_cost, prior_C, prior_g = self.prior(x.lenses)
        B, C, g_c = parts.B, parts.C.sum(axis=0) + prior_C, parts.g_c.sum(axis=0) + prior_g
        self._fix(B, C, g_c)
        return cost + prior_cost, Arrowhead(BlockDiagonal(parts.A), B, C, parts.g_x, g_c)

    def information(self, x: LensState) -> tuple[Array, Array]:
        """Return each instant's information S_i (m, p, p) about the border and its projected score (m, p) at x, the prior left out."""
        _, parts = self._normal_parts(x)
        solved = BlockDiagonal(parts.A).solve(np.concatenate([parts.B, parts.g_x[:, :, None]], axis=2))
        nuisance = np.swapaxes(parts.B, 1, 2) @ solved
        return parts.C - nuisance[:, :, :-1], parts.g_c - nuisance[:, :, -1]

    def _normal_parts(self, x: LensState) -> tuple[float, "_Parts"]:
        """Return the cost and each instant's part of the normal equations."""
        m, p = len(x.T_cam0_board), self.border_size
        parts = _Parts(np.zeros((m, 6, 6)), np.zeros((m, 6, p)), np.zeros((m, p, p)), np.zeros((m, 6)), np.zeros((m, p)))
        cost = 0.0
        pose = np.arange(6)
        for c, views in enumerate(self.cameras):
            columns = np.arange(p)[self.lens_slices[c]]
            if c:
                columns = np.concatenate([np.arange(p)[self.rig_slice(c)], columns])
            for rows, G, part in self._map_chunks(x, c, views):
                cost += part
                at = views.instant[rows]
                parts.A[at] += G[:, :6, :6]
                parts.B[np.ix_(at, pose, columns)] += G[:, :6, 6:-1]
                parts.C[np.ix_(at, columns, columns)] += G[:, 6:-1, 6:-1]
                parts.g_x[at] += G[:, :6, -1]
                parts.g_c[np.ix_(at, columns)] += G[:, 6:-1, -1]
        # An instant whose corners were all given up must not make the core singular.
        scale = np.einsum("mii->m", parts.A)
        ridge = 1e-12 * scale + np.where(scale > 0, 0.0, 1.0)
        parts.A[:] += ridge[:, None, None] * np.eye(6)
        return cost, parts

    def _fix(self, B: Array, C: Array, g_c: Array) -> None:
        """Hold what is not free: its rows and columns become an identity without coupling."""
        lens_end = self.lens_slices[-1].stop
        fixed = np.zeros(self.border_size, bool)
        fixed[:lens_end], fixed[lens_end:] = not self.free_lens, not self.free_rig
        B[:, :, fixed] = 0
        C[fixed, :], C[:, fixed], g_c[fixed] = 0, 0, 0
        C[fixed, fixed] = 1

    def _map_chunks(self, x: LensState, c: int, views: CameraViews) -> list[tuple[slice, Array, float]]:
        def one(rows: slice) -> tuple[slice, Array, float]:
            G, cost = self._normal_blocks(x, c, views, rows)
            return rows, G, cost

        return map_views(views, one)

    def _normal_blocks(self, x: LensState, c: int, views: CameraViews, rows: slice) -> tuple[Array, float]:
        """Return per view the products G of its columns [pose | rig | lens | residual], and the cost."""
        T_rig = x.T_cam_cam0[c]
        T = T_rig @ x.T_cam0_board[views.instant[rows]]
        G, cost = corner_products(self.points, views, rows, T, x.lenses[c], self.loss_scale)
        return _in_right_tangents(G, T, T_rig if c else None), cost

    def residuals(self, x: LensState, c: int) -> Residuals:
        """Return camera c's residuals in px at a state."""
        views = self.cameras[c]
        T = x.T_cam_cam0[c] @ x.T_cam0_board[views.instant]
        in_camera = se3.transform(T, self.points)
        projection = views.model.project(in_camera, x.lenses[c])
        seen = (views.weight > 0) & projection.valid
        px = np.where(seen[..., None], views.uv - projection.uv, 0.0)
        return Residuals(px, seen, np.linalg.norm(in_camera, axis=-1), T[:, :3, 2])


def map_views(views: CameraViews, one: Callable[[slice], A]) -> list[A]:
    """Return `one` of each chunk of the views, in their order, on two threads where there are many."""
    f, n = views.weight.shape
    size = max(1, _CHUNK_POINTS // n)
    chunks = [slice(start, min(start + size, f)) for start in range(0, f, size)]
    if f * n < _THREADED_POINTS:
        return [one(rows) for rows in chunks]
    with ThreadPoolExecutor(2) as pool:  # numpy lets go of the GIL in its kernels; the order of the sums stays fixed
        return list(pool.map(one, chunks))


@dataclass(frozen=True)
class Shutter:
    """A camera that reads row by row while it moves."""

    twist: Array  # (f, 6) how points move in the camera frame, rho + phi x p, 1/s
    late: Array  # (f, n) s by which each corner's row is read after the pose's time
    by_unknown: Array | None = None  # (f, n) d late / d(the unknown); None: none is free

    def moved(self, in_camera: Array) -> Array:
        """Return points in the camera frame (f, n, 3) as they are when their row is read."""
        rho, phi = self.twist[:, None, :3], self.twist[:, None, 3:]
        out: Array = in_camera + self.late[..., None] * (rho + np.cross(phi, in_camera))
        return out


def corner_products(
    points: Array, views: CameraViews, rows: slice, T_cam_board: Array, lens: Array, loss_scale: float, shutter: Shutter | None = None
) -> tuple[Array, float]:
    """Return per view the products G of its columns [motion | lens | the shutter's unknown, where free | residual], and the robust cost.

    The motion moves a point in the camera frame by rho + phi x p.
    """
    weight = views.weight[rows]
    in_camera = se3.transform(T_cam_board, points)
    if shutter is not None:
        in_camera = shutter.moved(in_camera)
    projection = views.model.project(in_camera, lens, jacobians=True)
    assert projection.J_point is not None
    assert projection.J_params is not None
    usable = (weight > 0) & projection.valid
    r = np.where(usable, np.moveaxis(views.uv[rows] - projection.uv, -1, 0), 0.0) * weight
    loss, down = cauchy(r[0] ** 2 + r[1] ** 2, loss_scale)
    # A corner that leaves the model's domain costs as much as one a whole image away: no gain in pushing it out.
    lost = (weight > 0) & ~projection.valid
    penalty, _ = cauchy((max(views.image_size) * weight[lost]) ** 2, loss_scale)
    cost = float(np.sum(loss) + np.sum(penalty))

    down = np.sqrt(down)
    w = np.where(usable, weight * down, 0.0)
    K = np.empty((2, 6 + len(lens) + (shutter is not None and shutter.by_unknown is not None) + 1, *w.shape))
    np.multiply(np.moveaxis(projection.J_point, (-2, -1), (0, 1)), w, out=K[:, :3])
    p = np.moveaxis(in_camera, -1, 0)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        np.subtract(p[i] * K[:, j], p[j] * K[:, i], out=K[:, 3 + k])
    np.multiply(np.moveaxis(projection.J_params, (-2, -1), (0, 1)), w, out=K[:, 6 : 6 + len(lens)])
    if shutter is not None and shutter.by_unknown is not None:
        K[:, -2] = np.einsum("xkfn,fk->xfn", K[:, :6], shutter.twist) * shutter.by_unknown
    np.multiply(r, down, out=K[:, -1])
    G: Array = np.matmul(K.transpose(0, 2, 1, 3), K.transpose(0, 2, 3, 1)).sum(axis=0)
    return G, cost


def _in_right_tangents(G: Array, T: Array, T_rig: Array | None) -> Array:
    """Return G (f, k, k) with its first six columns, motions of the point in the camera frame, turned into right perturbations.

    T exp(d) moves the point by Ad(T) d; with T = T_rig T_board, a right perturbation of T_rig moves it by Ad(T_rig) d.
    """
    f, size = len(G), G.shape[-1]
    shift = 0 if T_rig is None else 6
    M = np.zeros((f, size, size + shift))
    M[:, :6, :6] = se3.adjoint(T)
    if T_rig is not None:
        M[:, :6, 6:12] = se3.adjoint(T_rig)
    M[:, np.arange(6, size), np.arange(6, size) + shift] = 1
    turned: Array = np.swapaxes(M, 1, 2) @ G @ M
    return turned
