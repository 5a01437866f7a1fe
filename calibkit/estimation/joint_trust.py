"""How far the joint estimate may be trusted: its covariance with correlated residuals paid for, less what noise alone pretends."""

from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from calibkit.estimation.joint_fit import JointFit, corner_residuals
from calibkit.estimation.joint_noise import schur
from calibkit.estimation.joint_parts import projected
from calibkit.estimation.joint_state import A_G, DRIFTING, LINE, LINE_SCALE, M_A, M_G, PHI, SCALE, of_imu
from calibkit.estimation.lens_fit import rows_of
from calibkit.estimation.lens_trust import biased, lens_scales
from calibkit.estimation.open_directions import TRANSFORM_SCALES
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Steps
from calibkit.models.imu import STANDARD_GRAVITY
from calibkit.solver.banded import Banded
from calibkit.solver.trust import SCALES, Covariance, covariance_in_time

BIAS_SCALES = (1e-3, 1e-3 * STANDARD_GRAVITY.value)  # rad/s, m/s^2: what a gyroscope's and an accelerometer's must be known to
_GRAVITY_SCALE = 0.01  # m/s^2: 1 mrad of its direction
EXTRA_SCALES = {
    SCALE: SCALES[""],
    M_A: SCALES[""],
    M_G: SCALES[""],
    PHI: SCALES["rad"],
    A_G: BIAS_SCALES[0] / STANDARD_GRAVITY.value,  # as much as a bias, at 1 g
}
_BIAS_FRAMES = 40
_KNOWN_AT_LEAST = 1e-3  # of a direction's information is not noise's: one draw of it does not tell less from none


@dataclass(frozen=True)
class Trust:
    """Covariance of the border and where it comes from."""

    covariance: Covariance
    cov: Array  # (p, p) what counts: corrected, and without the information that noise pretends
    scales: Array  # (p,) what each parameter must be known to
    pretended: float  # the greatest share of a direction's information that is noise's


def joint_trust(fit: JointFit) -> Trust:
    """Return the covariance of the calibration."""
    with threadpool_limits(1, user_api="blas"):
        return _trust(fit, border_scales(fit))


def _trust(fit: JointFit, scales: Array) -> Trust:
    covariance = joint_covariance(fit, scales)
    covariance = replace(covariance, corrected=covariance.corrected + bias_covariance(fit, scales))
    values, vectors = np.linalg.eigh(fit.drawn.S * scales[:, None] * scales)
    root = scales[:, None] * vectors / np.sqrt(np.maximum(values, values[-1] * 1e-15))  # F F^T = S^-1
    share, directions = np.linalg.eigh(root.T @ noise_information(fit) @ root)
    share = np.clip(share, 0.0, 1 - _KNOWN_AT_LEAST)
    inverse = np.linalg.inv(root)
    grown = root @ (directions / np.sqrt(1 - share)) @ directions.T @ inverse
    return Trust(covariance, grown @ covariance.corrected @ grown.T, scales, float(share.max()))


def joint_covariance(fit: JointFit, scales: Array) -> Covariance:
    """Return the covariance of the border, plain and corrected, by epochs of time.

    A trajectory that bends to the noise on both sides of a block's ends takes from its score (white noise: 15 % of the variance), so what
    comes out below the plain one is not believed.
    """
    epochs = fit.epochs
    prior = fit.drawn.S - epochs.information.sum(axis=0)
    return covariance_in_time(epochs.information, epochs.score, epochs.t_s, 1.0, scales, prior, least=1.0)


def bias_covariance(fit: JointFit, scales: Array) -> Array:
    """Return what the detectors' own bias does to the border (p, p): sum over patches of d d^T, d its step when a patch's corners shift.

    No number of frames averages it out (`lens_trust`), so it is worked out on some of them.
    """
    total = np.zeros_like(fit.drawn.S)
    root = scales[:, None] * scales
    inverse = root * np.linalg.pinv(fit.drawn.S * root, rcond=1e-14, hermitian=True)
    steps = Steps.of(fit.x.R)
    for c, frames in enumerate(fit.problem.cameras):
        if not frames.bias_px:
            continue
        some = np.unique(np.linspace(0, len(frames.t) - 1, _BIAS_FRAMES).astype(int))
        part = replace(frames, t=frames.t[some], views=rows_of(frames.views, some))
        cameras = fit.problem.cameras
        sample = replace(fit.problem, cameras=(*cameras[:c], part, *cameras[c + 1 :]))
        predicted = part.views.uv - corner_residuals(sample, fit.x, c)[0]
        for uv in biased(predicted, part.views.image_size, part.bias_px):
            shifted = replace(part, views=replace(part.views, uv=uv))
            parts = replace(sample, cameras=(*cameras[:c], shifted, *cameras[c + 1 :])).frame_parts(fit.x, steps, c)
            scores = sum(projected(each, fit.drawn.core_answer)[1].sum(axis=0) for each in parts)
            step = inverse @ np.asarray(scores) * (len(frames.t) / len(some))
            total += np.outer(step, step)
    return total


def noise_information(fit: JointFit, seed: int = 1) -> Array:
    """Return the part of S (p, p) that the trajectory's own noise makes: what another draw of it, N(0, A^-1), adds.

    At rest the trajectory still turns and shakes by its noise, and the Jacobians take that for motion.
    """
    core = fit.system.core
    assert isinstance(core, Banded)
    white = np.random.default_rng(seed).standard_normal((core.ab.shape[1],))
    moved = core.draw(white).reshape(fit.system.gradient_core.shape)
    x = fit.problem.retract(fit.x, moved, np.zeros(fit.problem.border.size))
    _, system = fit.problem.linearize(x)
    out: Array = schur(system)[1] - fit.drawn.S
    return out


def border_scales(fit: JointFit) -> Array:
    """Return what each border parameter must be known to."""
    border = fit.problem.border
    scales = np.empty(border.size)
    scales[border["gravity"]] = _GRAVITY_SCALE
    for name in set(fit.problem.extras) - {LINE}:
        scales[border[name]] = EXTRA_SCALES[name]
    for j, beside in enumerate(fit.problem.beside, 1):
        scales[border[f"T_imu {j}"]], scales[border[f"dt_imu {j}"]] = TRANSFORM_SCALES, SCALES["s"]
        for name in beside.extras:
            scales[border[of_imu(name, j)]] = EXTRA_SCALES[name]
    for c, (frames, camera) in enumerate(zip(fit.problem.cameras, fit.x.cameras, strict=True)):
        scales[border[f"T {c}"]] = TRANSFORM_SCALES
        scales[border[f"dt {c}"]] = SCALES["s"]
        scales[border[f"lens {c}"]] = lens_scales(frames.views, camera.lens)
        if LINE in fit.problem.extras:
            rows = frames.views.image_size[1]
            scales[border[f"{LINE} {c}"]] = SCALES["s"] / (LINE_SCALE * rows)  # of the whole readout
        for drift in fit.problem.drifts:
            scales[border[f"{drift.name} {c}"]] = scales[border.camera(c)][:DRIFTING]
    return scales
