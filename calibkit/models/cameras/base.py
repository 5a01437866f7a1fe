"""What a camera model is: a name, its parameters, `project` and `unproject` with Jacobians, and its domain of validity."""

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Projection:
    """Pixels of points and, when asked for, their derivatives.

    The derivative arrays are views of planes that are contiguous over the points (axes moved to the end), which is how
    batched normal equations want to read them.
    """

    uv: Array  # (..., 2) px; meaningless where not valid
    valid: Mask  # (...)
    J_point: Array | None = None  # (..., 2, 3) px/m
    J_params: Array | None = None  # (..., 2, p) px per unit of each parameter


class CameraModel(Protocol):
    """A central projection; points are in the camera frame (x right, y down, z forward), pixel (0, 0) is a centre."""

    @property
    def name(self) -> str:
        """The name in rig files and of `--model`."""
        ...

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names in the order of the parameter vector; the first four are always fx, fy, cx, cy."""
        ...

    equation: ClassVar[str]  # one line for the rig file

    def project(self, points: Array, params: Array, jacobians: bool = False) -> Projection:
        """Return the pixels of points (..., 3) m under parameters (p,)."""
        ...

    def unproject(self, uv: Array, params: Array) -> tuple[Array, Mask]:
        """Return unit rays (..., 3) of pixels (..., 2), and where they are valid."""
        ...

    def seed(self, focal: float, centre: tuple[float, float]) -> Array:
        """Return parameters (p,) of the undistorted lens with this focal length and centre in px."""
        ...

    def prior(self, params: Array, reach: float) -> tuple[Array, Array]:
        """Return residuals (k,) in sigmas of what is known of real lenses before any is measured, and their Jacobian (k, p).

        `reach` is tan^2 of the outermost angle that was seen.
        """
        ...


def planes(shape: tuple[int, ...], columns: int) -> tuple[Array, Array]:
    """Return zeros as planes (2, columns, ...) to write to, and the same memory seen as (..., 2, columns)."""
    memory = np.zeros((2, columns, *shape))
    return memory, np.moveaxis(memory, (0, 1), (-2, -1))


def first_turning_point(coefficients: ArrayLike, limit: float) -> float:
    """Return the smallest root in (0, limit) of the polynomial (ascending coefficients), or `limit`: where a radial map stops growing."""
    coefficients = np.trim_zeros(np.asarray(coefficients, float), "b")
    if len(coefficients) < 2:
        return limit
    roots = np.roots(coefficients[::-1])
    real = roots.real[np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots))]
    return float(min(real[(real > 0) & (real < limit)], default=limit))
