"""Writes OpenVINS' kalibr_imucam_chain.yaml and kalibr_imu_chain.yaml; `io/kalibr.py` reads them, `io/imu_keys.py` has the IMU's equations.

OpenVINS (rpng/open_vins) reads them by cv::FileStorage, which wants the first line %YAML:1.0 (opencv_yaml_parse.h), and takes T_imu_cam to
bring the camera's points into the IMU's frame (VioManagerOptions.h), the inverse of Kalibr's T_cam_imu. It has one IMU, imu0, and does not
start where a key of it is missing.
"""

from typing import Any

import numpy as np

from calibkit.data.rig import Rig
from calibkit.io import foreign, imu_keys
from calibkit.io.foreign import Exported, Exporter
from calibkit.io.kalibr_export import imus_of, left_out, lens_of, matrix_of, noise_of, renamed, seconds_of
from calibkit.io.yaml_file import dump_yaml
from calibkit.models.imu import ImuModel

_HEADER = "%YAML:1.0\n\n"


def _write(rig: Rig) -> Exported:
    notes = foreign.without_place(rig)
    imu = next(iter(imus_of(rig)), None)
    names = {name: f"cam{i}" for i, name in enumerate(rig.cameras)} | ({} if imu is None else {imu: "imu0"})
    notes += renamed(names)
    files: dict[str, str] = {}
    if rig.cameras:
        chain = {names[name]: _camera_of(rig, name, imu, notes) for name in rig.cameras}
        notes += _uneven_shifts(chain)
        files["kalibr_imucam_chain.yaml"] = _HEADER + dump_yaml(chain)
    if imu in rig.imus:
        files["kalibr_imu_chain.yaml"] = _HEADER + dump_yaml({"imu0": _imu_of(rig, imu, notes)})
    notes += [f"{name} is not written: OpenVINS has one IMU, {imu}" for name in rig.imus if name != imu]
    return Exported(files, (*notes, *left_out(rig, "OpenVINS", {*rig.cameras, *([] if imu is None else [imu])})))


def _camera_of(rig: Rig, name: str, imu: str | None, notes: list[str]) -> dict[str, Any]:
    T_imu_cam = None if imu is None else matrix_of(rig, imu, name)
    shift = None if imu is None else seconds_of(rig, imu, name)
    if T_imu_cam is None:
        notes.append(f"{name} has no transform to an IMU, which OpenVINS demands; add T_imu_cam by hand")
    node = {} if T_imu_cam is None else {"T_imu_cam": T_imu_cam}
    return node | lens_of(name, rig.cameras[name]) | ({} if shift is None else {"timeshift_cam_imu": shift})


def _uneven_shifts(chain: dict[str, Any]) -> list[str]:
    """Return the note on shifts that differ from cam0's, the only one that OpenVINS reads."""
    first = chain["cam0"].get("timeshift_cam_imu", 0.0)
    others = [name for name, node in chain.items() if node.get("timeshift_cam_imu", first) != first]
    text = f"OpenVINS takes cam0's timeshift_cam_imu, {first:g} s, for every camera; that of {', '.join(others)} differs"
    return [text] if others else []


def _imu_of(rig: Rig, name: str, notes: list[str]) -> dict[str, Any]:
    imu = rig.imus[name]
    node = {"T_i_b": np.eye(4).tolist(), **noise_of(name, imu, "OpenVINS", notes), "time_offset": 0.0}
    model = imu_keys.exportable(name, imu, "OpenVINS", notes)
    if model is not None and imu.intrinsics is not None:
        notes.append(f"{name}: its scale hangs on |g| = {imu.intrinsics.gravity:.5f} m/s^2; set gravity_mag in estimator_config.yaml to it")
    elif imu.intrinsics is None:
        notes.append(f"{name} has no intrinsics; identities are written, which OpenVINS demands")
    return node | imu_keys.to_openvins(model or ImuModel())


EXPORTER = Exporter("openvins", ("pinhole-radtan", "pinhole-equi"), _write)
