"""What a cause does to the residuals, and how large it is from moment to moment: what a diagnosis is drawn from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibkit.estimation.joint_fit import JointFit, corner_residuals
from calibkit.estimation.joint_noise import schur
from calibkit.estimation.joint_parts import projected
from calibkit.estimation.joint_problem import Drift, JointProblem
from calibkit.estimation.joint_state import JointState
from calibkit.estimation.joint_suspects import ASKED, with_trajectory
from calibkit.geometry.so3 import Array

_WINDOWS, _SHORTEST_S = 30, 1.0
_APART_S = 1e-3  # that a pixel's velocity is taken over
_TELLS_LITTLE = 0.01  # of what the best window tells


@dataclass(frozen=True)
class Signature:
    """One sensor's residuals under the calibration under test, and what of them a cause alone explains; rows that count."""

    left: Array  # (n, d)
    predicted: Array  # (n, d) what mending the cause takes away, the trajectory set anew
    sigma: Array  # (n,)
    moving: Array  # (n, d) how fast the measurement changes, per s
    uv: Array | None = None  # (n, 2) px, of corners

    @property
    def weight(self) -> float:
        """Return the squares of what the cause predicts, in sigmas."""
        return float(np.sum((self.predicted / self.sigma[:, None]) ** 2))


@dataclass(frozen=True)
class Course:
    """How large a suspect is in windows of time, the trajectory eliminated and all else as the recording itself has it."""

    t: Array  # (w,) s from the recording's start
    theta: Array  # (w,)
    sigma: Array  # (w,)


def signatures(fit: JointFit, held: JointState, drifts: Sequence[Drift], step: Array) -> dict[str, Signature]:
    """Return by sensor ("camera 0", ..., "gyro", "accel") what a step (p,) of the calibration under test, without gravity, explains."""
    asked = _asked(fit, drifts)
    core = np.zeros_like(asked.linearize(held)[1].gradient_core)
    mended = with_trajectory(fit.problem, asked.retract(held, core, _with_gravity(asked, step)))
    was, now = (_signatures(fit.problem, x) for x in (held, mended))
    return {
        kind: replace(each, predicted=each.left - now[kind].left) for kind, each in was.items() if each.left.shape == now[kind].left.shape
    }


def courses(fit: JointFit, drifts: Sequence[Drift], columns: Mapping[str, Array], sizes: Mapping[str, float]) -> dict[str, Course]:
    """Return the course of suspects of one column (p,) each, whose sizes the recording as a whole has told.

    With K the columns of the unknown, the trajectory eliminated, and r the residuals at the recording's own estimate, a window w has
    theta_w = theta + (K_w^T K_w)^-1 K_w^T r_w.
    """
    asked = _asked(fit, drifts)
    with threadpool_limits(1, user_api="blas"):
        parts = list(asked.parts(fit.x))
        _, system = asked.assembled(parts, fit.x)
        answer, _ = schur(system)
    first, last = fit.problem.imu.t[[0, -1]]
    windows = int(np.clip((last - first) // _SHORTEST_S, 1, _WINDOWS))
    steps = np.stack([_with_gravity(asked, column) for column in columns.values()], axis=1)
    information, score = np.zeros((2, windows, len(columns)))
    for part in parts:
        of_each, scores = projected(part, answer)
        window = np.clip((part.t_s - first) / (last - first) * windows, 0, windows - 1).astype(int)
        np.add.at(information, window, np.einsum("pk,npq,qk->nk", steps, of_each, steps, optimize=True))
        np.add.at(score, window, scores @ steps)
    t = (np.arange(windows) + 0.5) * (last - first) / windows
    out = {}
    for k, key in enumerate(columns):
        told = information[:, k] > _TELLS_LITTLE * information[:, k].max(initial=0.0)
        inverse = 1 / information[told, k]
        out[key] = Course(t[told], sizes[key] + inverse * score[told, k], np.sqrt(inverse))
    return out


def _asked(fit: JointFit, drifts: Sequence[Drift]) -> JointProblem:
    return replace(fit.problem, extras=tuple(dict.fromkeys((*fit.problem.extras, *ASKED))), drifts=tuple(drifts))


def _with_gravity(problem: JointProblem, step: Array) -> Array:
    """Return a step of the border from one that leaves gravity out."""
    whole = np.zeros(problem.border.size)
    whole[np.setdiff1d(np.arange(len(whole)), np.arange(len(whole))[problem.border["gravity"]])] = step
    return whole


def _signatures(problem: JointProblem, x: JointState) -> dict[str, Signature]:
    """Return each sensor's residuals at x; what is predicted is not known yet."""
    out = {}
    for c, (frames, camera) in enumerate(zip(problem.cameras, x.cameras, strict=True)):
        later = replace(x, cameras=(*x.cameras[:c], replace(camera, dt=camera.dt + _APART_S), *x.cameras[c + 1 :]))
        (px, valid), (then, also) = (corner_residuals(problem, each, c) for each in (x, later))
        rows = np.nonzero((frames.views.weight > 0) & valid & also)
        moving = (px - then)[rows] / _APART_S  # of the prediction
        out[f"camera {c}"] = Signature(px[rows], np.zeros((0, 2)), 1 / frames.views.weight[rows], moving, frames.views.uv[rows])
    left, imu = problem.imu_residuals(x), problem.imu
    for k, (kind, measured) in enumerate((("gyro", imu.gyro), ("accel", imu.accel))):
        part, keep = slice(3 * k, 3 * k + 3), imu.keep[:, k]
        moving = np.gradient(measured - left[:, part], imu.t, axis=0)
        sigma = np.full(int(keep.sum()), float(imu.sigma[part].mean()))
        out[kind] = Signature(left[keep, part], np.zeros((0, 3)), sigma, moving[keep])
    return out
