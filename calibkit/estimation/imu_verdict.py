"""What to say of an IMU's calibration: which numbers are not known, why not, and which positions would mend it."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from calibkit.data.plural import counted
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.estimation.imu_advice import NEEDED_POSITIONS, positions, positions_to_add, turns_missing, what_is_missing
from calibkit.estimation.imu_fit import ImuFit
from calibkit.estimation.imu_trust import Number
from calibkit.models.imu import ACCEL_PARAMETERS

Array = NDArray[np.float64]

STILL_START_S = 10.0
_LARGE_MISFIT = 2e-3  # of gravity
_MANY_DROPPED = 0.1
_CHANCE = 1e-4  # that bias follows gravity so well by chance


def advice_for(fit: ImuFit, parameters: Mapping[str, Number]) -> tuple[str, ...]:
    """Return what to add to the recording, positions and turns, each a sentence; nothing where all is determined."""
    out = []
    bad = {n for n, number in parameters.items() if number.status is not Status.DETERMINED}
    up = fit.state.up
    if bad & set(ACCEL_PARAMETERS) or len(positions(up)) < NEEDED_POSITIONS:
        add = positions_to_add(up)
        if add:
            out.append(f"{len(add)} more positions: " + "; ".join(add) if len(add) > 1 else f"1 more position: {add[0]}")
    if bad - set(ACCEL_PARAMETERS):
        missing = turns_missing(_turns(fit))
        out.append(
            "turn it by 90 to 180 deg between stands, about each of its axes held level" + (f": {'; '.join(missing)}" if missing else "")
        )
    return tuple(out)


def _turns(fit: ImuFit) -> Array:
    """Return how far each turn went about each axis (m, 3) rad, along the way that gravity can tell."""
    p = fit.problem
    rate = p.turns.rate[:, :3] * p.turns.dt[:, None]
    return np.add.reduceat(rate, p.turns.offset, axis=0) if len(rate) else np.zeros((0, 3))


def spoken(parameter: str) -> str:
    """Return a parameter in words: "z scale of the accelerometer (M_a_zz)"."""
    kind, sensor = parameter[0], "accelerometer" if parameter[2] == "a" else "gyroscope"
    axes = parameter.rsplit("_", 1)[1]
    if kind == "M":
        words = f"{axes[0]} scale" if axes[0] == axes[1] else f"angle between {axes[1]} and {axes[0]} axis"
    else:
        words = {"b": f"{axes} bias", "p": f"rotation about {axes}", "A": f"sensitivity {axes} to acceleration"}[kind]
    return f"{words} of the {sensor} ({parameter})"


def _listed(bad: list[str]) -> str:
    if len(bad) <= 3:
        return ", ".join(spoken(n) for n in bad)
    sensor = "accelerometer" if bad[0] in ACCEL_PARAMETERS else "gyroscope"
    return f"{len(bad)} numbers of the {sensor} ({', '.join(bad)})"


def _too_few(fit: ImuFit, of_accel: bool) -> str:
    if of_accel:
        return f"{fit.problem.stands} stands are too few for errors as large as theirs"
    return f"{counted(len(fit.problem.start), 'turn')} between stands are too few, each tells two numbers"


def reasons_for(
    fit: ImuFit, parameters: Mapping[str, Number], advice: tuple[str, ...], misfit: float, gravity: float, name: str
) -> list[Reason]:
    """Return the reasons of the verdict, the gravest first."""
    why = what_is_missing(fit.state.up)
    remedy = f"; add {advice[0]}" if advice else ""
    reasons: list[Reason] = []
    for status, verdict in ((Status.NOT_OBSERVABLE, Verdict.FAIL), (Status.WEAK, Verdict.CHECK)):
        for of_accel in (True, False):
            bad = [n for n, number in parameters.items() if number.status is status and (n in ACCEL_PARAMETERS) == of_accel]
            if not bad:
                continue
            cause = "; ".join(why if of_accel else turns_missing(_turns(fit))) or _too_few(fit, of_accel)
            verb = "is" if len(bad) == 1 else "are"
            reasons.append(Reason(verdict, f"{name}: {_listed(bad)} {verb} {status.value}: {cause}{'' if reasons else remedy}"))
    if len(positions(fit.state.up)) < NEEDED_POSITIONS and not reasons:
        reasons.append(Reason(Verdict.CHECK, f"{name}: {why[-1]}{remedy}"))
    first = fit.stands
    still = float(first.end_s[0] - first.start_s[0]) if first.start_s[0] < 1.0 else 0.0
    if still < STILL_START_S:
        text = f"the gyroscope does not begin with {STILL_START_S:.0f} s at rest (but {still:.0f} s): its bias is the stands' alone"
        reasons.append(Reason(Verdict.CHECK, f"{name}: {text}"))
    if len(fit.why) > _MANY_DROPPED * len(first):
        reasons.append(Reason(Verdict.CHECK, f"{name}: {len(fit.why)} of {len(first)} stands contradict the others and were left out"))
    if misfit > _LARGE_MISFIT * gravity:
        text = f"|a| at rest errs by {misfit:.3f} m/s^2 rms: the scale is not constant, or the IMU was not still"
        reasons.append(Reason(Verdict.CHECK, f"{name}: {text}"))
    sensitivity = _follows_gravity(fit)
    if sensitivity > 0:
        text = f"the gyroscope's bias follows gravity's direction, by {sensitivity:.1g} rad/s from one side to the other"
        reasons.append(Reason(Verdict.CHECK, f"{name}: {text}: it is sensitive to acceleration; estimate that too (--g-sensitivity)"))
    return reasons


def _follows_gravity(fit: ImuFit) -> float:
    """Return by how much rad/s the gyroscope's rest value changes as an axis turns from up to down, 0 where chance explains it (F test)."""
    p = fit.problem
    n = p.stands
    if p.size > 21 or n < 2 * NEEDED_POSITIONS:
        return 0.0
    r = -p.rows(fit.state).gyro
    sigma = np.sqrt(np.einsum("nii->ni", p.cov_gyro) + p.weights.wobble**2)
    most = 0.0
    for axis in range(3):
        J = np.column_stack([fit.state.up, np.ones(n)]) / sigma[:, axis, None]
        y = r[:, axis] / sigma[:, axis]
        x = np.linalg.lstsq(J, y, rcond=None)[0]
        left = float(np.sum((y - J @ x) ** 2))
        constant = float(np.sum((y - J[:, 3] * (J[:, 3] @ y) / (J[:, 3] @ J[:, 3])) ** 2))
        if left > 0 and f_distribution.sf((constant - left) / 3 / (left / (n - 4)), 3, n - 4) < _CHANCE:
            most = max(most, 2 * float(np.linalg.norm(x[:3])))
    return most
