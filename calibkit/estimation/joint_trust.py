"""How far the joint estimate may be trusted: its covariance with correlated residuals paid for."""

import numpy as np

from calibkit.estimation.joint_fit import JointFit
from calibkit.estimation.joint_parts import projected
from calibkit.estimation.lens_trust import lens_scales
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import SCALES, Covariance, covariance_in_time

_GRAVITY_SCALE = 0.01  # m/s^2: 1 mrad of its direction


def joint_covariance(fit: JointFit) -> Covariance:
    """Return the covariance of the border, plain and corrected, by epochs of time."""
    S, scores, t = [], [], []
    for part in fit.problem.parts(fit.x):
        if part.kind != "stays":
            information, score = projected(part, fit.drawn.core_answer)
            S.append(information)
            scores.append(score)
            t.append(part.t_s)
    together = np.concatenate(S)
    prior = fit.drawn.S - together.sum(axis=0)
    return covariance_in_time(together, np.concatenate(scores), np.concatenate(t), 1.0, border_scales(fit), prior)


def border_scales(fit: JointFit) -> Array:
    """Return what each border parameter must be known to."""
    border = fit.problem.border
    scales = np.empty(border.size)
    scales[border["gravity"]] = _GRAVITY_SCALE
    for c, (frames, camera) in enumerate(zip(fit.problem.cameras, fit.x.cameras, strict=True)):
        scales[border[f"T {c}"]] = [SCALES["m"]] * 3 + [SCALES["rad"]] * 3
        scales[border[f"dt {c}"]] = SCALES["s"]
        scales[border[f"lens {c}"]] = lens_scales(frames.views, camera.lens)
    return scales
