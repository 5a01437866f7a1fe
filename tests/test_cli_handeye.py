"""`calibkit handeye` from the command line: every input, every setup, what is open and what is wrong told, one line for every mistake."""

import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from commands import Run, Said
from numpy.typing import NDArray
from recording_helper import Make, write

from calibkit.data.rig import Camera, Estimate, Rig
from calibkit.data.verdict import Status, Verdict
from calibkit.geometry import se3, so3
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.io.target_file import dump_target
from calibkit.models.board import AprilGrid
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.simulation.camera import SimCamera, random_board_poses
from calibkit.simulation.corners import views_of_poses
from calibkit.simulation.render import Renderer

Array = NDArray[np.float64]

X = se3.make(so3.exp(np.array([0.3, -0.8, 1.2])), np.array([0.05, -0.08, 0.12]))
Z = se3.make(so3.exp(np.array([2.5, 0.4, -0.3])), np.array([0.9, 0.2, 0.1]))
SIGMA_P, SIGMA_R = 3e-4, 4e-4  # of a robot's pose
N = 24
CAMERA = SimCamera(CAMERAS["pinhole-radtan"], np.array([322.0, 320.5, 246.0, 161.0, -0.25, 0.06, 2e-4, -3e-4]), (480, 320))
BOARD = AprilGrid(4, 4, 0.12, 0.3)
START_S = 1_700_000_000


@pytest.fixture
def run(run: Run) -> Run:
    return partial(run, "handeye")


# What was recorded, and in which files.


def noisy(T: Array, rng: np.random.Generator, sigma_p: float = SIGMA_P, sigma_R: float = SIGMA_R) -> Array:
    return se3.retract(T, np.concatenate([sigma_p * rng.normal(size=(len(T), 3)), sigma_R * rng.normal(size=(len(T), 3))], axis=1))


def arm(rng: np.random.Generator, n: int = N, angle: float = 0.5) -> Array:
    """T_base_gripper of a robot that turns about everything."""
    return se3.make(so3.exp(angle * rng.normal(size=(n, 3))), np.array([0.5, 0.0, 0.6]) + 0.2 * rng.normal(size=(n, 3)))


