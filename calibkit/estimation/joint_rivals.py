"""Several solutions of one recording whose motion repeats itself: which fits best, and whether another fits as well."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibkit.estimation.joint_fit import JointFit, RoughFit, fit_roughly, refine
from calibkit.estimation.joint_problem import JointProblem
from calibkit.estimation.joint_state import LINE, LINE_SCALE, JointState, model_step, of_imu
from calibkit.estimation.joint_trust import Trust
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array

_APART_S = 0.05  # what lies nearer is one solution
_WORSE = 0.05  # of the residuals' number, as -2 ln likelihood: by so much a solution is surely the worse one
_CLEAN = 2.0  # real over stated sigma: what fits worse is no solution that could rule out another


@dataclass(frozen=True)
class Rival:
    """Another solution that cannot be ruled out."""

    offsets: tuple[float, ...]  # s, dt of each camera
    apart: Array  # (p,) the step of the border to it
    alike: bool  # it fits as well; else neither fits


def fit_best(starts: Sequence[tuple[JointProblem, JointState]]) -> tuple[JointFit, int, Rival | None]:
    """Return the fit that is best, of those that fit alike that of the least offset, its start, and what else nothing rules out."""
    rough = [fit_roughly(*start) for start in starts]
    misfit, dt = np.array([_misfit(each) for each in rough]), np.array([each.x.cameras[0].dt for each in rough])
    alike = np.flatnonzero(misfit - misfit.min() <= _WORSE * _rows(rough[int(np.argmin(misfit))]))
    best = int(alike[np.argmin(np.abs(dt[alike]))])
    fit = refine(rough[best])
    others = [k for k in np.argsort(misfit).tolist() if abs(dt[k] - fit.x.cameras[0].dt) > _APART_S]
    clean = fit.converged and max(fit.factors.values()) < _CLEAN
    if not others or (clean and others[0] not in alike):
        return fit, best, None
    other = rough[others[0]]
    return fit, best, Rival(tuple(camera.dt for camera in other.x.cameras), border_step(fit, other), others[0] in alike)


def _misfit(fit: RoughFit) -> float:
    """Return -2 ln likelihood but for a constant: n ln s^2 of each sensor's noise."""
    sizes = {of_imu(kind, j): 3 * len(rows.t) for j, rows in enumerate(fit.problem.imus) for kind in ("gyro", "accel")}
    sizes |= {f"camera {c}": 2 * int(np.count_nonzero(weight)) for c, weight in enumerate(fit.found)}
    return sum(n * 2 * float(np.log(fit.factors[kind])) for kind, n in sizes.items())


def _rows(fit: RoughFit) -> int:
    return 6 * sum(len(rows.t) for rows in fit.problem.imus) + 2 * sum(int(np.count_nonzero(weight)) for weight in fit.found)


def spread(trust: Trust, rival: Rival | None) -> Trust:
    """Return the trust in either of two solutions that fit alike: E (x - truth)^2 grows by half of d d^T, d what lies between them."""
    return trust if rival is None else replace(trust, cov=trust.cov + np.outer(rival.apart, rival.apart) / 2)


def border_step(a: JointFit, b: JointFit | RoughFit) -> Array:
    """Return the step of the border from a to b, gravity's left out (0)."""
    border, one, two = a.problem.border, a.x, b.x
    out = np.zeros(border.size)
    for j, (first_imu, second_imu) in enumerate(zip(one.imus, two.imus, strict=True)):
        steps = model_step(first_imu.model, second_imu.model)
        for name in border.free_of(j):
            out[border[of_imu(name, j)]] = steps[name]
        if j:
            out[border[f"T_imu {j}"]] = se3.local(first_imu.T_imu_ref, second_imu.T_imu_ref)
            out[border[f"dt_imu {j}"]] = second_imu.dt - first_imu.dt
    for c, (first, second) in enumerate(zip(one.cameras, two.cameras, strict=True)):
        out[border[f"T {c}"]] = se3.local(first.T_cam_imu, second.T_cam_imu)
        out[border[f"dt {c}"]] = second.dt - first.dt
        out[border[f"lens {c}"]] = second.lens - first.lens
        if LINE in border.extras:
            out[border[f"{LINE} {c}"]] = (second.line_delay - first.line_delay) / LINE_SCALE
    return out
