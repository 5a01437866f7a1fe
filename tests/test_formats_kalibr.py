"""Kalibr's files: every direction and sign by a projected point, and the odd files that people keep."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutate import mutated, read_or_refused
from rigs import IMU_MODEL, T_CAM0_IMU0, T_CAM1_CAM0, full_rig, imu_intrinsics

from calibkit.data.rig import Estimate, Imu, Rig
from calibkit.data.transforms import find_transform, make_transform
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.geometry import se3, so3
from calibkit.io.rig_file import dump_rig, load_rig, save_rig
from calibkit.models.cameras import CAMERAS
from calibkit.models.imu import PARAMETERS, ImuModel
from calibkit.stages.convert import export_rig, import_files

CHAIN = {
    "cam0": {
        "T_cam_imu": T_CAM0_IMU0.tolist(),
        "cam_overlaps": [1],
        "camera_model": "pinhole",
        "distortion_coeffs": [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
        "distortion_model": "radtan",
        "intrinsics": [458.654, 457.296, 367.215, 248.375],
        "resolution": [752, 480],
        "rostopic": "/cam0/image_raw",
        "timeshift_cam_imu": -0.008,
    },
    "cam1": {
        "T_cn_cnm1": T_CAM1_CAM0.tolist(),
        "T_cam_imu": (T_CAM1_CAM0 @ T_CAM0_IMU0).tolist(),
        "cam_overlaps": [0],
        "camera_model": "pinhole",
        "distortion_coeffs": [0.0034, 0.0007, -0.002, 0.0002],
        "distortion_model": "equidistant",
        "intrinsics": [190.978, 190.973, 254.932, 256.897],
        "resolution": [512, 512],
        "rostopic": "/cam1/image_raw",
        "timeshift_cam_imu": 0.025,
    },
}
IMU = {
    "accelerometer_noise_density": 2.0e-3,
    "accelerometer_random_walk": 3.0e-3,
    "gyroscope_noise_density": 1.6968e-4,
    "gyroscope_random_walk": 1.9393e-5,
    "rostopic": "/imu0",
    "update_rate": 200.0,
}

C_GYRO_I = so3.exp(np.array([0.02, -0.03, 0.01]))
INTRINSICS = {
    "model": "scale-misalignment",
    "accelerometers": {"M": [[1.01, 0.0, 0.0], [0.002, 0.99, 0.0], [-0.003, 0.004, 1.02]]},
    "gyroscopes": {
        "M": [[0.98, 0.0, 0.0], [0.005, 1.03, 0.0], [-0.006, 0.007, 1.01]],
        "A": [[1e-4, 2e-4, -3e-4], [4e-4, -5e-4, 6e-4], [7e-4, 8e-4, -9e-4]],
        "C_gyro_i": C_GYRO_I.tolist(),
    },
}
PLACES = (("accelerometers", "M"), ("gyroscopes", "M"), ("gyroscopes", "A"), ("gyroscopes", "C_gyro_i"))


def brought_in(folder: Path, *contents: Any) -> tuple[Rig, str]:
    """Return the rig imported from these data or texts, and the notes in one text."""
    paths = []
    for i, content in enumerate(contents):
        paths.append(folder / f"in{i}.yaml")
        paths[-1].write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    outcome = import_files(paths, folder / "rig.yaml", force=True)
    assert load_rig(folder / "rig.yaml") == outcome.rig
    return outcome.rig, "\n".join(outcome.notes)


def pixel(rig: Rig, camera: str, point: Any, frame: str = "imu0") -> Any:
    """Return where a point given in another frame appears."""
    found = find_transform(rig, camera, frame)
    assert found is not None
    entry = rig.cameras[camera]
    model = CAMERAS[entry.model]
    params = np.array([entry.parameters[name].value for name in model.parameter_names], float)
    projection = model.project((found[0] @ point)[None, :3], params)
    assert projection.valid.all()
    return projection.uv[0]


def by_hand(node: dict[str, Any], T_cam_imu: Any, p_imu: Any) -> Any:
    """Project as Kalibr's wiki writes it, with nothing of calibkit's."""
    X, Y, Z, _ = np.array(T_cam_imu) @ p_imu
    fu, fv, pu, pv = node["intrinsics"]
    a, b, c, d = node["distortion_coeffs"]
    x, y = X / Z, Y / Z
    if node["distortion_model"] == "radtan":
        r2 = x * x + y * y
        q = 1 + a * r2 + b * r2**2
        return np.array(
            [fu * (x * q + 2 * c * x * y + d * (r2 + 2 * x * x)) + pu, fv * (y * q + 2 * d * x * y + c * (r2 + 2 * y * y)) + pv]
        )
    r = np.hypot(x, y)
    t = np.arctan(r)
    s = t * (1 + a * t**2 + b * t**4 + c * t**6 + d * t**8) / r
    return np.array([fu * s * x + pu, fv * s * y + pv])


@pytest.fixture
def point() -> Any:
    """A point that both cameras of CHAIN see, off every axis, in imu0's frame."""
    return se3.inverse(T_CAM0_IMU0) @ np.array([0.31, -0.17, 1.9, 1.0])


