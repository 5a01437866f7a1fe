"""From a joint estimate to a result: the rig's entries, what is said of them, and what the report draws."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews
from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Camera, Estimate, Imu, Reprojection, Rig
from calibkit.data.transforms import make_covariance, make_time_offset, make_transform
from calibkit.data.verdict import Status
from calibkit.estimation.added_motion import DURATION_S, AddedMotion, in_words
from calibkit.estimation.hand_eye_known import parameter_statuses
from calibkit.estimation.joint import CameraInput, Joint
from calibkit.estimation.joint_checks import Checks
from calibkit.estimation.joint_fit import corner_residuals
from calibkit.estimation.joint_imu import NamedImu, intrinsics_of
from calibkit.estimation.joint_noise import draw
from calibkit.estimation.joint_rivals import spread
from calibkit.estimation.joint_state import LINE, LINE_SCALE, biases
from calibkit.estimation.joint_trust import Trust
from calibkit.estimation.joint_verdict import Judged, judge_joint, known
from calibkit.estimation.stamps import StampReport
from calibkit.estimation.time_offset_result import early_or_late
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Steps, basis, turning
from calibkit.solver.trust import grade

STAGE = "joint"
_BIAS_DRAWS = 32  # of the state: a sigma is then known to 13 %


def joint_result(
    joint: Joint,
    trust: Trust,
    checks: Checks,
    cameras: Sequence[CameraInput],
    imus: Sequence[NamedImu],
    stamps: dict[str, StampReport],
    motions: Sequence[AddedMotion] = (),
) -> Result:
    """Return the result of stage `joint`: lenses, T_cam_imu and dt_imu_cam of each camera, T_imu_ref and dt_ref_imu of further IMUs.

    `motions` are what the recording lacks.
    """
    if not _tells_an_offset(joint, trust):  # the motion leaves it open: another solution is no news
        joint = replace(joint, rival=None)
    trust = spread(trust, joint.rival)
    names, imu = tuple(each.views.camera for each in cameras), imus[0].name
    judged = judge_joint(joint, trust, checks, cameras, imus, stamps)
    fit, border = joint.fit, joint.fit.problem.border
    rig = Rig()
    unknown: list[str] = []
    for c, (name, each) in enumerate(zip(names, cameras, strict=True)):
        x = fit.x.cameras[c]
        unknown += _add_pose(rig, trust, judged, (name, imu), x.T_cam_imu, x.dt, (border[f"T {c}"], border[f"dt {c}"].start))
        rig.cameras[name] = _camera(joint, trust, judged, each, c)
        lens = rig.cameras[name]
        unknown += [f"{name}.{key}" for key, value in lens.parameters.items() if value.status is Status.NOT_OBSERVABLE]
        unknown += [f"{name}.line_delay"] if lens.line_delay is not None and lens.line_delay.value is None else []
    for j, of_imu in enumerate(imus):
        name = of_imu.name
        if j:
            beside = fit.x.beside[j - 1]
            where = border[f"T_imu {j}"], border[f"dt_imu {j}"].start
            unknown += _add_pose(rig, trust, judged, (name, imu), beside.T_imu_ref, beside.dt, where)
        rig.imus[name] = of_imu.before or Imu(rate_hz=round(joint.imus[j].rate_hz, 3))
        if of_imu.input.extras:
            found = intrinsics_of(fit, trust, of_imu.input, fit.problem.gravity.size, j)
            judgement = {"verdict": judged.verdict(name), "reasons": judged.texts(name)}
            rig.imus[name] = rig.imus[name].model_copy(update={"intrinsics": found.model_copy(update=judgement)})
            unknown += [f"{name}.{key}" for key, value in found.parameters.items() if value.status is Status.NOT_OBSERVABLE]
    residuals = residual_sets(joint, [each.views for each in cameras], [each.name for each in imus])
    return Result(
        stage=STAGE,
        rig=rig,
        reasons=judged.all,
        residuals=tuple(residuals),
        facts={
            "joint": _facts(joint, trust, checks, names, [each.name for each in imus]),
            "frame_labels": {
                name: [each.views.labels[i] for i in rows] for name, each, rows in zip(names, cameras, joint.frames, strict=True)
            },
            "lines": _lines(joint, trust, checks, names, [each.name for each in imus], judged) + _to_add(judged, motions),
            "t_zero_ns": dict.fromkeys((each.sensor for each in residuals), joint.origin_ns),
        },
        not_observable=tuple(unknown),
    )


def _add_pose(
    rig: Rig, trust: Trust, judged: Judged, names: tuple[str, str], T_a_b: Array, offset: float, where: tuple[slice, int]
) -> list[str]:
    """Add T_a_b and dt_b_a of sensors a and b, and return what of them is not observable."""
    (a, b), (of_T, k) = names, where
    T, dt, cov, status = f"T_{a}_{b}", f"dt_{b}_{a}", trust.cov[of_T, of_T], judged.statuses[k]
    statuses = parameter_statuses(T_a_b, cov)
    told = {name: {"verdict": judged.verdict(name), "reasons": judged.texts(name)} for name in (T, dt)}
    rig.transforms[T] = make_transform(a, b, T_a_b, cov, known(judged.statuses, of_T), statuses=statuses, **told[T])
    rig.time_offsets[dt] = make_time_offset(b, a, _estimate(offset, "s", trust, k, status), **told[dt])
    open_ = [f"{T}.{key}" for key, value in statuses.items() if value is Status.NOT_OBSERVABLE]
    return [*open_, *([f"{dt}.offset"] if status is Status.NOT_OBSERVABLE else [])]


def _tells_an_offset(joint: Joint, trust: Trust) -> bool:
    at = [joint.fit.problem.border[f"dt {c}"].start for c in range(len(joint.fit.problem.cameras))]
    return any(grade(float(np.sqrt(trust.cov[k, k]) / trust.scales[k])) != "not observable" for k in at)


def _estimate(value: float, unit: str, trust: Trust, k: int, status: Status) -> Estimate:
    if status is Status.NOT_OBSERVABLE:
        return Estimate(value=None, unit=unit, status=status)
    sigma, plain = (float(np.sqrt(cov[k, k])) for cov in (trust.cov, trust.covariance.plain))
    return Estimate(value=float(value), unit=unit, sigma=sigma, sigma_plain=plain, status=status)


def _lens(joint: Joint, trust: Trust, judged: Judged, c: int) -> dict[str, object]:
    """Return what was found of camera c's lens and shutter."""
    fit, border = joint.fit, joint.fit.problem.border
    where, names = border[f"lens {c}"], fit.problem.cameras[c].views.model.parameter_names
    parameters = {
        p: _estimate(fit.x.cameras[c].lens[i], "px" if i < 4 else "", trust, where.start + i, judged.statuses[where.start + i])
        for i, p in enumerate(names)
    }
    every = all(value.value is not None for value in parameters.values())
    return {"parameters": parameters, "covariance": make_covariance(names, trust.cov[where, where]) if every else None}


