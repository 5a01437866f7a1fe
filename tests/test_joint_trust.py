"""What the detector's own bias does to a joint estimate, against fits of corners that are shifted."""

from dataclasses import replace

import numpy as np
from joint_samples import recorded

from calibkit.estimation.joint_fit import corner_residuals
from calibkit.estimation.joint_trust import bias_covariance, border_scales
from calibkit.estimation.lens_trust import biased
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.solver.levenberg_marquardt import minimise

BIAS_PX = 0.05


def test_the_detectors_bias_moves_the_estimate_as_refits_do() -> None:
    fit = recorded(0, duration_s=6.0).fitted().fit
    frames, border = fit.problem.cameras[0], fit.problem.border
    told = bias_covariance(replace(fit, problem=replace(fit.problem, cameras=(replace(frames, bias_px=BIAS_PX),))), border_scales(fit))
    px, _ = corner_residuals(fit.problem, fit.x, 0)
    predicted = frames.views.uv - px
    total = np.zeros((border.camera(0).stop - border.camera(0).start,) * 2)
    for shifted in list(biased(predicted, frames.views.image_size, BIAS_PX)):
        moved = replace(frames, views=replace(frames.views, uv=shifted + px))
        x = minimise(replace(fit.problem, cameras=(moved,)), fit.x, tolerance=1e-8).x
        was, now = fit.x.cameras[0], x.cameras[0]
        step: Array = np.concatenate([se3.local(was.T_cam_imu, now.T_cam_imu), [now.dt - was.dt], now.lens - was.lens])
        total += np.outer(step, step)
    where = border.camera(0)
    ratio = np.sqrt(np.diag(told[where, where]) / np.diag(total))
    np.testing.assert_allclose(ratio, 1, atol=0.35)  # 40 of the 120 frames tell it


def test_no_bias_adds_nothing() -> None:
    fit = recorded(0, duration_s=4.0).fitted().fit
    assert not bias_covariance(fit, border_scales(fit)).any()
