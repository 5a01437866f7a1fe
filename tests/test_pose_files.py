"""Pose files: each convention against scipy's rotations, each refusal by its line, names to images, and bytes that are wrong."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutate import mutated, read_or_refused
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibkit.errors import BadInputError
from calibkit.geometry.euler import from_zyx
from calibkit.io import pose_rows
from calibkit.io.pose_files import PoseTable, join_tables, load_pose_pairs, load_poses
from calibkit.io.pose_formats import FORMATS
from calibkit.io.pose_match import match_images

Array = NDArray[np.float64]
N = 5
ANGLES_DEG = np.array([[31.0, -22.0, 113.0], [-140.0, 12.5, -71.0], [5.0, 61.0, 17.0], [99.0, -45.0, 160.0], [-8.0, 33.0, -121.0]])
P = np.array([[0.4, -0.25, 1.1], [-0.31, 0.52, 0.9], [0.61, 0.13, 0.75], [0.2, 0.44, -0.3], [-0.12, -0.6, 1.3]])
R = Rotation.from_euler("ZYX", ANGLES_DEG, degrees=True)  # intrinsic: R = Rz Ry Rx


def poses() -> Array:
    T = np.tile(np.eye(4), (N, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), P
    return T


XYZW, WXYZ = R.as_quat(), R.as_quat()[:, [3, 0, 1, 2]]
MATRICES = poses().reshape(N, 16)
# What a file of each convention holds for the same poses; scipy and the definitions of the makers are the witnesses.
WRITTEN: dict[str, Array] = {
    "ros": np.hstack([P, XYZW]),
    "tum": np.hstack([np.arange(N)[:, None] / 4, P, XYZW]),
    "matrix": MATRICES,
    "matrix-columns": np.swapaxes(poses(), 1, 2).reshape(N, 16),
    "rpy": np.hstack([P, R.as_euler("xyz")]),  # extrinsic x, y, z
    "kuka-abc": np.hstack([1000 * P, ANGLES_DEG]),
    "fanuc-wpr": np.hstack([1000 * P, R.as_euler("xyz", degrees=True)]),
    "ur-rotvec": np.hstack([P, R.as_rotvec()]),
    "abb-quat": np.hstack([1000 * P, WXYZ]),
}


def rows(values: Array, mark: str = " ", labels: list[str] | None = None) -> str:
    lines = [mark.join(f"{value:.17g}" for value in row) for row in values]
    return (
        "\n".join(f"{label}{mark}{line}" if label else line for label, line in zip(labels or [""] * len(lines), lines, strict=True)) + "\n"
    )


def write(folder: Path, content: str | bytes, name: str = "poses.txt") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refused(read: Callable[[], object]) -> str:
    with pytest.raises(BadInputError) as caught:
        read()
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 600
    return message


def check(table: PoseTable) -> None:
    np.testing.assert_allclose(table.poses, poses(), rtol=0, atol=1e-12)


def test_angles_about_z_y_x_are_scipys() -> None:
    np.testing.assert_allclose(from_zyx(np.radians(ANGLES_DEG)), R.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(from_zyx(np.radians(ANGLES_DEG[0])), R[0].as_matrix(), atol=1e-15)


def test_every_convention_is_written_here() -> None:
    assert WRITTEN.keys() == FORMATS.keys()


@pytest.mark.parametrize("mark", [" ", ",", "; ", "\t"])
@pytest.mark.parametrize("fmt", FORMATS)
def test_each_convention_reads_what_its_maker_writes(tmp_path: Path, fmt: str, mark: str) -> None:
    table = load_poses(write(tmp_path, rows(WRITTEN[fmt], mark)), fmt)
    check(table)
    assert (table.format, table.parent, table.child, table.labels) == (fmt, "base", "gripper", None)
    assert (table.t_ns is None) == (fmt != "tum")


@pytest.mark.parametrize("fmt", FORMATS)
def test_units_are_overridden(tmp_path: Path, fmt: str) -> None:
    form = FORMATS[fmt]
    values = WRITTEN[fmt].copy()
    at = {"tum": [1, 2, 3], "matrix": [3, 7, 11], "matrix-columns": [12, 13, 14]}.get(fmt, [0, 1, 2])
    values[:, at] *= 1000 if form.length == "m" else 0.001
    angle = {"rad": "deg", "deg": "rad"}.get(form.angle)
    if angle:
        values[:, 3:] = np.degrees(values[:, 3:]) if angle == "deg" else np.radians(values[:, 3:])
    check(load_poses(write(tmp_path, rows(values)), fmt, "mm" if form.length == "m" else "m", angle))


@pytest.mark.parametrize("fmt", ["matrix", "matrix-columns", "tum"])
def test_layouts_that_fit_one_convention_only_need_no_option(tmp_path: Path, fmt: str) -> None:
    table = load_poses(write(tmp_path, rows(WRITTEN[fmt])))
    check(table)
    assert table.format == fmt
    assert bool(table.notes) == (fmt != "matrix")  # what is not the plainest is said


def test_a_tum_files_times_are_exact(tmp_path: Path) -> None:
    texts = ["1491557193.090000123", "1491557193.1", "1491557194"]
    content = "".join(f"{t} {line}\n" for t, line in zip(texts, rows(WRITTEN["ros"]).splitlines(), strict=False))
    table = load_poses(write(tmp_path, "# timestamp tx ty tz qx qy qz qw\n" + content))
    assert table.t_ns is not None
    assert table.t_ns.tolist() == [1491557193090000123, 1491557193100000000, 1491557194000000000]


def test_12_numbers_and_blocks_of_4_lines_are_matrices(tmp_path: Path) -> None:
    check(load_poses(write(tmp_path, rows(MATRICES[:, :12]))))
    block = "\n".join(rows(T) for T in poses())
    check(load_poses(write(tmp_path, block)))
    named = "\n".join(f"im_{i}.png\n{rows(T)}" for i, T in enumerate(poses()))
    table = load_poses(write(tmp_path, named))
    check(table)
    assert table.labels == tuple(f"im_{i}.png" for i in range(N))
    check(
        load_poses(write(tmp_path, np.array2string(poses(), separator=" ", floatmode="unique", max_line_width=200)))
    )  # as numpy prints it


@pytest.mark.parametrize(
    ("header", "fmt"),
    [
        ("x,y,z,qx,qy,qz,qw", "ros"),
        ("position.x,position.y,position.z,orientation.x,orientation.y,orientation.z,orientation.w", "ros"),
        ("pose.position.x, pose.position.y, pose.position.z, q_x, q_y, q_z, q_w", "ros"),
        ("X [mm],Y [mm],Z [mm],A,B,C", "kuka-abc"),
        ("X;Y;Z;W;P;R", "fanuc-wpr"),
        ("# x y z roll pitch yaw", "rpy"),
        ("tx ty tz roll (rad) pitch (rad) yaw (rad)", "rpy"),
        ("x_mm,y_mm,z_mm,qw,qx,qy,qz", "abb-quat"),
    ],
)
def test_headers_name_the_convention(tmp_path: Path, header: str, fmt: str) -> None:
    mark = next((mark for mark in ",;" if mark in header), " ")
    check(load_poses(write(tmp_path, header + "\n" + rows(WRITTEN[fmt], mark))))


def test_headers_name_images_times_and_units(tmp_path: Path) -> None:
    lines = rows(np.hstack([100 * P, R.as_euler("xyz", degrees=True)]), ",").splitlines()
    content = "time [ms],x [cm],y [cm],z [cm],note,roll [deg],pitch [deg],yaw [deg],image\n"
    for i, line in enumerate(lines):
        fields = line.split(",")
        content += ",".join([f"{1000 + i}.5", *fields[:3], "ok then", *fields[3:], f"im {i}.png"]) + "\n"
    table = load_poses(write(tmp_path, content, "poses.csv"))
    check(table)
    assert table.labels == tuple(f"im {i}.png" for i in range(N))
    assert table.t_ns is not None
    assert table.t_ns[0] == 1000_500_000


def test_rx_ry_rz_are_asked_for(tmp_path: Path) -> None:
    header = "x,y,z,rx,ry,rz\n"
    vectors = write(tmp_path, header + rows(WRITTEN["ur-rotvec"], ","))
    assert "--pose-format ur-rotvec or rpy or fanuc-wpr" in refused(lambda: load_poses(vectors))
    assert "ur-rotvec or rpy or fanuc-wpr and not kuka-abc" in refused(lambda: load_poses(vectors, "kuka-abc"))
    check(load_poses(vectors, "ur-rotvec"))
    check(load_poses(write(tmp_path, header + rows(WRITTEN["rpy"], ",")), "rpy"))
    check(load_poses(write(tmp_path, header + rows(WRITTEN["fanuc-wpr"], ",")), "fanuc-wpr"))


def test_image_names_stand_first_or_last(tmp_path: Path) -> None:
    names = [f"im_{i:02}.png" for i in range(N)]
    first = load_poses(write(tmp_path, rows(WRITTEN["ros"], ",", names)), "ros")
    last = load_poses(write(tmp_path, "".join(f"{line} {name}\n" for line, name in zip(rows(MATRICES).splitlines(), names, strict=True))))
    for table in (first, last):
        check(table)
        assert table.labels == tuple(names)
        assert table.named(2) == "im_02.png"


@pytest.mark.parametrize("pattern", ["im[0{}].png", "[{}].jpg", "im*?{}.png", "cam[0][{}]"])
def test_brackets_and_other_signs_of_a_name_are_its_own(tmp_path: Path, pattern: str) -> None:
    names = [pattern.format(i) for i in range(N)]
    for mark in (",", " "):
        table = load_poses(write(tmp_path, rows(WRITTEN["ros"], mark, names)), "ros")
        check(table)
        assert table.labels == tuple(names)
    assert match_images(table, names[::-1]).pose.tolist() == list(range(N))


def test_brackets_take_no_time(tmp_path: Path) -> None:
    start = time.thread_time()
    for line in ("[" * 8000, "[a]" * 2700, "a" * 8000 + "[", "a[" * 4000):
        refused(lambda line=line: load_poses(write(tmp_path, f"{line}\n"), "ros"))
    assert time.thread_time() - start < 1.0


def test_a_counter_in_front_is_no_number_of_the_pose(tmp_path: Path) -> None:
    def counted(fmt: str) -> Path:
        return write(tmp_path, rows(np.hstack([np.arange(1, N + 1)[:, None], WRITTEN[fmt]])))

    check(table := load_poses(counted("kuka-abc"), "kuka-abc"))
    assert table.labels == ("1", "2", "3", "4", "5")
    check(load_poses(counted("matrix")))
    assert "--pose-format tum or ros or abb-quat" in refused(lambda: load_poses(counted("ros")))
    check(load_poses(counted("ros"), "ros"))


def entries(kind: str) -> list[Any]:
    xyz, xyzw = P.tolist(), XYZW.tolist()
    both = list(zip(xyz, xyzw, strict=True))
    made: dict[str, Callable[[], list[Any]]] = {
        "matrices": lambda: poses().tolist(),
        "flat": lambda: MATRICES.tolist(),
        "position, orientation": lambda: [
            {"position": dict(zip("xyz", p, strict=True)), "orientation": dict(zip("xyzw", q, strict=True))} for p, q in both
        ],
        "around": lambda: [{"pose": {"translation": p, "quaternion_xyzw": q}, "joints": [0.1] * 6} for p, q in both],
        "wxyz": lambda: [{"translation": p, "rotation_wxyz": [q[3], *q[:3]]} for p, q in both],
        "translation, matrix": lambda: [{"translation": p, "rotation": M} for p, M in zip(xyz, R.as_matrix().tolist(), strict=True)],
        "named matrix": lambda: [{"image": f"im_{i}.png", "pose": T} for i, T in enumerate(poses().tolist())],
        "T": lambda: [{"file": f"im_{i}.png", "T_base_gripper": T} for i, T in enumerate(poses()[:, :3].tolist())],
        "numbers": lambda: [dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*p, *q], strict=True)) for p, q in both],
        "abc": lambda: [dict(zip("XYZABC", row, strict=True)) for row in WRITTEN["kuka-abc"].tolist()],
        "rotvec": lambda: [{"position": p, "rotvec": r} for p, r in zip(xyz, R.as_rotvec().tolist(), strict=True)],
    }
    return made[kind]()


@pytest.mark.parametrize("name", ["poses.json", "poses.yaml", "poses.txt"])
@pytest.mark.parametrize(
    "kind",
    [
        *("matrices", "flat", "position, orientation", "around", "wxyz", "translation, matrix"),
        *("named matrix", "T", "numbers", "abc", "rotvec"),
    ],
)
def test_lists_of_yaml_and_json(tmp_path: Path, kind: str, name: str) -> None:
    data = {"poses": entries(kind)}
    content = yaml.safe_dump(data) if name.endswith("yaml") else json.dumps(data, indent="\t")
    table = load_poses(write(tmp_path, content, name))
    check(table)
    assert (table.labels is not None) == (kind in ("named matrix", "T"))
    if not name.endswith("txt"):
        check(load_poses(write(tmp_path, json.dumps(data["poses"]), name)))


def test_yaml_may_name_a_pose_each(tmp_path: Path) -> None:
    for kind in ("matrices", "position, orientation", "flat"):
        data = {f"im_{i}.png": entry for i, entry in enumerate(entries(kind))}
        for content in (data, {"poses": data}):
            table = load_poses(write(tmp_path, yaml.safe_dump(content), "poses.yaml"))
            check(table)
            assert table.labels == tuple(data)


def test_yaml_states_its_unit_and_its_times(tmp_path: Path) -> None:
    mm = [
        {"t": 1 + i, "position": (1000 * p).tolist(), "quaternion_xyzw": q.tolist()} for i, (p, q) in enumerate(zip(P, XYZW, strict=True))
    ]
    table = load_poses(write(tmp_path, yaml.safe_dump({"unit": "mm", "poses": mm}), "poses.yaml"))
    check(table)
    assert table.t_ns is not None
    assert table.t_ns[1] == 2 * 10**9


def test_lists_without_an_order_are_asked_for(tmp_path: Path) -> None:
    lists = [{"position": p, "orientation": q} for p, q in zip(P.tolist(), XYZW.tolist(), strict=True)]
    path = write(tmp_path, json.dumps(lists), "poses.json")
    assert "--pose-format ros or abb-quat" in refused(lambda: load_poses(path))
    check(load_poses(path, "ros"))
    angles = [{"orientation": a, "position": p} for a, p in zip(R.as_euler("xyz").tolist(), P.tolist(), strict=True)]
    path = write(tmp_path, json.dumps(angles), "poses.json")
    assert "rpy or kuka-abc or fanuc-wpr or ur-rotvec" in refused(lambda: load_poses(path))
    check(load_poses(path, "rpy"))


def changed(fmt: str, row: int, column: int, value: float | str) -> str:
    table = [line.split() for line in rows(WRITTEN[fmt]).splitlines()]
    table[row][column] = str(value)
    return "\n".join(map(" ".join, table))


@pytest.mark.parametrize(
    ("content", "fmt", "words"),
    [
        (rows(WRITTEN["ros"]), None, ["fit ros (x y z qx qy qz qw in m) and abb-quat (x y z qw", "--pose-format ros or abb-quat"]),
        (rows(WRITTEN["kuka-abc"]), None, ["6 numbers", "--pose-format rpy or kuka-abc or fanuc-wpr or ur-rotvec"]),
        (rows(WRITTEN["kuka-abc"]), "ros", ["6 numbers", "ros has 7", "check the file"]),
        (rows(WRITTEN["ros"]), "kuka", ["--pose-format kuka", "use one of ros, tum"]),
        (rows(np.ones((3, 9))), None, ["9 numbers", "wanted are 16 or 12"]),
        (rows(MATRICES), "matrix-columns", ["line 1", "0 0 0 1"]),
        (rows(WRITTEN["matrix-columns"]), "matrix", ["line 1", "(matrix-columns)"]),
        (changed("ros", 2, 5, 0.9), "ros", ["line 3", "quaternion", "length 1.", "leave this pose out"]),
        (changed("matrix", 3, 0, 0.9), None, ["line 4", "no rotation", "leave this pose out"]),
        (changed("matrix", 3, 13, 0.5), None, ["line 4", "0 0 0 1"]),
        (rows(MATRICES * np.where(np.arange(16) % 4 == 1, -1, 1)), None, ["line 1", "determinant -1", "right-handed"]),
        (changed("matrix", 1, 3, "nan"), None, ["line 2", "nan", "leave this pose out"]),
        (changed("matrix", 1, 3, "-inf"), None, ["line 2", "inf"]),
        (changed("matrix", 1, 3, "1e300"), None, ["line 2", "1e+300"]),
        (changed("matrix", 1, 3, "1_0"), None, ["line 2", "'1_0' is not a number"]),
        (changed("matrix", 1, 3, "\x1b[31m"), None, ["line 2"]),
        (changed("matrix", 1, 3, ""), None, ["line 2", "has 15 columns", "16"]),
        (rows(MATRICES, ",").replace(",0,0,0,1", ",0,,0,1", 1), None, ["line 1", "a field is empty"]),
        (rows(poses()[0, :3]), None, ["line 3", "blocks of 4"]),
        (rows(poses()[0, :2]) + "im.png\n" + rows(poses()[0, 2:]), None, ["line 4", "within a block"]),
        (rows(np.hstack([1000 * P, XYZW])), "ros", ["looks like mm: add --pose-unit mm"]),
        (rows(MATRICES + 1000 * np.isin(np.arange(16), [3, 7, 11])), None, ["looks like mm: add --pose-unit mm"]),
        (rows(np.hstack([P, ANGLES_DEG])), "kuka-abc", ["looks like m: add --pose-unit m"]),
        (rows(np.hstack([P, ANGLES_DEG])), "rpy", ["line 4", "looks like degrees: add --angle-unit deg"]),
        (rows(np.hstack([P, ANGLES_DEG])), "ur-rotvec", ["looks like degrees: add --angle-unit deg"]),
        (rows(np.hstack([1000 * P, np.radians(ANGLES_DEG)])), "kuka-abc", ["looks like radians: add --angle-unit rad"]),
        (rows(np.hstack([ANGLES_DEG, 1000 * P])), "kuka-abc", ["more than a turn", "order of the columns"]),
        (rows(WRITTEN["ros"]).replace(".", ","), "ros", ["line 1", "decimal commas", "decimal points"]),
        ("1,5;2,5;0,5\n", None, ["decimal commas"]),
        ("x,y,z,qx,qy,qz,qw,t\n" + rows(WRITTEN["ros"], ","), None, ["line 1", "header", "names 8 columns, and the rows have 7"]),
        ("px,py,pz,x,y,z,w\n" + rows(WRITTEN["ros"], ","), None, ["line 1", "names x twice", "remove it"]),
        ("x,y,z,x,qy,qz,qw\n" + rows(WRITTEN["ros"], ","), None, ["line 1", "names x twice"]),
        ("x,y,z,qx,qy,qz,other\n" + rows(WRITTEN["ros"], ","), None, ["x y z qx qy qz", "one whole rotation"]),
        ("x,y,z,roll,pitch,yaw\n" + rows(WRITTEN["rpy"], ","), "kuka-abc", ["named roll pitch yaw", "not kuka-abc"]),
        ("x,y,z,qx,qy,qz,qw\n" + rows(WRITTEN["ros"], ","), "tum", ["no time column"]),
        ("x [inch],y [inch],z [inch],qx,qy,qz,qw\n" + rows(WRITTEN["ros"], ","), None, ["inch", "use one of m, cm, mm"]),
        ("t [h],x,y,z,qx,qy,qz,qw\n" + rows(WRITTEN["tum"], ","), None, ["time column"]),
        ("x,y,z,qx,qy,qz,qw\n" + rows(WRITTEN["ros"], ",") + "and so on, and on\n", None, ["line 7", "no row of numbers"]),
        ("x,y,z,qx,qy,qz,qw,file\n1,2,3,0,0,one,1,a.png\n", None, ["line 2", "'one' is not a number"]),
        ("28\n" + rows(MATRICES), None, ["line 1", "1 columns are no pose", "remove this line"]),
        ("x" * 10_000 + "\n", None, ["line 1", "8192 characters"]),
        (b" " * 20_000_000, None, ["larger than 16000000 bytes"]),
        ("# nothing\n\n", None, ["holds no poses"]),
        ("", None, ["holds no poses"]),
        (b"\x00\x01\x02", None, ["not UTF-8 text"]),
        (b"1 2 3 \xff\n", None, ["not UTF-8 text"]),
    ],
)
def test_each_fault_is_one_line_with_its_remedy(tmp_path: Path, content: str | bytes, fmt: str | None, words: list[str]) -> None:
    message = refused(lambda: load_poses(write(tmp_path, content), fmt))
    for word in words:
        assert word in message
    assert "poses.txt" in message or "--pose-format" in message


def test_more_rows_than_any_robot_wrote_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert pose_rows._MAX_ROWS == 500_000
    monkeypatch.setattr(pose_rows, "_MAX_ROWS", 50)
    text = rows(np.tile(WRITTEN["ros"], (10, 1)))
    assert len(load_poses(write(tmp_path, text), "ros", "m").poses) == 50
    assert "50 rows" in refused(lambda: load_poses(write(tmp_path, text + "1 2 3 0 0 0 1\n"), "ros", "m"))


def test_translations_alone_fit_rows_and_columns_where_they_are_zero(tmp_path: Path) -> None:
    T = poses()
    T[:, :3, 3] = 0
    path = write(tmp_path, rows(T.reshape(N, 16)))
    assert "--pose-format matrix or matrix-columns" in refused(lambda: load_poses(path))
    np.testing.assert_allclose(load_poses(path, "matrix").poses, T, atol=1e-12)
    np.testing.assert_allclose(load_poses(path, "matrix-columns").poses, np.swapaxes(T, 1, 2), atol=1e-12)


def test_stated_units_are_believed_or_contradicted(tmp_path: Path) -> None:
    far: Array = np.hstack([P + np.array([2000, 0, 0]), XYZW])
    assert load_poses(write(tmp_path, rows(far)), "ros", "m").poses[0, 0, 3] == pytest.approx(2000.4)
    path = write(tmp_path, "x [mm],y [mm],z [mm],qx,qy,qz,qw\n" + rows(far, ","))
    assert "says that x, y, z are in mm, and --pose-unit says m" in refused(lambda: load_poses(path, None, "m"))
    assert "--pose-unit inch" in refused(lambda: load_poses(path, None, "inch"))
    small = write(tmp_path, rows(np.hstack([1000 * P, ANGLES_DEG / 60])))
    assert "--angle-unit rad (or deg if it is deg)" in refused(lambda: load_poses(small, "kuka-abc"))
    np.testing.assert_allclose(
        load_poses(small, "kuka-abc", None, "deg").poses[:, :3, :3], from_zyx(np.radians(ANGLES_DEG / 60)), atol=1e-12
    )


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([{"position": [1, 2, 3]}], ["0: holds no pose", "wanted are {position"]),
        ([{"position": [1, 2, 3], "orientation": [0, 0, 0, "w"]}], ["0.orientation", "'w' is not a number"]),
        ([{"a": {"x": 1, "y": 2, "z": 3}}, 5], ["wanted"]),
        ([entries("flat")[0], entries("numbers")[0]], ["names x y z qx", "the first pose has 16 numbers"]),
        ([[*WRITTEN["matrix"][0].tolist()], [1.0] * 15], ["has 15 numbers, and the first pose has 16"]),
        ({"a": entries("flat"), "b": entries("flat")}, ["a second list of poses beside a"]),
        ([{"robot": entries("matrices")[0], "camera": entries("matrices")[0]}], ["a second pose beside"]),
        ([{"pose": entries("numbers")[0], "x": 1}], ["names x twice"]),
        ({"version": 1}, ["holds no poses"]),
        ({"poses": [], "unit": "m"}, ["holds no poses"]),
        ([[]], ["holds no poses"]),
        ([True], ["'True' is not a number"]),
        ([[1e999] * 16], ["inf"]),
    ],
)
def test_each_fault_of_a_document_is_one_line(tmp_path: Path, data: object, words: list[str]) -> None:
    message = refused(lambda: load_poses(write(tmp_path, yaml.safe_dump(data), "poses.yaml")))
    for word in ("poses.yaml", *words):
        assert word in message


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    refused(lambda: load_poses(tmp_path))
    refused(lambda: load_poses(tmp_path / "absent.txt"))
    refused(lambda: load_poses(tmp_path / "absent.json"))


def test_pairs_are_two_files_or_two_poses_a_row(tmp_path: Path) -> None:
    other = np.asarray(np.linalg.inv(poses()), np.float64)
    first, second = write(tmp_path, rows(MATRICES), "a.txt"), write(tmp_path, rows(other.reshape(N, 16)), "b.txt")
    one = write(tmp_path, rows(np.hstack([MATRICES, other.reshape(N, 16)])), "c.txt")
    counted = write(tmp_path, rows(np.hstack([np.arange(N)[:, None], MATRICES, other.reshape(N, 16)])), "d.txt")
    lists = write(tmp_path, json.dumps([[a, b] for a, b in zip(poses().tolist(), other.tolist(), strict=True)]), "e.json")
    keys = write(tmp_path, json.dumps({"B": other.tolist(), "A": poses().tolist()}), "f.json")
    each = write(tmp_path, json.dumps([{"b": b, "a": a} for a, b in zip(poses().tolist(), other.tolist(), strict=True)]), "g.json")
    for pair in (load_pose_pairs(first, second), *map(load_pose_pairs, (one, counted, lists, keys, each))):
        check(pair[0])
        np.testing.assert_allclose(pair[1].poses, other, atol=1e-12)
    assert load_pose_pairs(counted)[1].labels == ("0", "1", "2", "3", "4")


def test_pairs_of_other_formats_need_it_said(tmp_path: Path) -> None:
    path = write(tmp_path, rows(np.hstack([WRITTEN["abb-quat"], WRITTEN["abb-quat"]])))
    assert "--pose-format" in refused(lambda: load_pose_pairs(path))
    for table in load_pose_pairs(path, fmt="abb-quat"):
        check(table)
    twelve = write(tmp_path, rows(np.hstack([WRITTEN["kuka-abc"], WRITTEN["kuka-abc"]])))
    assert "two poses a row" in refused(lambda: load_pose_pairs(twelve))
    for table in load_pose_pairs(twelve, fmt="kuka-abc"):
        check(table)


def test_pairs_that_are_none_are_refused(tmp_path: Path) -> None:
    one = write(tmp_path, rows(MATRICES), "one.txt")
    fewer = write(tmp_path, rows(MATRICES[:3]), "fewer.txt")
    assert "give two files" in refused(lambda: load_pose_pairs(one))
    assert "has 5 poses and" in refused(lambda: load_pose_pairs(one, fewer))
    names = [f"{i}.png" for i in range(N)]
    ahead = load_poses(write(tmp_path, rows(MATRICES, " ", names), "ahead.txt"))
    behind = load_poses(write(tmp_path, rows(MATRICES, " ", names[::-1]), "behind.txt"))
    assert "pair 1 is 0.png in" in refused(lambda: join_tables(ahead, behind))
    uneven = write(tmp_path, rows(np.hstack([MATRICES[::-1, :1], MATRICES, MATRICES])), "uneven.txt")
    assert "neither a counter nor a time" in refused(lambda: load_pose_pairs(uneven))
    assert "no pair of poses" in refused(lambda: load_pose_pairs(write(tmp_path, json.dumps(entries("matrices")), "one.json")))


def table_of(tmp_path: Path, labels: list[str] | None) -> PoseTable:
    return load_poses(write(tmp_path, rows(MATRICES, ",", labels)))


@pytest.mark.parametrize(
    ("labels", "images", "pairs", "says"),
    [
        (
            ["a/c.png", "b.png", "x.png", "a.png", "y.png"],
            ["a.png", "b.png", "c.png"],
            [(0, 2), (1, 1), (3, 0)],
            "3 poses found by file name",
        ),
        (["c", "b", "x", "a", "y"], ["a.png", "b.png", "d.png"], [(1, 1), (3, 0)], "left out: 3 poses without an image, 1 image without"),
        (["1", "2", "3", "5", "6"], [f"im_{i:02}.png" for i in range(1, 7)], [(0, 0), (1, 1), (2, 2), (3, 4), (4, 5)], "by the number"),
        (["p1", "p2", "p3", "p5", "p6"], [f"im_{i}.png" for i in range(1, 7)], [(0, 0), (1, 1), (2, 2), (3, 4), (4, 5)], "by the number"),
        (["0", "1", "2", "3", "4"], [f"im_{i}.png" for i in range(1, 6)], [(i, i) for i in range(5)], "in their order"),
        (None, [f"im_{i}.png" for i in range(5)], [(i, i) for i in range(5)], "5 poses and as many images are paired in their order"),
        (["1.5", "2.5", "3.5", "4.5", "5.5"], ["1.5.png", "4.5.png"], [(0, 0), (3, 1)], "2 poses found"),
    ],
)
def test_images_find_their_poses(
    tmp_path: Path, labels: list[str] | None, images: list[str], pairs: list[tuple[int, int]], says: str
) -> None:
    if labels and labels[0] == "1.5":  # stamps that are names
        labels = [f"{label}.png" for label in labels]
    matches = match_images(table_of(tmp_path, labels), images)
    assert list(zip(matches.pose.tolist(), matches.image.tolist(), strict=True)) == pairs
    assert says in matches.how


@pytest.mark.parametrize(
    ("labels", "images", "words"),
    [
        (None, ["a.png"], ["has 5 poses and there are 1 image"]),
        (None, [], ["has 5 poses and there are 0 images"]),
        (["0", "1", "2", "3", "4"], ["im_1.png", "im_2.png"], ["has 5 poses and there are 2 images"]),
        (["a.png", "b.png", "c.png", "d.png", "e.png"], ["im_1.png"] * 5, ["names no image", "im_1.png"]),
        (["a.png", "b.png", "c.png", "d.png", "e.png"], [], ["names no image", "none"]),
        (["a.png", "b.png", "a.png", "d.png", "e.png"], ["a.png", "b.png"], ["line 3: a.png", "line 1"]),
        (["a", "b", "c", "d", "e"], ["a.png", "a.jpg"], ["line 1: a", "fits 2 images"]),
    ],
)
def test_images_without_their_poses_are_refused(tmp_path: Path, labels: list[str] | None, images: list[str], words: list[str]) -> None:
    message = refused(lambda: match_images(table_of(tmp_path, labels), images))
    for word in words:
        assert word in message


def test_a_real_robots_file_reads_with_and_without_its_format(data_dir: Path) -> None:
    path = data_dir / "kuka2/RobotPosesVec.txt"
    wanted = np.loadtxt(path).reshape(-1, 4, 4)
    for fmt in (None, "matrix"):
        np.testing.assert_allclose(load_poses(path, fmt).poses, wanted, atol=1e-8)


def test_a_real_trackers_file_reads(data_dir: Path) -> None:
    table = load_poses(data_dir / "pose_streams/vicon_hand.csv")
    assert table.format == "tum"
    assert table.t_ns is not None
    assert table.t_ns[0] == 1491754390_480000000


TEXTS = [
    *(rows(WRITTEN[fmt], mark) for fmt in ("matrix", "tum", "ros", "kuka-abc") for mark in (" ", ",")),
    "t,x,y,z,qx,qy,qz,qw\n" + rows(WRITTEN["tum"], ","),
    "\n".join(f"im_{i}.png\n{rows(T)}" for i, T in enumerate(poses())),
]
FORMAT = st.sampled_from([None, *FORMATS])
FUZZ = settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])


def check_read(path: Path, fmt: str | None, images: list[str]) -> None:
    table = read_or_refused(lambda: load_poses(path, fmt))
    if table is not None:
        turn = table.poses[:, :3, :3]
        assert np.isfinite(table.poses).all()
        np.testing.assert_allclose(np.swapaxes(turn, 1, 2) @ turn, np.tile(np.eye(3), (len(turn), 1, 1)), atol=1e-9)
        read_or_refused(lambda: match_images(table, images))
    read_or_refused(lambda: load_pose_pairs(path, fmt=fmt))


@FUZZ
@given(
    content=st.sampled_from(TEXTS),
    places=st.lists(
        st.tuples(st.floats(0, 1), st.binary(max_size=6) | st.sampled_from([b"nan", b",", b"\n", b"-", b"1e309", b"[", b"e.png "])),
        max_size=4,
    ),
    fmt=FORMAT,
)
def test_mutated_text_is_read_or_refused_in_one_line(
    tmp_path: Path, content: str, places: list[tuple[float, bytes]], fmt: str | None
) -> None:
    out = bytearray(content.encode())
    for where, change in places:
        at = int(where * len(out))
        out[at : at + len(change) // 2] = change
    check_read(write(tmp_path, bytes(out)), fmt, ["im_0.png", "im_1.png"])


DOCUMENTS = [
    yaml.safe_dump({"unit": "m", "poses": entries(kind)[:2]})
    for kind in ("matrices", "position, orientation", "around", "named matrix", "numbers", "rotvec")
]


@FUZZ
@given(content=st.sampled_from(DOCUMENTS).flatmap(mutated), fmt=FORMAT)
def test_mutated_documents_are_read_or_refused_in_one_line(tmp_path: Path, content: bytes, fmt: str | None) -> None:
    check_read(write(tmp_path, content, "poses.yaml"), fmt, ["im_0.png", "im_1.png"])