def _line_delay(joint: Joint, trust: Trust, judged: Judged, c: int) -> Estimate:
    k = joint.fit.problem.border[f"{LINE} {c}"].start
    if judged.statuses[k] is Status.NOT_OBSERVABLE:
        return Estimate(value=None, unit="s", status=Status.NOT_OBSERVABLE)
    sigma, plain = (LINE_SCALE * float(np.sqrt(cov[k, k])) for cov in (trust.cov, trust.covariance.plain))
    return Estimate(value=joint.fit.x.cameras[c].line_delay, unit="s", sigma=sigma, sigma_plain=plain, status=judged.statuses[k])


def _camera(joint: Joint, trust: Trust, judged: Judged, each: CameraInput, c: int) -> Camera:
    fit, name = joint.fit, each.views.camera
    found = {} if each.lens_given else _lens(joint, trust, judged, c)
    if LINE in fit.problem.extras:
        found["line_delay"] = _line_delay(joint, trust, judged, c)
    px, valid = corner_residuals(fit.problem, fit.x, c)
    kept, seen = fit.problem.cameras[c].views.weight > 0, fit.found[c] & valid
    return each.camera.model_copy(
        update={
            **found,
            "reprojection": Reprojection(
                rms_px=_rms(px[kept]),
                rms_all_px=_rms(px[seen]),
                held_out_rms_px=None,
                corners=int(kept.sum()),
                corners_dropped=int(fit.found[c].sum() - kept.sum()),
                frames=len(joint.frames[c]),
                frames_dropped=each.views.n_frames - len(joint.frames[c]),
            ),
            "verdict": judged.verdict(name),
            "reasons": judged.texts(name),
        }
    )


def _rms(px: Array) -> float:
    return float(np.sqrt(np.sum(px**2) / max(len(px), 1)))


def residual_sets(joint: Joint, cameras: Sequence[BoardViews], imus: Sequence[str]) -> list[ResidualSet]:
    """Return the residuals at the joint's state, of the cameras with their views and of the IMUs with their names."""
    of_cameras = [_corner_set(joint, views, c) for c, views in enumerate(cameras)]
    return [*of_cameras, *(each for j, name in enumerate(imus) for each in _imu_sets(joint, name, j))]


