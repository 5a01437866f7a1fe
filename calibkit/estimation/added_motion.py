"""Which motion a recording lacks: what ten more seconds of each simple motion would tell, by the same equations.

The information of a motion does not hang on what is measured, only on where everything is: S = C - B^T A^-1 B of the motion is added to
that of the recording, and the motion is best that leaves the least sigma, in units of what must be known, of the worst parameter.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibkit.estimation.joint_fit import JointFit
from calibkit.estimation.joint_inertial import ImuRows
from calibkit.estimation.joint_noise import schur
from calibkit.estimation.joint_problem import Frames, JointProblem
from calibkit.estimation.joint_state import ImuState, JointState
from calibkit.estimation.joint_trust import Trust
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots, Steps
from calibkit.solver.arrowhead import Arrowhead
from calibkit.solver.trust import DETERMINED, WEAK

DURATION_S, HZ = 10.0, 1.0
TURN_RAD, MOVE_M = np.radians(25.0), 0.08  # each way, at HZ: 2.7 rad/s and 3.2 m/s^2 at the most
_ROUNDING, _NOTHING = 1e-13, 1e-26  # of information: what is less than the first is the second
_HELPS = 0.8  # of the worst sigma, at least
_MARGIN_S = 0.1  # frames so near the ends of the motion are left out
_INSIDE_PX = 5.0  # of the image's edge
_AXES = {"x": "(pitch)", "y": "(yaw)", "z": "(roll)"}


@dataclass(frozen=True)
class AddedMotion:
    """Ten seconds of one simple motion."""

    text: str
    left: float  # the worst sigma of T and dt with it, and with those before it, in units of what must be known


def missing_motions(fit: JointFit, trust: Trust) -> tuple[AddedMotion, ...]:
    """Return the motions about and along the first camera's axes to add, the most useful first, until all is determined or none helps."""
    with threadpool_limits(1, user_api="blas"):
        return _missing(fit, trust)


def in_words(motions: Sequence[AddedMotion]) -> list[str]:
    """Return each motion with what is known once it is added, too."""
    known = ("T and dt are determined then" if each.left <= DETERMINED else _left(each.left) for each in motions)
    return [f"{each.text} ({then})" for each, then in zip(motions, known, strict=True)]


def _left(worst_sigma: float) -> str:
    if worst_sigma > WEAK:
        return "something is open still"
    return f"the worst is known to {worst_sigma:.0f} times 1 mm, 1 mrad, 0.1 ms then"


def _missing(fit: JointFit, trust: Trust) -> tuple[AddedMotion, ...]:
    left = worst(trust.cov, trust.scales, fit)
    if left <= DETERMINED:
        return ()
    told = {text: _scaled(schur(_moved(fit, turn, move))[1], trust) for text, turn, move in _simple()}
    known, found = _information(trust), []
    while left > DETERMINED and told:
        covs = {text: _covariance(known + S, trust) for text, S in told.items()}
        best = min(covs, key=lambda text: worst(covs[text], trust.scales, fit))
        known = known + told.pop(best)
        before, left = left, worst(covs[best], trust.scales, fit)
        found.append(AddedMotion(best, left))
        if left > _HELPS * before:
            return tuple(found[:-1])
    return tuple(found)


def _simple() -> Iterator[tuple[str, Array, Array]]:
    """Yield each motion in words, with how far it turns (3,) rad and moves (3,) m, each way."""
    for unit, (axis, word) in zip(np.eye(3), _AXES.items(), strict=True):
        yield (
            f"turn it about the camera's {axis} axis {word}, {np.degrees(TURN_RAD):.0f} deg each way, once a second",
            TURN_RAD * unit,
            0 * unit,
        )
        yield f"shake it along the camera's {axis} axis, {100 * MOVE_M:.0f} cm each way, once a second", 0 * unit, MOVE_M * unit


def _covariance(information: Array, trust: Trust) -> Array:
    """Return the inverse; what the information does not hold is open, and not known as a pseudo-inverse has it."""
    root = 1 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information * root[:, None] * root)
    F = (trust.scales * root)[:, None] * vectors / np.sqrt(np.where(values > _ROUNDING, values, _NOTHING))
    out: Array = F @ F.T
    return out


