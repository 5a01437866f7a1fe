"""Points of a scene followed through one camera's frames, as a perfect tracker with Gaussian noise would: observations without images."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import FeatureTracks
from calibkit.geometry import se3
from calibkit.simulation.camera import SimCamera, inside
from calibkit.simulation.session import START_NS, Session

Array = NDArray[np.float64]

_EDGE_PX = 5.0  # a tracker needs a few pixels around a point
_FEATURES = 5  # the random stream after those of `session`


@dataclass(frozen=True)
class Scene:
    """What is before the rig, by distance in m."""

    near: float = 0.9
    far: float = 5.0
    kind: str = "room"  # a key of SCENES


def _room(scene: Scene, origin_w: Array, rays_w: Array, rng: np.random.Generator) -> Array:
    """Return distances (k,) m along rays: a cloud of things, as many per doubling of the distance."""
    distance: Array = np.exp(rng.uniform(np.log(scene.near), np.log(scene.far), len(rays_w)))
    return distance


def _wall(scene: Scene, origin_w: Array, rays_w: Array, rng: np.random.Generator) -> Array:
    """Return distances (k,) m to a flat wall that the resting rig looks at from `near`; what misses it is `far`."""
    ahead = np.maximum(rays_w[:, 0], 1e-9)  # the rig rests looking along world +x
    distance: Array = np.minimum((scene.near - origin_w[0]) / ahead, scene.far)
    return distance


SCENES: dict[str, Callable[[Scene, Array, Array, np.random.Generator], Array]] = {"room": _room, "wall": _wall}


def simulate_tracks(
    session: Session,
    noise_px: float = 0.3,
    n_points: int = 200,
    scene: Scene | None = None,
    drift_px: float = 0.0,
    outliers: float = 0.0,
    mean_life_s: float = 1.5,
    camera: int = 0,
) -> FeatureTracks:
    """Return tracks with the stamps of the session's camera, n_points in each frame; a lost one is replaced at a random pixel.

    noise_px is each observation's own, per coordinate; drift_px is what a tracker from frame to frame adds at every step and keeps.
    A share `outliers` of the tracks slides over the scene instead, by up to 6 px a frame.
    """
    seen_by, scene = session.tracks[camera], scene or Scene()
    sim, rng = seen_by.camera, session.rng(_FEATURES, camera)
    T_world_cam = session.trajectory.at((seen_by.t_true_ns - START_NS) * 1e-9).T_world_imu @ sim.T_imu_cam
    survival = np.exp(-1 / (sim.rate_hz * mean_life_s))
    points, offset, slide, number = np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int32)
    born, rows = 0, []
    for k, T in enumerate(T_world_cam):
        offset = offset + slide + drift_px * rng.standard_normal(offset.shape)
        seen = sim.model.project(se3.transform(se3.inverse(T), points), sim.params)
        alive = seen.valid & inside(sim, seen.uv + offset, _EDGE_PX) & (rng.random(len(points)) < survival)
        lost = n_points - int(alive.sum())
        fresh = _new_points(sim, scene, T, lost, rng)
        wrong = rng.random((lost, 1)) < outliers
        points = np.concatenate([points[alive], fresh])
        offset = np.concatenate([offset[alive], np.zeros((lost, 2))])
        slide = np.concatenate([slide[alive], wrong * rng.uniform(-6, 6, (lost, 2))])
        number = np.concatenate([number[alive], np.arange(born, born + lost, dtype=np.int32)])
        born += lost
        uv = sim.model.project(se3.transform(se3.inverse(T), points), sim.params).uv + offset + noise_px * rng.standard_normal(offset.shape)
        rows.append((np.full(n_points, k, np.int32), number, uv))
    frame, track, uv = (np.concatenate(column) for column in zip(*rows, strict=True))
    labels = tuple(f"frame {k}" for k in range(len(T_world_cam)))
    return FeatureTracks(sim.name, sim.size, seen_by.stamp_ns, labels, frame, track, uv)


def _new_points(sim: SimCamera, scene: Scene, T_world_cam: Array, n: int, rng: np.random.Generator) -> Array:
    """Return points (n, 3) m in the world at random pixels of the camera."""
    width, height = sim.size
    rays = np.zeros((0, 3))
    while len(rays) < n:  # a fisheye's corners may see nothing
        uv = rng.uniform((_EDGE_PX, _EDGE_PX), (width - 1 - _EDGE_PX, height - 1 - _EDGE_PX), (n, 2))
        found, valid = sim.model.unproject(uv, sim.params)
        rays = np.concatenate([rays, found[valid]])[:n]
    rays_w = rays @ T_world_cam[:3, :3].T
    origin_w = T_world_cam[:3, 3]
    points: Array = origin_w + SCENES[scene.kind](scene, origin_w, rays_w, rng)[:, None] * rays_w
    return points