def _corner_set(joint: Joint, each: BoardViews, c: int) -> ResidualSet:
    """Return every corner's residual with the rate of turn and where the board was."""
    fit, frames = joint.fit, joint.fit.problem.cameras[c]
    px, valid = corner_residuals(fit.problem, fit.x, c)
    frame, corner = np.nonzero(fit.found[c])
    seen = fit.problem.seen(fit.x, Steps.of(fit.x.R), c)
    T = seen.T_cam_board
    points = se3.transform(T, fit.problem.points)
    weight = frames.views.weight[frame, corner]
    usual = float(np.median(weight[weight > 0])) if np.any(weight > 0) else 1.0
    return ResidualSet(
        sensor=each.camera,
        unit="px",
        t_ns=each.t_ns[joint.frames[c]][frame],
        raw=np.where(valid[..., None], px, np.nan)[frame, corner],
        sigma=1 / np.where(weight > 0, weight, usual),
        context={
            "uv": frames.views.uv[frame, corner],
            "corner": corner.astype(np.int32),
            "frame": frame.astype(np.int32),
            "kept": weight > 0,
            "distance": np.linalg.norm(points, axis=-1)[frame, corner],
            "tilt": np.arccos(np.clip(np.abs(T[:, 2, 2]), 0, 1))[frame],
            "rate": np.linalg.norm(seen.at.omega, axis=1)[frame],
        },
    )


def _imu_sets(joint: Joint, imu: str, j: int) -> list[ResidualSet]:
    """Return IMU j's gyroscope's and accelerometer's residuals with what was measured, and the way with the biases on it."""
    fit, rows = joint.fit, joint.fit.problem.imus[j]
    left = fit.problem.imu_residuals(fit.x, j)
    i, _ = fit.problem.knots.locate(rows.t + fit.x.imus[j].dt)
    rate = np.linalg.norm(rows.gyro - left[:, :3] - fit.x.imus[j].bias[i, :3], axis=1)
    sets = []
    for k, (name, unit, measured) in enumerate((("gyro", "rad/s", rows.gyro), ("accel", "m/s^2", rows.accel))):
        part = slice(3 * k, 3 * k + 3)
        sigma = np.full(len(rows.t), float(rows.sigma[part].mean()))
        context = {"measured": measured, "kept": rows.keep[:, k], "rate": rate}
        sets.append(ResidualSet(f"{imu}_{name}", unit, _stamps(joint, rows.t), left[:, part], sigma, context))
    return [*sets, _way(joint, imu, j)]


def _way(joint: Joint, imu: str, j: int) -> ResidualSet:
    """Return where IMU j was and its biases, once a segment; the residuals are the steps of the biases over their walk's sigma."""
    fit, knots, own = joint.fit, joint.fit.problem.knots, joint.fit.x.imus[j]
    i, half = np.arange(knots.segments), np.full(knots.segments, 0.5)
    value = basis(knots, half)
    at = turning(fit.x.R, Steps.of(fit.x.R), i, value, basis(knots, half, 1), jacobians=False)
    place = np.einsum("nl,nlk->nk", value, fit.x.p[i[:, None] + np.arange(knots.order)]) + at.R @ se3.inverse(own.T_imu_ref)[:3, 3]
    steps = (own.bias[i + 1] - own.bias[i]) / (fit.problem.imus[j].walk * np.sqrt(knots.spacing))
    drawn = draw(fit.system, _BIAS_DRAWS).core.reshape(knots.controls, fit.problem.border.knot, _BIAS_DRAWS)
    sigma = np.sqrt(np.mean(drawn[i, biases(j)] ** 2, axis=2))
    context = {"place": place, "bias": own.bias[i], "bias_sigma": sigma}
    return ResidualSet(imu, "sigma", _stamps(joint, knots.middle(i)), steps, np.ones(knots.segments), context)


def _stamps(joint: Joint, t: Array) -> NDArray[np.int64]:
    return np.asarray(joint.origin_ns + np.round(t * 1e9).astype(np.int64))


