"""What a board's corners say of each pose and of the lens, wherever the poses are: hand-eye's share of the reprojection error.

r = (uv - project(M_i^-1 p_board; lens)) / sigma with M_i = T_target_cam(i). Linearised at M_i exp(m) and lens + d, with J and L the columns
of m and d, |r - J m - L d|^2 is a measurement of M_i, and one of the lens,

    Q_i = M_i exp(A^-1 J^T r - K d), K = A^-1 J^T L, of covariance A^-1 = (J^T J)^-1;      S d = g, S = L^T L - L^T J K.

Taken anew at each adjusted pose, Q_i makes of pose equations those of the images: corners that tell a pose badly are no Gaussian pose.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.data.rig import Camera
from calibkit.estimation.board_poses import BoardPoses
from calibkit.estimation.camera_problem import CameraProblem, CameraViews, LensState
from calibkit.estimation.lens_fit import OUTLIER, dense_views, rows_of
from calibkit.estimation.lens_trust import biased
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CAMERAS
from calibkit.solver.robust import scales_of_norms


@dataclass(frozen=True)
class Sight:
    """What the corners say, linearised at poses M; the lens's share is 0 throughout where it is held."""

    Q: Array  # (n, 4, 4)
    cov: Array  # (n, 6, 6) right tangent of M, for corners of one sigma
    K: Array  # (n, 6, p) by how much Q moves back when the lens moves
    S: Array  # (n, p, p) each view's information about the lens
    score: Array  # (n, p)
    chi2: float  # what each view leaves at its own best pose, squared sigmas
    freedom: float  # residuals that this is the sum of, less what was fitted to them


@dataclass(frozen=True)
class Corners:
    """A view's corners for each pose, and the lens that they were seen through."""

    points: Array  # (c, 3) m
    grid: CameraViews  # (n, c) with the weights of the corners that take part
    found: Array  # (n, c) weights of all corners
    lens: Array  # (p,)
    free: bool  # the lens is to be estimated
    prior: Array  # (p, p) information about it that these images are no part of
    start: Array  # (p,) the lens that it is about
    covariance: Array | None  # (p, p) of a lens that is held, where it is told
    bias_px: float = 0.0  # what the detector always errs by at one place of the image

    def at(self, M: Array) -> Sight:
        """Return what the corners say, linearised at poses M (n, 4, 4)."""
        problem, state = CameraProblem(self.points, (self.grid,)), self._state(M)
        cost, system = problem.linearize(state)
        n, p = len(M), len(self.lens)
        identity = np.broadcast_to(np.eye(6), (n, 6, 6))
        solved = system.core.solve(np.concatenate([identity, system.border, system.gradient_core[:, :, None]], axis=2))
        back = -se3.adjoint(se3.inverse(M))  # (M exp(m))^-1 = M^-1 exp(-Ad(M) m)
        cost -= problem.prior(state.lenses)[0] + float(np.sum(system.gradient_core * solved[:, :, -1]))
        S, score = problem.information(state) if self.free else (np.zeros((n, p, p)), np.zeros((n, p)))
        freedom = 2 * np.sum(self.grid.weight > 0) - 6 * n - (p if self.free else 0)
        return Sight(
            se3.retract(M, (back @ solved[:, :, -1:])[:, :, 0]),
            back @ solved[:, :, :6] @ np.swapaxes(back, 1, 2),
            back @ solved[:, :, 6:-1],
            S,
            score,
            cost,
            float(freedom),
        )

    def lens_prior(self) -> tuple[Array, Array]:
        """Return the information (p, p) about the lens that is not in the images, and its gradient (p,): the rig's and the model's own."""
        _, C, g = CameraProblem(self.points, (self.grid,)).prior((self.lens,))
        return self.prior + C, self.prior @ (self.start - self.lens) + g

    def biased(self, M: Array) -> Iterator["Corners"]:
        """Yield the corners as poses M (n, 4, 4) predict them, then the same with one patch of the image biased, patch by patch."""
        whole = replace(self.grid, weight=np.ones_like(self.grid.weight))
        predicted = self.grid.uv - CameraProblem(self.points, (whole,)).residuals(self._state(M), 0).px
        for uv in (predicted, *biased(predicted, self.grid.image_size, self.bias_px)):
            yield replace(self, grid=replace(self.grid, uv=uv))

    def without_outliers(self, M: Array) -> "Corners":
        """Return the corners with those given up that lie beyond 4.5 sigmas of their view at poses M; the others get their weight back."""
        every = replace(self.grid, weight=self.found)
        left = CameraProblem(self.points, (every,)).residuals(self._state(M), 0)
        size = np.linalg.norm(left.px, axis=2) * self.found
        limit = OUTLIER * np.maximum(scales_of_norms(size, left.seen), 1.0)
        return replace(self, grid=replace(self.grid, weight=np.where(left.seen & (size <= limit[:, None]), self.found, 0.0)))

    def rms(self, M: Array) -> tuple[float, float]:
        """Return the rms px of the corners that take part and of all found ones, at poses M."""
        out = []
        for weight in (self.grid.weight, self.found):
            left = CameraProblem(self.points, (replace(self.grid, weight=weight),)).residuals(self._state(M), 0)
            out.append(float(np.sqrt(np.sum(left.px**2) / max(int(left.seen.sum()), 1))))
        return out[0], out[1]

    def _state(self, M: Array) -> LensState:
        return LensState((self.lens,), np.eye(4)[None], se3.inverse(M))