def worst(cov: Array, scales: Array, fit: JointFit) -> float:
    """Return the greatest sigma of T and dt of all cameras and further IMUs, in units of what they must be known to."""
    cameras, imus = range(len(fit.problem.cameras)), range(1, len(fit.problem.imus))
    names = [name for c in cameras for name in (f"T {c}", f"dt {c}")] + [name for j in imus for name in (f"T_imu {j}", f"dt_imu {j}")]
    at = fit.problem.border.at(names)
    return float(np.max(np.sqrt(np.diag(cov))[at] / scales[at]))


def _scaled(S: Array, trust: Trust) -> Array:
    out: Array = S * trust.scales[:, None] * trust.scales
    return out


def _information(trust: Trust) -> Array:
    """Return what the recording itself tells, scaled."""
    values, vectors = np.linalg.eigh(trust.cov / trust.scales[:, None] / trust.scales)
    out: Array = vectors / np.maximum(values, values[-1] * 1e-15) @ vectors.T
    return out


def _moved(fit: JointFit, turn: Array, move: Array) -> Arrowhead:
    """Return the normal equations of a motion from where the board is seen best."""
    problem, x = fit.problem, fit.x
    knots = Knots(0.0, problem.knots.spacing, problem.knots.order, int(np.ceil(DURATION_S / problem.knots.spacing)))
    start = _best_seen(problem, x)
    t = knots.centre()
    phase = np.sin(2 * np.pi * HZ * t)[:, None]
    T_start = se3.make(so3.exp(phase * turn), phase * move)  # of the camera at t in the camera at the start
    T_world_imu = start @ T_start @ x.cameras[0].T_cam_imu
    biases = [np.tile(imu.bias.mean(axis=0), (knots.controls, 1)) for imu in x.imus]
    beside = tuple(replace(imu, bias=bias) for imu, bias in zip(x.beside, biases[1:], strict=True))
    state = replace(x, R=T_world_imu[:, :3, :3], p=T_world_imu[:, :3, 3], bias=biases[0], beside=beside)
    imus = [_samples(rows, imu) for rows, imu in zip(problem.imus, x.imus, strict=True)]
    motion = replace(problem.with_imus(imus), knots=knots, loss_scale=np.inf)
    cameras = tuple(_frames(motion, state, c) for c in range(len(problem.cameras)))
    return replace(motion, cameras=cameras).linearize(state)[1]


def _samples(rows: ImuRows, imu: ImuState) -> ImuRows:
    """Return an IMU's samples of the motion, whose values do not matter."""
    t = np.arange(0, DURATION_S, float(np.median(np.diff(rows.t)))) - imu.dt
    nothing = np.zeros((len(t), 3))
    return replace(rows, t=t, gyro=nothing, accel=nothing, keep=np.ones((len(t), 2), bool))


def _best_seen(problem: JointProblem, x: JointState) -> Array:
    """Return T_board_cam (4, 4) of the first camera where it sees the board whole, from the middle of such frames' distances."""
    T = problem.seen(x, Steps.of(x.R), 0).T_cam_board
    corners = np.count_nonzero(problem.cameras[0].views.weight, axis=1)
    best = np.flatnonzero(corners >= 0.98 * corners.max())
    middle = T[best, :3, 3] @ T[best, :3, 3].mean(axis=0)
    out: Array = se3.inverse(T[best[np.argsort(middle)[len(best) // 2]]])
    return out


def _frames(problem: JointProblem, x: JointState, c: int) -> Frames:
    """Return camera c's frames of the motion: what of the board is in the image, at the sigma that its corners have."""
    frames, camera = problem.cameras[c], x.cameras[c]
    views = frames.views
    gap = float(np.median(np.diff(np.sort(frames.t))))
    t = np.arange(_MARGIN_S, DURATION_S - _MARGIN_S, gap) - camera.dt
    blank = np.zeros((len(t), len(problem.points)))
    grid = replace(views, instant=np.arange(len(t)), uv=np.repeat(blank[..., None], 2, axis=2), weight=blank)
    here = replace(frames, t=t, views=grid)
    moving = replace(problem, cameras=(*problem.cameras[:c], here, *problem.cameras[c + 1 :]))
    T = moving.seen(x, Steps.of(x.R), c).T_cam_board
    seen = views.model.project(se3.transform(T, problem.points), camera.lens)
    high = np.array(views.image_size) - 1 - _INSIDE_PX
    inside = seen.valid & np.all((seen.uv > _INSIDE_PX) & (seen.uv < high), axis=-1)
    usual = float(np.median(views.weight[views.weight > 0]))
    return replace(here, views=replace(grid, uv=np.where(inside[..., None], seen.uv, 0.0), weight=np.where(inside, usual, 0.0)))
