"""What is wrong with a robot, told by a pattern in what its poses leave: an arm that is off by its pose, or what was moved half-way."""

from dataclasses import dataclass

import numpy as np

from calibkit.data.plural import plain
from calibkit.data.verdict import Verdict
from calibkit.errors import one_line
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_explained import Explained, Left, left_of
from calibkit.estimation.hand_eye_normal import SCALES
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

_CHANCE, _CHANCE_MOVED = 1e-3, 1e-5  # what was moved fails, and few poses at one place of the list are soon alike
_FAR = 3.0  # times what X must be known to, as beyond which a parameter is weak
_LEAST = 4  # poses before and after
_STEPS = 30  # places where something may have been moved
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Moved:
    """From one pose on another X or Z fits."""

    label: str  # of that pose
    what: str  # X or Z
    step: Array  # (6,) m, rad
    chance: float


@dataclass(frozen=True)
class Pattern:
    """What explains most of what the poses leave, in words."""

    verdict: Verdict
    text: str
    moved: bool  # something was, half-way; else the arm is off


def pattern_of(fit: HandEyeFit) -> Pattern | None:
    """Return what explains most of what an arm's poses leave, where it is no chance and larger than what X must be known to."""
    left = left_of(fit)
    if left is None:
        return None
    moved, arm = moved_at(left), left.by(by_pose(left))
    if moved is not None and (arm is None or moved.chance < arm.chance):
        verdict = _verdict(moved.chance < _CHANCE_MOVED, np.linalg.norm(moved.step.reshape(2, 3), axis=1))
        return None if verdict is Verdict.PASS else Pattern(verdict, _moved_text(fit, moved), True)
    verdict = Verdict.PASS if arm is None else _verdict(arm.chance < _CHANCE, np.array([arm.distance, arm.angle]))
    return None if arm is None or verdict is Verdict.PASS else Pattern(verdict, _arm_text(arm), False)


def _verdict(told: bool, size: Array) -> Verdict:
    """Return the verdict on a pattern of a size (m, rad)."""
    times = float(np.max(size / SCALES[[0, 3]]))
    if not told or times < 1:
        return Verdict.PASS
    return Verdict.FAIL if times > _FAR else Verdict.CHECK


def _arm_text(arm: Explained) -> str:
    size = f"{plain(1e3 * arm.distance)} mm and {plain(np.degrees(arm.angle))} deg"
    return (
        f"what the poses leave depends on the arm's own pose ({size} of it): X may be off by several of its sigmas; "
        "calibrate the arm (zero positions of its joints, link lengths), or check the lens, the board's size and flatness"
    )


def _moved_text(fit: HandEyeFit, moved: Moved) -> str:
    one, two, w1, w2 = fit.data.words.frames
    name = f"T_{one}_{two}" if moved.what == "X" else f"T_{w1}_{w2}"
    p, R = np.linalg.norm(moved.step.reshape(2, 3), axis=1)
    return (
        f"from {one_line(moved.label, 60)} on {name} is another one, by {plain(1e3 * p)} mm and {plain(np.degrees(R))} deg: "
        "was the tool changed, or the camera, the board or the robot's base touched? use the poses before or after it"
    )


def by_pose(left: Left) -> Array:
    """Return the columns (n, 6, 36) of e by B, the gripper's error being B xi, xi its place and turn about their middle.

    Wrong joint offsets and link lengths make such errors; X and Z take up a part of them, so that X is off by more than is seen here.
    """
    P, at_world = left.fit.data.P[left.rows], left.fit.data.words.P_at_world
    gripper = se3.inverse(P) if at_world else P  # T_base_gripper
    turn = so3.log(so3.project(gripper[:, :3, :3].mean(axis=0)).T @ gripper[:, :3, :3])
    xi = np.concatenate([gripper[:, :3, 3], turn], axis=1)
    xi = (xi - xi.mean(axis=0)) / np.maximum(xi.std(axis=0), _ROUNDING)
    carry = np.broadcast_to(se3.adjoint(se3.inverse(left.fit.refined.X)), (len(P), 6, 6))
    carry = carry @ se3.adjoint(gripper) if at_world else carry
    out: Array = np.einsum("nij,nk->nijk", carry, xi).reshape(len(P), 6, 36)
    return out


def moved_at(left: Left) -> Moved | None:
    """Return the pose from which on another X or Z explains most, its chance that of the best of all that were tried."""
    rows, t_s = left.rows, left.fit.data.t_s
    order = np.arange(len(rows)) if t_s is None else np.argsort(t_s[rows], kind="stable")
    place = np.empty(len(rows), np.intp)
    place[order] = np.arange(len(rows))
    steps = np.unique(np.linspace(_LEAST, len(rows) - _LEAST, _STEPS).round().astype(np.intp))
    tried = [
        Moved(left.fit.data.labels[rows[order[k]]], what, found.b, found.chance * 2 * len(steps))
        for k in steps
        for what, part in (("X", slice(0, 6)), ("Z", slice(6, 12)))
        if (found := left.by(left.J[:, :, part] * (place >= k)[:, None, None])) is not None
    ]
    return min(tried, key=lambda moved: moved.chance, default=None)
