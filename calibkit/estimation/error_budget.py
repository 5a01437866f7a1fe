"""What a rig's uncertainties cost whoever uses it: pixels, metres at range, phantom velocity and acceleration.

One sigma of each cause alone, to first order. Pixels and metres of lenses and transforms are root mean squares over the image,
sqrt(mean tr(J Sigma J^T)), of sqrt(du^2 + dv^2) and of the way across; the rest is a worst direction:

    time offset  f rate s px (2.5 px at 500 px, 1 rad/s, 5 ms), range rate s m; moving: speed s m
    lever arm    rate s m/s (2 cm/s at 1 rad/s, 2 cm)
    rotation     speed s m/s of a velocity that is turned, g s m/s^2 of a gravity that is
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import sqrt
from typing import Literal

import numpy as np

from calibkit.data.rig import Camera, Estimate, Rig, Transform
from calibkit.data.transforms import frames_of
from calibkit.data.verdict import Status
from calibkit.estimation.pixel_grid import turned_jacobian
from calibkit.estimation.pixel_shift import Lens, known_lens
from calibkit.estimation.rig_values import of_estimates, tangent_covariance
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array, hat
from calibkit.models.cameras import CAMERAS
from calibkit.models.imu import STANDARD_GRAVITY

Known = Literal["known", "unknown", "unbounded"]
_ALL_AROUND = np.concatenate([np.eye(3), -np.eye(3)])  # the mean of squares over a sphere, exactly


@dataclass(frozen=True)
class Use:
    """How the rig is used."""

    rate: float = 1.0  # rad/s
    range_m: float = 10.0
    speed: float = 1.0  # m/s


@dataclass(frozen=True)
class Cost:
    """What one sigma of one term of one entry costs."""

    entry: str  # cam0, T_cam0_imu0, dt_imu0_cam0
    term: str
    known: Known  # unknown: given without a sigma; unbounded: not observable
    sigma: float | None = None  # along the worst direction; None for a lens
    unit: str = ""
    px: float | None = None
    metres: float | None = None  # at range
    velocity: float | None = None  # m/s
    acceleration: float | None = None  # m/s^2
    remedy: str = ""


def budget(rig: Rig, use: Use) -> list[Cost]:
    """Return all costs: what is unbounded first, then what is unknown, then by metres at range."""
    costs = [cost for name, camera in rig.cameras.items() for cost in _of_camera(name, camera, use)]
    costs += [cost for name, entry in rig.transforms.items() for cost in _of_transform(name, entry, rig, use)]
    costs += [cost for name, offset in rig.time_offsets.items() for cost in _of_time(name, offset.offset, rig, use)]
    order = ("unbounded", "unknown", "known")
    return sorted(costs, key=lambda cost: (order.index(cost.known), -(cost.metres or 0.0)))


def _known(statuses: set[Status], has_sigma: bool) -> Known:
    if Status.NOT_OBSERVABLE in statuses:
        return "unbounded"
    return "known" if has_sigma else "unknown"


def _of_camera(name: str, camera: Camera, use: Use) -> Iterator[Cost]:
    values = of_estimates({key: camera.parameters[key] for key in CAMERAS[camera.model].parameter_names}, camera.covariance)
    known = _known({estimate.status for estimate in camera.parameters.values()}, bool(np.any(values.cov)))
    remedy = f"calibkit intrinsics with more views of the board, in {name}'s corners and tilted"
    lens = known_lens(name, camera)
    if known != "known" or lens is None:
        yield Cost(name, "lens", known, remedy=remedy)
    else:
        px, angle = lens_costs(lens, values.cov)
        yield Cost(name, "lens", known, None, "", px, angle * use.range_m, remedy=remedy)
    if camera.line_delay is not None:
        remedy = "calibkit joint --line-delay with faster turns"
        yield from _turning(name, "line delay (first row)", camera.line_delay, camera.resolution[1] / 2, use, lens, remedy)


def lens_costs(lens: Lens, cov: Array) -> tuple[float, float]:
    """Return the rms over the image of a far point's pixel (px) and of its direction (rad), the camera turned along as a whole."""
    _, rays = lens.rays()
    rays = rays[np.isfinite(rays).all(axis=1)]
    model = CAMERAS[lens.camera.model]
    J = turned_jacobian(model, lens.params, rays, np.ones(len(rays), bool))
    J_point = model.project(rays, lens.params, jacobians=True).J_point
    assert J_point is not None
    return _rms(J, cov), _rms(np.linalg.pinv(J_point) @ J, cov)  # J_point x = 0: its inverse gives the way across


def _rms(J: Array, cov: Array) -> float:
    """Return sqrt(mean tr(J cov J^T)) of J (n, k, p)."""
    return sqrt(max(float(np.mean(np.einsum("nip,pq,niq->n", J, cov, J))), 0.0))


