"""Writes what VINS-Fusion's configuration says of a rig: vins.yaml, and camodocal's file of each camera.

VINS-Fusion (HKUST, parameters.cpp) reads body_T_cam0, which brings the camera's points into the IMU's frame, and td, image clock + td =
IMU clock, as ours. Its noise (integration_base.h) is the sigma of one sample, and a walk's is its step over the interval: a density
times sqrt(rate). At most two cameras and one IMU; how it tracks and solves stays with the user's own file.
"""

from typing import Any

import numpy as np

from calibkit.data.rig import Camera, Estimate, Imu, Rig
from calibkit.io import foreign
from calibkit.io.foreign import Exported, Exporter
from calibkit.io.kalibr_export import imus_of, left_out, matrix_of, renamed, seconds_of
from calibkit.io.opencv_yaml import matrix_text
from calibkit.io.yaml_file import dump_yaml
from calibkit.models.cameras import CAMERAS
from calibkit.models.imu import STANDARD_GRAVITY

_HEADER = "%YAML:1.0\n---\n"
_MOST = 2
_NOISE = {"acc_n": "accel_noise_density", "gyr_n": "gyro_noise_density", "acc_w": "accel_random_walk", "gyr_w": "gyro_random_walk"}
# Names of camodocal's by ours: the model, its distortion and its projection.
_LENSES = {
    "pinhole-radtan": ("PINHOLE", {key: key for key in ("k1", "k2", "p1", "p2")}, {key: key for key in ("fx", "fy", "cx", "cy")}),
    "pinhole-equi": (
        "KANNALA_BRANDT",
        {},
        {"k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4", "mu": "fx", "mv": "fy", "u0": "cx", "v0": "cy"},
    ),
}


def _write(rig: Rig) -> Exported:
    notes = foreign.without_place(rig)
    imu = next(iter(imus_of(rig)), None)
    cameras = dict(list(rig.cameras.items())[:_MOST])
    names = {name: f"cam{i}" for i, name in enumerate(cameras)} | ({} if imu is None else {imu: "imu0"})
    notes += renamed(names)
    notes += [f"{name} is not written: VINS-Fusion has {_MOST} cameras at most" for name in list(rig.cameras)[_MOST:]]
    notes += [f"{name} is not written: VINS-Fusion has one IMU, {imu}" for name in rig.imus if name != imu]
    files = {f"{names[name]}.yaml": _HEADER + dump_yaml(_lens_of(name, camera)) for name, camera in cameras.items()}
    if imu in rig.imus and rig.imus[imu].intrinsics is not None:
        notes.append(f"{imu}'s intrinsics are not written: VINS-Fusion takes samples as corrected; correct them first")
    if imu is not None and cameras:
        files = {"vins.yaml": _rig_of(rig, cameras, imu, names, notes), **files}
    return Exported(files, (*notes, *left_out(rig, "VINS-Fusion", {*cameras, *([] if imu is None else [imu])})))


def _rig_of(rig: Rig, cameras: dict[str, Camera], imu: str, names: dict[str, str], notes: list[str]) -> str:
    width, height = next(iter(cameras.values())).resolution
    keys: dict[str, Any] = {"imu": 1, "num_of_cam": len(cameras)}
    topics = {"imu_topic": rig.imus[imu].topic if imu in rig.imus else None}
    topics |= {f"image{i}_topic": camera.topic for i, camera in enumerate(cameras.values())}
    keys |= {key: topic for key, topic in topics.items() if topic is not None}
    keys |= {f"{names[name]}_calib": f"{names[name]}.yaml" for name in cameras} | {"image_width": width, "image_height": height}
    keys["estimate_extrinsic"] = 0
    text = ""
    for name in cameras:
        T_imu_cam = matrix_of(rig, imu, name)
        if T_imu_cam is None:
            notes.append(f"{name} has no transform to {imu}, which VINS-Fusion demands; add body_T_{names[name]} by hand")
        else:
            text += matrix_text(f"body_T_{names[name]}", 4, 4, np.ravel(T_imu_cam).tolist())
    keys |= _noise_of(imu, rig.imus.get(imu), notes) | {"g_norm": STANDARD_GRAVITY.value, "estimate_td": 0}
    shifts = {name: seconds_of(rig, imu, name) for name in cameras}
    first = next(iter(shifts.values())) or 0.0
    others = [name for name, shift in shifts.items() if shift is not None and shift != first]
    if others:
        notes.append(f"VINS-Fusion takes cam0's td, {first:g} s, for every camera; that of {', '.join(others)} differs")
    return _HEADER + dump_yaml(keys | {"td": first}) + text


def _noise_of(name: str, imu: Imu | None, notes: list[str]) -> dict[str, float]:
    found: dict[str, float] = {}
    for key, field in _NOISE.items():
        estimate: Estimate | None = getattr(imu, field, None)
        if imu is None or imu.rate_hz is None or estimate is None:
            lacking = "rate_hz" if estimate is not None else field
            notes.append(f"{name} has no {lacking}, which VINS-Fusion demands; add {key} by hand")
            continue
        foreign.refuse_unobservable(f"imus.{name}.{field}", estimate.status)
        found[key] = float(estimate.value or 0.0) * imu.rate_hz**0.5
    return found


def _lens_of(name: str, camera: Camera) -> dict[str, Any]:
    model, distortion, projection = _LENSES[camera.model]
    values = dict(zip(CAMERAS[camera.model].parameter_names, foreign.camera_values(name, camera).tolist(), strict=True))
    width, height = camera.resolution
    node: dict[str, Any] = {"model_type": model, "camera_name": "camera", "image_width": width, "image_height": height}
    if distortion:
        node["distortion_parameters"] = {key: values[ours] for key, ours in distortion.items()}
    return node | {"projection_parameters": {key: values[ours] for key, ours in projection.items()}}


EXPORTER = Exporter("vins", tuple(_LENSES), _write)
