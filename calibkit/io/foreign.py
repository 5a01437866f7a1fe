"""What all importers and exporters share: typed access to a foreign file's values, and cameras as bare parameters."""

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibkit.data.rig import Camera, Estimate, Rig
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError, one_line
from calibkit.geometry import so3
from calibkit.io.yaml_file import Document
from calibkit.models.cameras import CAMERAS

Array = NDArray[np.float64]
Keys = Sequence[Hashable]
_ROUNDING = 1e-4  # a rotation written with few digits is that far from orthonormal
_NO_ROTATION = 1e-2


@dataclass(frozen=True)
class Imported:
    """What one foreign file says, and what about it a person should look at."""

    rig: Rig
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Importer:
    """A foreign format: how its data is recognised and read; `so_far` is what earlier files gave, for the next free name."""

    name: str
    recognises: Callable[[Mapping[str, Any]], bool]
    read: Callable[[Document, Rig], Imported]


@dataclass(frozen=True)
class Exported:
    """Texts by file name, and what the format had no place for."""

    files: dict[str, str]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Exporter:
    """A foreign format: the camera models that it holds exactly, and its writer."""

    name: str
    holds: tuple[str, ...]
    write: Callable[[Rig], Exported]


def value_at(document: Document, keys: Keys) -> Any:
    """Return the value under these keys, None where there is none."""
    node = document.data
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node


def text_at(document: Document, keys: Keys) -> str | None:
    """Return an optional text."""
    value = value_at(document, keys)
    if value is None or (isinstance(value, str) and len(value) <= 2000):
        return value
    raise document.error(keys, f"{quote(value)} is not a name; write a text")


def number_at(document: Document, keys: Keys) -> float | None:
    """Return an optional finite number."""
    value = value_at(document, keys)
    return None if value is None else float(_numbers(document, keys, [value])[0])


def numbers_at(document: Document, keys: Keys, counts: Sequence[int]) -> Array:
    """Return a list of finite numbers, nested lists written out, as long as one of `counts`."""
    value = value_at(document, keys)
    if value is None:
        raise document.error(keys, "is missing; this key is needed")
    if not isinstance(value, list):
        raise document.error(keys, f"{quote(value)} is not a list of numbers; write [1.0, ...]")
    flat = [item for row in value for item in (row if isinstance(row, list) else [row])]
    if len(flat) not in counts:
        raise document.error(keys, f"has {len(flat)} numbers; it needs {' or '.join(map(str, counts))}")
    return _numbers(document, keys, flat)


def _numbers(document: Document, keys: Keys, values: list[Any]) -> Array:
    for value in values:
        if type(value) not in (int, float) or not abs(value) <= 1e100:
            raise document.error(keys, f"{quote(value)} is not a finite number; write it like 0.05")
    return np.array(values, float)


def size_at(document: Document, width: Any, height: Any, keys: Keys) -> tuple[int, int]:
    """Return an image size that makes sense."""
    for value in (width, height):
        if type(value) not in (int, float) or not 0 < value <= 100000 or value != int(value):
            raise document.error(keys, f"{quote(value)} is not an image size; write width and height in pixels")
    return int(width), int(height)


def rigid_at(document: Document, keys: Keys, warnings: list[str]) -> Array | None:
    """Return an optional 4x4 transform, its rotation made orthonormal: rows of 4 or 16 numbers in a row."""
    if value_at(document, keys) is None:
        return None
    T = numbers_at(document, keys, (16,)).reshape(4, 4)
    R = T[:3, :3]
    if np.abs(T[3] - [0, 0, 0, 1]).max() > _ROUNDING:
        raise document.error(keys, "the last row is not 0 0 0 1; write the transform row by row")
    if np.abs(T[:3, 3]).max() > 1e6:
        raise document.error(keys, "the last column is no translation in metres; check its numbers")
    T[:3, :3] = rotation_of(document, keys, R, "the upper left 3 x 3", warnings)
    T[3] = [0, 0, 0, 1]
    return T


