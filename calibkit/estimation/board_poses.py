"""Where a board was before a camera whose lens is known: each frame's pose with its covariance, or why it has none."""

from collections import Counter
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews, Times
from calibkit.data.rig import Camera
from calibkit.errors import BadInputError
from calibkit.estimation.camera_problem import CameraProblem, LensState
from calibkit.estimation.flat_poses import flat_poses
from calibkit.estimation.lens_fit import BAD_VIEW, MIN_CORNERS, NOISY_VIEW, DroppedView, dense_views, misfit
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CAMERAS, CameraModel

_SLAB_POINTS = 2**15  # corners at a time: what an hour's recording needs is no more than a minute's
_FINEST = 1e-6  # sigmas; perfect data leaves rounding alone
_EXACT_STEPS = 4
_SETTLED = 1e-2  # of the noise's square: what the last step leaves is of second order in it
_LOOSEST = 0.2  # rad; an orientation less sure than this has no covariance that means something

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class BoardPoses:
    """Poses of one camera's frames, in the recording's order."""

    camera: str
    t_ns: Times  # (f,) 0 throughout where there are no stamps
    labels: tuple[str, ...]  # (f,)
    frame: NDArray[np.intp]  # (f,) which of the views
    T_cam_board: Array  # (f, 4, 4) p_cam = T_cam_board p_board
    cov: Array  # (f, 6, 6) of d in T_cam_board exp(d), (rho m, phi rad)
    rms: Array  # (f,) px, sqrt(sum(du^2 + dv^2) / N) over the frame's kept corners
    n_corners: NDArray[np.intp]  # (f,) kept ones
    kept: Mask  # (n,) which rows of the views took part
    dropped: tuple[DroppedView, ...]
    sigma_px: float  # of a corner, per coordinate, by the residuals


@dataclass(frozen=True)
class _Slab:
    """All frames of a part of the views, good or not; sigmas are the detector's."""

    T: Array  # (f, 4, 4)
    cov: Array  # (f, 6, 6) for noise of one sigma
    scale: Array  # (f,) noise by the median residual, inf where there is no pose
    chi2: Array  # (f,) over the kept corners
    px2: Array  # (f,) likewise, px^2
    found: NDArray[np.intp]  # (f,) corners
    count: NDArray[np.intp]  # (f,) and how many of them are kept
    ambiguous: Mask  # (f,)
    kept: Mask  # (n,) rows


def board_poses(views: BoardViews, camera: Camera) -> BoardPoses:
    """Return each frame's maximum-likelihood pose under the camera's lens, wrong corners given up.

    The covariance is that of white noise as large as the residuals have it; a frame much noisier than the others has its own.
    Raises BadInputError where the lens is not known or not that of these images, and where no frame has a pose.
    """
    model, lens = _lens_of(camera, views)
    step = max(1, _SLAB_POINTS // len(views.board.points))
    slabs = [_pose_slab(_part(views, start, start + step), model, lens) for start in range(0, views.n_frames, step)]
    if not slabs:
        raise _nothing(views, "no image shows the board")
    every = _Slab(**{field.name: np.concatenate([getattr(slab, field.name) for slab in slabs]) for field in fields(_Slab)})

    posed = np.isfinite(every.scale) & (every.count >= MIN_CORNERS)
    if not posed.any():
        raise _nothing(views, f"no image has {MIN_CORNERS} corners that fit one")
    typical = max(float(np.median(every.scale[posed])), _FINEST)
    times = every.scale / typical
    quiet = posed & (times <= NOISY_VIEW)
    freedom = float(np.sum(2 * every.count[quiet] - 6))
    noise = max(float(np.sqrt(every.chi2[quiet].sum() / freedom)), _FINEST)
    cov = every.cov * (noise * np.maximum(np.where(posed, times, 0.0) / NOISY_VIEW, 1.0))[:, None, None] ** 2

    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(cov[:, 3:, 3:])[:, -1], 0.0))
    why = _reasons(every, times, sigma)
    good = np.array([not reason for reason in why])
    if not good.any():
        reason, images = Counter(why).most_common(1)[0]
        raise _nothing(views, f"{images} of {len(why)} images: {reason}")
    count = every.count[good]
    return BoardPoses(
        camera=views.camera,
        t_ns=views.t_ns[good],
        labels=tuple(label for label, reason in zip(views.labels, why, strict=True) if not reason),
        frame=np.flatnonzero(good),
        T_cam_board=every.T[good],
        cov=cov[good],
        rms=np.sqrt(every.px2[good] / count),
        n_corners=count,
        kept=every.kept & good[views.frame],
        dropped=tuple(DroppedView(views.camera, label, reason) for label, reason in zip(views.labels, why, strict=True) if reason),
        sigma_px=float(np.sqrt(every.px2[quiet].sum() / freedom)),
    )


