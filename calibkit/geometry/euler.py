"""Rotations from angles about the axes, batch-first."""

import numpy as np

from calibkit.geometry import so3
from calibkit.geometry.so3 import Array


def from_zyx(angles: Array) -> Array:
    """Return R = Rz(a) Ry(b) Rx(c) from (a, b, c) (..., 3) rad: yaw, pitch, roll about axes that stay, or z, y', x'' that turn along."""
    a, b, c = np.moveaxis(np.asarray(angles, float)[..., None], -2, 0)
    x, y, z = np.eye(3)
    rotation: Array = so3.exp(a * z) @ so3.exp(b * y) @ so3.exp(c * x)
    return rotation
