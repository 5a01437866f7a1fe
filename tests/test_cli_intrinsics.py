"""`calibkit intrinsics` from the command line: small recordings in, rig and report out, and one line for every mistake."""

import hashlib
import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import Run
from rigs import full_rig

from calibkit.data.observations import BoardViews
from calibkit.data.rig import Camera, Rig
from calibkit.data.verdict import Status
from calibkit.detection import crew
from calibkit.estimation import intrinsics
from calibkit.geometry import se3, so3
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.models.board import AprilGrid, Board
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.simulation.camera import SimCamera, place_board, random_board_poses
from calibkit.simulation.corners import views_of_poses
from calibkit.simulation.render import Renderer
from calibkit.stages import outputs

SAMPLES = Path(__file__).parents[1] / "sample_bags"
BOARD = AprilGrid(4, 4, 0.12, 0.3)
CAMERA = SimCamera(CAMERAS["pinhole-radtan"], np.array([322.0, 320.5, 246.0, 161.0, -0.25, 0.06, 2e-4, -3e-4]), (480, 320))
FRAMES = 14
START_S = 1_700_000_000
TARGET = "target_type: aprilgrid\ntagCols: 4\ntagRows: 4\ntagSize: 0.12\ntagSpacing: 0.3\n"


@pytest.fixture
def run(run: Run) -> Run:
    return partial(run, "intrinsics")


@pytest.fixture
def quick(monkeypatch):
    """Compare no models: most of these tests are about something else."""
    monkeypatch.setattr(intrinsics, "CAMERAS", {"pinhole-radtan": CAMERAS["pinhole-radtan"]})


@pytest.fixture(scope="session")
def rendered(tmp_path_factory) -> Path:
    """A folder of rendered images, one a second, named by their stamps."""
    folder = tmp_path_factory.mktemp("recording") / "images"
    folder.mkdir()
    rng = np.random.default_rng(0)
    renderer = Renderer(CAMERA, BOARD)
    for k, pose in enumerate(random_board_poses(CAMERA, BOARD, FRAMES, rng, fill=(0.45, 0.8))):
        cv2.imwrite(str(folder / f"{START_S + k}000000000.png"), renderer.render(pose, rng))
    return folder


@pytest.fixture
def target(tmp_path) -> Path:
    path = tmp_path / "target.yaml"
    path.write_text(TARGET)
    return path


def write_corners(path: Path, views: BoardViews) -> Path:
    """The views as a corner file, stamps one a second."""
    rows = [
        f"{START_S + int(f)}000000000,{c // 4},{c % 4},{u:.6f},{v:.6f},{s:.3f}"
        for f, c, (u, v), s in zip(views.frame, views.corner, views.uv, views.sigma_px, strict=True)
    ]
    path.write_text("\n".join(["#timestamp [ns],tag_id,corner_idx,u [px],v [px],sigma_px", *rows]) + "\n")
    return path


def corner_views(
    camera: SimCamera = CAMERA, board: Board = BOARD, frames: int = FRAMES, seed: int = 0, T: np.ndarray | None = None
) -> BoardViews:
    rng = np.random.default_rng(seed)
    poses = random_board_poses(CAMERA, board, frames, rng, fill=(0.45, 0.8))
    return views_of_poses(camera, board, poses if T is None else T @ poses, rng, 0.1)[0]


@pytest.fixture
def corners(tmp_path) -> Path:
    return write_corners(tmp_path / "corners.csv", corner_views())


SIZE = ("--resolution", "480x320")


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def numbers(rig: Rig) -> dict[str, dict[str, tuple[float | None, float | None]]]:
    return {name: {k: (e.value, e.sigma) for k, e in camera.parameters.items()} for name, camera in rig.cameras.items()}


def assert_within(camera: Camera, truth: np.ndarray, sigmas: float) -> None:
    z = {name: (e.value - true) / e.sigma for (name, e), true in zip(camera.parameters.items(), truth, strict=True)}
    assert max(map(abs, z.values())) < sigmas, z


