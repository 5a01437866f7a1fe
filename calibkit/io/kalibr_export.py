"""Writes Kalibr's camchain.yaml and imu.yaml; `io/kalibr.py` says which name of Kalibr's is which of ours."""

from typing import Any

from calibkit.data.rig import Camera, Estimate, Rig
from calibkit.data.transforms import find_time_offset, find_transform, frames_of
from calibkit.io import foreign
from calibkit.io.foreign import Exported, Exporter
from calibkit.io.kalibr import MODELS, NOISE
from calibkit.io.yaml_file import dump_yaml
from calibkit.models.cameras import CAMERAS


def _write(rig: Rig) -> Exported:
    notes = foreign.without_place(rig)
    kalibr = {name: f"cam{i}" for i, name in enumerate(rig.cameras)}
    notes += [f"{name} is written as {other}, as Kalibr names cameras" for name, other in kalibr.items() if name != other]
    imus = list(rig.imus) or _imu_frames(rig)
    chain: dict[str, Any] = {}
    before: str | None = None
    for name, camera in rig.cameras.items():
        chain[kalibr[name]] = _lens_of(name, camera) | _mounting_of(rig, name, before, imus[0] if imus else None)
        before = name
    files = {"camchain.yaml": dump_yaml(chain)} if chain else {}
    for i, name in enumerate(rig.imus):
        node = _imu_of(rig, name, imus[0], notes)
        files["imu.yaml" if i == 0 else f"imu{i}.yaml"] = dump_yaml(node)
    notes += _left_out(rig, {*rig.cameras, *imus} if chain else {*rig.imus})
    return Exported(files, tuple(notes))


def _left_out(rig: Rig, written: set[str]) -> list[str]:
    """Return the note on transforms and offsets of sensors that the files do not hold."""
    lost = [name for name in (*rig.transforms, *rig.time_offsets) if not written.issuperset(frames_of(name))]
    return [f"not written, Kalibr's files have no place for: {', '.join(lost)}"] if lost else []


def _imu_frames(rig: Rig) -> list[str]:
    """Return imu0 where only transforms or offsets speak of it."""
    return ["imu0"] if any("imu0" in name.split("_") for name in (*rig.transforms, *rig.time_offsets)) else []


def _lens_of(name: str, camera: Camera) -> dict[str, Any]:
    (model, distortion), (_, intrinsics, coefficients) = next((k, v) for k, v in MODELS.items() if v[0] == camera.model)
    values = dict(zip(CAMERAS[camera.model].parameter_names, foreign.camera_values(name, camera).tolist(), strict=True))
    node = {
        "cam_overlaps": [],
        "camera_model": model,
        "distortion_coeffs": [values[key] for key in coefficients],
        "distortion_model": distortion,
        "intrinsics": [values[key] for key in intrinsics],
        "resolution": list(camera.resolution),
    }
    return node if camera.topic is None else node | {"rostopic": camera.topic}


def _mounting_of(rig: Rig, name: str, before: str | None, imu: str | None) -> dict[str, Any]:
    node: dict[str, Any] = {}
    T_cn_cnm1 = None if before is None else _matrix(rig, name, before)
    T_cam_imu = None if imu is None else _matrix(rig, name, imu)
    offset = None if imu is None else _seconds(rig, imu, name)
    if T_cn_cnm1 is not None:
        node["T_cn_cnm1"] = T_cn_cnm1
    if T_cam_imu is not None:
        node["T_cam_imu"] = T_cam_imu
    if offset is not None:
        node["timeshift_cam_imu"] = offset
    return node


def _matrix(rig: Rig, a: str, b: str) -> list[list[float]] | None:
    found = find_transform(rig, a, b)
    if found is None:
        return None
    T, used = found
    for name in used:
        foreign.refuse_unobservable(f"transforms.{name}", rig.transforms[name].status)
    matrix: list[list[float]] = T.tolist()
    return matrix


def _seconds(rig: Rig, a: str, b: str) -> float | None:
    offset = find_time_offset(rig, a, b)
    if offset is None:
        return None
    foreign.refuse_unobservable(f"time_offsets.dt_{a}_{b}", offset.status)
    return offset.value


def _imu_of(rig: Rig, name: str, first: str, notes: list[str]) -> dict[str, Any]:
    imu, node = rig.imus[name], dict[str, Any]()
    for key, (field, _) in NOISE.items():
        estimate: Estimate | None = getattr(imu, field)
        if estimate is None:
            notes.append(f"{name} has no {field}, which Kalibr demands; add {key} by hand")
            continue
        foreign.refuse_unobservable(f"imus.{name}.{field}", estimate.status)
        node[key] = estimate.value
    for key, value in (("rostopic", imu.topic), ("update_rate", imu.rate_hz)):
        if value is None:
            notes.append(f"{name} has no {key}, which Kalibr demands; add it by hand")
        else:
            node[key] = value
    if name != first:
        T_i_b, offset = _matrix(rig, name, first), _seconds(rig, first, name)
        node |= ({} if T_i_b is None else {"T_i_b": T_i_b}) | ({} if offset is None else {"time_offset": offset})
    return node


EXPORTER = Exporter("kalibr", tuple(dict.fromkeys(ours for ours, _, _ in MODELS.values())), _write)
