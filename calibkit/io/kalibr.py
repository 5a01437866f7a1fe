"""Reads Kalibr's camchain.yaml and imu.yaml (github.com/ethz-asl/kalibr/wiki/yaml-formats), and OpenVINS' dialect of them.

Kalibr's names for ours: T_cam_imu = T_camN_imu0, T_imu_cam = T_imu0_camN, T_cn_cnm1 = T_camN_cam(N-1), T_i_b = T_imuN_imu0,
timeshift_cam_imu = dt_imu0_camN (t_imu = t_cam + shift), time_offset = dt_imu0_imuN (Kalibr adds it to imuN's stamps).
"""

import difflib
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from calibkit.data.rig import Camera, Estimate, Imu, Rig, TimeOffset, Transform
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.errors import one_line
from calibkit.geometry import se3
from calibkit.io import foreign, imu_keys
from calibkit.io.foreign import Imported, Importer
from calibkit.io.yaml_file import Document
from calibkit.models.cameras import CAMERAS

_PINHOLE = ("fx", "fy", "cx", "cy")
_RADTAN = ("k1", "k2", "p1", "p2")
# (camera_model, distortion_model) -> our model, and our names for `intrinsics` and `distortion_coeffs`.
MODELS: dict[tuple[str, str], tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    ("pinhole", "radtan"): ("pinhole-radtan", _PINHOLE, _RADTAN),
    ("pinhole", "equidistant"): ("pinhole-equi", _PINHOLE, ("k1", "k2", "k3", "k4")),
    ("pinhole", "none"): ("pinhole-none", _PINHOLE, ()),
    ("pinhole", "fov"): ("pinhole-fov", _PINHOLE, ("w",)),
    ("omni", "radtan"): ("omni-radtan", ("xi", *_PINHOLE), _RADTAN),
    ("omni", "none"): ("omni-radtan", ("xi", *_PINHOLE), ()),
    ("ds", "none"): ("ds-none", ("xi", "alpha", *_PINHOLE), ()),
    ("eucm", "none"): ("eucm-none", ("alpha", "beta", *_PINHOLE), ()),
}
NOISE = {  # Kalibr's key -> our field and its unit
    "gyroscope_noise_density": ("gyro_noise_density", "rad/s/sqrt(Hz)"),
    "gyroscope_random_walk": ("gyro_random_walk", "rad/s^2/sqrt(Hz)"),
    "accelerometer_noise_density": ("accel_noise_density", "m/s^2/sqrt(Hz)"),
    "accelerometer_random_walk": ("accel_random_walk", "m/s^3/sqrt(Hz)"),
}
_LENS_KEYS = ("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution")
_CAMERA_KEYS = (*_LENS_KEYS, "rostopic", "cam_overlaps", "T_cn_cnm1", "T_cam_imu", "T_imu_cam", "timeshift_cam_imu")
_IMU_KEYS = (*NOISE, "rostopic", "update_rate", "T_i_b", "time_offset", *imu_keys.NAMES)
_RECOGNISED = (*NOISE, "accelerometers", "gyroscopes", "Tw", "Ta", "Tg")  # of a file that holds the keys of one IMU without its name
_SENSOR = re.compile(r"(cam|imu)[0-9]{1,3}")  # not \d: other scripts' digits make no name of a rig file
_DISAGREE_RAD, _DISAGREE_M = 2e-3, 2e-3  # beyond rounding, between T_cn_cnm1 and the two T_cam_imu


def _recognises(data: Mapping[str, Any]) -> bool:
    return any(_SENSOR.fullmatch(key) for key in data) or any(key in data for key in _RECOGNISED)