def corners_of(views: BoardViews, poses: BoardPoses, camera: Camera, free: bool = False, same_images: bool = False) -> Corners:
    """Return the corners of the posed frames, weighed as `board_poses` weighs them.

    A free lens keeps to the camera's covariance, unless it was calibrated from the `same_images`, which would then count twice.
    """
    model = CAMERAS[camera.model]
    lens = np.array([camera.parameters[name].value for name in model.parameter_names], float)
    grid = dense_views(views, camera.model, np.arange(views.n_frames))
    kept = np.zeros(grid.weight.shape, bool)
    kept[views.frame[poses.kept], views.corner[poses.kept]] = True
    grid = rows_of(replace(grid, weight=np.where(kept, grid.weight, 0.0)), poses.frame)  # type: ignore[arg-type]
    grid = replace(grid, instant=np.arange(len(poses.frame)))
    found = np.zeros(kept.shape)
    found[views.frame, views.corner] = 1 / views.sigma_px
    covariance = _covariance(camera, model.parameter_names)
    prior = np.zeros((len(lens), len(lens)))
    if covariance is not None and not same_images:
        prior = np.asarray(np.linalg.pinv(covariance, hermitian=True, rcond=1e-15), np.float64)
    corners = Corners(views.board.points, grid, found[poses.frame], lens, free, prior, lens, covariance, views.sigma_bias_px)
    M = se3.inverse(poses.T_cam_board)
    # The poses' covariance is that of the view's noise: sigma^2 A^-1, as here but for sigma.
    Ad = se3.adjoint(poses.T_cam_board)
    of_M = Ad @ poses.cov @ np.swapaxes(Ad, 1, 2)
    noise = np.sqrt(np.einsum("nii->n", of_M @ np.linalg.inv(corners.at(M).cov)) / 6)[:, None]
    return replace(corners, grid=replace(grid, weight=grid.weight / noise), found=corners.found / noise)


def _covariance(camera: Camera, names: tuple[str, ...]) -> Array | None:
    """Return the lens's covariance in the model's order; None where it is not all told: sigmas alone say nothing of a lens.

    Coefficients make up for each other; taken for independent, their sigmas move pixels by many times what the lens is known to.
    """
    told = camera.covariance
    if told is None or not set(names) <= set(told.order):
        return None
    order = [told.order.index(name) for name in names]
    return np.array(told.matrix)[np.ix_(order, order)]