def _nothing(views: BoardViews, why: str) -> BadInputError:
    return BadInputError(f"{views.camera}: no board poses ({why}): check the target file and the lens against the images")


def _lens_of(camera: Camera, views: BoardViews) -> tuple[CameraModel, Array]:
    """Return the lens's model and parameters, which must be known and of images of this size."""
    name = views.camera
    unknown = [parameter for parameter, estimate in camera.parameters.items() if estimate.value is None]
    if unknown:
        raise BadInputError(f"{name}: the rig file has no value for {', '.join(unknown)}: calibrate the lens first (calibkit intrinsics)")
    if camera.resolution != views.image_size:
        had, has = ("{} x {}".format(*size) for size in (camera.resolution, views.image_size))
        raise BadInputError(f"{name}: the rig file's lens is for images of {had}, these are {has}: give the rig file of this camera mode")
    model = CAMERAS[camera.model]
    lens = np.array([camera.parameters[parameter].value for parameter in model.parameter_names], float)
    if lens[:2].min() <= 0:
        raise BadInputError(f"{name}: fx and fy must be positive: correct them in the rig file")
    return model, lens


def _part(views: BoardViews, start: int, stop: int) -> BoardViews:
    """Return frames start ... stop - 1: views of the arrays."""
    frames = slice(start, min(stop, views.n_frames))
    rows = slice(*np.searchsorted(views.frame, [frames.start, frames.stop]))
    return replace(
        views,
        t_ns=views.t_ns[frames],
        labels=views.labels[frames],
        frame=views.frame[rows] - np.int32(start),
        corner=views.corner[rows],
        uv=views.uv[rows],
        sigma_px=views.sigma_px[rows],
    )


def _pose_slab(views: BoardViews, model: CameraModel, lens: Array) -> _Slab:
    """Return the poses of some frames: robust ones of the linearised lens, then exact least squares of the corners that are kept."""
    points = views.board.points
    grid = dense_views(views, model.name, np.arange(views.n_frames))
    found = flat_poses(grid, lens, points)
    scale = found.scale.copy()
    kept = found.kept & np.isfinite(scale)[:, None]
    problem = CameraProblem(points, (replace(grid, weight=np.where(kept, grid.weight, 0.0)),), free_lens=False, free_rig=False)
    state = LensState((lens,), np.eye(4)[None], found.T_cam_board)
    limit = _SETTLED * np.maximum(scale, _FINEST) ** 2
    for _ in range(_EXACT_STEPS):
        _, system = problem.linearize(state)
        g = system.gradient_core[:, :, None]
        cov = system.core.solve(np.tile(np.eye(6), (len(g), 1, 1)))
        step = (cov @ g)[:, :, 0]
        state = replace(state, T_cam0_board=se3.retract(state.T_cam0_board, step))
        unsettled = np.sum(g[:, :, 0] * step, axis=1) > limit
        if not unsettled.any():
            break
    scale[unsettled] = np.inf

    left = problem.residuals(state, 0)
    kept &= left.seen
    squares = np.sum(left.px**2, axis=-1)
    return _Slab(
        T=state.T_cam0_board,
        cov=cov,
        scale=scale,
        chi2=np.sum(squares * grid.weight**2, axis=1),
        px2=squares.sum(axis=1),
        found=np.sum(grid.weight > 0, axis=1),
        count=kept.sum(axis=1),
        ambiguous=found.ambiguous,
        kept=kept[views.frame, views.corner],
    )


def _reasons(every: _Slab, times: Array, sigma: Array) -> list[str]:
    """Return why each frame is not to be used, or nothing."""
    why = [""] * len(times)
    cases = [
        (sigma > _LOOSEST, "its corners hardly tell the board's orientation"),
        (every.ambiguous, "ambiguous: the board tilted the other way fits as well; hold it nearer, or take a larger one"),
        (every.count < MIN_CORNERS, f"fewer than {MIN_CORNERS} corners fit one pose"),
        (times > BAD_VIEW, ""),
        (every.found < MIN_CORNERS, f"fewer than {MIN_CORNERS} corners"),
    ]
    for frames, text in cases:  # the last one says it
        for i in np.flatnonzero(frames):
            why[i] = text or misfit(float(times[i]))
    return why
