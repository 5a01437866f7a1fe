"""VINS-Fusion's files: a point through its equations lands where the rig has it, and the reader that it uses reads them."""

from pathlib import Path

import numpy as np
import pytest
from rigs import T_CAM0_IMU0, T_CAM1_CAM0, camera, full_rig

from calibkit.data.rig import Estimate, Rig
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.data.verdict import Status
from calibkit.errors import BadInputError
from calibkit.geometry import se3
from calibkit.io.rig_file import save_rig
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.stages.convert import Outcome, export_rig


def written(rig: Rig, folder: Path) -> Outcome:
    save_rig(rig, folder / "rig.yaml")
    return export_rig(folder / "rig.yaml", "vins", folder / "out")


def stereo() -> Rig:
    rig = full_rig()
    transforms = {name: entry for name, entry in rig.transforms.items() if "imu1" not in name}
    offsets = {"dt_imu0_cam0": rig.time_offsets["dt_imu0_cam0"]}
    return rig.model_copy(update={"imus": {"imu0": rig.imus["imu0"]}, "transforms": transforms, "time_offsets": offsets})


def read(path: Path) -> cv2.FileStorage:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.isOpened()
    return storage


def test_a_point_lands_where_vins_projects_it(tmp_path: Path) -> None:
    """p_cam = body_T_cam^-1 p_imu; PINHOLE is OpenCV's, KANNALA_BRANDT (k2 .. k5) its fisheye."""
    rig = stereo()
    written(rig, tmp_path)
    config = read(tmp_path / "out" / "vins.yaml")
    p_imu = np.array([[0.7, -0.4, 1.9], [0.2, 0.1, 2.5]])
    for name, T_cam_imu in (("cam0", T_CAM0_IMU0), ("cam1", T_CAM1_CAM0 @ T_CAM0_IMU0)):
        camera = rig.cameras[name]
        ours = CAMERAS[camera.model].project(
            se3.transform(T_cam_imu, p_imu), np.array([camera.parameters[key].value for key in camera.parameters])
        )
        body_T_cam = config.getNode(f"body_T_{name}").mat()
        p_cam = se3.transform(se3.inverse(body_T_cam), p_imu)
        lens = read(tmp_path / "out" / config.getNode(f"{name}_calib").string())
        shape = lens.getNode("projection_parameters")
        if lens.getNode("model_type").string() == "PINHOLE":
            K = np.diag([shape.getNode("fx").real(), shape.getNode("fy").real(), 1.0])
            K[:2, 2] = [shape.getNode(key).real() for key in ("cx", "cy")]
            D = np.array([lens.getNode("distortion_parameters").getNode(key).real() for key in ("k1", "k2", "p1", "p2")])
            uv, _ = cv2.projectPoints(p_cam, np.zeros(3), np.zeros(3), K, D)
        else:
            K = np.diag([shape.getNode("mu").real(), shape.getNode("mv").real(), 1.0])
            K[:2, 2] = [shape.getNode(key).real() for key in ("u0", "v0")]
            D = np.array([shape.getNode(key).real() for key in ("k2", "k3", "k4", "k5")])
            uv, _ = cv2.fisheye.projectPoints(p_cam[:, None], np.zeros(3), np.zeros(3), K, D)
        np.testing.assert_allclose(uv.reshape(-1, 2), ours.uv, atol=1e-9)
        assert (lens.getNode("image_width").real(), lens.getNode("image_height").real()) == camera.resolution
    assert {rig.cameras[name].model for name in ("cam0", "cam1")} == {"pinhole-radtan", "pinhole-equi"}


def test_the_clock_and_the_noise_of_one_sample(tmp_path: Path) -> None:
    """td: image clock + td = IMU clock; sigma of a sample is the density times sqrt(rate), 200 Hz."""
    rig = stereo()
    outcome = written(rig, tmp_path)
    config = read(tmp_path / "out" / "vins.yaml")
    assert config.getNode("td").real() == -0.008
    imu = rig.imus["imu0"]
    fields = {"acc_n": imu.accel_noise_density, "gyr_n": imu.gyro_noise_density, "acc_w": imu.accel_random_walk}
    for key, estimate in (fields | {"gyr_w": imu.gyro_random_walk}).items():
        assert estimate is not None
        assert config.getNode(key).real() == pytest.approx((estimate.value or 0) * np.sqrt(200))
    assert (config.getNode("imu_topic").string(), config.getNode("num_of_cam").real()) == ("/imu0", 2)
    assert [path.name for path in outcome.files] == ["vins.yaml", "cam0.yaml", "cam1.yaml"]


def test_what_vins_cannot_take_is_said(tmp_path: Path) -> None:
    lenses = {f"c{i}": camera("pinhole-radtan") for i in range(3)}
    rig = Rig(
        cameras=lenses,
        imus={"imu0": full_rig().imus["imu0"].model_copy(update={"accel_random_walk": None})},
        transforms={"T_imu0_c0": make_transform("imu0", "c0", se3.inverse(T_CAM0_IMU0))},
        time_offsets={
            "dt_imu0_c0": make_time_offset("imu0", "c0", Estimate(value=0.01, unit="s")),
            "dt_imu0_c1": make_time_offset("imu0", "c1", Estimate(value=0.03, unit="s")),
        },
    )
    notes = "\n".join(written(rig, tmp_path).notes)
    for said in (
        "c0 is written as cam0",
        "c2 is not written: VINS-Fusion has 2 cameras at most",
        "c1 has no transform to imu0, which VINS-Fusion demands; add body_T_cam1 by hand",
        "takes cam0's td, 0.01 s, for every camera; that of c1 differs",
        "imu0 has no accel_random_walk, which VINS-Fusion demands; add acc_w by hand",
    ):
        assert said in notes


def test_what_is_not_observable_does_not_leave(tmp_path: Path) -> None:
    rig = stereo()
    unknown = make_time_offset("imu0", "cam0", Estimate(value=None, unit="s", status=Status.NOT_OBSERVABLE))
    rig = rig.model_copy(update={"time_offsets": {"dt_imu0_cam0": unknown}})
    with pytest.raises(BadInputError, match="dt_imu0_cam0 is marked 'not observable'"):
        written(rig, tmp_path)
    assert not (tmp_path / "out" / "vins.yaml").exists()
