"""Folders of images, ASL folders and CSV files."""

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibkit.errors import BadInputError
from calibkit.io.folder import stamp_ns
from calibkit.io.recording import open_recording
from calibkit.models.board import AprilGrid

T0 = 1_403_709_385_487_836_928
BOARD = AprilGrid(6, 6, 0.088, 0.3)


def _image(path: Path, value: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((6, 8), value, np.uint8))
    return path


def _values(path: Path) -> list[int]:
    recording = open_recording([path])
    return [int(frame.decode()[0, 0]) for frame in recording.images(recording.choose("image"))]


def test_images_come_in_natural_order_without_times(tmp_path: Path) -> None:
    for number in (10, 9, 100, 1):
        _image(tmp_path / "cam" / f"img{number}.png", number)
    (tmp_path / "cam" / ".hidden.png").write_bytes(b"")
    assert _values(tmp_path / "cam") == [1, 9, 10, 100]
    recording = open_recording([tmp_path / "cam"])
    assert {frame.t_ns for frame in recording.images("cam")} == {0}
    assert next(recording.images("cam")).label == "img1.png"
    assert any("no stamps" in warning for warning in recording.warnings)


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("1403709385487836928", T0),
        ("1403709385487836", T0 // 1000 * 1000),
        ("1403709385487", T0 // 10**6 * 10**6),
        ("1403709385", T0 // 10**9 * 10**9),
        ("1403709385.487836928", T0),
        ("0000001234", None),
        ("img1403709385", None),
        ("1403709385487836928x", None),
        ("", None),
        ("٣" * 19, None),
        ("20230131120000", None),  # dates
        ("20230131120000123", None),
        ("9" * 20, None),
    ],
)
def test_stamps_in_names(text: str, t_ns: int | None) -> None:
    assert stamp_ns(text) == t_ns


def test_images_named_by_their_stamps_are_sorted_by_them(tmp_path: Path) -> None:
    for i in (2, 0, 1):
        _image(tmp_path / "cam" / f"{T0 + i}.png", i)
    recording = open_recording([tmp_path / "cam"])
    assert [(f.t_ns, int(f.decode()[0, 0])) for f in recording.images("cam")] == [(T0, 0), (T0 + 1, 1), (T0 + 2, 2)]
    assert recording.warnings == []


def _asl(root: Path) -> Path:
    for camera, value in (("cam0", 10), ("cam1", 20)):
        rows = ["#timestamp [ns],filename"]
        for i in range(3):
            _image(root / "mav0" / camera / "data" / f"{T0 + i}.png", value + i)
            rows.append(f"{T0 + i},{T0 + i}.png")
        rows += [f"{T0 + 3},gone.png", f"{T0 + 4},../../cam0/data/{T0}.png" if camera == "cam0" else "x,y"]
        (root / "mav0" / camera / "data.csv").write_text("\r\n".join(rows) + "\r\n")
    header = (
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    )
    (root / "mav0" / "imu0").mkdir()
    (root / "mav0" / "imu0" / "data.csv").write_text(f"{header}\n{T0},1,2,3,4,5,6\n{T0 + 5000000},7,8,9,10,11,12\n")
    truth = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]"
    (root / "mav0" / "state_groundtruth_estimate0").mkdir()
    (root / "mav0" / "state_groundtruth_estimate0" / "data.csv").write_text(f"{truth}\n{T0},1,2,3,0.5,0.5,-0.5,0.5,9\n")
    return root


@pytest.mark.parametrize("given", [".", "mav0"])
def test_an_asl_folder_holds_all_its_sensors(tmp_path: Path, given: str) -> None:
    recording = open_recording([_asl(tmp_path / "V1_01") / given])
    assert {t.name: t.kind for t in recording.topics} == {
        "cam0": "image",
        "cam1": "image",
        "imu0": "imu",
        "state_groundtruth_estimate0": "pose",
    }
    assert [int(f.decode()[0, 0]) for f in recording.images("cam1")] == [20, 21, 22]
    imu = recording.imu("imu0")
    assert imu.t_ns.tolist() == [T0, T0 + 5000000]
    np.testing.assert_array_equal(np.hstack([imu.gyro, imu.accel]), [[1, 2, 3, 4, 5, 6], [7, 8, 9, 10, 11, 12]])
    pose = recording.poses("state_groundtruth_estimate0")
    np.testing.assert_array_equal(pose.q, [[0.5, -0.5, 0.5, 0.5]])  # the file has w first
    assert any("cam1: 1 images of data.csv are missing" in w for w in recording.warnings)
    assert any("cam1: 1 rows of data.csv are not" in w for w in recording.warnings)