def _read(document: Document, so_far: Rig) -> Imported:
    data, warnings = document.data, list[str]()
    cameras: dict[str, Camera] = {}
    imus: dict[str, Imu] = {}
    transforms: dict[str, Transform] = {}
    offsets: dict[str, TimeOffset] = {}
    sensors: dict[str, tuple[str, ...]] = {key: (key,) for key in data if _SENSOR.fullmatch(key)}
    if not sensors:  # imu.yaml as one writes it for Kalibr: the keys of one IMU, without its name
        sensors = {f"imu{len(so_far.imus)}": ()}
    else:
        _warn_ignored(document, (), (key for key in data if key not in sensors), warnings)
    for name, keys in sensors.items():
        if not isinstance(foreign.value_at(document, keys), dict):
            raise document.error(keys, "holds no keys; check the indentation below it")
        read = _read_camera if name.startswith("cam") else _read_imu
        read(document, name, keys, (cameras, imus, transforms, offsets), warnings)
    return Imported(Rig(cameras=cameras, imus=imus, transforms=transforms, time_offsets=offsets), (*warnings, *_disagreements(transforms)))


_Parts = tuple[dict[str, Camera], dict[str, Imu], dict[str, Transform], dict[str, TimeOffset]]


def _read_camera(document: Document, name: str, keys: tuple[str, ...], parts: _Parts, warnings: list[str]) -> None:
    cameras, imus, transforms, offsets = parts
    node = foreign.value_at(document, keys)
    _check_names(document, keys, (*_CAMERA_KEYS, *NOISE), warnings)
    if "camera_model" in node or "intrinsics" in node:
        cameras[name] = _lens(document, name, keys)
        warnings += foreign.suspicions(name, cameras[name])
    else:
        warnings.append(f"{name}: has no camera_model and intrinsics; only its other values are taken")
    if any(key in node for key in NOISE):
        imus.setdefault("imu0", _noise(document, keys))
        warnings.append(f"{name}: holds IMU noise; taken as that of imu0")
    T_cam_imu, T_imu_cam = (foreign.rigid_at(document, (*keys, key), warnings) for key in ("T_cam_imu", "T_imu_cam"))
    if T_cam_imu is not None and T_imu_cam is not None:
        raise document.error((*keys, "T_imu_cam"), "T_cam_imu is given as well; keep one")
    if T_imu_cam is not None:
        T_cam_imu = se3.inverse(T_imu_cam)
    if T_cam_imu is not None:
        transforms[f"T_{name}_imu0"] = make_transform(name, "imu0", T_cam_imu)
    T_cn_cnm1 = foreign.rigid_at(document, (*keys, "T_cn_cnm1"), warnings)
    if T_cn_cnm1 is not None:
        before = f"cam{int(name[3:]) - 1}"
        if int(name[3:]) == 0:
            raise document.error((*keys, "T_cn_cnm1"), "cam0 has no camera before it; move it to the camera that it belongs to")
        transforms[f"T_{name}_{before}"] = make_transform(name, before, T_cn_cnm1)
    shift = foreign.number_at(document, (*keys, "timeshift_cam_imu"))
    if shift is not None:
        offsets[f"dt_imu0_{name}"] = make_time_offset("imu0", name, Estimate(value=shift, unit="s"))
    overlaps = foreign.value_at(document, (*keys, "cam_overlaps")) or []
    for other in overlaps if isinstance(overlaps, list) else [overlaps]:
        if f"cam{other}" not in document.data:
            warnings.append(f"{name}: cam_overlaps names cam{foreign.quote(other)}, which the file does not hold")


def _lens(document: Document, name: str, keys: tuple[str, ...]) -> Camera:
    for key in ("camera_model", "intrinsics", "resolution"):
        if foreign.value_at(document, (*keys, key)) is None:
            raise document.error(keys, f"{key} is missing; Kalibr writes it for each camera")
    model = foreign.text_at(document, (*keys, "camera_model")) or ""
    distortion = foreign.text_at(document, (*keys, "distortion_model")) or "none"
    if (model, distortion) not in MODELS:
        known = ", ".join(f"{a}-{b}" for a, b in MODELS)
        raise document.error((*keys, "camera_model"), f"{one_line(f'{model}-{distortion}', 60)} is no model of Kalibr's; it may be {known}")
    ours, intrinsics, coefficients = MODELS[model, distortion]
    if ours not in CAMERAS:
        raise document.error((*keys, "camera_model"), f"{model}-{distortion} is not supported yet; remove {name} to import the rest")
    values = dict(zip(intrinsics, foreign.numbers_at(document, (*keys, "intrinsics"), (len(intrinsics),)), strict=True))
    foreign.focal_lengths_positive(document, (*keys, "intrinsics"), values)
    if coefficients:
        values |= zip(coefficients, foreign.numbers_at(document, (*keys, "distortion_coeffs"), (len(coefficients),)), strict=True)
    width, height = foreign.numbers_at(document, (*keys, "resolution"), (2,)).tolist()
    resolution = foreign.size_at(document, width, height, (*keys, "resolution"))
    return foreign.given_camera(ours, values, resolution, foreign.text_at(document, (*keys, "rostopic")))


