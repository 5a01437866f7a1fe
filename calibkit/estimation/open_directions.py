"""What a recording leaves open of a transform: the directions that are weak or not observable, in words."""

from dataclasses import dataclass

import numpy as np

from calibkit.geometry.so3 import Array
from calibkit.solver import trust
from calibkit.solver.trust import SCALES

TRANSFORM_SCALES: Array = np.repeat([SCALES["m"], SCALES["rad"]], 3)  # of the right tangent (rho, phi)
_PURE = 0.1  # of a direction of unit length: less than this is not in it
_SAME_AXIS = 0.98


@dataclass(frozen=True)
class Open:
    """A direction of T_a_b that the data tell little or nothing of."""

    text: str  # "p of T_gripper_cam along the gripper's (0.1, 0.9, 0.3)"
    sigma: float  # in 1 mm and 1 mrad
    grade: trust.Grade
    vector: Array  # (6,) of unit length in the right tangent, m and rad


def open_directions(name: str, frame: str, R: Array, cov: Array) -> tuple[Open, ...]:
    """Return what is not observable and what is weak of the transform `name`, in words, the weakest first.

    R turns the right tangent's vectors into the axes of `frame`: R_a_b where that is a, the identity where it is b.
    """
    found = trust.directions(cov, TRANSFORM_SCALES)
    out: list[Open] = []
    for grade in ("not observable", "weak"):
        those = [d for d in found if d.grade == grade]
        if those:
            out += _named(name, frame, R, np.stack([d.vector for d in those], axis=1), cov, grade)
    return tuple(out)


def _named(name: str, frame: str, R: Array, basis: Array, cov: Array, grade: trust.Grade) -> list[Open]:
    """Return the directions of a subspace (6, k) apart: those of p alone, and turns, with p where it goes with them."""
    _, s, Vt = np.linalg.svd(basis[3:])
    columns, turns = (basis @ Vt.T).T, np.append(s, np.zeros(len(Vt)))[: len(Vt)] > _PURE
    p_alone = columns[~turns, :3]
    # What p alone may do anyway is no part of a turn.
    across = np.eye(3) - p_alone.T @ np.linalg.pinv(p_alone.T)
    out = []
    for v, turn in zip(columns, turns, strict=True):
        follows = ", and p with it" if np.linalg.norm(across @ v[:3]) > _PURE else ""
        text = f"R of {name} about {_axis_of(frame, R @ v[3:])}{follows}" if turn else f"p of {name} along {_axis_of(frame, R @ v[:3])}"
        scaled = v / TRANSFORM_SCALES
        out.append(Open(text, float(np.sqrt(scaled @ cov @ scaled)), grade, v))
    return sorted(out, key=lambda direction: -direction.sigma)


def _axis_of(frame: str, v: Array) -> str:
    v = v / max(float(np.linalg.norm(v)), 1e-300)
    i = int(np.argmax(np.abs(v)))
    if abs(v[i]) > _SAME_AXIS:
        return f"the {frame}'s {'xyz'[i]} axis"
    v = v * np.sign(v[i])
    return f"the {frame}'s ({v[0]:.1f}, {v[1]:.1f}, {v[2]:.1f})".replace("-0.0", "0.0")