@pytest.mark.parametrize(
    ("header", "told"),
    [
        ("t [s],wx [rpm],wy [rpm],wz [rpm],ax,ay,az", r"\[rpm\] of column wx is not known: use one of rad/s, .*deg/s"),
        ("t [s],wx,wy,wz,ax [m/s^2],ay [ft/s^2],az [m/s^2]", r"\[ft/s\^2\] of column ay is not known: use one of m/s\^2"),
        ("t [min],wx,wy,wz,ax,ay,az", r"\[min\] of column t is not known: use one of ns, us"),
    ],
)
def test_a_unit_that_is_not_known_is_refused_and_not_taken_for_si(header: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text(f"{header}\n1,2,3,4,5,6,7\n2,2,3,4,5,6,7\n")
    with pytest.raises(BadInputError, match=told):
        open_recording([tmp_path / "imu.csv"])
    (tmp_path / "other.csv").write_text("t,wx,wy,wz,ax,ay,az\n1,2,3,4,5,6,7\n")
    recording = open_recording([tmp_path])
    assert [topic.name for topic in recording.topics] == ["other"]
    assert any("is not known" in warning for warning in recording.warnings)


def test_each_column_has_its_own_unit(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("t [ms],x [mm],y [cm],z [m],qx,qy,qz,qw\n1000,1500,150,1.5,0,0,0,1\n")
    poses = open_recording([tmp_path / "p.csv"]).poses("p")
    np.testing.assert_allclose(poses.p, [[1.5, 1.5, 1.5]], rtol=1e-15)
    assert poses.t_ns.tolist() == [10**9]


def test_a_stamp_beyond_any_time_is_no_row(tmp_path: Path) -> None:
    _image(tmp_path / "cam0" / "data" / "a.png", 7)
    (tmp_path / "cam0" / "data.csv").write_text(f"{T0},a.png\n9999999999999999999,a.png\n")
    recording = open_recording([tmp_path / "cam0"])
    assert [frame.t_ns for frame in recording.images("cam0")] == [T0]
    assert any("1 rows of data.csv are not" in w for w in recording.warnings)


def test_one_camera_of_an_asl_folder(tmp_path: Path) -> None:
    assert _values(_asl(tmp_path) / "mav0" / "cam1") == [20, 21, 22]


def _csv(folder: Path, text: str, name: str = "s.csv") -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("#ts,wx,wy,wz,ax,ay,az\n1403709385487836928,1,2,3,4,5,6\n", T0),
        ("t [s],wx,wy,wz,ax,ay,az\n12.5,1,2,3,4,5,6\n", 12_500_000_000),
        ("time;gx;gy;gz;ax;ay;az\n1403709385.487836928;1;2;3;4;5;6\n", T0),
        ("t [us],ax,ay,az,wx,wy,wz\n7,4,5,6,1,2,3\n", 7000),
        ("1403709385487,1,2,3,4,5,6\n", T0 // 10**6 * 10**6),
        ("t,gx [deg/s],gy [deg/s],gz [deg/s],ax [g],ay [g],az [g]\n0.5,57.29577951308232,114.59155902616465,171.88733853924697,"
         "0.4078864851911713,0.5098581064889641,0.6118297277867569\n", 500_000_000),
    ],
)  # fmt: skip
def test_imu_csv_by_header_or_shape(tmp_path: Path, text: str, t_ns: int) -> None:
    imu = open_recording([_csv(tmp_path, text)]).imu("s")
    assert imu.t_ns.tolist() == [t_ns]
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), [[1, 2, 3, 4, 5, 6]], rtol=1e-14)


@pytest.mark.parametrize(
    "text",
    [
        "# ground truth\n# timestamp tx ty tz qx qy qz qw\n1403709385.487836928 1 2 3 0 0 0.6 0.8\n",
        "1403709385.487836928, 1, 2, 3, 0, 0, 0.6, 0.8\n",
        "t,qw,qx,qy,qz,x,y,z\n1403709385487836928,0.8,0,0,0.6,1,2,3\n",
        "\ufefft,x,y,z,qx,qy,qz,qw\r\n1403709385487836928,1,2,3,0,0,6e-1,8e-1\r\n",
    ],
)
def test_pose_csv_and_tum(tmp_path: Path, text: str) -> None:
    poses = open_recording([_csv(tmp_path, text)]).poses("s")
    assert poses.t_ns.tolist() == [T0]
    np.testing.assert_allclose(np.hstack([poses.p, poses.q]), [[1, 2, 3, 0, 0, 0.6, 0.8]], atol=1e-15)


def test_an_odometry_with_rates_is_poses(tmp_path: Path) -> None:
    text = "t,x,y,z,qx,qy,qz,qw,wx,wy,wz\n1,1,2,3,0,0,0,1,7,8,9\n"
    assert [topic.kind for topic in open_recording([_csv(tmp_path, text)]).topics] == ["pose"]