def rotation_of(document: Document, keys: Keys, R: Array, what: str, warnings: list[str]) -> Array:
    """Return the rotation nearest to R (3, 3), which `what` names; refuse what is none and say what was off."""
    off = float(np.abs(R @ R.T - np.eye(3)).max()) if np.abs(R).max() < 2 else np.inf
    if off > _NO_ROTATION or np.linalg.det(R) < 0:
        raise document.error(keys, f"{what} is not a rotation; check its numbers")
    if off > _ROUNDING:
        warnings.append(f"{'.'.join(map(str, keys))}: its rotation is off by {off:.1g} from orthonormal; the nearest rotation is taken")
    return so3.project(R)


def quote(value: object) -> str:
    """Return a foreign value as a short printable text."""
    return one_line(repr(value), 60)


def given_camera(model: str, values: Mapping[str, float], resolution: tuple[int, int], topic: str | None = None) -> Camera:
    """Return a camera with parameters as given, those that are not named 0."""
    names = CAMERAS[model].parameter_names
    units = dict.fromkeys(names[:4], "px")
    return Camera(
        topic=topic,
        resolution=resolution,
        model=model,
        equation=CAMERAS[model].equation,
        parameters={name: Estimate(value=float(values.get(name, 0.0)), unit=units.get(name, "")) for name in names},
    )


def suspicions(name: str, camera: Camera) -> list[str]:
    """Return what looks wrong about a camera's image size and centre."""
    (w, h), (fx, fy, cx, cy) = camera.resolution, camera_values(name, camera)[:4]
    off, off_swapped = np.hypot(cx - w / 2, cy - h / 2), np.hypot(cx - h / 2, cy - w / 2)
    seen = []
    if not (0 <= cx < w and 0 <= cy < h):
        seen.append(f"{name}: the centre ({cx:.1f}, {cy:.1f}) lies outside the image of {w} x {h}; check resolution")
    elif off > 0.1 * np.hypot(w, h) and off_swapped < off / 2:
        seen.append(f"{name}: the centre ({cx:.1f}, {cy:.1f}) suits {h} x {w} better than {w} x {h}; check whether resolution is swapped")
    if not 0.5 < fx / fy < 2:
        seen.append(f"{name}: fx {fx:.1f} and fy {fy:.1f} differ by more than a factor of 2; check the order of the intrinsics")
    return seen


def focal_lengths_positive(document: Document, keys: Keys, values: Mapping[str, float]) -> None:
    """Refuse a focal length that is not positive."""
    if not (values["fx"] > 0 and values["fy"] > 0):
        raise document.error(keys, "a focal length is not positive; check the order of the numbers")


def camera_values(name: str, camera: Camera) -> Array:
    """Return the parameters in the model's order; one that is not observable has no value and is refused by name."""
    names = CAMERAS[camera.model].parameter_names
    for parameter in names:
        refuse_unobservable(f"cameras.{name}.{parameter}", camera.parameters[parameter].status)
    return np.array([camera.parameters[parameter].value for parameter in names], float)


def refuse_unobservable(name: str, status: Status) -> None:
    """Raise where a value is marked as not observable: it must not leave as if it were known."""
    if status is Status.NOT_OBSERVABLE:
        raise BadInputError(f"{name} is marked 'not observable' and cannot be exported; record again with the motion that shows it")


def without_place(rig: Rig, *sections: str) -> list[str]:
    """Return the note on what a format does not hold: sigmas, and these sections of the rig."""
    lost = [section.replace("_", " ") for section in sections if getattr(rig, section)]
    if any(e.sigma is not None for e in _estimates(rig)):
        lost.insert(0, "sigmas and covariances")
    if "imus" not in sections and any(imu.noise for imu in rig.imus.values()):
        lost.append("the noise of each axis")
    if "cameras" not in sections and (rolling := [name for name, camera in rig.cameras.items() if camera.line_delay is not None]):
        lost.append(f"the line delay of {', '.join(rolling)}")
    return [f"not written, the format has no place for them: {', '.join(lost)}"] if lost else []


def _estimates(rig: Rig) -> Iterator[Estimate]:
    for camera in rig.cameras.values():
        yield from camera.parameters.values()
    for imu in rig.imus.values():
        densities = (imu.gyro_noise_density, imu.gyro_random_walk, imu.accel_noise_density, imu.accel_random_walk)
        yield from (density for density in densities if density is not None)
        yield from imu.intrinsics.parameters.values() if imu.intrinsics else ()
