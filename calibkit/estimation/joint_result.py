"""From a joint estimate to a result: the rig's entries, what is said of them, and what the report draws."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibkit.data.result import Result
from calibkit.data.rig import Camera, Estimate, Imu, Reprojection, Rig
from calibkit.data.transforms import make_covariance, make_time_offset, make_transform
from calibkit.data.verdict import Status
from calibkit.estimation.added_motion import AddedMotion
from calibkit.estimation.hand_eye_known import parameter_statuses
from calibkit.estimation.joint import CameraInput, Joint
from calibkit.estimation.joint_causes import wrong_sensors
from calibkit.estimation.joint_checks import Checks
from calibkit.estimation.joint_fit import corner_residuals
from calibkit.estimation.joint_imu import NamedImu, intrinsics_of
from calibkit.estimation.joint_lines import lines, to_add
from calibkit.estimation.joint_residuals import residual_sets
from calibkit.estimation.joint_rivals import spread
from calibkit.estimation.joint_state import LINE, LINE_SCALE
from calibkit.estimation.joint_trust import Trust
from calibkit.estimation.joint_verdict import Judged, judge_joint, known
from calibkit.estimation.stamps import StampReport
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import grade

STAGE = "joint"
_NOTHING_KNOWN = 1e9  # times the sigma


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
    wrong = [wrong_sensors(joint, each.name, j) for j, each in enumerate(imus)]
    trust = _distrusted(joint, trust, [j for j, sensors in enumerate(wrong) if j and sensors])
    judged = judge_joint(joint, trust, checks, cameras, imus, stamps, wrong)
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
            "lines": lines(joint, trust, checks, names, [each.name for each in imus], judged) + to_add(judged, motions),
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


def _distrusted(joint: Joint, trust: Trust, imus: Sequence[int]) -> Trust:
    """Return the trust with nothing known of where some further IMUs sit and when they sample: they contradict all other sensors."""
    grown = np.ones(len(trust.cov))
    grown[joint.fit.problem.border.at(f"{part} {j}" for j in imus for part in ("T_imu", "dt_imu"))] = _NOTHING_KNOWN
    return replace(trust, cov=trust.cov * grown[:, None] * grown) if imus else trust


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
