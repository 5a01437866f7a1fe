"""Lenses, camera positions and board poses from board corners: seed, robust solve, outliers given up, plain least squares."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews
from calibkit.errors import BadInputError, NotConvergedError
from calibkit.estimation.camera_problem import CameraProblem, CameraViews, LensState, Residuals
from calibkit.estimation.camera_rig_seed import Instants, board_poses, seed_rig
from calibkit.estimation.lens_seed import robust_poses_of_views, seed_camera
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CAMERAS
from calibkit.solver.levenberg_marquardt import minimise
from calibkit.solver.robust import scale_of_norms, scales_of_norms

MIN_CORNERS = 6  # a view's pose alone takes six numbers
OUTLIER = 4.5  # in sigmas of the view: one honest corner in 25 000
NOISY_VIEW = 1.5  # a view this much noisier than the median (blur) is weighed down by what exceeds it
BAD_VIEW = 6.0  # and one this much noisier is given up
_ROBUST_ROUNDS = 3
_SETTLED = 0.01  # of the noise: a further robust round would change nothing
_CLOSE = 1e-5  # of the cost: what a fit to be judged by its errors must be known to
_POSE_LOSS = 8.0  # px: wide enough to bring a pose in from a far start
_OUTERMOST = 99.9  # percentile of corners, a stray one left out
_FINEST = 1e-6  # sigmas; perfect data leaves rounding alone, in which nothing stands out

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class DroppedView:
    """A view that did not take part, and why."""

    camera: str
    label: str
    why: str


@dataclass(frozen=True)
class LensFit:
    """Cameras of one component at the optimum."""

    views: tuple[BoardViews, ...]  # of the views that took part
    problem: CameraProblem  # plain least squares, given-up corners with weight 0
    state: LensState
    observed: tuple[Mask, ...]  # (f, n) per camera: corners found
    dropped: tuple[DroppedView, ...]
    converged: bool

    @property
    def kept(self) -> tuple[Mask, ...]:
        """Return the corners that took part."""
        return tuple(camera.weight > 0 for camera in self.problem.cameras)

    def residuals(self, c: int) -> tuple[Residuals, Residuals]:
        """Return camera c's residuals over the kept corners, and over all that were found in these views."""
        every = replace(self.problem.cameras[c], weight=self.observed[c].astype(float))
        whole = replace(self.problem, cameras=(*self.problem.cameras[:c], every, *self.problem.cameras[c + 1 :]))
        return self.problem.residuals(self.state, c), whole.residuals(self.state, c)


def dense_views(views: BoardViews, model: str, instant: NDArray[np.int64]) -> CameraViews:
    """Return the views as a (view, corner) grid for one camera model; rows with too few corners have weight 0."""
    f, n = views.n_frames, len(views.board.points)
    uv, weight = np.zeros((f, n, 2)), np.zeros((f, n))
    uv[views.frame, views.corner] = views.uv
    weight[views.frame, views.corner] = 1 / views.sigma_px
    return CameraViews(CAMERAS[model], instant, uv, weight, views.image_size)


def fit_lenses(cameras: Sequence[BoardViews], models: Sequence[str], instants: Instants, robust: bool = True) -> LensFit:
    """Return the maximum-likelihood lenses, T_cam_cam0 and board poses of cameras that share instants.

    Raises BadInputError naming the camera whose views have too few corners, NotConvergedError when there is no start or the solver ends
    nowhere.
    """
    points = cameras[0].board.points
    dropped: list[DroppedView] = []
    used: list[BoardViews] = []
    grids: list[CameraViews] = []
    lenses, poses, errors = [], [], []
    for views, model, instant in zip(cameras, models, instants, strict=True):
        enough = np.bincount(views.frame, minlength=views.n_frames) >= MIN_CORNERS
        dropped += [DroppedView(views.camera, views.labels[i], f"fewer than {MIN_CORNERS} corners") for i in np.flatnonzero(~enough)]
        views = views.select(enough)
        if not views.n_frames:
            raise BadInputError(f"{views.camera}: no view has {MIN_CORNERS} corners or more: check the target file against the board")
        grid = dense_views(views, model, instant[enough])
        lens, seeds = seed_camera(grid, points)
        found = np.isfinite(seeds.error)
        if not found.any():
            raise NotConvergedError(
                f"{views.camera}: no board pose fits the corners of any view: check the target file, or try another --model"
            )
        dropped += [DroppedView(views.camera, views.labels[i], "no board pose fits its corners") for i in np.flatnonzero(~found)]
        used.append(views.select(found))
        grids.append(rows_of(grid, found))
        lenses.append(lens)
        poses.append(seeds.T_cam_board[found])
        errors.append(seeds.error[found])
    renumber(grids)
    T_cam_cam0, T_cam0_board = seed_rig(tuple(g.instant for g in grids), poses, errors)
    problem = CameraProblem(points, tuple(grids))
    fit, rows = _solve(used, problem, LensState(tuple(lenses), T_cam_cam0, T_cam0_board), dropped, robust)
    if len(fit.dropped) > len(dropped):
        fit, _ = _solve(used, problem, _all_views(problem, fit, rows), dropped, robust)
    return fit


