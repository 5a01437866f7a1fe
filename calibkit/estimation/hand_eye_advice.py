"""Which poses to add: the information that one more pose would bring, and the elementary motions that lift the weakest direction most."""

from dataclasses import dataclass

import numpy as np

from calibkit.estimation.hand_eye_data import HandEyeData
from calibkit.estimation.hand_eye_normal import SCALES
from calibkit.estimation.hand_eye_refine import Refined
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.solver import trust

TILT = np.deg2rad(30.0)
SHIFT = 0.2  # m
MORE = 10  # poses that advice reckons with
_MOST_ADVICE = 3


@dataclass(frozen=True)
class Advice:
    """Poses to add and what ten of them would do to the weakest direction."""

    text: str
    sigma: float  # today, in 1 mm and 1 mrad
    sigma_then: float


def good_poses(data: HandEyeData, fit: Refined) -> Array:
    """Return the mean information (12, 12) of one more pose, turned about any of the mover's axes by 30 deg or as far as the others."""
    world = int(np.argmax(np.bincount(data.world, fit.kept, data.n_worlds)))
    own = fit.M[fit.kept & (data.world == world), :3, :3]
    turn = so3.log(so3.project(own.sum(axis=0)).T @ own) if len(own) else np.zeros((1, 3))
    angle = max(TILT, float(np.sqrt(np.mean(np.sum(turn**2, axis=1)))))
    steps = np.concatenate([np.zeros((6, 3)), angle * np.concatenate([np.eye(3), -np.eye(3)])], axis=1)
    return information(moved(data, fit, world, steps), fit.C[fit.kept].mean(axis=0) if fit.kept.any() else fit.C.mean(axis=0))


def advise(data: HandEyeData, fit: Refined, both: Array, world: int) -> tuple[Advice, ...]:
    """Return the elementary motions that, ten poses of each, lift the weakest direction most, one after the other until none is weak."""
    who = data.words.mover
    C = fit.C[fit.kept].mean(axis=0) if fit.kept.any() else fit.C.mean(axis=0)
    choices = []
    for i, axis in enumerate("xyz"):
        tilts, shifts = np.zeros((2, 6)), np.zeros((2, 6))
        tilts[:, 3 + i], shifts[:, i] = [TILT, -TILT], [SHIFT, -SHIFT]
        for text, steps in (
            (f"add poses tilted about the {who}'s {axis} axis by 30 deg or more", tilts),
            (f"add poses moved along the {who}'s {axis} axis by {SHIFT:g} m or more", shifts),
        ):
            choices.append((text, MORE * information(moved(data, fit, world, steps), C)))
    out: list[Advice] = []
    while len(out) < _MOST_ADVICE:
        weakest = trust.directions(both[:6, :6], SCALES)[0]
        if weakest.grade == "determined":
            break
        v = weakest.vector / SCALES
        after = [with_more(both, more) for _, more in choices]
        then = [float(np.sqrt(max(v @ cov[:6, :6] @ v, 0.0))) for cov in after]
        best = int(np.argmin(then))
        out.append(Advice(choices[best][0], weakest.sigma, then[best]))
        both = after[best]
    return tuple(out)


def moved(data: HandEyeData, fit: Refined, world: int, step: Array) -> Array:
    """Return M (k, 4, 4) where the mover is moved by steps (k, 6) in its own frame from its middle pose."""
    own = np.flatnonzero(fit.kept & (data.world == world))
    own = own if len(own) else np.arange(len(data.P))
    turn = so3.log(so3.project(fit.M[own, :3, :3].sum(axis=0)).T @ fit.M[own, :3, :3])
    middle = fit.M[own[np.argmin(np.linalg.norm(turn, axis=1))]]
    Z = fit.Z[world]
    P = Z @ middle @ se3.inverse(fit.X)
    P = se3.inverse(se3.retract(se3.inverse(P), step)) if data.words.P_at_world else se3.retract(P, step)
    out: Array = se3.inverse(Z) @ P @ fit.X
    return out


def information(M: Array, C: Array) -> Array:
    """Return the mean information (12, 12) of poses M (k, 4, 4) about (x, z) under noise C (6, 6)."""
    J = np.concatenate([np.broadcast_to(-np.eye(6), (len(M), 6, 6)), se3.adjoint(se3.inverse(M))], axis=2)
    return np.asarray(np.mean(np.swapaxes(J, 1, 2) @ np.linalg.inv(C) @ J, axis=0))


def with_more(cov: Array, information: Array) -> Array:
    """Return (cov^-1 + information)^-1: of a cov that holds 10 m beside 1 um, no inverse."""
    values, vectors = np.linalg.eigh(information)
    R = (vectors * np.sqrt(np.maximum(values, 0))).T
    RP = R @ cov
    out: Array = cov - RP.T @ np.linalg.solve(np.eye(len(R)) + RP @ R.T, RP)
    return out