def test_images_to_a_rig_file_with_its_residuals_report_and_json(tmp_path, rendered, target, run):
    out = tmp_path / "out"
    out.mkdir()
    said = run(rendered, "--target", target, "-o", out / "rig.yaml", "--report", out / "report", "--json", out / "rig.json")
    assert (said.code, said.err) == (0, "")
    assert said.out.splitlines()[0].startswith("cam0: pinhole-radtan, 480x320; the board is in 14 of 14 images")
    assert said.out.splitlines()[-4:] == [
        f"written: {out / name}" for name in ("rig.intrinsics.residuals.npz", "rig.yaml", "rig.json", "report/report.html")
    ]
    assert "\nPASS\n" in said.out

    rig = load_rig(out / "rig.yaml")
    camera = rig.cameras["cam0"]
    assert (camera.model, camera.resolution, camera.reprojection.frames) == ("pinhole-radtan", (480, 320), FRAMES)
    assert all(e.status is Status.DETERMINED for e in camera.parameters.values())
    assert_within(camera, CAMERA.params, 4)
    assert camera.parameters["fx"].sigma < 0.5

    made = rig.provenance[-1]
    assert made.stage == "intrinsics"
    assert made.command.startswith(f"calibkit intrinsics {rendered}")
    assert {file.name: file.sha256 for file in made.inputs}["target.yaml"] == hashlib.sha256(target.read_bytes()).hexdigest()
    assert "images" in {file.name for file in made.inputs}
    assert made.residual_sha256 == hashlib.sha256((out / made.residual_file).read_bytes()).hexdigest()

    told = json.loads((out / "rig.json").read_text())
    assert (told["schema"], told["verdict"]) == ("calibkit-report/1", "PASS")
    assert "<html" in (out / "report" / "report.html").read_text()[:500]
    assert all((out / "report" / entry["file"]).is_file() for entry in json.loads((out / "report" / "report.json").read_text())["pictures"])


def test_a_second_run_finds_no_corners_anew_and_says_the_same(tmp_path, rendered, target, run, monkeypatch, quick):
    first, second, third = (tmp_path / f"{name}.yaml" for name in ("first", "second", "third"))
    arguments = (rendered, "--target", target, "--model", "pinhole-radtan", "-o")
    assert run(*arguments, first).code == 0
    monkeypatch.setattr(crew, "look_through", None)  # whoever detects again fails
    assert run(*arguments, second).code == 0
    assert numbers(load_rig(first)) == numbers(load_rig(second))
    assert run(*arguments, third, "--no-cache").code != 0


def test_two_cameras_by_name_with_the_transform_between_them(tmp_path, target, run, quick):
    right = SimCamera(CAMERAS["pinhole-radtan"], np.array([340.0, 341.0, 238.0, 155.0, -0.2, 0.04, -1e-4, 2e-4]), (480, 320))
    T = se3.make(so3.exp(np.array([0.02, -0.05, 0.08])), np.array([-0.11, 0.02, 0.03]))
    write_corners(tmp_path / "left.csv", corner_views(frames=25))
    write_corners(tmp_path / "right.csv", corner_views(right, frames=25, T=T))
    sources = (tmp_path / "left.csv", tmp_path / "right.csv")
    said = run(
        *sources,
        "--target",
        target,
        *SIZE,
        "--camera",
        "left=left",
        "--camera",
        "right=right",
        "--model",
        "pinhole-radtan",
        "-o",
        tmp_path / "rig.yaml",
    )
    assert said.code == 0, said
    rig = load_rig(tmp_path / "rig.yaml")
    assert list(rig.cameras) == ["left", "right"]
    assert list(rig.transforms) == ["T_right_left"]
    sigma = np.sqrt(np.diag(rig.transforms["T_right_left"].covariance.matrix))
    assert np.abs(se3.local(T, np.array(rig.transforms["T_right_left"].matrix)) / sigma).max() < 4.5
    assert_within(rig.cameras["right"], right.params, 4.5)


def test_check_is_0_and_strict_makes_it_1(tmp_path, target, run, quick):
    """A board in one corner only."""
    rng = np.random.default_rng(1)
    tilt = so3.exp(np.stack([rng.uniform(-0.7, 0.7, 30), rng.uniform(-0.7, 0.7, 30), np.zeros(30)], axis=-1))
    z = rng.uniform(1.6, 2.2, 30)
    centre = np.stack([rng.uniform(-0.6, -0.3, 30) * z, rng.uniform(-0.4, -0.2, 30) * z, z], axis=-1)
    views = views_of_poses(CAMERA, BOARD, place_board(BOARD, tilt, centre), rng, 0.05)[0]
    arguments = (write_corners(tmp_path / "corners.csv", views), "--target", target, *SIZE, "--model", "pinhole-radtan")
    said = run(*arguments)
    assert "\nCHECK\n" in said.out
    assert said.code == 0
    assert run(*arguments, "--strict").code == 1


def test_not_observable_is_3_and_the_rig_file_says_null(tmp_path, target, run, quick):
    path = write_corners(tmp_path / "corners.csv", corner_views(frames=2))
    said = run(path, "--target", target, *SIZE, "-o", tmp_path / "rig.yaml")
    assert said.code == 3
    assert "not observable" in said.out
    written = yaml.safe_load((tmp_path / "rig.yaml").read_text())["cameras"]["cam0"]
    assert all(entry["value"] is None and entry["status"] == "not observable" for entry in written["parameters"].values())
    assert "covariance" not in written
    assert load_rig(tmp_path / "rig.yaml").cameras["cam0"].verdict.value == "FAIL"