def _facts(joint: Joint, trust: Trust, checks: Checks, names: tuple[str, ...], imus: list[str]) -> dict[str, object]:
    """Return everything in SI units, for machines."""
    fit, x = joint.fit, joint.fit.x
    halves = checks.halves
    return {
        "imu": imus[0],
        "imus": imus,
        "cameras": list(names),
        "gravity": x.gravity.tolist(),
        "gravity_sigma": np.sqrt(np.diag(trust.cov)[:3]).tolist(),
        "bias_mean": x.bias.mean(axis=0).tolist(),
        "noise": {
            kind: {"factor": fit.factors.get(kind, 1.0), "residuals": part.rows}
            for kind, part in fit.components.items()
            if kind in fit.factors
        },
        "sample_sigma": fit.problem.imu.sigma.tolist(),
        "knots": {
            "order": fit.problem.knots.order,
            "spacing": fit.problem.knots.spacing,
            "unknowns": fit.problem.border.knot * fit.problem.knots.controls,
        },
        "board_scale": list(checks.board_scale),
        "halves": None
        if halves is None
        else {"z": halves.z.tolist(), "rms_px": list(halves.rms_px), "own_rms_px": list(halves.own_rms_px)},
        "pretended": trust.pretended,
        "blocks": trust.covariance.blocks,
        "steps": fit.steps,
    }


def _lines(joint: Joint, trust: Trust, checks: Checks, names: tuple[str, ...], imus: list[str], judged: Judged) -> list[str]:
    fit, x, border, imu = joint.fit, joint.fit.x, joint.fit.problem.border, imus[0]
    knots = fit.problem.knots
    corners = sum(int((frames.views.weight > 0).sum()) for frames in fit.problem.cameras)
    samples, frames = sum(len(rows.t) for rows in fit.problem.imus), sum(len(each) for each in joint.frames)
    lines = [
        f"{', '.join(names)} and {', '.join(imus)}: {corners} corners in {frames} frames, {samples} samples over "
        f"{knots.segments * knots.spacing:.4g} s; spline of order {knots.order}, a knot every {knots.spacing * 1e3:.3g} ms",
        *(_noise_line(joint, name if j else "", j) for j, name in enumerate(imus)),
    ]
    lines[1] += "".join(f", corners of {name} {_corner_sigma(joint, c):.3g} px" for c, name in enumerate(names))
    placed = [
        *((name, each.T_cam_imu, each.dt, f"dt {c}", judged.opens[c]) for c, (name, each) in enumerate(zip(names, x.cameras, strict=True))),
        *(
            (name, each.T_imu_ref, each.dt, f"dt_imu {j}", judged.opens_of_imus[j - 1])
            for j, (name, each) in enumerate(zip(imus[1:], x.beside, strict=True), 1)
        ),
    ]
    for name, T, offset, block, opens in placed:
        k = border[block].start
        if judged.statuses[k] is not Status.NOT_OBSERVABLE:
            sigma = 1e3 * float(np.sqrt(trust.cov[k, k]))
            lines.append(f"  t_{imu} = t_{name} + dt: {early_or_late(name, offset)} (+- {sigma:.2g} ms)")
        if not any(each.grade == "not observable" for each in opens):
            v, p = np.degrees(so3.log(T[:3, :3])), 1e3 * se3.inverse(T)[:3, 3]
            turned = f"R_{name}_{imu} = exp({v[0]:.4f}, {v[1]:.4f}, {v[2]:.4f}) deg"
            lines.append(f"  {turned}; {name} sits at ({p[0]:.2f}, {p[1]:.2f}, {p[2]:.2f}) mm of {imu}")
    size, where = float(np.linalg.norm(x.gravity)), border["gravity"]
    along = x.gravity / size
    lines.append(f"  gravity {size:.4f} +- {float(np.sqrt(along @ trust.cov[where, where] @ along)):.2g} m/s^2")
    if checks.halves is not None:
        worst = np.abs(checks.halves.z).max()
        px = ", ".join(
            f"{name} {a:.3g} px ({b:.3g} under its own)"
            for name, a, b in zip(names, checks.halves.rms_px, checks.halves.own_rms_px, strict=True)
        )
        lines.append(f"  halves agree within {worst:.1f} sigma; the second half under the first one's calibration: {px}")
    return lines


def _noise_line(joint: Joint, of: str, j: int) -> str:
    sigma, root = joint.fit.problem.imus[j].sigma, np.sqrt(joint.imus[j].rate_hz)
    gyro, accel = f"{sigma[:3].mean() / root:.2e} rad/s/sqrt(Hz)", f"{sigma[3:].mean() / root:.2e} m/s^2/sqrt(Hz)"
    return f"  noise {f'of {of} ' if of else ''}as the residuals have it: gyroscope {gyro}, accelerometer {accel}"


def _to_add(judged: Judged, motions: Sequence[AddedMotion]) -> list[str]:
    if not motions or judged.contradicted:
        return []
    return [f"  to determine T and dt, add, for {DURATION_S:.0f} s each:", *(f"    {text}" for text in in_words(motions))]


def _corner_sigma(joint: Joint, c: int) -> float:
    weight = joint.fit.problem.cameras[c].views.weight
    return float(1 / np.median(weight[weight > 0])) if np.any(weight > 0) else float("nan")