def _all_views(problem: CameraProblem, fit: LensFit, rows: list[NDArray[np.int64]]) -> LensState:
    """Return the state of a fit with the views that it gave up posed anew under its lenses: the seed's may have misled them."""
    m = max(int(grid.instant.max()) for grid in problem.cameras) + 1
    T_cam0_board, known = np.tile(np.eye(4), (m, 1, 1)), np.zeros(m, bool)
    for grid, part, kept in zip(problem.cameras, fit.problem.cameras, rows, strict=True):
        T_cam0_board[grid.instant[kept]] = fit.state.T_cam0_board[part.instant]
        known[grid.instant[kept]] = True
    grids = [rows_of(grid, ~known[grid.instant]) for grid in problem.cameras]
    lost = renumber(grids)
    poses = [robust_poses_of_views(grid, lens, problem.points) for grid, lens in zip(grids, fit.state.lenses, strict=True)]
    start = board_poses([g.instant for g in grids], fit.state.T_cam_cam0, [p.T_cam_board for p in poses], [p.error for p in poses])
    per_px = float(np.median(np.concatenate([grid.weight[grid.weight > 0] for grid in problem.cameras])))
    held = CameraProblem(problem.points, tuple(grids), _POSE_LOSS * per_px, free_lens=False, free_rig=False)
    if len(lost):
        T_cam0_board[lost] = minimise(held, LensState(fit.state.lenses, fit.state.T_cam_cam0, start), tolerance=1e-8).x.T_cam0_board
    return LensState(fit.state.lenses, fit.state.T_cam_cam0, T_cam0_board)


def refit(fit: LensFit, frames: Sequence[Mask], lenses_of: LensFit | None = None) -> LensFit:
    """Return the plain fit of some of the views of one that is done, started from it.

    With `lenses_of`, lenses and camera positions are held at that fit's and the poses alone are free.
    """
    problem, state = part_of(fit, frames)
    if lenses_of is not None:
        state = replace(state, lenses=lenses_of.state.lenses, T_cam_cam0=lenses_of.state.T_cam_cam0)
        problem = replace(problem, free_lens=False, free_rig=False)
    solution = minimise(problem, state, tolerance=_CLOSE)
    return LensFit(
        tuple(views.select(rows) for views, rows in zip(fit.views, frames, strict=True)),
        problem,
        solution.x,
        tuple(mask[rows] for mask, rows in zip(fit.observed, frames, strict=True)),
        fit.dropped,
        solution.converged,
    )


def part_of(fit: LensFit, frames: Sequence[Mask]) -> tuple[CameraProblem, LensState]:
    """Return the problem and the state of some of the views of each camera."""
    grids = [rows_of(grid, rows) for grid, rows in zip(fit.problem.cameras, frames, strict=True)]
    kept = renumber(grids)
    return replace(fit.problem, cameras=tuple(grids)), replace(fit.state, T_cam0_board=fit.state.T_cam0_board[kept])


def instant_times(fit: LensFit) -> Array:
    """Return each instant's time in s from the first; without stamps every image counts as a second of its own."""
    m = len(fit.state.T_cam0_board)
    t = np.zeros(m, np.int64)
    for views, camera in zip(fit.views, fit.problem.cameras, strict=True):
        t[camera.instant] = views.t_ns
    return (t - t.min()) * 1e-9 if t.any() else np.arange(m, dtype=float)


def rows_of(grid: CameraViews, rows: Mask) -> CameraViews:
    """Return some of a camera's views."""
    return replace(grid, instant=grid.instant[rows], uv=grid.uv[rows], weight=grid.weight[rows])


def renumber(grids: list[CameraViews]) -> NDArray[np.int64]:
    """Close the gaps in the instants' numbers after views were dropped; return the old numbers that stay."""
    kept, renumbered = np.unique(np.concatenate([g.instant for g in grids]), return_inverse=True)
    ends = np.cumsum([len(g.instant) for g in grids])
    for c, part in enumerate(np.split(renumbered, ends[:-1])):
        grids[c] = replace(grids[c], instant=part.astype(np.int64))
    return kept


