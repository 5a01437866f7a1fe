"""Transforms and clock offsets of a rig by the names of their frames, whichever direction or chain the rig holds."""

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibkit.data.rig import Covariance, Estimate, Rig, TimeOffset, Transform
from calibkit.data.verdict import Status
from calibkit.geometry import se3, so3

Array = NDArray[np.float64]
TANGENT = ("rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z")  # m, rad: T exp(d), in the right-hand frame


def make_transform(a: str, b: str, T_a_b: ArrayLike, cov: ArrayLike | None = None, status: Status = Status.GIVEN, **more: Any) -> Transform:
    """Return the rig's entry T_a_b from a 4x4 matrix, made exactly orthonormal, and its covariance (6, 6) in the order of TANGENT."""
    T = np.asarray(T_a_b, float)
    T = se3.make(so3.project(T[:3, :3]), T[:3, 3])
    return Transform(
        equation=f"p_{a} = T_{a}_{b} p_{b}",
        matrix=T.tolist(),
        rotation_xyzw=so3.to_quat(T[:3, :3]).tolist(),
        translation=T[:3, 3].tolist(),
        inverse_name=f"T_{b}_{a}",
        inverse_matrix=se3.inverse(T).tolist(),
        covariance=None if cov is None else make_covariance(TANGENT, cov),
        status=status,
        **more,
    )


def make_covariance(order: tuple[str, ...] | list[str], matrix: ArrayLike) -> Covariance:
    """Return the named covariance, made exactly symmetric."""
    C = np.asarray(matrix, float)
    return Covariance(order=list(order), matrix=((C + C.T) / 2).tolist())


def carry_parameters(T_a_b: ArrayLike) -> Array:
    """Return d (p_a_b, r) / d (rho, phi) of T exp(d), r = log R (6, 6): dp_a = R rho, dr = J_r(r)^-1 phi."""
    R = np.asarray(T_a_b, float)[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = R, so3.right_jacobian_inverse(so3.log(R))
    return out


def make_time_offset(a: str, b: str, offset: Estimate, **more: Any) -> TimeOffset:
    """Return the rig's entry dt_a_b in s."""
    return TimeOffset(equation=f"t_{a} = t_{b} + dt_{a}_{b}", offset=offset, **more)


def frames_of(name: str) -> tuple[str, str]:
    """Return a and b of T_a_b or dt_a_b."""
    _, a, b = name.split("_")
    return a, b


def find_transform(rig: Rig, a: str, b: str) -> tuple[Array, tuple[str, ...]] | None:
    """Return T_a_b (4, 4) by the shortest chain of the rig's transforms and the names used, None where nothing joins the frames."""
    steps: dict[str, list[tuple[str, Array, str]]] = {}
    for name, entry in rig.transforms.items():
        left, right = frames_of(name)
        steps.setdefault(left, []).append((right, np.array(entry.matrix), name))
        steps.setdefault(right, []).append((left, np.array(entry.inverse_matrix), name))
    queue: deque[tuple[str, Array, tuple[str, ...]]] = deque([(a, np.eye(4), ())])
    seen = {a}
    while queue:
        frame, T, used = queue.popleft()
        if frame == b:
            return T, used
        for neighbour, step, name in steps.get(frame, []):
            if neighbour not in seen:
                seen.add(neighbour)
                queue.append((neighbour, T @ step, (*used, name)))
    return None


def find_time_offset(rig: Rig, a: str, b: str) -> Estimate | None:
    """Return dt_a_b as the rig has it, or the negated dt_b_a."""
    if f"dt_{a}_{b}" in rig.time_offsets:
        return rig.time_offsets[f"dt_{a}_{b}"].offset
    if f"dt_{b}_{a}" not in rig.time_offsets:
        return None
    offset = rig.time_offsets[f"dt_{b}_{a}"].offset
    return offset if offset.value is None else offset.model_copy(update={"value": -offset.value})