def in_hand(G: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """T_base_gripper and T_cam_target as seen, the camera on the gripper."""
    return noisy(G, rng), noisy(se3.inverse(G @ X) @ Z, rng)


def beside(G: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """The same with the camera beside the robot: X = T_base_cam, Z = T_gripper_target."""
    return noisy(G, rng), noisy(se3.inverse(X) @ G @ Z, rng)


def rows(path: Path, T: Array, labels: list[str] | None = None) -> Path:
    text = [" ".join(f"{x:.9f}" for x in pose.ravel()) for pose in T]
    path.write_text("".join(f"{labels[i]} {line}\n" if labels else f"{line}\n" for i, line in enumerate(text)))
    return path


class Pairs:
    """Two files of poses, and the command's words for them."""

    def __init__(self, folder: Path, first: Array, second: Array) -> None:
        self.asked = ("--pairs", rows(folder / "arm.txt", first), "--pairs", rows(folder / "board.txt", second), "--pose-format", "matrix")


def facts(path: Path) -> dict:
    found = json.loads(path.read_text())["facts"]["handeye"]["hand_eye"]
    [only] = found.values()
    return only


def assert_found(rig: Path, name: str = "T_gripper_cam", truth: Array = X, within: float = 1e-3) -> None:
    entry = load_rig(rig).transforms[name]
    assert entry.status is Status.DETERMINED
    assert entry.covariance is not None
    off, sigma = se3.local(truth, np.array(entry.matrix)), np.sqrt(np.diag(entry.covariance.matrix))
    assert np.all(np.abs(off) < 4.5 * sigma), (off, sigma)
    assert sigma.max() < within
    np.testing.assert_allclose(np.array(entry.inverse_matrix) @ truth, np.eye(4), atol=5 * within)


# Pairs.


def test_pairs_to_a_rig_file_with_its_residuals_report_and_json(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pairs = Pairs(tmp_path, *in_hand(arm(rng), rng))
    rig, report, js = tmp_path / "rig.yaml", tmp_path / "report", tmp_path / "h.json"
    said = run(*pairs.asked, "-o", rig, "--report", report, "--json", js, "--predict", "40")
    assert said.code == 0, said
    assert re.search(r"with 40 more good poses: p to \([\d.]+, [\d.]+, [\d.]+\) mm, R to", said.out)
    assert_found(rig)
    assert_found(rig, "T_base_target", Z, within=2e-3)
    kept = load_rig(rig)
    assert kept.transforms["T_gripper_cam"].equation == "p_gripper = T_gripper_cam p_cam"
    assert kept.transforms["T_gripper_cam"].inverse_name == "T_cam_gripper"
    assert kept.transforms["T_gripper_cam"].verdict is Verdict.CHECK  # until --setup is given
    assert "confirm it with --setup eye-in-hand" in kept.transforms["T_gripper_cam"].reasons[0]
    assert run(*pairs.asked, "--setup", "eye-in-hand", "-o", tmp_path / "told.yaml").code == 0
    assert load_rig(tmp_path / "told.yaml").transforms["T_gripper_cam"].verdict is Verdict.PASS
    assert kept.provenance[-1].options["setup"] == "eye-in-hand"
    assert "eye-in-hand (the camera on the gripper): it fits" in said.out
    assert "24 of 24 poses used" in said.out
    p = re.search(r"p = \(([-+.\d]+), ([-+.\d]+), ([-+.\d]+)\) \+- ", said.out)
    assert p
    np.testing.assert_allclose([float(v) for v in p.groups()], 1e3 * X[:3, 3], atol=1.0)
    found = facts(js)
    assert set(found["methods"]) == {"tsai", "park", "horaud", "andreff", "daniilidis", "shah", "li"}
    assert all(re.search(rf"^{name} +[\d.]+ +[\d.]+ +[\d.]+ +[\d.]+", said.out, re.MULTILINE) for name in found["methods"])
    assert found["predict"]["sigma_p"] < 0.8 * np.sqrt(np.linalg.eigvalsh(np.array(found["X_covariance"])[:3, :3])[-1])
    assert found["poses_kept"] == N
    assert len(found["residuals"]["angle"]) == N
    assert found["scatter"]["distance"] < 2e-3
    made = {path.name for path in report.rglob("*.*")}
    assert {f"T_gripper_cam-handeye-{key}.png" for key in ("pose_residuals", "rotation_axes", "cross_sections", "poses_in_space")} <= made
    assert "daniilidis" in (report / "report.html").read_text()


def test_the_camera_beside_the_robot_cannot_be_told_from_two_sensors(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    pairs = Pairs(tmp_path, *beside(arm(rng), rng))
    assert "give --setup eye-to-hand or motion" in run(*pairs.asked).mistake
    rig = tmp_path / "rig.yaml"
    assert run(*pairs.asked, "--setup", "eye-to-hand", "--base", "robot", "-o", rig).code == 0
    assert_found(rig, "T_robot_cam", X, within=2e-3)
    assert_found(rig, "T_gripper_target", Z)


def test_two_sensors_and_their_motions(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    G = arm(rng, 40)
    first, second = noisy(G, rng), noisy(se3.inverse(Z) @ G @ X, rng)
    rig = tmp_path / "rig.yaml"
    assert run(*Pairs(tmp_path, first, second).asked, "--setup", "motion", "-o", rig).code == 0
    assert_found(rig, "T_sensor1_sensor2")
    A, B = (se3.inverse(T[:-1]) @ T[1:] for T in (first, second))
    assert run(*Pairs(tmp_path, A, B).asked, "--motions", "-o", rig, "--force").code == 0
    assert_found(rig, "T_sensor1_sensor2", within=3e-3)


def test_poses_the_other_way_round_are_told(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    first, second = in_hand(arm(rng), rng)
    pairs = Pairs(tmp_path, se3.inverse(first), second)
    said = run(*pairs.asked, "--setup", "eye-in-hand")
    assert said.code in (1, 3)
    assert re.search(r"FAIL +T_gripper_cam: --setup eye-to-hand .*--inverse-poses\), fits \d+ times better", said.out)
    assert "FAIL  T_gripper_cam: --setup" in re.split(r"^FAIL$", said.out, flags=re.MULTILINE)[1].splitlines()[1]  # the first reason
    assert "add poses" not in said.out  # the poses are not the fault
    assert "lengths times" not in said.out
    assert run(*pairs.asked, "--setup", "eye-in-hand", "--inverse-poses", "-o", tmp_path / "rig.yaml").code == 0
    assert_found(tmp_path / "rig.yaml")


def test_what_is_wrong_with_a_pose_is_guessed(run: Run, tmp_path: Path) -> None:
    """Two poses exchanged, a board read upside down, a board that was moved for three images, and nonsense: X stays, all are named."""
    rng = np.random.default_rng(4)
    first, second = in_hand(arm(rng, 40), rng)
    wrong = second.copy()
    wrong[[3, 7]] = second[[7, 3]]
    wrong[11] = second[11] @ se3.make(so3.exp(np.array([0, 0, np.pi])), np.array([0.3, 0.2, 0]))
    wrong[20:23] = second[20:23] @ se3.make(so3.exp(np.array([0, 0.02, 0.1])), np.array([0.03, 0.01, 0]))
    wrong[30] = se3.retract(second[30], np.array([0.01, -0.02, 0.03, 0.2, -0.1, 0.1]))
    labels = [f"im_{k:02}.png" for k in range(40)]
    asked = (
        "--pairs",
        rows(tmp_path / "a.txt", first, labels),
        "--pairs",
        rows(tmp_path / "b.txt", wrong, labels),
        "--pose-format",
        "matrix",
    )
    rig, js = tmp_path / "rig.yaml", tmp_path / "h.json"
    said = run(*asked, "-o", rig, "--json", js)
    assert said.code == 0, said
    assert_found(rig)
    guesses = {entry["pose"]: entry["guess"] for entry in facts(js)["left_out"]}
    assert set(guesses) == {labels[k] for k in (3, 7, 11, 20, 21, 22, 30)}
    assert guesses["im_03.png"] == "it fits the pose of im_07.png: are poses and images paired wrongly?"
    assert "half turn" in guesses["im_11.png"]
    assert "moved as in" in guesses["im_20.png"]
    assert "not of one moment" in guesses["im_30.png"]
    assert "7 of 40 poses do not fit the others and are left out" in said.out
    assert load_rig(rig).transforms["T_gripper_cam"].verdict is Verdict.CHECK
    assert run(*asked, "--strict").code == 1


def test_files_out_of_step_and_a_wrong_board_size_are_told(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    first, second = in_hand(arm(rng), rng)
    said = run(*Pairs(tmp_path, first[1:], second[:-1]).asked, "--setup", "eye-in-hand")
    assert said.code in (1, 3)
    assert "fit the first side's 1 row before their own far better: the files are out of step" in said.out
    for factor, told in ((1.03, "times 0.97"), (1000.0, "the board's size is in mm")):
        large = second.copy()
        large[:, :3, 3] *= factor
        said = run(*Pairs(tmp_path, first, large).asked, "--pose-unit", "m")
        assert said.code in (1, 3), said
        assert told in said.out


def test_poses_of_another_convention_are_told_by_their_places(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(14)
    first, second = in_hand(arm(rng), rng)
    first[:, :3, 3] = first[:, [1, 2, 0], 3] * [1, -1, 1]  # as if the columns were others: the turns are as they were
    said = run(*Pairs(tmp_path, first, second).asked, "--setup", "eye-in-hand")
    assert said.code in (1, 3)
    reasons = re.split(r"^FAIL$", said.out, flags=re.MULTILINE)[1].splitlines()
    assert "the angles between poses agree and their places do not" in reasons[1]
    assert "--pose-format" in reasons[1]
    assert "add poses" not in said.out


def test_one_axis_leaves_the_translation_along_it_open(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    t = np.linspace(-1, 1, 24)
    turned = se3.make(
        so3.exp(t[:, None] * np.array([0, 0, 1.0])), np.stack([0.5 + 0.1 * np.cos(3 * t), 0.1 * np.sin(5 * t), t / 9], axis=1)
    )
    rig, js = tmp_path / "rig.yaml", tmp_path / "h.json"
    said = run(*Pairs(tmp_path, *in_hand(turned, rng)).asked, "--setup", "eye-in-hand", "-o", rig, "--json", js)
    assert said.code == 3, said
    entry = load_rig(rig).transforms["T_gripper_cam"]
    assert entry.status is Status.NOT_OBSERVABLE
    assert entry.verdict is Verdict.FAIL
    assert "not observable: p of T_gripper_cam along the gripper's z axis" in entry.reasons[0]
    assert re.search(r"add poses tilted about the gripper's [xy] axis by 30 deg or more", entry.reasons[0])
    values = {row["name"]: row["value"] for row in json.loads(js.read_text())["parameters"] if row["part"] == "T_gripper_cam"}
    assert {name for name, value in values.items() if value is None} == {"p_z"}
    assert {name for name, status in entry.statuses.items() if status is Status.NOT_OBSERVABLE} == {"p_z"}
    assert json.loads(js.read_text())["not_observable"][0] == "T_gripper_cam.p_z"
    assert re.search(r"^T_gripper_cam p_z +not observable +m +not observable$", said.out, re.MULTILINE)
    # What is known is said all the same, and right.
    known = re.search(
        r"in gripper's axes: ([-+.\d]+) \+- ([.\d]+) mm along x; ([-+.\d]+) \+- ([.\d]+) mm along y; the rest is not known", said.out
    )
    assert known
    x, sigma_x, y, sigma_y = (float(v) for v in known.groups())
    assert abs(x - 50) < 4 * sigma_x < 4
    assert abs(y + 80) < 4 * sigma_y < 4
    assert re.search(r"R = exp\(", said.out)


@pytest.mark.parametrize("what", ["translation", "rest"])
def test_without_turns_p_is_not_known(run: Run, tmp_path: Path, what: str) -> None:
    rng = np.random.default_rng(7)
    G = np.broadcast_to(np.eye(4), (20, 4, 4)).copy()
    G[:, :3, 3] = 0.2 * rng.normal(size=(20, 3)) if what == "translation" else 0.5
    rig = tmp_path / "rig.yaml"
    said = run(*Pairs(tmp_path, *in_hand(G, rng)).asked, "--setup", "eye-in-hand", "-o", rig)
    assert said.code == 3, said
    assert "p of T_gripper_cam is not known" in said.out
    assert ("R = exp(" in said.out) == (what == "translation")
    assert load_rig(rig).transforms["T_gripper_cam"].status is Status.NOT_OBSERVABLE
    assert run("--pairs", tmp_path / "arm.txt", "--pairs", tmp_path / "board.txt", "--pose-format", "matrix").code in (2, 3)


def test_few_poses_are_told(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    first, second = in_hand(arm(rng), rng)
    assert "5 poses only" in run(*Pairs(tmp_path, first[:5], second[:5]).asked).out
    three = run(*Pairs(tmp_path, first[:3], second[:3]).asked, "--setup", "eye-in-hand")
    assert "3 poses only" in three.out
    assert "3 of 3 poses used" in three.out  # none of three is thrown out: nobody contradicts it
    two = run(*Pairs(tmp_path, first[:2], second[:2]).asked, "--setup", "eye-in-hand")
    assert two.code == 3
    assert "arm.txt, board.txt: hand-eye needs two poses at least and has 1" in run(*Pairs(tmp_path, first[:1], second[:1]).asked).mistake


def test_another_method_is_written_where_it_is_asked_for(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    pairs, rig, js = Pairs(tmp_path, *in_hand(arm(rng), rng)), tmp_path / "rig.yaml", tmp_path / "h.json"
    said = run(*pairs.asked, "--method", "park", "-o", rig, "--json", js)
    assert said.code == 0, said
    entry = load_rig(rig).transforms["T_gripper_cam"]
    np.testing.assert_allclose(entry.matrix, facts(js)["methods"]["park"]["X"], atol=1e-9)
    assert_found(rig)  # its own sigmas, as honest as the refined one's
    assert_found(rig, "T_base_target", Z, within=2e-3)
    assert "X by park as asked for" in said.out
    off = 1e3 * np.array(entry.matrix)[:3, 3]
    assert f"p = ({off[0]:+.2f}" in said.out  # what is printed is what is written


# Images, corners and streams.


def lens() -> Camera:
    names = CAMERA.model.parameter_names
    parameters = {name: Estimate(value=float(v), sigma=0.1, status=Status.DETERMINED) for name, v in zip(names, CAMERA.params, strict=True)}
    return Camera(resolution=CAMERA.size, model=CAMERA.model.name, parameters=parameters)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a board from a gripper, the gripper's poses in a file, the target and the lens."""
    folder = tmp_path_factory.mktemp("photos")
    (folder / "images").mkdir()
    rng = np.random.default_rng(10)
    seen = random_board_poses(CAMERA, BOARD, 14, rng, fill=(0.45, 0.8))
    renderer = Renderer(CAMERA, BOARD)
    for k, T in enumerate(seen):
        cv2.imwrite(str(folder / "images" / f"im_{k + 1:02}.png"), renderer.render(T, rng))
    rows(folder / "poses.txt", noisy(Z @ se3.inverse(seen) @ se3.inverse(X), rng))
    (folder / "target.yaml").write_text(dump_target(BOARD))
    save_rig(Rig(cameras={"cam0": lens()}), folder / "lens.yaml")
    return folder


def assert_near(rig: Path, name: str, truth: Array = X, p: float = 3e-3, R: float = 3e-3) -> None:
    off = se3.local(truth, np.array(load_rig(rig).transforms[name].matrix))
    assert np.linalg.norm(off[:3]) < p, off
    assert np.linalg.norm(off[3:]) < R, off


def test_images_and_a_robots_file(run: Run, photos: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    asked = (photos / "images", "--target", photos / "target.yaml", "--rig", photos / "lens.yaml")
    said = run(*asked, "--poses", photos / "poses.txt", "-o", rig, "--json", tmp_path / "h.json")
    assert said.code == 0, said
    assert_near(rig, "T_gripper_cam0")
    kept = load_rig(rig)
    assert kept.cameras == load_rig(photos / "lens.yaml").cameras
    assert "poses.txt: 14 poses and as many images are paired in their order" in said.out
    assert re.search(r"in the images: rms [\d.]+ px", said.out)
    assert facts(tmp_path / "h.json")["residuals"]["pose"][0] == "im_01.png"
    # the same by the lens that these images give, named poses in another order, one of them missing
    named = rows(
        tmp_path / "named.txt", np.loadtxt(photos / "poses.txt").reshape(-1, 4, 4)[::-1][1:], [f"im_{k:02}" for k in range(13, 0, -1)]
    )
    both = tmp_path / "both.yaml"
    said = run(*asked[:3], "--poses", named, "--model", "pinhole-radtan", "--base", "stand", "--gripper", "flange", "-o", both)
    assert said.code == 0, said
    assert "13 poses found by name without its ending; left out: 1 image without a pose" in said.out
    assert_near(both, "T_flange_cam0", p=1e-2, R=1e-2)
    assert load_rig(both).cameras["cam0"].parameters["fx"].value == pytest.approx(322.0, rel=0.01)


def recorded(folder: Path, setup: str, dt: float = 0.0) -> tuple[Path, Path, Path, Path]:
    """A corner file and a robot's stream of a moving rig, on clocks dt apart: t_robot = t_cam + dt."""
    rng = np.random.default_rng(11)
    t = np.arange(0, 10, 0.1)
    middle = random_board_poses(CAMERA, BOARD, 1, rng, max_tilt=0.1, max_roll=0.1, fill=(0.45, 0.5))[0]

    def seen(t: Array) -> Array:
        turn = np.stack([0.4 * np.sin(1.7 * t), 0.4 * np.sin(2.3 * t + 1), 0.5 * np.sin(1.3 * t + 2)], axis=1)
        return middle @ se3.make(so3.exp(turn), 0.05 * np.stack([np.sin(1.1 * t), np.sin(1.9 * t), np.sin(0.7 * t)], axis=1))

    views, _ = views_of_poses(CAMERA, BOARD, seen(t), rng, 0.1, (START_S * 10**9 + 1e9 * t).astype(np.int64))
    stamps = views.t_ns[views.frame]
    lines = [f"{s},{c // 4},{c % 4},{u:.5f},{v:.5f}" for s, c, (u, v) in zip(stamps, views.corner, views.uv, strict=True)]
    corners = folder / "corners.csv"
    corners.write_text("\n".join(["t [ns],tag_id,corner_idx,u [px],v [px]", *lines]) + "\n")
    s = np.arange(0, 10, 0.02)
    T = Z @ se3.inverse(seen(s)) @ se3.inverse(X) if setup == "eye-in-hand" else X @ seen(s) @ se3.inverse(Z)
    T = noisy(T, rng, 1e-4, 1e-4)
    robot = folder / "robot.csv"
    rows_ = np.column_stack([T[:, :3, 3], so3.to_quat(T[:, :3, :3])])
    stamp = (START_S * 10**9 + 1e9 * (s + dt)).astype(np.int64)
    robot.write_text(
        "t [ns],x,y,z,qx,qy,qz,qw\n" + "".join(f"{a}," + ",".join(f"{x:.9f}" for x in b) + "\n" for a, b in zip(stamp, rows_, strict=True))
    )
    target, rig = folder / "target.yaml", folder / "lens.yaml"
    target.write_text(dump_target(BOARD))
    save_rig(Rig(cameras={"cam0": lens()}), rig)
    return corners, robot, target, rig


@pytest.mark.parametrize(("setup", "name", "dt"), [("eye-in-hand", "T_gripper_cam0", 0.03), ("eye-to-hand", "T_base_cam0", 0.0)])
def test_a_moving_camera_and_a_robots_stream(run: Run, tmp_path: Path, setup: str, name: str, dt: float) -> None:
    corners, robot, target, rig = recorded(tmp_path, setup, dt)
    out = tmp_path / "rig.yaml"
    said = run(corners, robot, "--target", target, "--rig", rig, "-o", out)
    assert said.code == 0, said
    assert f"{setup} (" in said.out
    assert_near(out, name)
    offset = load_rig(out).time_offsets["dt_gripper_cam0"].offset
    assert offset.value == pytest.approx(dt, abs=1e-3)


def test_two_streams_of_poses_on_clocks_minutes_apart(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(12)

    def stream(path: Path, fixed: Array, rate: float, start: float) -> Path:
        t = np.arange(0, 12, 1 / rate)
        turn = np.stack([0.8 * np.sin(1.7 * t), 0.7 * np.sin(2.3 * t + 1), 0.9 * np.sin(1.3 * t + 2)], axis=1)
        T = se3.make(so3.exp(turn), 0.3 * np.stack([np.sin(1.1 * t), np.sin(1.9 * t), np.sin(0.7 * t)], axis=1))
        T = noisy(T if fixed is None else se3.inverse(Z) @ T @ fixed, rng)
        both = np.column_stack([T[:, :3, 3], so3.to_quat(T[:, :3, :3])])
        path.write_text(
            "".join(f"{START_S + start + a:.6f} " + " ".join(f"{x:.9f}" for x in b) + "\n" for a, b in zip(t, both, strict=True))
        )
        return path

    vicon, vio = stream(tmp_path / "vicon.txt", se3.inverse(np.eye(4)), 50, 0.0), stream(tmp_path / "vio.txt", X, 10, -400.0)
    out = tmp_path / "rig.yaml"
    said = run(vicon, vio, "--pose", "hand=vicon", "--pose", "head=vio", "-o", out)
    assert said.code == 0, said
    relative = se3.inverse(np.eye(4)) @ X
    assert_near(out, "T_hand_head", relative)
    assert load_rig(out).time_offsets["dt_hand_head"].offset.value == pytest.approx(400.0, abs=1e-3)
    assert "T_handworld_headworld" in load_rig(out).transforms


def test_tf_frames_name_the_transform(run: Run, tmp_path: Path) -> None:
    corners, robot, target, rig = recorded(tmp_path, "eye-in-hand")
    make, values = Make("ros1"), np.loadtxt(robot, delimiter=",", skiprows=1)
    stamps = [int(line.split(",")[0]) for line in robot.read_text().splitlines()[1:]]
    messages = [("/tf", t, make.tf((t, "base_link", "tool0", row[1:4], row[4:]))) for t, row in zip(stamps, values, strict=True)]
    bag = write(tmp_path, "ros1", messages)
    out = tmp_path / "rig.yaml"
    said = run(bag, corners, "--pose", "tf:base_link/tool0", "--setup", "eye-in-hand", "--target", target, "--rig", rig, "-o", out)
    assert said.code == 0, said
    assert_near(out, "T_tool0_cam0")
    assert "T_baselink_target" in load_rig(out).transforms


# Mistakes, each in one line.


def test_every_mistake_is_one_line(run: Run, photos: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(13)
    first, second = in_hand(arm(rng), rng)
    pairs = Pairs(tmp_path, first, second)
    images, target, poses = photos / "images", photos / "target.yaml", photos / "poses.txt"
    short = rows(tmp_path / "short.txt", first[:10])
    mm = first.copy()
    mm[:, :3, 3] *= 1000
    bent = first.copy()
    bent[4, :3, :3] *= 1.2
    known = ("--rig", photos / "lens.yaml")
    cases = [
        ((), "no recording is given"),
        ((images, "--target", target, *known), "which are the robot's poses?"),
        ((images, "--poses", poses), "--poses belongs to images of a board: add --target"),
        ((images, "--target", target, "--poses", short, *known), "short.txt has 10 poses and there are 14 images"),
        ((images, "--target", target, "--poses", tmp_path / "none.txt", *known), "none.txt"),
        ((images, "--target", target, "--poses", poses, "--setup", "motion", *known), "eye-in-hand or eye-to-hand"),
        ((images, "--target", target, "--poses", poses, "--model", "wide"), "--model wide is not known"),
        ((*pairs.asked, "--setup", "sideways"), "--setup sideways: choose one of eye-in-hand"),
        ((*pairs.asked, "--method", "magic"), "--method magic: choose one of refined, tsai"),
        ((*pairs.asked, "--predict", "-1"), "--predict -1"),
        ((*pairs.asked, "--base", "a b"), "give two names of letters and digits"),
        ((images, *pairs.asked), "--pairs is all there is"),
        (("--pairs", short, "--pairs", rows(tmp_path / "b.txt", second)), "10 poses and"),
        (("--pairs", rows(tmp_path / "mm.txt", mm), "--pairs", rows(tmp_path / "b.txt", second)), "--pose-unit mm"),
        (("--pairs", rows(tmp_path / "bent.txt", bent), "--pairs", rows(tmp_path / "b.txt", second)), "line 5"),
        ((tmp_path / "arm.csv",), "arm.csv does not exist"),
        ((images, "--target", target, "--poses", poses, "--motions", *known), "--motions: "),
        ((images, "--target", target, "--poses", poses, "--inverse-second", *known), "--inverse-second: "),
        ((images, "--target", target, "--poses", poses, "--pose", "/foo", *known), "--pose: "),
        ((*pairs.asked, "--motions", "--setup", "eye-in-hand"), "--setup: "),
        ((*pairs.asked, "--setup", "motion", "--base", "foo"), "--base and --gripper: "),
        ((tmp_path / "arm.csv", "--pose-unit", "mm"), "--pose-unit"),
        ((*pairs.asked, "--setup", "eye-in-hand", "--base", "cam"), "two frames would have one name, of gripper, cam, cam, target"),
        ((*pairs.asked, "--setup", "eye-in-hand", "--gripper", "target"), "two frames would have one name"),
    ]
    for asked, told in cases:
        said: Said = run(*asked, "-o", tmp_path / "never.yaml")
        assert told in said.mistake, (asked, said)
    assert not (tmp_path / "never.yaml").exists()


def test_streams_are_asked_for_by_name(run: Run, tmp_path: Path) -> None:
    corners, robot, target, rig = recorded(tmp_path, "eye-in-hand")
    assert "two streams of poses are needed, it has robot" in run(robot, corners).mistake
    assert "that sees a board: add --target" in run(robot, corners, "--setup", "eye-in-hand").mistake
    assert "there is no topic nothing" in run(robot, corners, "--pose", "nothing", "--target", target, "--rig", rig).mistake
    assert "leave out the other" in run(robot, corners, "--pose", "robot", "--pose", "x", "--target", target, "--rig", rig).mistake


# Real images.


def test_kuka_from_images_to_the_published_figures(run: Run, data_dir: Path, tmp_path: Path) -> None:
    target = tmp_path / "board.yaml"
    target.write_text("target_type: checkerboard\ntargetCols: 24\ntargetRows: 17\nrowSpacingMeters: 0.015\ncolSpacingMeters: 0.015\n")
    kuka, rig, js = data_dir / "kuka2", tmp_path / "rig.yaml", tmp_path / "h.json"
    asked = (kuka, "--poses", kuka / "RobotPosesVec.txt", "--target", target, "--model", "pinhole-radtan5")
    said = run(*asked, "-o", rig, "--json", js)
    assert said.code == 0, said
    assert "28 of 28 poses used" in said.out
    park = se3.make(so3.from_quat(np.array([-0.49659, 0.52801, -0.48651, 0.48777])), np.array([0.01439, -0.10786, -0.08193]))
    off = se3.local(park, np.array(load_rig(rig).transforms["T_gripper_cam0"].matrix))
    assert np.linalg.norm(off[:3]) < 1e-3
    assert np.degrees(np.linalg.norm(off[3:])) < 0.05
    found = facts(js)
    assert found["scatter"]["distance"] < 1.05 * 0.68e-3
    assert np.degrees(found["scatter"]["angle"]) < 1.05 * 0.047
    assert found["methods"]["andreff"]["failed"]
    assert re.search(r"^andreff .*FAILED$", said.out, re.MULTILINE)


def clocks(rig: Path, name: str) -> tuple[float, float]:
    offset = load_rig(rig).time_offsets[name].offset
    assert offset.value is not None
    assert offset.sigma is not None
    return offset.value, offset.sigma


@pytest.mark.slow
@pytest.mark.parametrize("command", ["timeoffset", "handeye"])
def test_three_phones_offsets_of_minutes_close_to_a_loop(run: Run, data_dir: Path, tmp_path: Path, command: str) -> None:
    streams, dt = data_dir / "pose_streams", {}
    for a, b in (("CALIGULA", "MARS"), ("MARS", "NERO"), ("CALIGULA", "NERO")):
        rig = tmp_path / f"{a}{b}.yaml"
        named = ("--pose", f"{a}=tango_{a}", "--pose", f"{b}=tango_{b}")
        said = run.func(command, *(streams / f"tango_{name}.csv" for name in (a, b)), *named, "-o", rig)
        assert said.code == 0, said
        dt[a + b] = clocks(rig, f"dt_{a}_{b}")[0]
    np.testing.assert_allclose([dt["CALIGULAMARS"], dt["MARSNERO"], dt["CALIGULANERO"]], [-125.15, -4458.26, -4583.41], atol=0.01)
    left = dt["CALIGULAMARS"] + dt["MARSNERO"] - dt["CALIGULANERO"]
    print(f"{command}: the loop closes within {1e3 * left:.2f} ms")
    assert abs(left) < 0.010


@pytest.mark.slow
def test_both_halves_of_motion_capture_and_camera_give_one_x(run: Run, data_dir: Path, tmp_path: Path) -> None:
    streams, found = data_dir / "pose_streams", []
    lines = (streams / "camera_in_target.csv").read_text().splitlines()
    for k, part in enumerate((lines[: len(lines) // 2], lines[len(lines) // 2 :])):
        (tmp_path / str(k)).mkdir()
        half, rig = tmp_path / str(k) / "camera_in_target.csv", tmp_path / f"{k}.yaml"
        half.write_text("\n".join(part) + "\n")
        said = run(
            data_dir / "pose_streams" / "vicon_hand.csv", half, "--pose", "hand=vicon_hand", "--pose", "cam=camera_in_target", "-o", rig
        )
        assert said.code == 0, said
        dt, sigma = clocks(rig, "dt_hand_cam")
        assert 0.015 - 3 * sigma < dt < 0.023 + 3 * sigma
        assert sigma < 4e-3
        entry = load_rig(rig).transforms["T_hand_cam"]
        assert entry.covariance is not None
        found.append((np.array(entry.matrix), np.array(entry.covariance.matrix), dt))
    (one, cov_one, _), (two, cov_two, _) = found
    apart = se3.local(one, two) / np.sqrt(np.diag(cov_one + cov_two))
    print("halves apart by", apart.round(2), "sigmas; dt", [1e3 * f[2] for f in found])
    assert np.abs(apart).max() < 3
