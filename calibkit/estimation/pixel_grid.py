"""What a lens's parameters move over the image, the freedom of turning the whole camera taken out (as mrcal does, Kogan 2021)."""

import numpy as np
from numpy.typing import NDArray

from calibkit.geometry.so3 import Array, hat
from calibkit.models.cameras import CameraModel

Mask = NDArray[np.bool_]
GRID = (24, 16)  # cells over the image


def grid(size: tuple[int, int], cells: tuple[int, int] = GRID) -> Array:
    """Return the pixels (g, 2) in the middle of each cell of an image of width, height px, row by row."""
    x, y = np.meshgrid(*((np.arange(n) + 0.5) * length / n - 0.5 for n, length in zip(cells, size, strict=True)))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def turned_jacobian(model: CameraModel, lens: Array, rays: Array, fit_at: Mask) -> Array:
    """Return du / dlens (g, 2, p) of far points where the camera turns along: du = J dlens + J_R phi.

    phi is the common rotation that best absorbs J dlens over the rays in `fit_at`.
    """
    projection = model.project(rays, lens, jacobians=True)
    assert projection.J_params is not None
    assert projection.J_point is not None
    J, J_R = projection.J_params, -projection.J_point @ hat(rays)
    absorb = np.linalg.lstsq(J_R[fit_at].reshape(-1, 3), -J[fit_at].reshape(-1, J.shape[-1]), rcond=None)[0]
    turned: Array = J + J_R @ absorb
    return turned


def bent(model: CameraModel, lens: Array, rays: Array, step: Array) -> Array:
    """Return how far (n, 2) px a step of the lens's coefficients moves far points, less what camera, focal length and centre make up for.

    du = J_k step - J_R phi - J_f f: phi and f, the steps of fx fy cx cy, leave least over the rays (n, 3).
    """
    projection = model.project(rays, lens, jacobians=True)
    assert projection.J_params is not None
    assert projection.J_point is not None
    moved = projection.J_params[..., 4:] @ step
    others = np.concatenate([projection.J_point @ hat(rays), projection.J_params[..., :4]], axis=-1)
    made_up = np.linalg.lstsq(others.reshape(-1, others.shape[-1]), moved.ravel(), rcond=None)[0]
    left: Array = moved - others @ made_up
    return left
