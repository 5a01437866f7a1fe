"""ROS camera_info and OpenCV YAML: read and written as their own tools mean them, checked by projected points against OpenCV."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutate import mutated, read_or_refused
from rigs import LENSES, SIZES, camera, full_rig

from calibkit.data.rig import Rig
from calibkit.errors import BadInputError
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.stages.convert import export_rig, import_files

POINTS = np.array([[0.21, -0.13, 1.1], [-0.3, 0.2, 0.9], [0.05, 0.3, 1.4], [-0.02, -0.01, 0.5]])
ROS = {  # the layout of camera_calibration_parsers
    "image_width": 640,
    "image_height": 480,
    "camera_name": "narrow_stereo/left",
    "camera_matrix": {"rows": 3, "cols": 3, "data": [520.1, 0, 322.3, 0, 519.7, 241.9, 0, 0, 1]},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.28, 0.07, 0.0002, -0.0003, 0.01]},
    "rectification_matrix": {"rows": 3, "cols": 3, "data": [1, 0, 0, 0, 1, 0, 0, 0, 1]},
    "projection_matrix": {"rows": 3, "cols": 4, "data": [520.1, 0, 322.3, 0, 0, 519.7, 241.9, 0, 0, 0, 1, 0]},
}


def pixels(rig: Rig, name: str = "cam0") -> Any:
    entry = rig.cameras[name]
    model = CAMERAS[entry.model]
    return model.project(POINTS, np.array([entry.parameters[p].value for p in model.parameter_names], float)).uv


def by_opencv(K: Any, D: Any, fisheye: bool) -> Any:
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    uv, _ = project(POINTS[:, None], np.zeros(3), np.zeros(3), np.reshape(K, (3, 3)).astype(float), np.array(D, float).ravel())
    return uv[:, 0]


def brought_in(folder: Path, content: Any) -> Rig:
    path = folder / "in.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return import_files([path], folder / "in_rig.yaml", force=True).rig


def exported(folder: Path, model: str, to: str) -> Path:
    save_rig(Rig(cameras={"cam0": camera(model)}), folder / "rig.yaml", force=True)
    outcome = export_rig(folder / "rig.yaml", to, folder / to)
    assert outcome.notes == ("not written, the format has no place for them: sigmas and covariances",)
    return outcome.files[0]


@pytest.mark.parametrize("to", ["ros", "opencv"])
@pytest.mark.parametrize("model", LENSES)
def test_every_model_comes_back_to_the_same_pixel(tmp_path: Path, model: str, to: str) -> None:
    path = exported(tmp_path, model, to)
    rig = import_files([path], tmp_path / "back.yaml").rig
    np.testing.assert_allclose(pixels(rig), pixels(Rig(cameras={"cam0": camera(model)})), rtol=0, atol=1e-10)
    assert rig.cameras["cam0"].resolution == SIZES[model]


@pytest.mark.parametrize("model", LENSES)
def test_opencv_reads_what_is_written(tmp_path: Path, model: str) -> None:
    storage = cv2.FileStorage(str(exported(tmp_path, model, "opencv")), cv2.FILE_STORAGE_READ)
    K, D = (storage.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
    fisheye = storage.getNode("fisheye_model").real() == 1
    assert fisheye == (model == "pinhole-equi")
    np.testing.assert_allclose(by_opencv(K, D, fisheye), pixels(Rig(cameras={"cam0": camera(model)})), rtol=0, atol=1e-9)
    assert (storage.getNode("image_width").real(), storage.getNode("image_height").real()) == SIZES[model]


@pytest.mark.parametrize(("count", "fisheye"), [(4, False), (5, False), (8, False), (12, False), (14, False), (4, True)])
def test_what_opencv_writes_is_read(tmp_path: Path, count: int, fisheye: bool) -> None:
    """4.x writes 14 coefficients where calibrateCamera had CALIB_RATIONAL_MODEL, the last ones 0."""
    K = np.array([[520.1, 0, 322.3], [0, 519.7, 241.9], [0, 0, 1]])
    D = np.array([0.31, -0.12, 1e-4, -3e-4, 0.02, 0.52, -0.03, 0.01, 0, 0, 0, 0, 0, 0])[:count]
    path = str(tmp_path / "cv.yml")
    storage = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sat Jan  1 00:00:00 2022")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("fisheye_model", int(fisheye))
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", D[:, None])
    storage.write("avg_reprojection_error", float("nan"))
    storage.release()
    assert Path(path).read_text().startswith(("%YAML:1.0", "%YAML 1.2"))  # OpenCV 4, 5
    rig = import_files([Path(path)], tmp_path / "rig.yaml").rig
    np.testing.assert_allclose(pixels(rig), by_opencv(K, D, fisheye), rtol=0, atol=1e-9)


def test_ros_files_are_read_as_they_are(tmp_path: Path) -> None:
    rig = brought_in(tmp_path, ROS)
    K, D = (ROS[key]["data"] for key in ("camera_matrix", "distortion_coefficients"))  # type: ignore[index]
    np.testing.assert_allclose(pixels(rig), by_opencv(K, D, False), atol=1e-9)
    fisheye = {
        **ROS,
        "distortion_model": "equidistant",
        "distortion_coefficients": {"rows": 1, "cols": 4, "data": [0.01, -0.02, 0.003, -0.001]},
    }
    np.testing.assert_allclose(pixels(brought_in(tmp_path, fisheye)), by_opencv(K, [0.01, -0.02, 0.003, -0.001], True), atol=1e-9)


def test_several_cameras_are_numbered_in_order(tmp_path: Path) -> None:
    for name in ("left.yaml", "right.yaml"):
        (tmp_path / name).write_text(yaml.safe_dump({**ROS, "image_width": 640 if name == "left.yaml" else 641}))
    rig = import_files([tmp_path / "left.yaml", tmp_path / "right.yaml"], tmp_path / "rig.yaml").rig
    assert {name: entry.resolution[0] for name, entry in rig.cameras.items()} == {"cam0": 640, "cam1": 641}
    save_rig(full_rig(), tmp_path / "full.yaml")
    outcome = export_rig(tmp_path / "full.yaml", "ros", tmp_path / "out")
    assert [path.name for path in outcome.files] == ["cam0.yaml", "cam1.yaml"]
    assert outcome.notes == ("not written, the format has no place for them: sigmas and covariances, imus, transforms, time offsets",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distortion_model": "thin_prism"}, "distortion_model: 'thin_prism' is not known; it may be plumb_bob"),
        ({"image_width": None}, "image_width and image_height are missing"),
        ({"image_width": "640"}, "image_width: '640' is not an image size"),
        ({"camera_matrix": {"data": [520.1, 3.0, 322.3, 0, 519.7, 241.9, 0, 0, 1]}}, "camera_matrix: has a skew"),
        ({"camera_matrix": {"data": [0, 0, 322.3, 0, 519.7, 241.9, 0, 0, 1]}}, "a focal length is not positive"),
        ({"camera_matrix": {"rows": 2, "cols": 3, "data": [520.1, 0, 322.3, 0, 519.7, 241.9, 0, 0, 1]}}, "its rows and cols do not fit"),
        ({"camera_matrix": [1, 2]}, "camera_matrix.data: is missing"),
        ({"distortion_coefficients": {"data": [0.1] * 8}}, "distortion_coefficients: has 8 coefficients, none 0; more than 5"),
        ({"distortion_coefficients": {"data": [0.1] * 3}}, "has 3 numbers; it needs 2 or 4 or 5 or 8"),
        ({"distortion_coefficients": {"data": [float("inf")] * 5}}, "inf is not a finite number"),
    ],
)
def test_what_is_wrong_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInputError, match=message) as caught:
        brought_in(tmp_path, {k: v for k, v in {**ROS, **change}.items() if v is not None})
    assert "in.yaml, line " in str(caught.value)


def test_a_rectified_stereo_pair_is_said(tmp_path: Path) -> None:
    (tmp_path / "in.yaml").write_text(yaml.safe_dump({**ROS, "rectification_matrix": {"data": [0, 1, 0, -1, 0, 0, 0, 0, 1]}}))
    notes = import_files([tmp_path / "in.yaml"], tmp_path / "rig.yaml").notes
    assert len(notes) == 1
    assert "rectification_matrix is that of a stereo pair" in notes[0]


@settings(max_examples=150, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(content=mutated(yaml.safe_dump(ROS, sort_keys=False)), opencv=st.booleans())
def test_mutated_files_are_read_or_refused_in_one_line(tmp_path: Path, content: bytes, opencv: bool) -> None:
    (tmp_path / "in.yaml").write_bytes(content.replace(b"distortion_model:", b"fisheye_model:") if opencv else content)
    outcome = read_or_refused(lambda: import_files([tmp_path / "in.yaml"], tmp_path / "rig.yaml", force=True))
    if outcome is not None:
        assert load_rig(tmp_path / "rig.yaml") == outcome.rig