def test_an_imported_chain_projects_as_kalibr_means_it(tmp_path: Path, point: Any) -> None:
    rig, notes = brought_in(tmp_path, CHAIN, IMU)
    assert notes == ""
    for name, node in CHAIN.items():
        np.testing.assert_allclose(pixel(rig, name, point), by_hand(node, node["T_cam_imu"], point), atol=1e-9)
    assert rig.cameras["cam0"].topic == "/cam0/image_raw"
    assert set(rig.transforms) == {"T_cam0_imu0", "T_cam1_imu0", "T_cam1_cam0"}
    assert rig.transforms["T_cam0_imu0"].equation == "p_cam0 = T_cam0_imu0 p_imu0"


def test_each_way_of_mounting_a_camera_means_the_same_pixel(tmp_path: Path, point: Any) -> None:
    """T_cam_imu, OpenVINS' T_imu_cam, and T_cn_cnm1 alone."""
    expected = [by_hand(node, node["T_cam_imu"], point) for node in CHAIN.values()]
    turned = {name: {k: v for k, v in node.items() if not k.startswith("T_")} for name, node in CHAIN.items()}
    for name, node in CHAIN.items():
        turned[name]["T_imu_cam"] = np.linalg.inv(np.array(node["T_cam_imu"])).ravel().tolist()  # flat, as some keep it
    chained = {"cam0": CHAIN["cam0"], "cam1": {k: v for k, v in CHAIN["cam1"].items() if k != "T_cam_imu"}}
    for chain in (turned, chained):
        rig, _ = brought_in(tmp_path, chain)
        np.testing.assert_allclose([pixel(rig, name, point) for name in CHAIN], expected, atol=1e-9)


def test_the_sign_of_the_time_shift(tmp_path: Path) -> None:
    """t_imu = t_cam + timeshift_cam_imu: a camera that stamps 8 ms late has -0.008."""
    rig, _ = brought_in(tmp_path, CHAIN)
    entry = rig.time_offsets["dt_imu0_cam0"]
    assert (entry.equation, entry.offset.value, entry.offset.unit) == ("t_imu0 = t_cam0 + dt_imu0_cam0", -0.008, "s")
    export_rig(tmp_path / "rig.yaml", "kalibr", tmp_path / "out")
    written = yaml.safe_load((tmp_path / "out" / "camchain.yaml").read_text())
    assert [written[name]["timeshift_cam_imu"] for name in ("cam0", "cam1")] == [-0.008, 0.025]