def _of_transform(name: str, entry: Transform, rig: Rig, use: Use) -> Iterator[Cost]:
    a, b = frames_of(name)
    cov = tangent_covariance(entry)
    across, pixels = transform_jacobians(name, entry, rig, use.range_m)
    for term, part, unit, letter in (("lever arm", slice(0, 3), "m", "p"), ("rotation", slice(3, 6), "rad", "r")):
        statuses = {status for key, status in entry.statuses.items() if key.startswith(letter)} or {entry.status}
        block = cov[part, part]
        known = _known(statuses, bool(np.any(block)))
        remedy = _REMEDIES[_pair(a, b, rig)][term]
        if known != "known":
            yield Cost(name, term, known, None, unit, remedy=remedy)
            continue
        sigma = sqrt(float(np.linalg.eigvalsh(block)[-1]))
        yield Cost(
            name,
            term,
            known,
            sigma,
            unit,
            None if pixels is None else _rms(pixels[..., part], block),
            _rms(across[..., part], block),
            sigma * (use.rate if unit == "m" else use.speed),
            sigma * STANDARD_GRAVITY.value if _has_imu(a, b, rig) and unit == "rad" else None,
            remedy,
        )


def transform_jacobians(name: str, entry: Transform, rig: Rig, range_m: float) -> tuple[Array, Array | None]:
    """Return what T_a_b exp(d) does to points at a range: d p / dd (n, 3, 6) in m, and, of a camera's image, d uv / dd (n, 2, 6) in px.

    The points are those that the camera sees (a where that is one, else b), or all around the sensor b.
    """
    a, b = frames_of(name)
    camera = next((frame for frame in (a, b) if frame in rig.cameras), None)
    lens = None if camera is None else known_lens(camera, rig.cameras[camera])
    if lens is None:
        return _point_jacobian(range_m * _ALL_AROUND), None
    _, rays = lens.rays()
    points = range_m * rays[np.isfinite(rays).all(axis=1)]
    J_point = CAMERAS[lens.camera.model].project(points, lens.params, jacobians=True).J_point
    assert J_point is not None
    if camera == b:
        J = _point_jacobian(points)
        return J, J_point @ J
    J = _point_jacobian(se3.transform(np.array(entry.inverse_matrix), points))
    return J, J_point @ np.array(entry.matrix)[:3, :3] @ J


def _point_jacobian(points: Array) -> Array:
    """Return d (exp(d) p) / dd = [I, -hat(p)] (n, 3, 6)."""
    return np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), -hat(points)], axis=-1)


def _of_time(name: str, offset: Estimate, rig: Rig, use: Use) -> Iterator[Cost]:
    a, b = frames_of(name)
    camera = next((frame for frame in (b, a) if frame in rig.cameras), None)
    lens = None if camera is None else known_lens(camera, rig.cameras[camera])
    remedy = "calibkit timeoffset or joint with faster turns, back and forth"
    gravity = STANDARD_GRAVITY.value if _has_imu(a, b, rig) else None
    yield from _turning(name, "time offset (turning)", offset, 1.0, use, lens, remedy, gravity)
    known = _known({offset.status}, bool(offset.sigma))
    if known == "known" and offset.sigma is not None and use.speed > 0:
        way = use.speed * offset.sigma
        px = None if lens is None else _focal(lens) * way / use.range_m
        yield Cost(name, "time offset (moving)", known, offset.sigma, "s", px, way, remedy=remedy)


def _turning(
    entry: str, term: str, time: Estimate, times: float, use: Use, lens: Lens | None, remedy: str, gravity: float | None = None
) -> Iterator[Cost]:
    """Yield what `times` the sigma of a time costs while the rig turns: an angle rate s."""
    known = _known({time.status}, bool(time.sigma))
    if known != "known" or time.sigma is None:
        yield Cost(entry, term, known, None, "s", remedy=remedy)
        return
    angle = use.rate * times * time.sigma
    px = None if lens is None else _focal(lens) * angle
    felt = None if gravity is None else gravity * angle
    yield Cost(entry, term, known, time.sigma, "s", px, use.range_m * angle, use.speed * angle, felt, remedy)


def _focal(lens: Lens) -> float:
    return sqrt(float(lens.params[0] * lens.params[1]))


def _pair(a: str, b: str, rig: Rig) -> str:
    cameras = sum(frame in rig.cameras for frame in (a, b))
    return "camera and IMU" if cameras and _has_imu(a, b, rig) else "cameras" if cameras == 2 else "other"


def _has_imu(a: str, b: str, rig: Rig) -> bool:
    """Return whether one of the frames is an IMU: by its entry, or by its name where a stage had nothing to enter."""
    return any(frame in rig.imus or frame.startswith("imu") for frame in (a, b))


_REMEDIES = {
    "camera and IMU": {
        "rotation": "calibkit joint with faster turns about all axes",
        "lever arm": "calibkit joint with faster turns about all axes, that start and stop briskly",
    },
    "cameras": {
        "rotation": "calibkit intrinsics with more views that both cameras have of the board",
        "lever arm": "calibkit intrinsics with more views that both cameras have of the board, near ones",
    },
    "other": {
        "rotation": "calibkit handeye with more poses, turned farther about two or more axes",
        "lever arm": "calibkit handeye with more poses, turned farther about two or more axes",
    },
}
