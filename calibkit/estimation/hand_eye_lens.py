"""The camera's lens in a hand-eye problem: estimated with X on request, else its covariance carried into X's."""

from dataclasses import dataclass

import numpy as np

from calibkit.estimation.hand_eye_data import HandEyeData, Mask
from calibkit.estimation.hand_eye_images import Corners, Sight
from calibkit.estimation.hand_eye_normal import SCALES, Normal
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.solver import trust


@dataclass(frozen=True)
class LensStep:
    """The lens's Gauss-Newton step with all poses following it."""

    d: Array  # (p,)
    information: Array  # (p, p)
    X: Array  # (6, p) d x / d lens
    Z: Array  # (n_worlds, 6, p)
    left: Array  # (n, 6, p) of e


@dataclass(frozen=True)
class LensEffect:
    """What the lens is known to, and how X and Z follow it."""

    cov: Array  # (p, p) as residuals are
    plain: Array  # as if they were white
    X: Array  # (6, p)
    Z: Array  # (n_worlds, 6, p)

    def of_X(self, cov: Array) -> Array:
        """Return what a covariance of the lens adds to that of X (6, 6)."""
        out: Array = self.X @ cov @ self.X.T
        return out

    def of_Z(self, cov: Array) -> Array:
        """Return what it adds to that of the first Z."""
        out: Array = self.Z[0] @ cov @ self.Z[0].T
        return out


def lens_step(
    data: HandEyeData, system: Normal, M: Array, C: Array, left: Array, kept: Mask, corners: Corners, sight: Sight, variance: float
) -> LensStep:
    """Return the step of least |left + K' d|^2_C + what the views say of the lens, K' being K with x and z following."""
    columns = [system.respond(data, M, C, column, kept) for column in np.moveaxis(sight.K, 2, 0)]
    X, Z, follows = (np.stack([column[i] for column in columns], axis=-1) for i in range(3))
    RW = np.swapaxes(follows, 1, 2) @ np.linalg.inv(C) * (kept & system.active)[:, None, None]
    prior, pull = corners.lens_prior()
    information = np.sum(RW @ follows, axis=0) + sight.S.sum(axis=0) / variance + prior
    right = sight.score.sum(axis=0) / variance + pull - np.einsum("nij,nj->i", RW, left)
    scale = 1 / np.sqrt(np.diag(information))
    d = scale * np.linalg.lstsq(information * scale[:, None] * scale, right * scale, rcond=1e-14)[0]
    return LensStep(d, information, X, Z, follows)


def lens_effect(
    data: HandEyeData, system: Normal, M: Array, C: Array, e: Array, kept: Mask, corners: Corners, sight: Sight, variance: float
) -> LensEffect | None:
    """Return the lens's covariance and how X follows it; None of a lens that is held and has none.

    A held lens's is what the rig says. A free one's is the sandwich of the views' scores about X, Z and lens; each view is a block.
    """
    if not corners.free and corners.covariance is None:
        return None
    if not corners.free:
        assert corners.covariance is not None
        # The views' share is 0: the step is of no use, how X follows is.
        columns = [system.respond(data, M, C, column, kept) for column in np.moveaxis(sight.K, 2, 0)]
        X, Z = (np.stack([column[i] for column in columns], axis=-1) for i in range(2))
        return LensEffect(corners.covariance, corners.covariance, X, Z)
    step = lens_step(data, system, M, C, e, kept, corners, sight, variance)
    k, p = system.free.shape[1], len(corners.lens)
    J = np.concatenate([-np.broadcast_to(system.free, (len(M), 6, k)), system.J_Z * SCALES, -sight.K], axis=2)
    JW = np.swapaxes(J, 1, 2) @ np.linalg.inv(C) * (kept & system.active)[:, None, None]
    S, scores = JW @ J, (JW @ e[:, :, None])[:, :, 0]
    S[:, -p:, -p:] += sight.S / variance
    scores[:, -p:] += sight.score / variance
    prior = np.zeros((k + 6 + p, k + 6 + p))
    prior[-p:, -p:] = corners.lens_prior()[0]
    units = np.concatenate([np.ones(k + 6), 1 / np.sqrt(np.diag(step.information))])
    found = trust.covariance(S, scores, 1.0, units, prior, least=min(1.0, trust.FEW_BLOCKS / len(S)))
    bias = _bias_covariance(data, system, M, C, kept, corners, variance)
    return LensEffect(found.corrected[-p:, -p:] + bias, found.plain[-p:, -p:], step.X, step.Z)


def _bias_covariance(data: HandEyeData, system: Normal, M: Array, C: Array, kept: Mask, corners: Corners, variance: float) -> Array:
    """Return what the detector's own bias does to a free lens (p, p): sum over patches of d d^T, d its step when a patch's corners shift.

    No number of images averages it out: see lens_trust. X follows the lens; what it does to the poses themselves is far below their noise.
    """
    total = np.zeros((len(corners.lens),) * 2)
    if not corners.bias_px:
        return total
    steps = []
    for moved in corners.biased(M):
        sight = moved.at(M)
        left = system.respond(data, M, C, -se3.local(M, sight.Q), kept)[2]
        steps.append(lens_step(data, system, M, C, left, kept, moved, sight, variance).d)
    d = np.array(steps[1:]) - steps[0]  # without the prior's own pull
    return np.asarray(d.T @ d)
