"""What a camera model is: a name, its parameters, `project` and `unproject` with Jacobians, and its domain of validity."""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Projection:
    """Pixels of points and, when asked for, their derivatives."""

    uv: Array  # (..., 2) px; NaN where not valid
    valid: NDArray[np.bool_]  # (...)
    J_point: Array | None = None  # (..., 2, 3) px/m
    J_params: Array | None = None  # (..., 2, p) px per unit of each parameter


class CameraModel(Protocol):
    """A central projection; points are in the camera frame (x right, y down, z forward), pixel (0, 0) is a centre."""

    name: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]  # the first four are always fx, fy, cx, cy
    equation: ClassVar[str]  # one line for the rig file

    def project(self, points: Array, params: Array, jacobians: bool = False) -> Projection:
        """Return the pixels of points (..., 3) m under parameters (p,)."""
        ...

    def unproject(self, uv: Array, params: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return unit rays (..., 3) of pixels (..., 2), and where they are valid."""
        ...

    def seed(self, focal: float, centre: tuple[float, float]) -> Array:
        """Return parameters (p,) of the undistorted lens with this focal length and centre in px."""
        ...
