"""How a sensor turned between pairs of its stamps: what every source of rotation is brought to, before two of them are compared."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import Times
from calibkit.geometry.so3 import Array

Index = NDArray[np.intp]


@dataclass(frozen=True)
class Turns:
    """Rotation vectors in the sensor's own axes: exp(hat(angle_k)) = R_w_s(t[first_k])^T R_w_s(t[last_k]), |angle| < pi.

    With e_i the error of the orientation at stamp i and n_k the turn's own, angle_k = true + e_last - e_first + n_k to first order:
    turns that share a stamp share its error.
    """

    t_ns: Times  # (m,) increasing
    first: Index  # (n,) into t_ns, increasing
    last: Index  # (n,) > first
    angle: Array  # (n, 3) rad
    end_cov: Array | None = None  # (m, 3, 3) rad^2 of e_i, to a common factor; None: the same for all stamps and axes
    own_cov: Array | None = None  # (n, 3, 3) rad^2 of n_k, to a common factor; None: as white noise of a rate
    axes: tuple[bool, bool, bool] = (True, True, True)  # which are measured: a vehicle's odometer knows z alone

    def __post_init__(self) -> None:
        m, n = len(self.t_ns), len(self.first)
        if self.last.shape != (n,) or self.angle.shape != (n, 3):
            raise ValueError(f"Turns has {n} first, {self.last.shape} last and {self.angle.shape} angle")
        if n and not (np.all(self.last > self.first) and np.all(np.diff(self.first) >= 0) and self.first[0] >= 0 and self.last.max() < m):
            raise ValueError("Turns must go forward in time, sorted by their first stamp")
        for name, array, shape in (("end_cov", self.end_cov, (m, 3, 3)), ("own_cov", self.own_cov, (n, 3, 3))):
            if array is not None and array.shape != shape:
                raise ValueError(f"Turns.{name} has shape {array.shape}, expected {shape}")

    @property
    def duration(self) -> Array:
        """Seconds that each turn took, (n,)."""
        out: Array = (self.t_ns[self.last] - self.t_ns[self.first]) * 1e-9
        return out

    @property
    def joined(self) -> NDArray[np.bool_]:
        """Whether each turn starts where the one before it ends, (n,)."""
        return np.concatenate([[False], self.first[1:] == self.last[:-1]])

    def select(self, keep: NDArray[np.generic]) -> "Turns":
        """Return some of the turns (a mask or increasing indices); stamps stay."""
        own = None if self.own_cov is None else self.own_cov[keep]
        return Turns(self.t_ns, self.first[keep], self.last[keep], self.angle[keep], self.end_cov, own, self.axes)
