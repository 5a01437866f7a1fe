"""ROS camera_info YAML: one camera a file (wiki.ros.org/camera_calibration_parsers)."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from calibkit.data.rig import Camera, Rig
from calibkit.io import foreign
from calibkit.io.foreign import Exported, Exporter, Imported, Importer
from calibkit.io.opencv_yaml import camera_at, camera_matrix, matrix_at, size_of
from calibkit.io.yaml_file import Document, dump_yaml

# distortion_model -> number of coefficients -> our model
_MODELS = {
    "plumb_bob": {0: "pinhole-radtan", 4: "pinhole-radtan", 5: "pinhole-radtan5"},
    "rational_polynomial": {8: "pinhole-radtan8"},
    "equidistant": {4: "pinhole-equi"},
}
# our model -> distortion_model as it is written, and how many coefficients; plumb_bob always has 5
_WRITTEN = {
    "pinhole-radtan": ("plumb_bob", 5),
    "pinhole-radtan5": ("plumb_bob", 5),
    "pinhole-radtan8": ("rational_polynomial", 8),
    "pinhole-equi": ("equidistant", 4),
}


def _recognises(data: Mapping[str, Any]) -> bool:
    return "camera_matrix" in data and "distortion_model" in data


def _read(document: Document, so_far: Rig) -> Imported:
    name = f"cam{len(so_far.cameras)}"
    distortion = foreign.text_at(document, ("distortion_model",))
    if distortion not in _MODELS:
        raise document.error(("distortion_model",), f"{foreign.quote(distortion)} is not known; it may be {', '.join(_MODELS)}")
    camera = camera_at(
        document, "camera_matrix", "distortion_coefficients", _MODELS[distortion], size_of(document, "image_width", "image_height")
    )
    warnings = foreign.suspicions(name, camera)
    if foreign.value_at(document, ("rectification_matrix",)) is not None:
        R = matrix_at(document, "rectification_matrix", (9,)).reshape(3, 3)
        if not np.allclose(R, np.eye(3)):
            warnings.append(f"{name}: rectification_matrix is that of a stereo pair; the raw image's camera is taken, the pair is not")
    return Imported(Rig(cameras={name: camera}), tuple(warnings))


def _text(name: str, camera: Camera) -> str:
    params = foreign.camera_values(name, camera)
    distortion, count = _WRITTEN[camera.model]
    K = camera_matrix(params)
    coefficients = (params[4:].tolist() + [0.0] * count)[:count]
    width, height = camera.resolution
    return dump_yaml(
        {
            "image_width": width,
            "image_height": height,
            "camera_name": name,
            "camera_matrix": {"rows": 3, "cols": 3, "data": K},
            "distortion_model": distortion,
            "distortion_coefficients": {"rows": 1, "cols": count, "data": coefficients},
            "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
            "projection_matrix": {"rows": 3, "cols": 4, "data": np.insert(K, [3, 6, 9], 0.0).tolist()},
        }
    )


def _write(rig: Rig) -> Exported:
    files = {f"{name}.yaml": _text(name, camera) for name, camera in rig.cameras.items()}
    return Exported(files, tuple(foreign.without_place(rig, "imus", "transforms", "time_offsets")))


IMPORTER = Importer("ros", _recognises, _read)
EXPORTER = Exporter("ros", tuple(_WRITTEN), _write)
