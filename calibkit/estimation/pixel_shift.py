"""How far pixels move between two calibrations, over the image and range: of a lens, and of where a camera sits.

As mrcal-show-projection-diff does for lenses: what turning (or moving) the whole camera explains is taken out first, because another
lens comes with another pose of its own.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from calibkit.data.rig import Camera, Rig
from calibkit.data.transforms import frames_of
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.estimation.pixel_grid import grid
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array, hat
from calibkit.models.cameras import CAMERAS

RANGES = (0.5, 2.0, np.inf)  # m


@dataclass(frozen=True)
class Shift:
    """Where NEW puts the points that OLD sees in pixels over the whole image."""

    what: str
    range_m: float  # inf: far
    uv: Array  # (g, 2) px of OLD
    moved: Array  # (g, 2) px from there to NEW's; NaN where one of them sees nothing
    size: tuple[int, int]

    @property
    def length(self) -> Array:
        length: Array = np.linalg.norm(self.moved, axis=1)
        return length

    @property
    def worst(self) -> tuple[float, Array]:
        """Return the largest shift in px and its pixel; NaN where the two share no pixel."""
        length = self.length
        if np.isnan(length).all():
            return float("nan"), np.full(2, np.nan)
        at = int(np.nanargmax(length))
        return float(length[at]), self.uv[at]

    @property
    def lost(self) -> float:
        """Return the share of the image that only one of the two sees."""
        return float(np.mean(np.isnan(self.length)))

    @property
    def rms(self) -> float:
        length = self.length[np.isfinite(self.length)]
        return float(np.sqrt(np.mean(length**2))) if len(length) else float("nan")


@dataclass(frozen=True)
class Lens:
    """A lens that is known, on the pixels of its image."""

    name: str
    camera: Camera
    params: Array

    def rays(self) -> tuple[Array, Array]:
        """Return pixels over the image and the unit rays that they see, NaN where they see none; BadInputError where all see none."""
        uv = grid(self.camera.resolution)
        with np.errstate(all="ignore"):  # a stranger's file may hold any number
            rays, valid = CAMERAS[self.camera.model].unproject(uv, self.params)
        valid &= np.isfinite(rays).all(axis=1)
        if not valid.any():
            raise BadInputError(f"{self.name}: no pixel of its image sees anything with these parameters; calibrate it anew")
        return uv, np.where(valid[:, None], rays, np.nan)

    def pixels(self, points: Array) -> Array:
        """Return the pixels (..., 2) of points (..., 3), NaN where they are not seen."""
        seen = CAMERAS[self.camera.model].project(points, self.params)
        return np.where((seen.valid & np.isfinite(points).all(axis=-1))[..., None], seen.uv, np.nan)


def known_lens(name: str, camera: Camera) -> Lens | None:
    """Return the camera's lens, None where a parameter is not observable."""
    values = [camera.parameters[key].value for key in CAMERAS[camera.model].parameter_names]
    return None if None in values else Lens(name, camera, np.array(values, float))


def lens_shifts(old: Lens, new: Lens) -> list[Shift]:
    """Return how far the lens alone moves pixels: as it is, with the camera turned along, and turned and moved along at RANGES."""
    uv, rays = old.rays()
    size = old.camera.resolution
    shifts = [Shift("as it is", np.inf, uv, new.pixels(rays) - uv, size)]
    for what, ranges in (("turned along", (np.inf,)), ("turned and moved along", RANGES)):
        T = _implied(new, rays, uv, ranges)
        shifts += [Shift(what, r, uv, new.pixels(_points(T, rays, r)) - uv, size) for r in ranges]
    return shifts


def _points(T: Array, rays: Array, range_m: float) -> Array:
    """Return points at a range along the rays, moved by T; far points as directions."""
    points: Array = rays @ T[:3, :3].T + T[:3, 3] / range_m
    return points


def _implied(new: Lens, rays: Array, uv: Array, ranges: Sequence[float]) -> Array:
    """Return the motion T of the camera that brings NEW's pixels nearest to OLD's: min sum |project(T r x) - uv|^2 over image and ranges.

    Without a finite range it is a rotation.
    """
    model = CAMERAS[new.camera.model]
    use = np.isfinite(rays).all(axis=1)
    rays, uv = rays[use], uv[use]
    free = slice(0 if np.isfinite(ranges).any() else 3, 6)

    def motion(x: Array) -> Array:
        step = np.zeros(6)
        step[free] = x
        return se3.retract(np.eye(4), step)

    def residual(x: Array) -> Array:
        moved = np.stack([new.pixels(_points(motion(x), rays, r)) - uv for r in ranges])
        return np.nan_to_num(moved).ravel()

    def jacobian(x: Array) -> Array:
        T, blocks = motion(x), []
        for r in ranges:
            seen = model.project(_points(T, rays, r), new.params, jacobians=True)
            assert seen.J_point is not None
            J = np.zeros((len(rays), 2, 6))
            if np.isfinite(r):
                J[..., :3] = seen.J_point / r
            J[..., 3:] = -seen.J_point @ (T[:3, :3] @ hat(rays) @ so3.right_jacobian(so3.log(T[:3, :3])))
            blocks.append(np.where(seen.valid[:, None, None], J, 0.0)[..., free])
        return np.concatenate(blocks).reshape(-1, blocks[0].shape[-1])

    if 2 * len(rays) < 6:  # an image that sees next to nothing
        return np.eye(4)
    return motion(least_squares(residual, np.zeros(6)[free], jac=jacobian, x_scale="jac", method="lm").x)


def transform_shifts(name: str, old: Rig, new: Rig) -> Iterator[Shift]:
    """Yield how far pixels of a camera move for points that stay in the other sensor's frame: by T alone, and with the new lens.

    The camera is a of T_a_b where that is one, else b; nothing where neither is, or a number is not observable.
    """
    a, b = frames_of(name)
    camera = next((frame for frame in (a, b) if frame in old.cameras and frame in new.cameras), None)
    entries = old.transforms[name], new.transforms[name]
    if camera is None or any(entry.status is Status.NOT_OBSERVABLE for entry in entries):
        return
    before, after = known_lens(camera, old.cameras[camera]), known_lens(camera, new.cameras[camera])
    if before is None or tuple(old.cameras[camera].resolution) != tuple(new.cameras[camera].resolution):
        return
    T_old, T_new = (np.array(entry.matrix) if camera == a else np.array(entry.inverse_matrix) for entry in entries)
    T = T_new @ se3.inverse(T_old)
    uv, rays = before.rays()
    for what, lens in (("alone", before), ("with the lens", after)):
        if lens is not None and (lens is before or _unlike(lens, before)):
            yield from (Shift(f"{camera}, {what}", r, uv, lens.pixels(_points(T, rays, r)) - uv, before.camera.resolution) for r in RANGES)


def _unlike(one: Lens, other: Lens) -> bool:
    return one.camera.model != other.camera.model or not np.array_equal(one.params, other.params)