def _read_imu(document: Document, name: str, keys: tuple[str, ...], parts: _Parts, warnings: list[str]) -> None:
    _, imus, transforms, offsets = parts
    _check_names(document, keys, _IMU_KEYS, warnings)
    imus[name] = _noise(document, keys).model_copy(update={"intrinsics": imu_keys.read(document, name, keys, warnings)})
    T_i_b = foreign.rigid_at(document, (*keys, "T_i_b"), warnings)
    offset = foreign.number_at(document, (*keys, "time_offset"))
    if name != "imu0":
        if T_i_b is not None:
            transforms[f"T_{name}_imu0"] = make_transform(name, "imu0", T_i_b)
        if offset is not None:
            offsets[f"dt_imu0_{name}"] = make_time_offset("imu0", name, Estimate(value=offset, unit="s"))
    elif offset or (T_i_b is not None and not np.allclose(T_i_b, np.eye(4))):
        warnings.append("imu0: T_i_b or time_offset differs from identity, though imu0 is Kalibr's reference; not taken over")


def _noise(document: Document, keys: tuple[str, ...]) -> Imu:
    values: dict[str, Estimate] = {}
    for key, (field, unit) in NOISE.items():
        value = foreign.number_at(document, (*keys, key))
        if value is not None and value < 0:
            raise document.error((*keys, key), "a noise density is not negative; check it")
        if value is not None:
            values[field] = Estimate(value=value, unit=unit)
    rate = foreign.number_at(document, (*keys, "update_rate"))
    if rate is not None and rate <= 0:
        raise document.error((*keys, "update_rate"), "a rate is positive; write it in Hz")
    return Imu(topic=foreign.text_at(document, (*keys, "rostopic")), rate_hz=rate).model_copy(update=values)


def _check_names(document: Document, keys: tuple[str, ...], known: tuple[str, ...], warnings: list[str]) -> None:
    """Refuse a key that looks like a misspelt one of Kalibr's that is absent; say which others are ignored."""
    node = foreign.value_at(document, keys)
    strangers = [key for key in node if key not in known]
    for key in strangers:
        near = difflib.get_close_matches(key, [name for name in known if name not in node], n=1, cutoff=0.8)
        if near:
            raise document.error((*keys, key), f"is no key of Kalibr's; rename it if {near[0]} is meant, else remove it")
    _warn_ignored(document, keys, strangers, warnings)


def _warn_ignored(document: Document, keys: tuple[str, ...], names: Iterable[str], warnings: list[str]) -> None:
    warnings += [
        f"line {document.line_of((*keys, name))}: {one_line('.'.join((*keys, name)), 80)} is no key of Kalibr's; ignored" for name in names
    ]


def _disagreements(transforms: Mapping[str, Transform]) -> list[str]:
    seen = []
    for name, entry in transforms.items():
        _, a, b = name.split("_")
        left, right = transforms.get(f"T_{a}_imu0"), transforms.get(f"T_{b}_imu0")
        if b.startswith("cam") and left and right:
            step = se3.local(np.array(entry.matrix), np.array(left.matrix) @ np.array(right.inverse_matrix))
            distance, angle = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
            if distance > _DISAGREE_M or angle > _DISAGREE_RAD:
                seen.append(
                    f"{a}: T_cn_cnm1 and the T_cam_imu of {a} and {b} disagree by {distance * 1e3:.1f} mm and {np.degrees(angle):.2f} deg; "
                    "check which is current"
                )
    return seen


IMPORTER = Importer("kalibr", _recognises, _read)
