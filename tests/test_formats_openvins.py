"""OpenVINS' files: its own equations, written out here, on what is exported; and read by the reader that it uses."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rigs import IMU_MODEL, T_CAM0_IMU0, T_CAM1_CAM0, camera, full_rig, imu_intrinsics

from calibkit.data.rig import Estimate, Imu, Rig
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.errors import BadInputError
from calibkit.geometry import se3, so3
from calibkit.io.rig_file import save_rig
from calibkit.models.imu import PARAMETERS, ImuModel
from calibkit.opencv import cv2
from calibkit.stages.convert import Outcome, export_rig, import_files

IMUCAM, IMU = "kalibr_imucam_chain.yaml", "kalibr_imu_chain.yaml"
EYE, ZERO = np.eye(3).tolist(), np.zeros((3, 3)).tolist()


def written(rig: Rig, folder: Path, name: str) -> tuple[dict[str, Any], Outcome]:
    """Return one exported file as plain data, and the outcome."""
    save_rig(rig, folder / "rig.yaml")
    outcome = export_rig(folder / "rig.yaml", "openvins", folder / "out")
    header, text = (folder / "out" / name).read_text().split("\n", 1)
    assert header == "%YAML:1.0"
    return yaml.safe_load(text), outcome


def two_cameras() -> Rig:
    """The full rig without its second IMU, with intrinsics."""
    rig = full_rig()
    imu = rig.imus["imu0"].model_copy(update={"intrinsics": imu_intrinsics()})
    transforms = {name: entry for name, entry in rig.transforms.items() if "imu1" not in name}
    offsets = {"dt_imu0_cam0": rig.time_offsets["dt_imu0_cam0"]}
    return rig.model_copy(update={"imus": {"imu0": imu}, "transforms": transforms, "time_offsets": offsets})


def test_the_imu_measures_as_openvins_means_it(tmp_path: Path) -> None:
    """a_m = Ta R_IMUtoACC a + b_a, w_m = Tw R_IMUtoGYRO w + Tg a + b_g, and Propagator.cpp's way back, with D = T^-1."""
    chain, outcome = written(two_cameras(), tmp_path, IMU)
    node = chain["imu0"]
    Tw, R_IMUtoGYRO, Ta, R_IMUtoACC, Tg = (np.array(node[key]) for key in ("Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC", "Tg"))
    assert node["model"] == "kalibr"
    for T in (Tw, Ta):  # OpenVINS keeps the lower triangle of D only
        assert not np.triu(np.linalg.inv(T), 1).any()
    accel, omega = np.random.default_rng(5).normal(size=(2, 20, 3)) * [[[9.0]], [[2.0]]]
    for a, w in zip(accel, omega, strict=True):
        a_m, w_m = IMU_MODEL.measure(a, w)
        np.testing.assert_allclose(Ta @ R_IMUtoACC @ a + IMU_MODEL.b_a, a_m, atol=1e-12)
        np.testing.assert_allclose(Tw @ R_IMUtoGYRO @ w + Tg @ a + IMU_MODEL.b_g, w_m, atol=1e-12)
        a_hat = R_IMUtoACC.T @ np.linalg.inv(Ta) @ (a_m - IMU_MODEL.b_a)
        w_hat = R_IMUtoGYRO.T @ np.linalg.inv(Tw) @ (w_m - IMU_MODEL.b_g - Tg @ a_hat)
        np.testing.assert_allclose([a_hat, w_hat], [a, w], atol=1e-12)
    notes = "\n".join(outcome.notes)
    assert "imu0: its biases are not written, OpenVINS's file has no place for them" in notes
    assert "imu0: its scale hangs on |g| = 9.81744 m/s^2; set gravity_mag in estimator_config.yaml to it" in notes