def _solve(
    used: list[BoardViews], problem: CameraProblem, state: LensState, dropped: list[DroppedView], robust: bool
) -> tuple[LensFit, list[NDArray[np.int64]]]:
    """Return the fit and which of the views took part."""
    dropped, rows = list(dropped), [np.arange(views.n_frames) for views in used]
    found = [camera.weight for camera in problem.cameras]
    if robust:
        # From px-wide tolerance inwards: the noise is unknown until most corners fit.
        known, given_up = np.inf, len(dropped)
        for _ in range(_ROBUST_ROUNDS):
            scale = _noise(problem, state)
            if abs(scale - known) <= _SETTLED * scale and len(dropped) == given_up:
                break
            known, given_up = scale, len(dropped)
            problem = _weigh_prior(problem, state)
            solution = minimise(replace(problem, loss_scale=2.5 * scale), state, max_steps=8, tolerance=1e-4)
            state = solution.x
            good, grids = _judge_views(used, problem, state, found, dropped)
            state = replace(state, T_cam0_board=state.T_cam0_board[renumber(grids)])
            problem = replace(problem, cameras=tuple(grids))
            used = [views.select(keep) for views, keep in zip(used, good, strict=True)]
            found = [weight[keep] for weight, keep in zip(found, good, strict=True)]
            rows = [row[keep] for row, keep in zip(rows, good, strict=True)]
        # Corners given up at the robust end may come back at the plain one; where there is a prior, that it pulls less may bring more.
        for _ in range(3 if problem.has_prior(state.lenses) else 2):
            problem = _give_up_corners(problem, state, found)
            problem = _weigh_prior(problem, state)
            solution = minimise(problem, state)
            state = solution.x
    else:
        solution = minimise(problem, state)
        if problem.has_prior(solution.x.lenses):
            problem = _weigh_prior(problem, solution.x)
            solution = minimise(problem, solution.x)
    names = ", ".join(views.camera for views in used)
    for views, lens in zip(used, solution.x.lenses, strict=True):
        if not np.all(np.isfinite(lens)) or lens[:2].min() <= 0:
            raise NotConvergedError(f"{views.camera}: the solver left the lens model's domain: try another --model")
    if not np.isfinite(solution.cost):
        raise NotConvergedError(f"{names}: the solver found no minimum: check the target file, or try another --model")
    observed = tuple(weight > 0 for weight in found)
    return LensFit(tuple(used), problem, solution.x, observed, tuple(dropped), solution.converged), rows


def _normalised(problem: CameraProblem, state: LensState, c: int, weight: Array) -> tuple[Array, Mask]:
    """Return |residual| in sigmas of camera c under the given weights, and where there is one."""
    camera = replace(problem.cameras[c], weight=weight)
    whole = replace(problem, cameras=(*problem.cameras[:c], camera, *problem.cameras[c + 1 :]))
    r = whole.residuals(state, c)
    return np.linalg.norm(r.px, axis=-1) * weight, r.seen


def _noise(problem: CameraProblem, state: LensState) -> float:
    norms = [z[seen] for z, seen in (_normalised(problem, state, c, v.weight) for c, v in enumerate(problem.cameras))]
    return max(scale_of_norms(np.concatenate(norms)), _FINEST)


def _weigh_prior(problem: CameraProblem, state: LensState) -> CameraProblem:
    """Return the problem with what the lenses' priors are asked about, if there are any: the corners' noise, and how far out they lie."""
    if not problem.has_prior(state.lenses):
        return problem
    grids = []
    for c, grid in enumerate(problem.cameras):
        p = se3.transform(state.T_cam_cam0[c] @ state.T_cam0_board[grid.instant], problem.points)[grid.weight > 0]
        p = p[p[:, 2] > _FINEST]
        r2 = (p[:, 0] ** 2 + p[:, 1] ** 2) / p[:, 2] ** 2
        grids.append(replace(grid, reach=float(np.percentile(r2, _OUTERMOST)) if len(r2) else grid.reach))
    return replace(problem, cameras=tuple(grids), noise=_noise(problem, state))


def _judge_views(
    used: list[BoardViews], problem: CameraProblem, state: LensState, found: list[Array], dropped: list[DroppedView]
) -> tuple[list[Mask], list[CameraViews]]:
    """Return which views are worth keeping and those, the noisy ones weighed down; the others are added to `dropped`."""
    kept, grids = [], []
    for c, (views, grid) in enumerate(zip(used, problem.cameras, strict=True)):
        z, seen = _normalised(problem, state, c, found[c])
        scale = scales_of_norms(z, seen)
        typical = max(float(np.median(scale)), _FINEST)
        if not np.isfinite(typical):
            raise NotConvergedError(f"{views.camera}: {grid.model.name} sees most boards nowhere: try another --model")
        good = scale <= BAD_VIEW * typical
        dropped += [DroppedView(views.camera, views.labels[i], misfit(scale[i] / typical)) for i in np.flatnonzero(~good)]
        noisier = np.maximum(scale / (NOISY_VIEW * typical), 1.0)[good]
        grids.append(replace(rows_of(grid, good), weight=found[c][good] / noisier[:, None]))
        kept.append(good)
    return kept, grids


def misfit(times: float) -> str:
    return f"its corners fit {times:.0f} times worse than usual" if np.isfinite(times) else "no board pose fits its corners"


def _give_up_corners(problem: CameraProblem, state: LensState, found: list[Array]) -> CameraProblem:
    """Set the weight of corners beyond the outlier limit, or outside the model's domain, to 0; the others get theirs back."""
    grids = []
    for c, grid in enumerate(problem.cameras):
        noisier = np.max(np.where(grid.weight > 0, found[c] / np.where(grid.weight > 0, grid.weight, 1.0), 0.0), axis=1, keepdims=True)
        weight = found[c] / np.maximum(noisier, 1.0)
        z, seen = _normalised(problem, state, c, weight)
        limit = OUTLIER * max(scale_of_norms(z[seen]), _FINEST)
        grids.append(replace(grid, weight=np.where(seen & (z <= limit), weight, 0.0)))
    return replace(problem, cameras=tuple(grids))