def test_export_and_import_come_back_to_the_same_pixel(tmp_path: Path, point: Any) -> None:
    rig = full_rig()
    save_rig(rig, tmp_path / "rig.yaml")
    outcome = export_rig(tmp_path / "rig.yaml", "kalibr", tmp_path / "out")
    assert [path.name for path in outcome.files] == ["camchain.yaml", "imu.yaml", "imu1.yaml"]
    assert any("sigmas and covariances" in note for note in outcome.notes)
    assert any("imu1 has no gyro_random_walk" in note for note in outcome.notes)
    again = import_files(outcome.files, tmp_path / "again.yaml").rig
    for name in ("cam0", "cam1"):
        np.testing.assert_allclose(pixel(again, name, point), pixel(rig, name, point), atol=1e-9)
        node = yaml.safe_load((tmp_path / "out" / "camchain.yaml").read_text())[name]
        np.testing.assert_allclose(by_hand(node, node["T_cam_imu"], point), pixel(rig, name, point), atol=1e-9)
    p_imu1 = np.array([0.2, -0.4, 0.9, 1])
    T_there, T_back = (find_transform(r, "cam1", "imu1") for r in (rig, again))
    assert T_there is not None
    assert T_back is not None
    np.testing.assert_allclose(T_back[0] @ p_imu1, T_there[0] @ p_imu1, atol=1e-12)
    assert again.time_offsets["dt_imu0_imu1"].offset.value == 0.025
    assert again.imus["imu0"].gyro_random_walk == rig.imus["imu0"].gyro_random_walk
    assert again.imus["imu0"].rate_hz == 200.0


def test_exported_intrinsics_measure_as_kalibr_means_them(tmp_path: Path) -> None:
    """IccSensors.py: a = M a_i, w = M C_gyro_i w_i + A C_gyro_i a_i; the biases are Kalibr's own to estimate."""
    save_rig(Rig(imus={"imu0": Imu(intrinsics=imu_intrinsics())}), tmp_path / "rig.yaml")
    outcome = export_rig(tmp_path / "rig.yaml", "kalibr", tmp_path / "out")
    node = yaml.safe_load((tmp_path / "out" / "imu.yaml").read_text())
    assert node["model"] == "scale-misalignment"
    assert not {"gyroscope_noise_density", "update_rate"} & node.keys()
    M_a, M, A, C = (np.array(node[part][key]) for part, key in PLACES)
    accel, omega = np.random.default_rng(4).normal(size=(2, 20, 3)) * [[[9.0]], [[2.0]]]
    for a_i, w_i in zip(accel, omega, strict=True):
        a_meas, w_meas = IMU_MODEL.measure(a_i, w_i)
        np.testing.assert_allclose(M_a @ a_i, a_meas - IMU_MODEL.b_a, atol=1e-12)
        np.testing.assert_allclose(M @ (C @ w_i) + A @ (C @ a_i), w_meas - IMU_MODEL.b_g, atol=1e-12)
    assert sum("its biases are not written" in note for note in outcome.notes) == 1
    again = import_files(outcome.files, tmp_path / "again.yaml").rig.imus["imu0"].intrinsics
    assert again is not None
    assert {entry.status for entry in again.parameters.values()} == {Status.GIVEN}
    values = IMU_MODEL.values() | {key: 0.0 for key in PARAMETERS if key.startswith("b_")}
    for key, value in values.items():
        assert again.parameters[key].value == pytest.approx(value, abs=1e-14)


def test_imported_intrinsics_are_kalibrs_numbers(tmp_path: Path) -> None:
    rig, notes = brought_in(tmp_path, {"imu0": {**IMU, **INTRINSICS}})
    found = rig.imus["imu0"].intrinsics
    assert found is not None
    model = ImuModel.of({key: entry.value or 0.0 for key, entry in found.parameters.items()})
    for ours, (part, key) in zip((model.M_a, model.M_g, model.A_g, model.C_g_i), PLACES, strict=True):
        np.testing.assert_allclose(ours, INTRINSICS[part][key], atol=1e-15)
    assert found.gravity == 9.80655  # Kalibr's own constant
    assert found.reasons[0] in notes


def test_identities_stand_for_no_intrinsics(tmp_path: Path) -> None:
    eye, zero = np.eye(3).tolist(), np.zeros((3, 3)).tolist()
    ideal = {"model": "calibrated", "accelerometers": {"M": eye}, "gyroscopes": {"M": eye, "C_gyro_i": eye, "A": zero}}
    rig, notes = brought_in(tmp_path, {"imu0": {**IMU, **ideal}})
    assert rig.imus["imu0"].intrinsics is None
    assert notes == ""