def test_a_camera_sees_a_point_where_openvins_puts_it(tmp_path: Path) -> None:
    """VioManagerOptions.h: T_imu_cam is T_CtoI, p_imu = T_CtoI p_cam."""
    chain, _ = written(two_cameras(), tmp_path, IMUCAM)
    p_imu = np.array([0.7, -0.4, 1.9, 1.0])
    for name, T_cam_imu in (("cam0", T_CAM0_IMU0), ("cam1", T_CAM1_CAM0 @ T_CAM0_IMU0)):
        node = chain[name]
        np.testing.assert_allclose(np.array(node["T_imu_cam"]) @ (T_cam_imu @ p_imu), p_imu, atol=1e-12)
        assert "T_cam_imu" not in node
        assert node["camera_model"] == "pinhole"
    assert [chain[name]["distortion_model"] for name in ("cam0", "cam1")] == ["radtan", "equidistant"]
    assert chain["cam0"]["intrinsics"] == [458.654, 457.296, 367.215, 248.375]
    assert chain["cam0"]["resolution"] == [752, 480]
    assert chain["cam0"]["timeshift_cam_imu"] == -0.008  # t_imu = t_cam + shift


def test_it_comes_back_as_it_left(tmp_path: Path) -> None:
    rig = two_cameras()
    _, outcome = written(rig, tmp_path, IMU)
    assert [path.name for path in outcome.files] == [IMUCAM, IMU]
    brought = import_files(outcome.files, tmp_path / "again.yaml")
    again = brought.rig
    for name in ("cam0", "cam1"):
        ours, theirs = ({key: e.value for key, e in r.cameras[name].parameters.items()} for r in (rig, again))
        assert ours == theirs
    np.testing.assert_allclose(again.transforms["T_cam0_imu0"].matrix, T_CAM0_IMU0, atol=1e-12)
    assert again.time_offsets["dt_imu0_cam0"].offset.value == -0.008
    assert again.imus["imu0"].accel_random_walk == rig.imus["imu0"].accel_random_walk
    assert (again.imus["imu0"].topic, again.imus["imu0"].rate_hz) == ("/imu0", 200.0)
    found = again.imus["imu0"].intrinsics
    assert found is not None
    values = IMU_MODEL.values() | {key: 0.0 for key in PARAMETERS if key.startswith("b_")}
    for key, value in values.items():
        assert found.parameters[key].value == pytest.approx(value, abs=1e-14)
    assert found.gravity == 9.80665
    assert [note for note in brought.notes if "neither biases nor gravity" in note]


def test_opencvs_reader_reads_every_key(tmp_path: Path) -> None:
    _, outcome = written(two_cameras(), tmp_path, IMU)
    for path in outcome.files:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        for sensor, node in yaml.safe_load(path.read_text().split("\n", 1)[1]).items():
            assert set(storage.getNode(sensor).keys()) == node.keys()
            for key, value in node.items():
                assert plain(storage.getNode(sensor).getNode(key)) == value


def plain(node: Any) -> Any:
    """Return what cv::FileStorage holds as plain data."""
    if node.isSeq():
        return [plain(node.at(i)) for i in range(node.size())]
    return node.string() if node.isString() else node.real()


def test_an_imu_without_intrinsics_gets_the_identities_that_openvins_demands(tmp_path: Path) -> None:
    chain, outcome = written(Rig(imus={"imu0": full_rig().imus["imu0"]}), tmp_path, IMU)
    assert [chain["imu0"][key] for key in ("Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC", "Tg")] == [EYE, EYE, EYE, EYE, ZERO]
    assert "imu0 has no intrinsics; identities are written, which OpenVINS demands" in outcome.notes
    brought = import_files(outcome.files, tmp_path / "again.yaml")
    assert brought.rig.imus["imu0"].intrinsics is None
    assert brought.notes == ()


def test_intrinsics_in_counts_are_left_to_the_samples(tmp_path: Path) -> None:
    chain, outcome = written(Rig(imus={"imu0": Imu(intrinsics=imu_intrinsics(unit="counts"))}), tmp_path, IMU)
    assert chain["imu0"]["Ta"] == EYE
    assert any("raw counts are not written, OpenVINS takes SI" in note for note in outcome.notes)
    assert not any("gravity_mag" in note or "identities" in note for note in outcome.notes)


