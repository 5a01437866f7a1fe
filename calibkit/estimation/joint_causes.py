"""What makes a sensor contradict the others: axes that are swapped or flipped, another unit, stamps that jitter."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from calibkit.data.verdict import Reason, Verdict
from calibkit.estimation.joint import Joint
from calibkit.estimation.joint_frozen import WORDS
from calibkit.estimation.joint_problem import JointProblem
from calibkit.estimation.joint_state import JointState, of_imu
from calibkit.estimation.stamps import StampReport
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array
from calibkit.geometry.spline import Steps, basis, turning

_UNITS = {"gyro": {"deg/s": 180 / np.pi}, "accel": {"g": 1 / 9.80665, "mg": 1000 / 9.80665}}  # what a reading in it is over one in SI
_NOISY = 3.0  # real over stated sigma
_EXPLAINED = 0.8  # of what a sensor reads must come from the others' motion by one matrix
_OTHER_UNIT = 0.15  # of a scale's logarithm
_TURNED = np.radians(10.0)
_LATELY_S, _WORSE_S, _FACTOR = 5e-4, 5e-3, 1.5  # jitter that is told, that spoils all, and what it must do to the corners


@dataclass(frozen=True)
class Read:
    """A sensor's readings as a matrix of what the others' trajectory has: measured = M true + bias."""

    M: Array  # (3, 3)
    explained: float

    @property
    def orthogonal(self) -> Array:
        """Return the orthogonal matrix next to M: a rotation, or one with a mirror."""
        U, _, Vt = np.linalg.svd(self.M)
        out: Array = U @ Vt
        return out


def wrong_sensors(joint: Joint, imu: str, j: int = 0) -> dict[str, str]:
    """Name, by kind, another unit or swapped or flipped axes of IMU j's sensors, where their residuals ask for it."""
    asked = [kind for kind in WORDS if joint.fit.factors[of_imu(kind, j)] > _NOISY]
    if not asked:
        return {}
    found = {kind: reading(joint.fit.problem, joint.fit.x, j) for kind, reading in _READINGS.items()}
    told = {kind: read for kind, read in found.items() if read.explained > _EXPLAINED}
    out = {kind: text for kind in asked if kind in told and (text := _unit(kind, told[kind], imu))}
    if out:
        return out
    axes = {kind: read.orthogonal for kind, read in told.items()}
    mirrored = [kind for kind, Q in axes.items() if np.linalg.det(Q) < 0]
    if j and len(mirrored) == len(WORDS):  # how it lies on the rig, nobody says
        text = f"{imu}'s axes are no right-handed frame by all other data: one is flipped, or two are swapped: mend the driver"
        return dict.fromkeys(mirrored, text)
    base = axes_of_rig = joint.fit.x.imus[j].T_imu_ref[:3, :3]
    if mirrored:  # what the other shows is that the rig's axes followed the mirrored one
        base = next((Q for kind, Q in axes.items() if kind not in mirrored), axes_of_rig)
    strange = mirrored or [kind for kind in asked if kind in axes and np.linalg.norm(so3.log(axes[kind] @ base.T)) > _TURNED]
    return {kind: _wrong(kind, axes[kind] @ base.T, imu, f"{imu}'s" if j else "the rig's") for kind in strange}


def _unit(kind: str, read: Read, imu: str) -> str:
    size = float(np.exp(np.mean(np.log(np.maximum(np.linalg.svd(read.M, compute_uv=False), 1e-300)))))
    unit = next((unit for unit, worth in _UNITS[kind].items() if abs(np.log(size / worth)) < _OTHER_UNIT), None)
    name = f"{imu}'s {WORDS[kind]}"
    return (
        "" if unit is None else f"{name} reads {size:.3g} times what all other data have it: is it in {unit}? then add --{kind}-unit {unit}"
    )


def _wrong(kind: str, Q: Array, imu: str, whose: str) -> str:
    hand = "; they are no right-handed frame" if np.linalg.det(Q) < 0 else ""
    return f"{imu}'s {WORDS[kind]} has its axes wrong: its x, y, z are {whose} {_axes(Q)} by all other data{hand}: mend the driver"


def _axes(Q: Array) -> str:
    """Return the signed axes nearest to an orthogonal matrix' rows: "y, x, -z"."""
    best = max(
        ((order, signs) for order in permutations(range(3)) for signs in product((1, -1), repeat=3)),
        key=lambda each: sum(sign * Q[row, axis] for row, (axis, sign) in enumerate(zip(*each, strict=True))),
    )
    return ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for axis, sign in zip(*best, strict=True))


def _gyro(problem: JointProblem, x: JointState, j: int) -> Read:
    rows = problem.imus[j]
    i, u = problem.knots.locate(rows.t + x.imus[j].dt)
    at = turning(x.R, Steps.of(x.R), i, basis(problem.knots, u), basis(problem.knots, u, 1), jacobians=False)
    return _regress(rows.gyro, at.omega, np.ones((len(i), 1)))


def _accel(problem: JointProblem, x: JointState, j: int) -> Read:
    """Regress on R^T p''; gravity and lever arm, wrong where the accelerometer is, add what is linear in R's entries and in those of E.

    a + E l is the acceleration of the point at l of a body that turns: E = hat(domega/dt) + hat(omega)^2.
    """
    rows = problem.imus[j]
    i, u = problem.knots.locate(rows.t + x.imus[j].dt)
    at = turning(x.R, Steps.of(x.R), i, basis(problem.knots, u), basis(problem.knots, u, 1), jacobians=False)
    a = np.einsum("nl,nlk->nk", basis(problem.knots, u, 2), x.p[i[:, None] + np.arange(problem.knots.order)])
    body = np.einsum("nji,nj->ni", at.R, a)
    turn = so3.hat(at.omega)
    E = so3.hat(np.gradient(at.omega, rows.t, axis=0)) + turn @ turn
    return _regress(rows.accel, body, np.concatenate([at.R.reshape(-1, 9), E.reshape(-1, 9), np.ones((len(i), 1))], axis=1))


def _regress(measured: Array, true: Array, beside: Array) -> Read:
    columns = np.concatenate([true, beside], axis=1)
    found = np.linalg.lstsq(columns, measured, rcond=1e-9)[0]
    left = measured - columns @ found
    rest = measured - beside @ np.linalg.lstsq(beside, measured, rcond=1e-9)[0]
    return Read(found[:3].T, 1 - float(np.sum(left**2) / max(float(np.sum(rest**2)), 1e-300)))


_READINGS = {"gyro": _gyro, "accel": _accel}


def jittering(joint: Joint, c: int, name: str, stamps: dict[str, StampReport]) -> Reason | None:
    """Say so where a camera's stamps jitter and its corners show it."""
    factor = joint.fit.factors[f"camera {c}"]
    by_turns = float(np.sqrt(joint.turns[c].alignment.levels.jitter))
    by_stamps = stamps[name].jitter_s if name in stamps else None
    jitter = by_turns if by_stamps is None else by_stamps
    if factor < _FACTOR or min(jitter, by_turns) < _LATELY_S:
        return None
    text = f"{name}: its stamps jitter by {jitter * 1e3:.2g} ms: its corners are {factor:.1f} times as far off as they were found"
    verdict = Verdict.FAIL if jitter > _WORSE_S else Verdict.CHECK
    return Reason(verdict, f"{text}; use the sensor's own stamps, or a trigger's, and record again")
