"""Writes Kalibr's camchain.yaml and imu.yaml; `io/kalibr.py` says which name of Kalibr's is which of ours."""

from typing import Any

from calibkit.data.rig import Camera, Estimate, Imu, Rig
from calibkit.data.transforms import find_time_offset, find_transform, frames_of
from calibkit.io import foreign, imu_keys
from calibkit.io.foreign import Exported, Exporter
from calibkit.io.kalibr import MODELS, NOISE
from calibkit.io.yaml_file import dump_yaml
from calibkit.models.cameras import CAMERAS


def _write(rig: Rig) -> Exported:
    notes = foreign.without_place(rig)
    kalibr = {name: f"cam{i}" for i, name in enumerate(rig.cameras)}
    notes += renamed(kalibr)
    imus = imus_of(rig)
    chain: dict[str, Any] = {}
    before: str | None = None
    for name, camera in rig.cameras.items():
        chain[kalibr[name]] = lens_of(name, camera) | _mounting_of(rig, name, before, imus[0] if imus else None)
        before = name
    files = {"camchain.yaml": dump_yaml(chain)} if chain else {}
    for i, name in enumerate(rig.imus):
        node = _imu_of(rig, name, imus[0], notes)
        files["imu.yaml" if i == 0 else f"imu{i}.yaml"] = dump_yaml(node)
    notes += left_out(rig, "Kalibr", {*rig.cameras, *imus} if chain else {*rig.imus})
    return Exported(files, tuple(notes))


def renamed(names: dict[str, str]) -> list[str]:
    """Return the notes on sensors that the files call otherwise."""
    return [f"{name} is written as {other}, as Kalibr names sensors" for name, other in names.items() if name != other]


def left_out(rig: Rig, tool: str, written: set[str]) -> list[str]:
    """Return the note on transforms and offsets of sensors that the files do not hold."""
    lost = [name for name in (*rig.transforms, *rig.time_offsets) if not written.issuperset(frames_of(name))]
    return [f"not written, {tool}'s files have no place for: {', '.join(lost)}"] if lost else []


def imus_of(rig: Rig) -> list[str]:
    """Return the IMUs' names; imu0 where only transforms or offsets speak of it."""
    spoken_of = any("imu0" in name.split("_") for name in (*rig.transforms, *rig.time_offsets))
    return list(rig.imus) or ["imu0"] * spoken_of


def lens_of(name: str, camera: Camera) -> dict[str, Any]:
    """Return a camera's keys without its mounting."""
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
    T_cn_cnm1 = None if before is None else matrix_of(rig, name, before)
    T_cam_imu = None if imu is None else matrix_of(rig, name, imu)
    offset = None if imu is None else seconds_of(rig, imu, name)
    if T_cn_cnm1 is not None:
        node["T_cn_cnm1"] = T_cn_cnm1
    if T_cam_imu is not None:
        node["T_cam_imu"] = T_cam_imu
    if offset is not None:
        node["timeshift_cam_imu"] = offset
    return node


def matrix_of(rig: Rig, a: str, b: str) -> list[list[float]] | None:
    """Return T_a_b row by row, None where nothing joins the frames."""
    found = find_transform(rig, a, b)
    if found is None:
        return None
    T, used = found
    for name in used:
        foreign.refuse_unobservable(f"transforms.{name}", rig.transforms[name].status)
    matrix: list[list[float]] = T.tolist()
    return matrix


def seconds_of(rig: Rig, a: str, b: str) -> float | None:
    """Return dt_a_b, None where the rig has none."""
    offset = find_time_offset(rig, a, b)
    if offset is None:
        return None
    foreign.refuse_unobservable(f"time_offsets.dt_{a}_{b}", offset.status)
    return offset.value


def _imu_of(rig: Rig, name: str, first: str, notes: list[str]) -> dict[str, Any]:
    node = noise_of(name, rig.imus[name], "Kalibr", notes)
    model = imu_keys.exportable(name, rig.imus[name], "Kalibr", notes)
    if model is not None:
        node |= imu_keys.to_kalibr(model)
    if name != first:
        T_i_b, offset = matrix_of(rig, name, first), seconds_of(rig, first, name)
        node |= ({} if T_i_b is None else {"T_i_b": T_i_b}) | ({} if offset is None else {"time_offset": offset})
    return node


def noise_of(name: str, imu: Imu, tool: str, notes: list[str]) -> dict[str, Any]:
    """Return an IMU's densities, topic and rate; a note on each that the tool demands and the rig has not."""
    node: dict[str, Any] = {}
    for key, (field, _) in NOISE.items():
        estimate: Estimate | None = getattr(imu, field)
        if estimate is None:
            notes.append(f"{name} has no {field}, which {tool} demands; add {key} by hand")
            continue
        foreign.refuse_unobservable(f"imus.{name}.{field}", estimate.status)
        node[key] = estimate.value
    for key, value in (("rostopic", imu.topic), ("update_rate", imu.rate_hz)):
        if value is None:
            notes.append(f"{name} has no {key}, which {tool} demands; add it by hand")
        else:
            node[key] = value
    return node


EXPORTER = Exporter("kalibr", tuple(dict.fromkeys(ours for ours, _, _ in MODELS.values())), _write)
