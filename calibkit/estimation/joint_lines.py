"""What `calibkit joint` says of its recording on the terminal, before the tables."""

from collections.abc import Sequence

import numpy as np

from calibkit.data.verdict import Status
from calibkit.estimation.added_motion import DURATION_S, AddedMotion, in_words
from calibkit.estimation.joint import Joint
from calibkit.estimation.joint_checks import Checks
from calibkit.estimation.joint_trust import Trust
from calibkit.estimation.joint_verdict import Judged
from calibkit.estimation.time_offset_result import early_or_late
from calibkit.geometry import se3, so3


def lines(joint: Joint, trust: Trust, checks: Checks, names: tuple[str, ...], imus: list[str], judged: Judged) -> list[str]:
    """Return what was measured and found, a line each."""
    fit, x, border, imu = joint.fit, joint.fit.x, joint.fit.problem.border, imus[0]
    knots = fit.problem.knots
    corners = sum(int((frames.views.weight > 0).sum()) for frames in fit.problem.cameras)
    samples, frames = sum(len(rows.t) for rows in fit.problem.imus), sum(len(each) for each in joint.frames)
    out = [
        f"{', '.join(names)} and {', '.join(imus)}: {corners} corners in {frames} frames, {samples} samples over "
        f"{knots.segments * knots.spacing:.4g} s; spline of order {knots.order}, a knot every {knots.spacing * 1e3:.3g} ms",
        *(_noise_line(joint, name if j else "", j) for j, name in enumerate(imus)),
    ]
    out[1] += "".join(f", corners of {name} {_corner_sigma(joint, c):.3g} px" for c, name in enumerate(names))
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
            out.append(f"  t_{imu} = t_{name} + dt: {early_or_late(name, offset)} (+- {sigma:.2g} ms)")
        if not any(each.grade == "not observable" for each in opens):
            v, p = np.degrees(so3.log(T[:3, :3])), 1e3 * se3.inverse(T)[:3, 3]
            turned = f"R_{name}_{imu} = exp({v[0]:.4f}, {v[1]:.4f}, {v[2]:.4f}) deg"
            out.append(f"  {turned}; {name} sits at ({p[0]:.2f}, {p[1]:.2f}, {p[2]:.2f}) mm of {imu}")
    size, where = float(np.linalg.norm(x.gravity)), border["gravity"]
    along = x.gravity / size
    out.append(f"  gravity {size:.4f} +- {float(np.sqrt(along @ trust.cov[where, where] @ along)):.2g} m/s^2")
    if checks.halves is not None:
        worst = np.abs(checks.halves.z).max()
        px = ", ".join(
            f"{name} {a:.3g} px ({b:.3g} under its own)"
            for name, a, b in zip(names, checks.halves.rms_px, checks.halves.own_rms_px, strict=True)
        )
        out.append(f"  halves agree within {worst:.1f} sigma; the second half under the first one's calibration: {px}")
    return out


def _noise_line(joint: Joint, of: str, j: int) -> str:
    sigma, root = joint.fit.problem.imus[j].sigma, np.sqrt(joint.imus[j].rate_hz)
    gyro, accel = f"{sigma[:3].mean() / root:.2e} rad/s/sqrt(Hz)", f"{sigma[3:].mean() / root:.2e} m/s^2/sqrt(Hz)"
    return f"  noise {f'of {of} ' if of else ''}as the residuals have it: gyroscope {gyro}, accelerometer {accel}"


def to_add(judged: Judged, motions: Sequence[AddedMotion]) -> list[str]:
    """Return the motions that would determine what is open, a line each."""
    if not motions or judged.contradicted:
        return []
    return [f"  to determine T and dt, add, for {DURATION_S:.0f} s each:", *(f"    {text}" for text in in_words(motions))]


def _corner_sigma(joint: Joint, c: int) -> float:
    weight = joint.fit.problem.cameras[c].views.weight
    return float(1 / np.median(weight[weight > 0])) if np.any(weight > 0) else float("nan")
