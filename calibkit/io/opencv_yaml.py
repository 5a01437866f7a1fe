"""OpenCV FileStorage YAML, as OpenCV's calibration sample writes it: one camera a file, pixel (0, 0) a centre as with us."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from calibkit.data.rig import Camera, Rig
from calibkit.io import foreign
from calibkit.io.foreign import Array, Exported, Exporter, Imported, Importer
from calibkit.io.yaml_file import Document
from calibkit.models.cameras import CAMERAS

_PINHOLE = {0: "pinhole-radtan", 4: "pinhole-radtan", 5: "pinhole-radtan5", 8: "pinhole-radtan8"}
_FISHEYE = {0: "pinhole-equi", 4: "pinhole-equi"}
_SPELLINGS = {  # of the sample through the years
    "width": ("image_width", "image_Width"),
    "height": ("image_height", "image_Height"),
    "matrix": ("camera_matrix", "Camera_Matrix", "cameraMatrix"),
    "coefficients": ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs"),
    "fisheye": ("fisheye_model",),
}


def _keys(data: Mapping[str, Any]) -> dict[str, str]:
    return {what: next((name for name in names if name in data), names[0]) for what, names in _SPELLINGS.items()}


def _recognises(data: Mapping[str, Any]) -> bool:
    return _keys(data)["matrix"] in data and "distortion_model" not in data


def matrix_at(document: Document, key: str, counts: tuple[int, ...]) -> Array:
    """Return the numbers of a matrix {rows, cols, data} whose rows and cols fit them."""
    values = foreign.numbers_at(document, (key, "data"), counts)
    shape = [foreign.number_at(document, (key, name)) for name in ("rows", "cols")]
    if None not in shape and np.prod(np.array(shape, float)) != len(values):
        raise document.error((key,), "its rows and cols do not fit its data; check them")
    return values


def camera_at(document: Document, matrix: str, coefficients: str, models: Mapping[int, str], size: tuple[int, int]) -> Camera:
    """Return the camera of a 3x3 matrix and its distortion; trailing zero coefficients beyond the known numbers are dropped."""
    K = matrix_at(document, matrix, (9,)).reshape(3, 3)
    fx, fy = K[0, 0], K[1, 1]
    if not np.allclose(K, [[fx, 0, K[0, 2]], [0, fy, K[1, 2]], [0, 0, 1]], rtol=0, atol=1e-9 * abs(fx)):
        raise document.error((matrix,), "has a skew or is no camera matrix; it must be [fx 0 cx; 0 fy cy; 0 0 1]")
    values = {"fx": fx, "fy": fy, "cx": K[0, 2], "cy": K[1, 2]}
    foreign.focal_lengths_positive(document, (matrix,), values)
    D = np.zeros(0)
    if foreign.value_at(document, (coefficients, "data")) not in (None, []):
        D = matrix_at(document, coefficients, (2, 4, 5, 8, 12, 14))
    fitting = [count for count in models if not D[count:].any()]
    if not fitting:
        raise document.error((coefficients,), f"has {len(D)} coefficients, none 0; more than {max(models)} are not supported yet")
    model = models[len(D) if len(D) in models else min(fitting)]
    return foreign.given_camera(model, values | dict(zip(CAMERAS[model].parameter_names[4:], D, strict=False)), size)


def size_of(document: Document, width: str, height: str) -> tuple[int, int]:
    """Return the image size under these keys; without it no calibration is usable."""
    values = [foreign.value_at(document, (key,)) for key in (width, height)]
    if None in values:
        raise document.error((), f"{width} and {height} are missing; add the size of the images in pixels")
    return foreign.size_at(document, values[0], values[1], (width,))


def _read(document: Document, so_far: Rig) -> Imported:
    keys = _keys(document.data)
    name = f"cam{len(so_far.cameras)}"
    models = _FISHEYE if foreign.value_at(document, (keys["fisheye"],)) in (1, True) else _PINHOLE
    camera = camera_at(document, keys["matrix"], keys["coefficients"], models, size_of(document, keys["width"], keys["height"]))
    return Imported(Rig(cameras={name: camera}), tuple(foreign.suspicions(name, camera)))


def camera_matrix(params: Array) -> list[float]:
    """Return K = [fx 0 cx; 0 fy cy; 0 0 1] row by row."""
    fx, fy, cx, cy = params[:4].tolist()
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def matrix_text(name: str, rows: int, cols: int, data: list[float]) -> str:
    """Return a matrix as cv::FileStorage reads it."""
    numbers = ", ".join(map(repr, data))
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {numbers} ]\n"


def _text(name: str, camera: Camera) -> str:
    params = foreign.camera_values(name, camera)
    width, height = camera.resolution
    return (
        f"%YAML:1.0\n---\nimage_width: {width}\nimage_height: {height}\n"
        f"fisheye_model: {int(camera.model in _FISHEYE.values())}\n"
        + matrix_text("camera_matrix", 3, 3, camera_matrix(params))
        + matrix_text("distortion_coefficients", len(params) - 4, 1, params[4:].tolist())
    )


def _write(rig: Rig) -> Exported:
    files = {f"{name}.yaml": _text(name, camera) for name, camera in rig.cameras.items()}
    return Exported(files, tuple(foreign.without_place(rig, "imus", "transforms", "time_offsets")))


IMPORTER = Importer("opencv", _recognises, _read)
EXPORTER = Exporter("opencv", (*dict.fromkeys(_PINHOLE.values()), "pinhole-equi"), _write)