@pytest.mark.parametrize(
    ("text", "rate"),
    [
        ("t,yaw_rate\n1,0.5\n2,nan\n3,-0.25\n", 0.5),
        ("time [s],v,wz [rad/s]\n1,2,0.5\n3,2,-0.25\n", 0.5),
        ("# t x y yaw_rate[deg/s]\n1 7 7 90\n3 7 7 -45\n", np.pi / 2),
    ],
)
def test_a_yaw_rate_alone_is_a_twist(text: str, rate: float, tmp_path: Path) -> None:
    recording = open_recording([_csv(tmp_path, text)])
    assert [(topic.kind, topic.type) for topic in recording.topics] == [("twist", "yaw rate CSV")]
    rates = recording.twist("s")
    assert rates.t_ns.tolist() == [10**9, 3 * 10**9]
    np.testing.assert_allclose(rates.gyro, [[0, 0, rate], [0, 0, -rate / 2]], rtol=1e-15)
    assert not rates.has_accel
    assert len(recording.survey()["s"].record_ns) == recording.topics[0].count


def test_a_yaw_rate_in_counts_is_refused_and_beside_an_accelerometer_it_is_none(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="yaw rate is in raw counts"):
        open_recording([_csv(tmp_path, "t,yaw_rate [lsb]\n1,5\n2,6\n")])
    recording = open_recording([_csv(tmp_path, "t,ax,ay,az,wz\n1,0,0,9.8,1\n2,0,0,9.8,1\n", "acc.csv")])
    assert [topic.kind for topic in recording.topics] == ["imu"]


def test_tables_of_one_name_are_two_streams(tmp_path: Path) -> None:
    for place, x in (("a/p.csv", 1), ("b/p.csv", 2), ("other/a/p.txt", 3), ("a/q.csv", 4), ("a/p.tum", 5)):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        _csv((tmp_path / place).parent, f"1 {x} 0 0 0 0 0 1\n", Path(place).name)
    recording = open_recording([tmp_path / place for place in ("a/p.csv", "b/p.csv", "other/a/p.txt", "a/q.csv")])
    assert [topic.name for topic in recording.topics] == [f"{tmp_path.name}/a/p", "b/p", "other/a/p", "q"]
    assert [recording.poses(topic.name).p[0, 0] for topic in recording.topics] == [1, 2, 3, 4]
    with pytest.raises(BadInputError, match="two files would both be called p: rename one"):
        open_recording([tmp_path / "a/p.csv", tmp_path / "a/p.tum"])


