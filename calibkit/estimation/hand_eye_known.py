"""What is known of a transform, each parameter by itself: what is open to any size counts with its whole circle, not with its tangent."""

import numpy as np

from calibkit.data.rig import TRANSFORM_PARAMETERS, TransformParameter
from calibkit.data.transforms import carry_parameters
from calibkit.data.verdict import Status
from calibkit.estimation.hand_eye_normal import SCALES
from calibkit.geometry.so3 import Array
from calibkit.solver.trust import WEAK, directions, grade

_ORDER = (Status.DETERMINED, Status.WEAK, Status.NOT_OBSERVABLE)
_TURN = 0.01  # of a direction of unit length: less is no turn


def open_covariance(cov: Array) -> Array:
    """Return the part of a covariance (6, 6) that lies along directions that are not observable."""
    those = [d for d in directions(cov, SCALES) if d.grade == "not observable"]
    V = np.stack([d.sigma * d.vector * SCALES for d in those], axis=1) if those else np.zeros((6, 0))
    out: Array = V @ V.T
    return out


def position_covariance(X: Array, cov: Array) -> Array:
    """Return the covariance (3, 3) of p in frame 1's axes; where R is open about an axis and p goes with it, p is anywhere on its circle.

    The tangent alone would have p known along the circle's radius.
    """
    R = X[:3, :3]
    out: Array = R @ cov[:3, :3] @ R.T
    for d in directions(cov, SCALES):
        turn = float(np.linalg.norm(d.vector[3:]))
        if d.grade == "not observable" and turn > _TURN:
            axis = R @ d.vector[3:] / turn
            radius = R @ d.vector[:3] * SCALES[0] / (turn * SCALES[3])
            out = out + radius @ radius * (np.eye(3) - np.outer(axis, axis))
    return out


def doubted(status: Status) -> Status:
    """Return a status of what is told by poses that no X fits: such sigmas determine nothing."""
    return Status.WEAK if status is Status.DETERMINED else status


def parameter_statuses(X: Array, cov: Array) -> dict[TransformParameter, Status]:
    """Return the status of p and of log R by component, that of no better than the least known direction's.

    A turn about an open axis changes all of log R, so R has one status where a part of it is open.
    """
    carry = carry_parameters(X)
    both = carry @ cov @ carry.T
    hidden = carry @ open_covariance(cov) @ carry.T
    circle = position_covariance(X, cov) - both[:3, :3]
    both[:3, :3] += circle
    hidden[:3, :3] += circle
    sigma, share = (np.sqrt(np.maximum(np.diag(C), 0)) / SCALES for C in (both, hidden))
    share[3:] = share[3:].max()
    limit = WEAK if share.max() > WEAK else WEAK / np.sqrt(6)  # one of six parameters moves at least as far
    worst = _ORDER.index(Status(directions(cov, SCALES)[0].grade))
    found = {}
    for key, of, by in zip(TRANSFORM_PARAMETERS, sigma, share, strict=True):
        found[key] = Status.NOT_OBSERVABLE if by > limit else _ORDER[min(_ORDER.index(Status(grade(float(of)))), worst, 1)]
    return found