def test_an_imu_file_of_intrinsics_alone_is_recognised(tmp_path: Path) -> None:
    rig, _ = brought_in(tmp_path, INTRINSICS)
    assert rig.imus["imu0"].intrinsics is not None
    assert rig.imus["imu0"].gyro_noise_density is None


def test_raw_counts_stay_behind_with_a_note(tmp_path: Path) -> None:
    imu = full_rig().imus["imu0"].model_copy(update={"intrinsics": imu_intrinsics(unit="counts")})
    save_rig(Rig(imus={"imu0": imu}), tmp_path / "rig.yaml")
    outcome = export_rig(tmp_path / "rig.yaml", "kalibr", tmp_path / "out")
    node = yaml.safe_load((tmp_path / "out" / "imu.yaml").read_text())
    assert not {"model", "gyroscopes", "accelerometers"} & node.keys()
    assert node["gyroscope_noise_density"] == 1.6968e-4
    assert any("imu0: intrinsics in raw counts are not written, Kalibr takes SI" in note for note in outcome.notes)


@pytest.mark.parametrize("to", ["kalibr", "openvins"])
def test_intrinsics_that_are_not_observable_do_not_leave(tmp_path: Path, to: str) -> None:
    parameters = dict(imu_intrinsics().parameters)
    unknown = Estimate(value=None, status=Status.NOT_OBSERVABLE)
    allowed = imu_intrinsics(parameters={**parameters, "b_g_x": unknown})  # a bias is not written anyway
    save_rig(Rig(imus={"imu0": Imu(intrinsics=allowed)}), tmp_path / "rig.yaml")
    assert export_rig(tmp_path / "rig.yaml", to, tmp_path / "biases").files
    refused = imu_intrinsics(parameters={**parameters, "M_a_zz": unknown})
    save_rig(Rig(imus={"imu0": Imu(intrinsics=refused)}), tmp_path / "rig.yaml", force=True)
    with pytest.raises(BadInputError, match=r"^imus.imu0.intrinsics.parameters.M_a_zz is marked 'not observable' and cannot be exported"):
        export_rig(tmp_path / "rig.yaml", to, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_every_number_that_is_written_is_a_float_to_kalibrs_reader(tmp_path: Path) -> None:
    save_rig(full_rig(), tmp_path / "rig.yaml")
    export_rig(tmp_path / "rig.yaml", "kalibr", tmp_path / "out")
    node = yaml.safe_load((tmp_path / "out" / "camchain.yaml").read_text())["cam0"]
    assert all(type(x) is float for key in ("intrinsics", "distortion_coeffs") for x in node[key])
    assert all(type(x) is float for row in node["T_cam_imu"] for x in row)
    assert node["resolution"] == [752, 480]
    assert type(yaml.safe_load((tmp_path / "out" / "imu.yaml").read_text())["gyroscope_random_walk"]) is float  # 1.9393e-05


def test_cameras_by_other_names_are_numbered_and_said(tmp_path: Path) -> None:
    rig = full_rig()
    left = Rig(cameras={"left": rig.cameras["cam0"]}, transforms={"T_imu0_left": make_transform("imu0", "left", se3.inverse(T_CAM0_IMU0))})
    save_rig(left, tmp_path / "rig.yaml")
    outcome = export_rig(tmp_path / "rig.yaml", "kalibr", tmp_path / "out")
    assert "left is written as cam0, as Kalibr names sensors" in outcome.notes
    np.testing.assert_allclose(yaml.safe_load(outcome.files[0].read_text())["cam0"]["T_cam_imu"], T_CAM0_IMU0, atol=1e-15)


@pytest.mark.parametrize(
    ("section", "name", "path"),
    [
        ("cameras", "cam0", "cameras.cam0.k2"),
        ("transforms", "T_cam0_imu0", "transforms.T_cam0_imu0"),
        ("time_offsets", "dt_imu0_cam0", "time_offsets.dt_imu0_cam0"),
        ("imus", "imu0", "imus.imu0.gyro_random_walk"),
    ],
)
def test_what_is_not_observable_does_not_leave(tmp_path: Path, section: str, name: str, path: str) -> None:
    data = yaml.safe_load(dump_rig(full_rig()))
    entry = data[section][name]
    unknown = {"value": None, "status": Status.NOT_OBSERVABLE.value}
    if section == "transforms":
        entry["status"] = Status.NOT_OBSERVABLE.value
    elif section == "time_offsets":
        entry["offset"] = unknown
    else:
        (entry["parameters"] if section == "cameras" else entry)[path.split(".")[-1]] = unknown
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(BadInputError, match=f"^{path} is marked 'not observable' and cannot be exported"):
        export_rig(tmp_path / "rig.yaml", "kalibr", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def changed(camera: str, **values: Any) -> dict[str, Any]:
    """Return CHAIN with keys of one camera set, or dropped where None."""
    node = {k: v for k, v in {**CHAIN[camera], **values}.items() if v is not None}
    return {**CHAIN, camera: node}


def intrinsics(part: str, **values: Any) -> dict[str, Any]:
    """Return an IMU with keys of its intrinsics set, or dropped where None."""
    node = {k: v for k, v in {**INTRINSICS[part], **values}.items() if v is not None}
    return {"imu0": {**IMU, **INTRINSICS, part: node}}


@pytest.mark.parametrize(
    ("chain", "message"),
    [
        (
            changed("cam0", camera_model="omni", intrinsics=[0.8, 833.0, 830.3, 373.8, 253.7]),
            "cam0.camera_model: omni-radtan is not supported yet",
        ),
        (changed("cam0", camera_model="pinehole"), "pinehole-radtan is no model of Kalibr's; it may be pinhole-radtan"),
        (changed("cam0", intrinsics=[458.0, 457.0, 367.0]), "cam0.intrinsics: has 3 numbers; it needs 4"),
        (changed("cam0", intrinsics=[458.0, 457.0, 367.0, "248"]), "cam0.intrinsics: '248' is not a finite number"),
        (changed("cam0", intrinsics=[458.0, -457.0, 367.0, 248.0]), "a focal length is not positive"),
        (changed("cam0", intrinsics=None), "cam0: intrinsics is missing"),
        (changed("cam0", distortion_coeffs=[0.1]), "cam0.distortion_coeffs: has 1 numbers; it needs 4"),
        (changed("cam0", distortion_coeffs=[0.1, 0.1, float("nan"), 0.0]), "cam0.distortion_coeffs: nan is not a finite number"),
        (
            changed("cam0", distortion_coeffs=None, distortion_coefs=[0.1] * 4),
            "cam0.distortion_coefs: is no key .* rename it if distortion_coeffs",
        ),
        (changed("cam0", timeshift_cam_imu=None, timeshift_cam_imuu=0.1), "rename it if timeshift_cam_imu is meant"),
        (changed("cam0", timeshift_cam_imu="late"), "cam0.timeshift_cam_imu: 'late' is not a finite number"),
        (changed("cam0", resolution=[752, 0]), "cam0.resolution: 0.0 is not an image size"),
        (changed("cam0", resolution=None), "cam0: resolution is missing"),
        (changed("cam0", rostopic=["/a"]), "cam0.rostopic: .* is not a name"),
        (changed("cam0", T_cam_imu=np.diag([1.0, 1, -1, 1]).tolist()), "cam0.T_cam_imu: the upper left 3 x 3 is not a rotation"),
        (changed("cam0", T_cam_imu=np.diag([2.0, 2, 2, 1]).tolist()), "cam0.T_cam_imu: the upper left 3 x 3 is not a rotation"),
        (changed("cam0", T_cam_imu=T_CAM0_IMU0.T.tolist()), "cam0.T_cam_imu: the last row is not 0 0 0 1"),
        (changed("cam0", T_cam_imu=T_CAM0_IMU0[:3].tolist()), "cam0.T_cam_imu: has 12 numbers; it needs 16"),
        (changed("cam0", T_imu_cam=np.eye(4).tolist()), "cam0.T_imu_cam: T_cam_imu is given as well"),
        (changed("cam0", T_cn_cnm1=np.eye(4).tolist()), "cam0.T_cn_cnm1: cam0 has no camera before it"),
        ({**CHAIN, "cam0": [1]}, "cam0: holds no keys"),
        ({"imu0": {**IMU, "update_rate": 0}}, "imu0.update_rate: a rate is positive"),
        ({**IMU, "gyroscope_noise_density": -1.0}, "gyroscope_noise_density: a noise density is not negative"),
        (
            intrinsics("accelerometers", M=[[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
            "line 5: imu0.accelerometers.M: is not lower",
        ),
        (intrinsics("accelerometers", M=None), "imu0.accelerometers.M: is missing"),
        (intrinsics("gyroscopes", M=np.diag([1.0, -1.0, 1.0]).tolist()), "imu0.gyroscopes.M: has a scale that is not positive"),
        (
            intrinsics("gyroscopes", M=np.diag([1.0, 4096.0, 1.0]).tolist()),
            "imu0.gyroscopes.M: has an entry beyond 100, which no IMU in SI has",
        ),
        (intrinsics("gyroscopes", C_gyro_i=np.diag([1.0, 1.0, -1.0]).tolist()), "imu0.gyroscopes.C_gyro_i: its matrix is not a rotation"),
        (intrinsics("gyroscopes", A=[[1e-4, 2e-4]]), "imu0.gyroscopes.A: has 2 numbers; it needs 9"),
        (
            {"imu0": {**IMU, **INTRINSICS, "Tw": np.diag([1.0, 1.0, 1.1]).tolist()}},
            "imu0: holds intrinsics in Kalibr's keys and in OpenVINS'",
        ),
        ({"a": 1}, "is in no known format"),
        ({"cam٣": CHAIN["cam0"]}, "is in no known format"),
    ],
)
def test_what_is_wrong_is_refused_with_line_and_key(tmp_path: Path, chain: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInputError, match=message) as caught:
        brought_in(tmp_path, chain)
    assert "in0.yaml, line " in str(caught.value)
    assert str(caught.value).isprintable()
    assert not (tmp_path / "rig.yaml").exists()


@pytest.mark.parametrize(
    ("chain", "message"),
    [
        (changed("cam0", resolution=[480, 752]), r"cam0: the centre \(367.2, 248.4\) suits 752 x 480 better than 480 x 752"),
        (changed("cam0", resolution=[320, 240]), "lies outside the image of 320 x 240"),
        (changed("cam0", cam_overlaps=[1, 4]), "cam_overlaps names cam4, which the file does not hold"),
        (changed("cam0", colour="red"), r"line \d+: cam0.colour is no key of Kalibr's; ignored"),
        (
            changed("cam0", T_cam_imu=np.round(T_CAM0_IMU0, 3).tolist()),
            "cam0.T_cam_imu: its rotation is off by .* the nearest rotation is taken",
        ),
        (changed("cam1", T_cam_imu=np.eye(4).tolist()), "cam1: T_cn_cnm1 and the T_cam_imu of cam1 and cam0 disagree by"),
        (
            {"imu0": {**IMU, **INTRINSICS}},
            r"imu0: Kalibr's file holds neither biases nor gravity: taken as 0 and 9.80655 m/s\^2",
        ),
        (
            {"imu0": {**IMU, "accelerometers": {"M": np.eye(3).tolist(), "rx_i": [0.0, 0.0, 0.0], "ry_i": [0.01, 0.0, 0.0]}}},
            r"imu0: accelerometers.rx_i, accelerometers.ry_i has no place in the rig file; not taken over",
        ),
    ],
)
def test_what_is_suspicious_is_said(tmp_path: Path, chain: dict[str, Any], message: str) -> None:
    _, notes = brought_in(tmp_path, chain)
    assert len(notes.splitlines()) == 1
    assert re.search(message, notes)


EXPECTED = {  # file -> cameras, IMUs, transforms and offsets of it, or the refusal; then a word of each note
    "707config_Timucam_not_Tcamimu_stereo.yaml": ((2, 0, 2, 0), []),
    "dmvio_only_Tcamimu_and_noise_no_intrinsics.yaml": ((0, 1, 1, 0), ["integration_sigma", "no camera_model", "IMU noise"]),
    "ds_none_stereo_camchain-2020-08-05-16-24-56.yaml": ("line 4: cam0.camera_model: ds-none is not supported yet", []),
    "kalibr_sample_dynamic_camchain-imucam_BROKEN_INDENT.yaml": ("line 7: is not YAML .*; mend the indentation", []),
    "kartikmohta_flat16_equi_stereo_notd.yaml": ((2, 0, 3, 0), []),
    "nickcharron_wiki_example_pinhole_plus_omni_td.yaml": ("line 15: cam1.camera_model: omni-radtan is not supported yet", []),
    "openvins_euroc_stereo.yaml": ((2, 0, 2, 0), []),
    "openvins_tumvi_equi.yaml": ((2, 0, 2, 0), []),
    "openvins_tumvi_imu.yaml": ((0, 1, 0, 0), []),
    "padrl_flat16_equi_stereo_td81ms_swapped_resolution_norostopic.yaml": (
        (2, 0, 3, 2),
        ["T_imu_body", "suits 640 x 480", "suits 640 x 480"],
    ),
    "ros2_px4_sim_overlap_to_missing_cam1.yaml": ((1, 0, 1, 1), ["names cam1"]),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_odd_files_of_real_rigs(tmp_path: Path, data_dir: Path, name: str) -> None:
    expected, words = EXPECTED[name]
    if isinstance(expected, str):
        with pytest.raises(BadInputError, match=expected):
            import_files([data_dir / "kalibr_files" / name], tmp_path / "rig.yaml")
        return
    outcome = import_files([data_dir / "kalibr_files" / name], tmp_path / "rig.yaml")
    rig = outcome.rig
    assert (len(rig.cameras), len(rig.imus), len(rig.transforms), len(rig.time_offsets)) == expected
    assert len(outcome.notes) == len(words)
    assert all(word in note for word, note in zip(words, outcome.notes, strict=True))


def test_the_published_euroc_mounting(tmp_path: Path, data_dir: Path) -> None:
    """OpenVINS keeps T_imu_cam: cam0's origin lies at (-0.0216, -0.0647, 0.0098) m in the IMU's frame (EuRoC sensor.yaml)."""
    rig = import_files([data_dir / "kalibr_files" / "openvins_euroc_stereo.yaml"], tmp_path / "rig.yaml").rig
    found = find_transform(rig, "imu0", "cam0")
    assert found is not None
    np.testing.assert_allclose(found[0][:3, 3], [-0.0216401454975, -0.064676986768, 0.00981073058949], atol=1e-9)


OPENVINS = {
    "model": "kalibr",
    "Tw": INTRINSICS["gyroscopes"]["M"],
    "R_IMUtoGYRO": C_GYRO_I.tolist(),
    "Ta": INTRINSICS["accelerometers"]["M"],
    "R_IMUtoACC": np.eye(3).tolist(),
    "Tg": INTRINSICS["gyroscopes"]["A"],
}
TEXTS = [
    yaml.safe_dump(CHAIN, sort_keys=False),
    yaml.safe_dump({"imu0": {**IMU, "T_i_b": np.eye(4).tolist(), "time_offset": 0.0}}),
    yaml.safe_dump(IMU),
    yaml.safe_dump({"imu0": {**IMU, **INTRINSICS}}),
    yaml.safe_dump({"imu0": OPENVINS}),
]


@settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(content=st.sampled_from(TEXTS).flatmap(mutated))
def test_mutated_files_are_read_or_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "in.yaml").write_bytes(content)
    outcome = read_or_refused(lambda: import_files([tmp_path / "in.yaml"], tmp_path / "rig.yaml", force=True))
    if outcome is not None:
        assert load_rig(tmp_path / "rig.yaml") == outcome.rig
        assert all(note.isprintable() for note in outcome.notes)
        for to in ("kalibr", "openvins"):
            read_or_refused(lambda to=to: export_rig(tmp_path / "rig.yaml", to, tmp_path / "out", force=True))