def test_what_openvins_cannot_take_is_said(tmp_path: Path) -> None:
    rig = Rig(
        cameras={"left": camera("pinhole-radtan"), "right": camera("pinhole-equi")},
        imus=full_rig().imus,
        transforms={"T_imu0_left": make_transform("imu0", "left", se3.inverse(T_CAM0_IMU0))},
        time_offsets={"dt_imu0_right": make_time_offset("imu0", "right", Estimate(value=0.03, unit="s"))},
    )
    _, outcome = written(rig, tmp_path, IMUCAM)
    notes = "\n".join(outcome.notes)
    for text in (
        "left is written as cam0",
        "right has no transform to an IMU, which OpenVINS demands; add T_imu_cam by hand",
        "OpenVINS takes cam0's timeshift_cam_imu, 0 s, for every camera; that of cam1 differs",
        "imu1 is not written: OpenVINS has one IMU, imu0",
    ):
        assert text in notes


def test_another_lens_becomes_one_that_openvins_has(tmp_path: Path) -> None:
    chain, outcome = written(Rig(cameras={"cam0": camera("pinhole-radtan8")}), tmp_path, IMUCAM)
    assert len(chain["cam0"]["distortion_coeffs"]) == 4
    assert outcome.notes[0].startswith("cam0: written as pinhole-")


def imu_file(**values: Any) -> dict[str, Any]:
    """Return OpenVINS' keys of an ideal IMU with some changed, or dropped where None."""
    node = {"model": "kalibr", "Tw": EYE, "R_IMUtoGYRO": EYE, "Ta": EYE, "R_IMUtoACC": EYE, "Tg": ZERO, **values}
    return {"imu0": {key: value for key, value in node.items() if value is not None}}


def test_an_imported_sensitivity_is_turned_into_the_gyroscopes_frame(tmp_path: Path) -> None:
    """Tg takes the specific force in the IMU's frame: a gyroscope turned by 90 degrees about z sees x where the IMU sees -y."""
    R = so3.exp(np.array([0.0, 0.0, np.pi / 2])).round(12)
    Tg = [[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, 0.0, 0.0]]
    (tmp_path / "in.yaml").write_text(yaml.safe_dump(imu_file(R_IMUtoGYRO=R.tolist(), Tg=Tg)))
    found = import_files([tmp_path / "in.yaml"], tmp_path / "rig.yaml").rig.imus["imu0"].intrinsics
    assert found is not None
    model = ImuModel.of({key: entry.value or 0.0 for key, entry in found.parameters.items()})
    _, w_meas = model.measure(np.array([2.0, 0.0, 0.0]), np.zeros(3))
    np.testing.assert_allclose(w_meas, [0, 2e-3, 0], atol=1e-15)
    np.testing.assert_allclose(model.A_g, [[0, 0, 0], [0, 1e-3, 0], [0, 0, 0]], atol=1e-15)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (imu_file(Ta=np.triu(np.ones((3, 3))).tolist()), r"line \d+: imu0.Ta: is not lower triangular"),
        (
            imu_file(Tw=np.triu(np.ones((3, 3))).tolist(), model="rpng"),
            r"line \d+: imu0.model: is rpng, but our IMU frame is the accelerometer's",
        ),
        (imu_file(R_IMUtoACC=IMU_MODEL.C_g_i.tolist()), r"line \d+: imu0.R_IMUtoACC: is not identity, but our IMU frame is the acceler"),
        (imu_file(R_IMUtoGYRO=np.diag([1.0, -1.0, 1.0]).tolist()), r"line \d+: imu0.R_IMUtoGYRO: its matrix is not a rotation"),
        (imu_file(Tg=EYE, Tw=None), r"imu0.Tw: is missing"),
    ],
)
def test_what_has_no_meaning_here_is_refused(tmp_path: Path, content: dict[str, Any], message: str) -> None:
    (tmp_path / "in.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(BadInputError, match=message):
        import_files([tmp_path / "in.yaml"], tmp_path / "rig.yaml")