def test_rows_that_are_cut_or_mean_nothing_are_left_out_and_told(tmp_path: Path) -> None:
    text = "t,wx,wy,wz,ax,ay,az\n1,1,2,3,4,5,6\n2,nan,2,3,4,5,6\n3,1,2,3,4,5,6\n4,1,2,3"
    recording = open_recording([_csv(tmp_path, text)])
    assert recording.imu("s").t_ns.tolist() == [10**9, 3 * 10**9]
    assert any("1 lines have not 7 columns" in w for w in recording.warnings)
    assert any("1 sample is not finite" in w for w in recording.warnings)
    recording = open_recording([_csv(tmp_path, "1 0 0 0 0 0 0 0\n2 0 0 0 0 0 0 2\n3 0 0 0 0 0 0 1.001\n", "p.txt")])
    np.testing.assert_array_equal(recording.poses("p").q, [[0, 0, 0, 1]])
    assert any("2 poses have no proper rotation" in w for w in recording.warnings)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "holds no rows of numbers"),
        ("a,b,c\n1,2,3\n", r"s\.csv is not recognised: wanted are columns"),
        ("1,2,3\n", "not recognised"),
        ("t,wx,wy,wz,ax,ay,az\n1,1,2,x,4,5,6\n", "columns wx, wy, wz, ax, ay, az must hold numbers"),
        ("t,wx,wy,wz,ax,ay,az\n1,1,2,3,4,5,6\ninf,1,2,3,4,5,6\n", "its time column must hold numbers"),
        ("t,wx,wy,wz,ax,ay,az\n1,1,2,3,4,5,6\n1e900000,1,2,3,4,5,6\n", "its time column must hold numbers .* too large"),
        ("t,wx,wy,wz,ax,ay,az\n1e999999999,1,2,3,4,5,6\n", "its time column must hold numbers .* too large"),
        ("t [s],wx,wy,wz,ax,ay,az\n1403709385487836928,1,2,3,4,5,6\n", "its time column must hold numbers"),
        ("\0\0\0", "holds no rows of numbers"),
    ],
)
def test_csv_that_cannot_be_read_is_refused_in_one_line(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(BadInputError, match=told) as refusal:
        open_recording([_csv(tmp_path, text)]).imu("s")
    assert "\n" not in str(refusal.value)


def _corner_rows(uv: np.ndarray, with_points: bool = True, board: AprilGrid = BOARD) -> str:
    rows = ["#timestamp [ns],tag_id,corner_idx,u [px],v [px]" + (",x [m],y [m],z [m]" if with_points else "")]
    for frame, corners in enumerate(uv):
        for corner, (u, v) in enumerate(corners):
            point = ",".join(f"{x:.6f}" for x in board.points[corner])
            rows.append(f"{T0 + 50_000_000 * frame},{corner // 4},{corner % 4},{u!r},{v!r}" + (f",{point}" if with_points else ""))
    return "\n".join(rows)


def test_corner_csv_becomes_board_views(tmp_path: Path) -> None:
    uv = np.random.default_rng(0).uniform(0, 400, (3, 144, 2)).round(3).tolist()
    recording = open_recording([_csv(tmp_path, _corner_rows(uv), "cam0.csv")])
    views = recording.board_views(BOARD, (752, 480))
    assert views.t_ns.tolist() == [T0, T0 + 50_000_000, T0 + 100_000_000]
    np.testing.assert_array_equal(views.uv, np.reshape(uv, (-1, 2)))
    np.testing.assert_array_equal(views.corner, np.tile(np.arange(144), 3))
    assert views.labels[0] == "1403709385.487836928"
    assert any("0.3 px is assumed" in w for w in views.warnings)


@pytest.mark.parametrize(
    ("board", "size", "told"),
    [
        (AprilGrid(6, 6, 0.08, 0.3), (752, 480), r"tag 0 corner 1 lies at|tag \d+ corner \d lies at .* check tagSize"),
        (AprilGrid(6, 6, 0.088, 0.2), (752, 480), r"tag \d+ corner \d lies at .* check tagSize"),
        (AprilGrid(5, 5, 0.088, 0.3), (752, 480), "tag 35 is not on the aprilgrid of 5 x 5"),
        (BOARD, (300, 300), "corners lie outside of an image of 300 x 300"),
    ],
)
def test_corners_that_do_not_fit_the_board_or_image_are_refused(tmp_path: Path, board: AprilGrid, size: tuple[int, int], told: str) -> None:
    uv = np.random.default_rng(0).uniform(0, 400, (2, 144, 2)).tolist()
    with pytest.raises(BadInputError, match=told):
        open_recording([_csv(tmp_path, _corner_rows(uv))]).board_views(board, size)


def test_corners_that_come_twice_are_taken_once(tmp_path: Path) -> None:
    text = f"timestamp,tag_id,corner_idx,u,v,sigma_px\n{T0},1,2,5,6,0.1\n{T0},1,1,3,4,0.2\n{T0},1,2,9,9,0.3\n"
    views = open_recording([_csv(tmp_path, text)]).board_views(BOARD, (752, 480))
    assert views.corner.tolist() == [5, 6]
    assert views.sigma_px.tolist() == [0.2, 0.1]
    assert any("1 corners come twice" in w for w in views.warnings)


def test_a_folder_of_several_files_is_one_recording(tmp_path: Path) -> None:
    _csv(tmp_path, "t,wx,wy,wz,ax,ay,az\n1,1,2,3,4,5,6\n", "imu0.csv")
    _csv(tmp_path, "some,notes\nand,words\n", "notes.csv")
    _image(tmp_path / "cam0" / "1.png", 1)
    recording = open_recording([tmp_path])
    assert {t.kind for t in recording.topics} == {"imu", "image"}
    assert any("notes.csv holds no rows" in w for w in recording.warnings)


def test_folders_of_one_name_are_told_apart(tmp_path: Path) -> None:
    for value, camera in enumerate(("cam0", "cam1")):
        _image(tmp_path / camera / "images" / "1.png", value)
    recording = open_recording([tmp_path / "cam0" / "images", tmp_path / "cam1" / "images"])
    assert [topic.name for topic in recording.topics] == ["cam0/images", "cam1/images"]
    assert int(next(recording.images("cam1/images")).decode()[0, 0]) == 1


def test_inputs_are_named_and_hashed(tmp_path: Path) -> None:
    path = _csv(tmp_path, "t,wx,wy,wz,ax,ay,az\n1,1,2,3,4,5,6\n", "imu0.csv")
    ((name, digest),) = open_recording([path]).inputs()
    assert (name, digest) == ("imu0.csv", hashlib.sha256(path.read_bytes()).hexdigest())
