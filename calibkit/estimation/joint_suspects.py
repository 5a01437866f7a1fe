"""What may be wrong with a camera-IMU calibration, and what a new recording's joint estimate says about it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibkit.estimation.diagnosis import Evidence, Suspect
from calibkit.estimation.joint_fit import JointFit, around, corner_residuals
from calibkit.estimation.joint_problem import DAMPING, Drift, JointProblem
from calibkit.estimation.joint_state import DRIFTING, LINE, M_A, M_G, PHI, SCALE, CameraState, JointState, model_step, of_imu
from calibkit.estimation.joint_trust import joint_trust
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.models.imu import ImuModel
from calibkit.solver.levenberg_marquardt import minimise

ASKED = (SCALE, M_A, M_G, PHI, LINE)  # what a joint estimate has not, and is suspected beside it
AXES = "xyz"
_TRAJECTORY_STEPS = 12
_DIAGONAL, _BESIDE = (0, 2, 5), (1, 3, 4)  # of a lower triangular matrix, row by row


@dataclass(frozen=True)
class Known:
    """The calibration under test."""

    cameras: tuple[CameraState, ...]
    imu: ImuModel
    covs: tuple[tuple[Array, float, Array], ...]  # of T (6, 6), dt's variance, of the lens; 0 where it has none


def evidence(fit: JointFit, known: Known, drifts: Sequence[Drift]) -> tuple[Evidence, tuple[Suspect, ...]]:
    """Return how a joint fit of new data wants the calibration moved, and the suspects, gravity eliminated."""
    extras = tuple(dict.fromkeys((*fit.problem.extras, *ASKED)))
    problem = replace(fit.problem, extras=extras, drifts=tuple(drifts))
    with threadpool_limits(1, user_api="blas"):
        system, drawn, epochs = around(problem, fit.x)
        asked = replace(fit, problem=problem, system=system, drawn=drawn, epochs=epochs)
        trust = joint_trust(asked)
    border, scales = problem.border, trust.scales
    answer, S = drawn.core_answer, drawn.S
    g = system.gradient_border - answer.T @ system.gradient_core.ravel()
    step = np.linalg.lstsq(S * scales[:, None] * scales, scales * g, rcond=1e-14)[0] * scales
    delta, cov = step + _from_known(asked, known), trust.cov + _of_known(asked, known)
    keep = np.setdiff1d(np.arange(border.size), np.arange(border.size)[border["gravity"]])
    gone = np.arange(border.size)[border["gravity"]]
    information = S[np.ix_(keep, keep)] - S[np.ix_(keep, gone)] @ np.linalg.solve(S[np.ix_(gone, gone)], S[np.ix_(gone, keep)])
    found = Evidence(delta[keep], cov[np.ix_(keep, keep)], information, scales[keep], float(max(trust.covariance.blocks, 8)))
    return found, tuple(replace(each, columns=each.columns[keep]) for each in _suspects(asked))


def _from_known(fit: JointFit, known: Known) -> Array:
    """Return the step (p,) from the calibration under test to the estimate."""
    border = fit.problem.border
    out = np.zeros(border.size)
    for name, step in model_step(known.imu, fit.x.imu).items():
        if name in border.extras:
            out[border[name]] = step
    for c, (was, now) in enumerate(zip(known.cameras, fit.x.cameras, strict=True)):
        out[border[f"T {c}"]] = se3.local(was.T_cam_imu, now.T_cam_imu)
        out[border[f"dt {c}"]] = now.dt - was.dt
        out[border[f"lens {c}"]] = now.lens - was.lens
    return out


def _of_known(fit: JointFit, known: Known) -> Array:
    border = fit.problem.border
    out = np.zeros((border.size, border.size))
    for c, (T, dt, lens) in enumerate(known.covs):
        for name, cov in ((f"T {c}", T), (f"dt {c}", dt), (f"lens {c}", lens)):
            out[border[name], border[name]] = cov
    return out


def _suspects(fit: JointFit) -> list[Suspect]:
    border, unit = fit.problem.border, np.eye(fit.problem.border.size)
    found = [Suspect("board scale", unit[:, border[SCALE]])]
    for c, (frames, camera) in enumerate(zip(fit.problem.cameras, fit.x.cameras, strict=True)):
        T, lens = border[f"T {c}"], unit[:, border[f"lens {c}"]]
        turns, shifts = mount(camera.T_cam_imu)
        moves = {f"R_{axis}": turns[:, i] for i, axis in enumerate(AXES)} | {f"p_{axis}": shifts[:, i] for i, axis in enumerate(AXES)}
        found += [Suspect(f"dt {c}", unit[:, border[f"dt {c}"]])]
        found += [Suspect(f"{name} {c}", unit[:, T] @ move[:, None]) for name, move in moves.items()]
        focal = camera.lens[:2] / camera.lens[:2].mean()
        found += [
            Suspect(f"focal {c}", lens[:, :2] @ focal[:, None]),
            Suspect(f"focal lengths {c}", lens[:, :2]),
            Suspect(f"centre {c}", lens[:, 2:4]),
            Suspect(f"line delay {c}", unit[:, border[f"{LINE} {c}"]]),
        ]
        found += [Suspect(f"distortion {c}", lens[:, 4:])] if lens.shape[1] > 4 else []
        for drift in fit.problem.drifts:
            block = unit[:, border[f"{drift.name} {c}"]]
            assert block.shape[1] == DRIFTING
            found += [Suspect(f"dt {c} with {drift.name}", block[:, 6:7])]
            found += [Suspect(f"{name} {c} with {drift.name}", block[:, :6] @ move[:, None]) for name, move in moves.items()]
            found += [Suspect(f"focal {c} with {drift.name}", block[:, 7:9] @ focal[:, None])]
        assert frames.views.model.parameter_names[2:4] == ("cx", "cy")
    for name, sensor in ((M_G, "gyroscope"), (M_A, "accelerometer")):
        columns = unit[:, border[name]]
        beside = [columns[:, list(_BESIDE)], *([unit[:, border[PHI]]] if name == M_G else [])]
        found += [Suspect(f"{sensor} scale", columns[:, list(_DIAGONAL)]), Suspect(f"{sensor} axes", np.concatenate(beside, axis=1))]
    return found


def with_trajectory(problem: JointProblem, x: JointState) -> JointState:
    """Return the state with the trajectory that suits its calibration best."""
    return minimise(replace(problem, held=True), x, max_steps=_TRAJECTORY_STEPS, tolerance=1e-5, damping=DAMPING).x


def left_by_sensor(problem: JointProblem, x: JointState) -> dict[str, tuple[Array, Array]]:
    """Return the times (n,) s and residuals (n, d) of what counts: "camera 0" ... px, "gyro" rad/s, "accel" m/s^2."""
    out = {}
    for c, (frames, camera) in enumerate(zip(problem.cameras, x.cameras, strict=True)):
        px, valid = corner_residuals(problem, x, c)
        frame, corner = np.nonzero((frames.views.weight > 0) & valid)
        out[f"camera {c}"] = frames.t[frame] + camera.dt, px[frame, corner]
    for j, (rows, imu) in enumerate(zip(problem.imus, x.imus, strict=True)):
        left, t = problem.imu_residuals(x, j), rows.t + imu.dt
        parts = {of_imu(kind, j): (rows.keep[:, k], slice(3 * k, 3 * k + 3)) for k, kind in enumerate(("gyro", "accel"))}
        out |= {kind: (t[kept], left[kept, part]) for kind, (kept, part) in parts.items()}
    return out


def rms_by_sensor(problem: JointProblem, x: JointState) -> dict[str, float]:
    """Return the rms of what counts, by the names of `left_by_sensor`."""
    return {kind: _rms(rows) for kind, (_, rows) in left_by_sensor(problem, x).items()}


def _rms(rows: Array) -> float:
    return float(np.sqrt(np.sum(rows**2) / max(len(rows), 1)))


def mount(T_cam_imu: Array) -> tuple[Array, Array]:
    """Return the steps (6, 3) of T_cam_imu as the camera turns in place about its own axes, by radian, and moves along the IMU's, by metre.

    T_imu_cam' = T_imu_cam exp(w), so T' = exp(-w) T: phi = -R^T w, rho = R^T (p x w); the centre -R^T p moved by m: rho = -m.
    """
    R, p = T_cam_imu[:3, :3], T_cam_imu[:3, 3]
    return np.concatenate([R.T @ so3.hat(p), -R.T]), np.concatenate([-np.eye(3), np.zeros((3, 3))])
