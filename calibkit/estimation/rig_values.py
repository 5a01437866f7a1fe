"""Entries of a rig file as vectors with one covariance each, and transforms and time offsets turned round."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from calibkit.data.rig import TRANSFORM_PARAMETERS, Covariance, Estimate, Rig, TimeOffset, Transform
from calibkit.data.transforms import TANGENT, find_transform, frames_of, make_time_offset, make_transform
from calibkit.data.verdict import Status
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array


@dataclass(frozen=True)
class Values:
    """Named numbers; NaN where one is not observable, variance 0 where one has no sigma."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    x: Array  # (n,)
    cov: Array  # (n, n)

    def of(self, names: Iterable[str]) -> "Values":
        """Return those of the names, in their order."""
        at = [self.names.index(name) for name in names]
        return Values(tuple(self.names[i] for i in at), tuple(self.units[i] for i in at), self.x[at], self.cov[np.ix_(at, at)])


def of_estimates(estimates: Mapping[str, Estimate], covariance: Covariance | None = None) -> Values:
    """Return estimates with their covariance; what that does not name has its own sigma, uncorrelated."""
    names = tuple(estimates)
    cov = np.diag([(estimate.sigma or 0.0) ** 2 for estimate in estimates.values()])
    if covariance is not None:
        at = [names.index(name) for name in covariance.order]
        cov[np.ix_(at, at)] = covariance.matrix
    x = np.array([np.nan if estimate.value is None else estimate.value for estimate in estimates.values()])
    return Values(names, tuple(estimate.unit for estimate in estimates.values()), x, cov)


def of_transform(entry: Transform, r_near: Array | None = None) -> Values:
    """Return p_a_b in a's axes and the rotation vector r of T_a_b; of the two vectors of one rotation the one nearer to `r_near`.

    dp = R rho, dr = J_r(r)^-1 phi carry the covariance there.
    """
    T = np.array(entry.matrix)
    r = so3.log(T[:3, :3])
    if r_near is not None and (angle := float(np.linalg.norm(r))) > 0:
        other = r * (1 - 2 * np.pi / angle)
        r = min(r, other, key=lambda v: float(np.linalg.norm(v - r_near)))
    carry = np.zeros((6, 6))
    carry[:3, :3], carry[3:, 3:] = T[:3, :3], so3.right_jacobian_inverse(r)
    x = np.concatenate([T[:3, 3], r])
    for i, name in enumerate(TRANSFORM_PARAMETERS):
        if entry.statuses.get(name, entry.status) is Status.NOT_OBSERVABLE:
            x[i] = np.nan
    return Values(TRANSFORM_PARAMETERS, ("m",) * 3 + ("rad",) * 3, x, carry @ tangent_covariance(entry) @ carry.T)


def tangent_covariance(entry: Transform) -> Array:
    """Return the covariance (6, 6) in the order of TANGENT, in b's frame; zeros where the file has none."""
    if entry.covariance is None or set(entry.covariance.order) != set(TANGENT):
        return np.zeros((6, 6))
    at = [entry.covariance.order.index(name) for name in TANGENT]
    return np.array(entry.covariance.matrix)[np.ix_(at, at)]


def chained(rig: Rig, a: str, b: str) -> tuple[Array, Array] | None:
    """Return T_a_b by the shortest chain of the rig's transforms and its covariance (6, 6); None where nothing known joins the frames.

    T_1 exp(d_1) T_2 exp(d_2) = T_1 T_2 exp(Ad_{T_2^-1} d_1 + d_2); the errors of the steps are taken to have nothing in common.
    """
    found = find_transform(rig, a, b)
    if found is None or any(rig.transforms[name].status is Status.NOT_OBSERVABLE for name in found[1]):
        return None
    cov, frame = np.zeros((6, 6)), a
    for name in found[1]:
        entry, (left, right) = rig.transforms[name], frames_of(name)
        if left != frame:
            entry, right = inverse_transform(name, entry), left
        frame, into = right, se3.adjoint(np.array(entry.inverse_matrix))
        cov = into @ cov @ into.T + tangent_covariance(entry)
    return found[0], cov


def distance(rig: Rig, a: str, b: str) -> tuple[float, float] | None:
    """Return how far the origins of two frames are apart, m, with sigma: d = |p|, dd = p^T R rho / d; None where nothing joins them."""
    found = chained(rig, a, b)
    if found is None:
        return None
    T, cov = found
    size = float(np.linalg.norm(T[:3, 3]))
    along = T[:3, :3].T @ T[:3, 3] / max(size, 1e-12)
    return size, float(np.sqrt(along @ cov[:3, :3] @ along))


def inverse_transform(name: str, entry: Transform) -> Transform:
    """Return T_b_a of T_a_b: (T exp(d))^-1 = T^-1 exp(-Ad_T d).

    Its rotation vector is the negated one; its p is made of p and R, and known where all of them are.
    """
    a, b = frames_of(name)
    Ad = se3.adjoint(np.array(entry.matrix))
    statuses = dict(entry.statuses)
    if Status.NOT_OBSERVABLE in statuses.values():
        statuses |= dict.fromkeys(("p_x", "p_y", "p_z"), Status.NOT_OBSERVABLE)
    cov = None if entry.covariance is None else Ad @ tangent_covariance(entry) @ Ad.T
    more = {"verdict": entry.verdict, "reasons": entry.reasons, "statuses": statuses}
    return make_transform(b, a, entry.inverse_matrix, cov, entry.status, **more)


def inverse_time_offset(name: str, entry: TimeOffset) -> TimeOffset:
    """Return dt_b_a = -dt_a_b."""
    a, b = frames_of(name)
    value = entry.offset.value
    offset = entry.offset.model_copy(update={"value": None if value is None else -value})
    return make_time_offset(b, a, offset, verdict=entry.verdict, reasons=entry.reasons)


def named_as(like: Rig, rig: Rig) -> Rig:
    """Return the rig with its transforms and time offsets in the direction that `like` has them in."""
    transforms, offsets = {}, {}
    for name, transform in rig.transforms.items():
        a, b = frames_of(name)
        turned = f"T_{b}_{a}" in like.transforms
        transforms[f"T_{b}_{a}" if turned else name] = inverse_transform(name, transform) if turned else transform
    for name, offset in rig.time_offsets.items():
        a, b = frames_of(name)
        turned = f"dt_{b}_{a}" in like.time_offsets
        offsets[f"dt_{b}_{a}" if turned else name] = inverse_time_offset(name, offset) if turned else offset
    return rig.model_copy(update={"transforms": transforms, "time_offsets": offsets})