def test_fail_is_1_and_everything_is_written(tmp_path, target, corners, run, quick):
    target.write_text(TARGET.replace("0.3", "0.15"))
    said = run(corners, "--target", target, *SIZE, "--model", "pinhole-radtan", "-o", tmp_path / "rig.yaml")
    assert said.code == 1
    assert "\nFAIL\n" in said.out
    assert load_rig(tmp_path / "rig.yaml").cameras["cam0"].verdict.value == "FAIL"


MISTAKES = {
    "no such source": (["nothing.bag"], "nothing.bag"),
    "no such target": (["corners.csv", "--target", "none.yaml"], "none.yaml"),
    "a topic that is not there": (["corners.csv", "--camera", "/nope"], "/nope"),
    "a name that is none": (["corners.csv", "--camera", "0=corners"], "--camera 0=corners"),
    "one name for two": (["corners.csv", "--camera", "a=corners", "--camera", "a=corners"], "--camera a=corners"),
    "an unknown model": (["corners.csv", "--model", "pinhole-magic"], "--model pinhole-magic is not known: choose auto, pinhole-none"),
    "more models than cameras": (["corners.csv", "--model", "kb4", "--model", "pinhole-radtan"], "--model is given 2 times for 1 camera:"),
    "no size": (["corners.csv"], "add --resolution WIDTHxHEIGHT"),
    "half a size": (["corners.csv", "--resolution", "480"], "--resolution 480: write WIDTHxHEIGHT"),
    "a size with a sign": (["corners.csv", "--resolution", "480x-320"], "--resolution 480x-320"),
    "a size of nothing": (["corners.csv", "--resolution", "0x320"], "--resolution 0x320"),
    "a size that is too small": (["corners.csv", "--resolution", "240x160"], "corners"),
    "an unknown loss": (["corners.csv", "--resolution", "480x320", "--loss", "huber"], "--loss is robust or plain"),
    "a rig that is none": (["corners.csv", "--resolution", "480x320", "--rig", "target.yaml"], "target.yaml"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_one_line_and_nothing_is_written(name, tmp_path, corners, target, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, said = MISTAKES[name]
    if "--target" not in arguments:
        arguments = [*arguments, "--target", "target.yaml"]
    outputs = ("-o", "rig.yaml", "--report", "report", "--json", "rig.json")
    before = names(tmp_path)
    assert said in run(*arguments, *outputs).mistake
    assert names(tmp_path) == before


def test_another_board_than_the_one_in_the_images(tmp_path, rendered, target, run):
    target.write_text("target_type: checkerboard\ntargetCols: 9\ntargetRows: 6\ncolSpacingMeters: 0.05\nrowSpacingMeters: 0.05\n")
    few = tmp_path / "few"
    few.mkdir()
    for path in sorted(rendered.iterdir())[:1]:
        shutil.copy(path, few)
    line = run(few, "--target", target, "-o", tmp_path / "rig.yaml").mistake
    assert "no checkerboard 9 x 6 found in 1 image: check the target file against the board" in line
    assert not (tmp_path / "rig.yaml").exists()


def test_a_folder_without_images(tmp_path, target, run):
    (tmp_path / "empty").mkdir()
    assert "empty" in run(tmp_path / "empty", "--target", target).mistake


def test_a_recording_of_an_imu_alone(tmp_path, target, run):
    path = tmp_path / "imu.csv"
    path.write_text("#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n" + "".join(f"{k * 5000000 + 10**18},0,0,0,0,0,9.8\n" for k in range(20)))
    assert "image" in run(path, "--target", target).mistake


@pytest.mark.parametrize("taken", ["rig.yaml", "rig.json", "report/report.html"])
def test_what_is_there_is_not_overwritten_without_force(taken, tmp_path, corners, target, run):
    (tmp_path / taken).parent.mkdir(exist_ok=True)
    (tmp_path / taken).write_text("mine")
    before = names(tmp_path)
    outputs = ("-o", tmp_path / "rig.yaml", "--json", tmp_path / "rig.json", "--report", tmp_path / "report")
    line = run(corners, "--target", target, *SIZE, *outputs).mistake
    assert "--force" in line
    assert taken.partition("/")[0] in line
    assert names(tmp_path) == before
    assert (tmp_path / taken).read_text() == "mine"


def test_force_overwrites(tmp_path, corners, target, run, quick):
    for name in ("rig.yaml", "rig.json"):
        (tmp_path / name).write_text("mine")
    assert run(corners, "--target", target, *SIZE, "-o", tmp_path / "rig.yaml", "--json", tmp_path / "rig.json", "--force").code in (0, 1)
    assert load_rig(tmp_path / "rig.yaml").cameras
    assert json.loads((tmp_path / "rig.json").read_text())["schema"]


def test_rigs_are_merged_and_the_camera_is_put_in_place_of_the_old_one(tmp_path, corners, target, run, quick):
    old = full_rig()
    save_rig(old, tmp_path / "rig.yaml")
    arguments = (corners, "--target", target, *SIZE, "--model", "pinhole-radtan", "--rig", tmp_path / "rig.yaml")
    assert run(*arguments, "-o", tmp_path / "new.yaml").code in (0, 1)
    new = load_rig(tmp_path / "new.yaml")
    assert load_rig(tmp_path / "rig.yaml") == old
    assert (new.imus, new.transforms, new.time_offsets, new.cameras["cam1"]) == (
        old.imus,
        old.transforms,
        old.time_offsets,
        old.cameras["cam1"],
    )
    assert new.cameras["cam0"].resolution == (480, 320)
    assert [made.stage for made in new.provenance] == [*(made.stage for made in old.provenance), "intrinsics"]

    assert run(*arguments, "-o", tmp_path / "rig.yaml").code in (0, 1)  # its own --rig: in place, without --force
    assert numbers(load_rig(tmp_path / "rig.yaml")) == numbers(new)


def test_rigs_that_contradict_each_other_are_refused_by_name(tmp_path, corners, target, run):
    rig = full_rig()
    save_rig(rig, tmp_path / "a.yaml")
    other = rig.cameras["cam1"].model_copy(update={"resolution": (640, 480)})
    save_rig(rig.model_copy(update={"cameras": {**rig.cameras, "cam1": other}}), tmp_path / "b.yaml")
    before = names(tmp_path)
    line = run(
        corners, "--target", target, *SIZE, "--rig", tmp_path / "a.yaml", "--rig", tmp_path / "b.yaml", "-o", tmp_path / "new.yaml"
    ).mistake
    assert "cameras.cam1 differs between" in line
    assert "a.yaml" in line
    assert "b.yaml" in line
    assert names(tmp_path) == before


def test_an_output_that_cannot_be_written_is_told_before_the_work(tmp_path, corners, target, run):
    before = names(tmp_path)
    for output in (("-o", tmp_path / "no" / "rig.yaml"), ("--json", tmp_path / "no" / "rig.json")):
        assert "there is no folder" in run(corners, "--target", target, *SIZE, *output).mistake
    assert names(tmp_path) == before


def test_a_run_that_fails_at_its_end_leaves_nothing_half_written(tmp_path, corners, target, run, monkeypatch, quick):
    before = names(tmp_path)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    arguments = (corners, "--target", target, *SIZE, "-o", tmp_path / "rig.yaml")
    with monkeypatch.context() as patched:
        patched.setattr(outputs, "save_rig", full)
        said = run(*arguments, "--json", tmp_path / "rig.json", "--report", tmp_path / "report")
    assert said.code != 0
    assert len(said.err.splitlines()) == 1
    # The residuals go first, whole and named by nothing; the same command works when there is room again.
    assert set(names(tmp_path)) - set(before) == {"rig.intrinsics.residuals.npz"}
    assert run(*arguments).code == 0


def test_a_truncated_bag_gives_what_is_left_of_it_or_one_line(tmp_path, run, quick):
    whole = (SAMPLES / "cam_imu.bag").read_bytes()
    for share in (0.02, 0.3):
        path = tmp_path / f"cut{share}.bag"
        path.write_bytes(whole[: int(share * len(whole))])
        said = run(path, "--target", SAMPLES / "target.yaml", "--model", "pinhole-radtan", "-o", tmp_path / f"{share}.yaml")
        if said.code == 2:
            assert said.mistake
            assert not (tmp_path / f"{share}.yaml").exists()
        else:
            assert said.code in (0, 1, 3)
            assert "cut" in said.err
            assert load_rig(tmp_path / f"{share}.yaml").cameras["cam0"].reprojection.frames < 100
    assert said.code == 0  # a third of the sample bag is 4.5 s


def test_the_sample_bag_is_within_3_sigma_of_its_truth(tmp_path, run):
    said = run(SAMPLES / "cam_imu.bag", "--target", SAMPLES / "target.yaml", "-o", tmp_path / "rig.yaml")
    assert said.code == 0, said
    truth = load_rig(SAMPLES / "truth.yaml").cameras["cam0"]
    camera = load_rig(tmp_path / "rig.yaml").cameras["cam0"]
    assert (camera.model, camera.topic) == (truth.model, truth.topic)
    assert_within(camera, np.array([e.value for e in truth.parameters.values()]), 3)
    assert camera.parameters["fx"].sigma < 0.5
