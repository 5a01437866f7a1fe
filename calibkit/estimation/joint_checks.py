"""Whether the joint estimate repeats: each half by itself, and one half's calibration on the other; and what else the data ask for."""

from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibkit.estimation.joint_fit import JointFit, around
from calibkit.estimation.joint_problem import DAMPING, JointProblem
from calibkit.estimation.joint_rivals import border_step
from calibkit.estimation.joint_state import LINE, LINE_SCALE, SCALE, JointState
from calibkit.estimation.joint_suspects import rms_by_sensor
from calibkit.estimation.joint_trust import border_scales, joint_covariance
from calibkit.estimation.lens_fit import rows_of
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Knots
from calibkit.solver.levenberg_marquardt import minimise

_SHORTEST_S = 8.0  # a recording whose halves are shorter than half of that is not halved
_HALF_STEPS = 6


@dataclass(frozen=True)
class Halves:
    """Calibration by the first and by the second half."""

    z: Array  # (p,) their difference over its sigma, gravity left out (0)
    rms_px: tuple[float, ...]  # per camera: corners of the second half under the first half's calibration, its trajectory free
    own_rms_px: tuple[float, ...]  # and under its own


@dataclass(frozen=True)
class Checks:
    """What was asked of the estimate."""

    board_scale: tuple[float, float]  # by the accelerations, with sigma
    line_delays: tuple[tuple[float, float] | None, ...]  # s a row, with sigma, of each camera's shutter; None: free or known
    halves: Halves | None


def check_joint(fit: JointFit, halves: bool = True) -> Checks:
    """Return the checks."""
    with threadpool_limits(1, user_api="blas"):
        return Checks(*suspects(fit), _halves(fit) if halves else None)


def suspects(fit: JointFit) -> tuple[tuple[float, float], tuple[tuple[float, float] | None, ...]]:
    """Return the board's size over what its file says and each camera's line delay, one Gauss-Newton step with these in the border."""
    cameras = range(len(fit.problem.cameras))
    shut = LINE not in fit.problem.extras and not any(camera.line_delay for camera in fit.x.cameras)
    asked = replace(fit, problem=replace(fit.problem, extras=(*fit.problem.extras, SCALE, *((LINE,) if shut else ()))))
    system, drawn, epochs = around(asked.problem, fit.x)
    asked = replace(asked, system=system, drawn=drawn, epochs=epochs)
    answer, S = drawn.core_answer, drawn.S
    g = system.gradient_border - answer.T @ system.gradient_core.ravel()
    scales = border_scales(asked)
    step = np.linalg.lstsq(S * scales[:, None] * scales, scales * g, rcond=1e-14)[0] * scales
    sigma, border = np.sqrt(np.diag(joint_covariance(asked, scales).corrected)), asked.problem.border
    k = border[SCALE].start
    lines = [border[f"{LINE} {c}"].start if shut else None for c in cameras]
    return (1 + float(step[k]), float(sigma[k])), tuple(
        None if i is None else (LINE_SCALE * float(step[i]), LINE_SCALE * float(sigma[i])) for i in lines
    )


def _halves(fit: JointFit) -> Halves | None:
    knots = fit.problem.knots
    if knots.segments * knots.spacing < _SHORTEST_S:
        return None
    middle = knots.segments // 2
    whole = (slice(0, middle), slice(middle, knots.segments))
    halves = [_refit(*part_of(fit.problem, fit.x, segments)) for segments in whole]
    if any(not half.converged for half in halves):
        return None
    scales = border_scales(fit)
    covs = [joint_covariance(half, scales).corrected for half in halves]
    off = border_step(halves[0], halves[1])
    z = off / np.sqrt(np.diag(covs[0]) + np.diag(covs[1]))
    z[fit.problem.border["gravity"]] = 0
    first, second = halves
    held = replace(second.problem, held=True)
    other = minimise(held, _with_calibration(second.x, first.x), max_steps=_HALF_STEPS, tolerance=1e-5, damping=DAMPING).x
    count = range(len(fit.problem.cameras))
    rms, own = (tuple(rms_by_sensor(second.problem, x)[f"camera {c}"] for c in count) for x in (other, second.x))
    return Halves(z, rms, own)


def _with_calibration(x: JointState, of: JointState) -> JointState:
    beside = tuple(replace(known, bias=imu.bias) for imu, known in zip(x.beside, of.beside, strict=True))
    return replace(x, cameras=of.cameras, gravity=of.gravity, board_scale=of.board_scale, imu=of.imu, beside=beside)


def _refit(problem: JointProblem, x: JointState) -> JointFit:
    solution = minimise(problem, x, max_steps=_HALF_STEPS * 3, tolerance=1e-6, damping=DAMPING)
    system, drawn, epochs = around(problem, solution.x)
    found = tuple(frames.views.weight > 0 for frames in problem.cameras)
    return JointFit(problem, solution.x, system, drawn, epochs, found, {}, {}, solution.converged, solution.steps)


def part_of(problem: JointProblem, x: JointState, segments: slice) -> tuple[JointProblem, JointState]:
    """Return the problem and the state of some of the segments: samples and frames whose time lies in them."""
    whole = problem.knots
    knots = Knots(whole.start + segments.start * whole.spacing, whole.spacing, whole.order, segments.stop - segments.start)
    end = knots.start + knots.segments * knots.spacing
    imus, cameras = [], []
    for rows, imu in zip(problem.imus, x.imus, strict=True):
        inside = (rows.t + imu.dt >= knots.start) & (rows.t + imu.dt < end)
        imus.append(replace(rows, t=rows.t[inside], gyro=rows.gyro[inside], accel=rows.accel[inside], keep=rows.keep[inside]))
    for frames, camera in zip(problem.cameras, x.cameras, strict=True):
        inside = (frames.t + camera.dt >= knots.start) & (frames.t + camera.dt < end)
        cameras.append(replace(frames, t=frames.t[inside], views=rows_of(frames.views, inside)))
    controls = slice(segments.start, segments.stop + whole.order - 1)
    beside = tuple(replace(imu, bias=imu.bias[controls]) for imu in x.beside)
    state = replace(x, R=x.R[controls], p=x.p[controls], bias=x.bias[controls], beside=beside)
    return replace(problem.with_imus(imus), knots=knots, cameras=tuple(cameras)), state
