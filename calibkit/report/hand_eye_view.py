"""What a hand-eye report is drawn from beside the residuals: the transforms themselves, and where other methods put them."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibkit.data.result import Result
from calibkit.data.rig import Transform
from calibkit.data.transforms import TANGENT, frames_of
from calibkit.data.verdict import Status
from calibkit.errors import one_line

Array = NDArray[np.float64]
_FAR = 1e3  # m
_MOST = 20  # methods that are drawn


@dataclass(frozen=True)
class HandEye:
    """X = T_1_2 of one residual set, and Z = T_w1_w2 where there is one."""

    one: str
    two: str
    X: Array  # (4, 4)
    cov: Array | None  # (6, 6) right tangent (rho m, phi rad); None: not known, or X not observable
    known: bool  # all of X is observable
    w1: str = "world"
    w2: str = "target"
    Z: Array | None = None
    methods: Mapping[str, Array] = field(default_factory=dict)  # p (3,) by other methods
    written: str = "refined"  # the method that X is by


def hand_eye_of(result: Result, sensor: str) -> HandEye | None:
    """Return the transform that the residual set `sensor` belongs to, None where it is none."""
    entry = result.rig.transforms.get(sensor)
    if entry is None:
        return None
    one, two = frames_of(sensor)
    known = entry.status is not Status.NOT_OBSERVABLE
    by_sensor = result.facts.get("hand_eye")
    facts = by_sensor.get(sensor) if isinstance(by_sensor, Mapping) else None
    if not isinstance(facts, Mapping):
        return HandEye(one, two, np.array(entry.matrix), _cov(entry) if known else None, known)
    fixed = facts.get("fixed_transform")
    other = result.rig.transforms.get(fixed) if isinstance(fixed, str) else None
    w1, w2 = frames_of(fixed) if isinstance(fixed, str) and fixed.count("_") == 2 else ("world", "target")
    methods = facts.get("methods")
    found: dict[str, Array] = {}
    for name, method in list(methods.items())[:_MOST] if isinstance(methods, Mapping) else []:
        p = _position(method)
        if p is not None:
            found[one_line(name, 20)] = p
    Z = None if other is None else np.array(other.matrix)
    written = one_line(facts.get("written", "refined"), 20)
    found.pop(written, None)
    return HandEye(one, two, np.array(entry.matrix), _cov(entry) if known else None, known, w1, w2, Z, found, written)


def _cov(entry: Transform) -> Array | None:
    good = entry.covariance is not None and entry.covariance.order == list(TANGENT)
    return np.array(entry.covariance.matrix) if good and entry.covariance is not None else None


def _position(method: object) -> Array | None:
    """Return p (3,) out of a file's {"X": 4x4}, None where it is none."""
    try:
        X = np.array(method["X"], float) if isinstance(method, Mapping) else np.zeros(0)
    except (KeyError, TypeError, ValueError):
        return None
    return X[:3, 3] if X.shape == (4, 4) and np.all(np.abs(X) < _FAR) else None
