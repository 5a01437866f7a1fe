"""`calibkit calibrate` from the command line: one rig file from every stage that a recording allows."""

import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import Run
from recorded_files import write_session
from time_offset_samples import camera_session, lens

from calibkit.data.rig import Rig
from calibkit.data.transforms import find_transform
from calibkit.data.verdict import Status
from calibkit.errors import NotConvergedError
from calibkit.geometry import se3
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.io.target_file import dump_target
from calibkit.opencv import cv2
from calibkit.report import page
from calibkit.simulation.session import Session
from calibkit.stages import calibrate
from calibkit.stages.convert import export_rig

SAMPLES = Path(__file__).parent.parent / "sample_bags"
README = Path(__file__).parent.parent / "README.md"
TD = 0.025
STAGES = ["intrinsics", "timeoffset", "joint"]
NO_WALKS = "imu0 has no random walks in the rig file"


@pytest.fixture
def run(run: Run) -> Run:
    return partial(run, "calibrate")


@pytest.fixture(scope="module")
def session() -> Session:
    return camera_session(0, TD, duration_s=10.0)


@pytest.fixture(scope="module")
def folder(session: Session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("recording")
    write_session(made, session)
    (made / "target.yaml").write_text(dump_target(session.board_told))
    save_rig(Rig(cameras={"cam0": lens(session).model_copy(update={"topic": "corners"})}), made / "lens.yaml")
    return made


@pytest.fixture
def asked(folder: Path, session: Session) -> tuple[object, ...]:
    width, height = session.scenario.cameras[0].size
    camera = (folder / "corners.csv", "--resolution", f"{width}x{height}", "--model", "pinhole-radtan")
    return (*camera, folder / "imu.csv", "--target", folder / "target.yaml")


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "draw", lambda view, kind: [])


def stages_of(rig: Path) -> list[str]:
    return [run.stage for run in load_rig(rig).provenance]


def assert_true(path: Path, session: Session) -> None:
    """Rotation, lever arm and time offset within 4 sigma of what was simulated."""
    rig = load_rig(path)
    found = find_transform(rig, "cam0", "imu0")
    assert found is not None
    entry = rig.transforms["T_cam0_imu0"]
    assert entry.covariance is not None
    off = se3.local(found[0], se3.inverse(session.scenario.cameras[0].T_imu_cam))
    assert np.all(np.abs(off) < 4 * np.sqrt(np.diag(entry.covariance.matrix)))
    offset = rig.time_offsets["dt_imu0_cam0"].offset
    assert offset.value is not None
    assert offset.sigma is not None
    assert abs(offset.value - TD) < 4 * offset.sigma < 1e-3


def assert_exported(path: Path, session: Session, folder: Path) -> None:
    """Kalibr's own keys: p_cam = T_cam_imu p_imu, t_imu = t_cam + timeshift_cam_imu; a point falls on the true pixel."""
    export_rig(path, "kalibr", folder)
    node = yaml.safe_load((folder / "camchain.yaml").read_text())["cam0"]
    true = session.scenario.cameras[0]
    p_imu = np.array([[0.3, -0.2, 0.1, 1.0]]) + true.T_imu_cam[:, 2]  # before the camera
    p_cam = p_imu @ np.array(node["T_cam_imu"]).T
    K, D = node["intrinsics"], node["distortion_coeffs"]
    uv, _ = cv2.projectPoints(p_cam[:, :3], np.zeros(3), np.zeros(3), np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]]), np.array(D))
    p_true = p_imu @ se3.inverse(true.T_imu_cam).T
    np.testing.assert_allclose(uv.reshape(2), true.model.project(p_true[0, :3], true.params).uv, atol=1.0)
    assert node["timeshift_cam_imu"] == pytest.approx(TD, abs=1e-4)


def test_from_a_recording_to_a_rig_file_and_one_report(
    run: Run, asked: tuple[object, ...], session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, pages, js = tmp_path / "rig.yaml", tmp_path / "report", tmp_path / "all.json"
    drawn: list[tuple[str, str]] = []
    monkeypatch.setattr(page, "plates", lambda view: drawn.append((view.sensor, view.stage)) or [])
    monkeypatch.setattr(page, "draw", lambda plates, formats: [])
    said = run(*asked, "-o", out, "--report", pages, "--json", js)
    assert said.code == 0, said
    assert stages_of(out) == STAGES
    assert_true(out, session)
    assert {path.name for path in tmp_path.iterdir()} == {"rig.yaml", "report", "all.json", *(f"rig.{s}.residuals.npz" for s in STAGES)}
    # Each sensor's latest residuals, and of the time offset the V and the windows, which joint has none of.
    assert list(dict.fromkeys(drawn)) == [
        ("cam0", "joint"), ("imu0_gyro", "joint"), ("imu0_accel", "joint"), ("imu0", "joint"), ("dt_imu0_cam0", "timeoffset")
    ]  # fmt: skip
    assert "A later stage has found this anew" in (pages / "report.html").read_text()
    assert_exported(out, session, tmp_path / "kalibr")
    told = json.loads(js.read_text())
    assert (told["verdict"], told["not_observable"]) == ("CHECK", [])  # no noise of the IMU is known
    assert NO_WALKS in said.out
    for line in ("cam0: pinhole-radtan", r"cam0's stamps are 2[45]\.\d+ ms early", "a knot every", "written: "):
        assert re.search(line, said.out)


@pytest.mark.slow
def test_the_sample_bag_says_what_the_readme_says(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One command from a clone to a rig file, pictures and all. Digits may differ by the version of OpenCV, words may not."""
    section = README.read_text(encoding="utf-8").split("## Your camera and IMU")[1].split("\n## ")[0]
    command, *shown = [line.strip() for line in section.splitlines() if line.startswith("    ")]
    (tmp_path / "out").mkdir()
    (tmp_path / "sample_bags").symlink_to(SAMPLES)
    monkeypatch.chdir(tmp_path)
    said = run(*command.split()[2:])
    assert said.code == 0, said

    def words(text: str) -> str:
        return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?| +", " ", text).replace("  ", " ").strip()

    printed = {words(line) for line in said.out.splitlines()}
    assert [line for line in shown if words(line) not in printed and not line.startswith("calibkit intrinsics")] == []
    rig, truth = load_rig(tmp_path / "out" / "rig.yaml"), load_rig(SAMPLES / "truth.yaml")
    found, true = (find_transform(each, "imu0", "cam0") for each in (rig, truth))
    assert found is not None
    assert true is not None
    off = np.abs(se3.local(found[0], true[0]))
    assert np.all(off[:3] < 2e-3)
    assert np.all(off[3:] < 3e-4)
    assert abs((rig.time_offsets["dt_imu0_cam0"].offset.value or 0) - 0.005) < 6e-5
    assert len(list((tmp_path / "out" / "report" / "pictures").glob("*.png"))) > 15


@pytest.mark.usefixtures("undrawn")
def test_without_an_imu_the_lens_alone(run: Run, asked: tuple[object, ...], folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "rig.yaml"
    said = run(*(word for word in asked if word != folder / "imu.csv"), "-o", out)
    assert said.code == 0, said
    assert stages_of(out) == ["intrinsics"]
    assert "warning: timeoffset and joint were not run: the recording has no IMU\n" in said.err


@pytest.mark.usefixtures("undrawn")
def test_a_lens_that_is_known_is_not_found_anew(run: Run, folder: Path, session: Session, tmp_path: Path) -> None:
    out = tmp_path / "rig.yaml"
    sources = (folder / "corners.csv", folder / "imu.csv", "--target", folder / "target.yaml")
    said = run(*sources, "--rig", folder / "lens.yaml", "-o", out)
    assert said.code == 0, said
    assert stages_of(out) == STAGES[1:]
    assert "intrinsics was not run: the rig file has the lens already" in said.err
    assert_true(out, session)


@pytest.mark.usefixtures("undrawn")
def test_what_earlier_stages_found_is_kept_where_a_later_one_fails(
    run: Run, asked: tuple[object, ...], folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header, *rows = (folder / "imu.csv").read_text().splitlines()
    samples = [row.split(",") for row in rows]
    in_g = tmp_path / "in_g.csv"
    in_g.write_text("\n".join([header, *(",".join([*row[:4], *(f"{float(a) / 9.80665:.9f}" for a in row[4:])]) for row in samples)]) + "\n")
    out, pages = tmp_path / "rig.yaml", tmp_path / "report"
    said = run(*(in_g if word == folder / "imu.csv" else word for word in asked), "-o", out, "--report", pages)
    assert said.code == 2
    assert stages_of(out) == STAGES[:2]
    assert load_rig(out).cameras["cam0"].parameters["fx"].status is Status.DETERMINED
    assert load_rig(out).time_offsets["dt_imu0_cam0"].offset.status is Status.DETERMINED
    assert (pages / "report.html").exists()
    line = said.err.splitlines()[-1]
    assert line.startswith("calibkit: joint: ")
    assert "it is in g" in line
    assert line.endswith(f"; {out} holds what the stages before it found")

    def diverges(*args: object, **kwargs: object) -> None:
        raise NotConvergedError("no solution; record again")

    monkeypatch.setattr(calibrate, "joint", diverges)
    said = run(*asked, "-o", out, "--force")
    assert said.code == 4
    assert stages_of(out) == STAGES[:2]
    assert "calibkit: joint: no solution" in said.err


def refused_board(folder: Path, tmp_path: Path) -> tuple[object, ...]:
    target = tmp_path / "target.yaml"
    target.write_text("target_type: checkerboard\ntargetCols: 4\ntargetRows: 5\nrowSpacingMeters: 0.1\ncolSpacingMeters: 0.1\n")
    return folder / "corners.csv", folder / "imu.csv", "--target", target, "--resolution", "752x480"


def refused_topic(folder: Path, tmp_path: Path) -> tuple[object, ...]:
    return folder / "corners.csv", folder / "imu.csv", "--target", folder / "target.yaml", "--resolution", "752x480", "--imu", "/imu7"


def refused_camera(folder: Path, tmp_path: Path) -> tuple[object, ...]:
    return folder / "imu.csv", "--target", folder / "target.yaml"


@pytest.mark.parametrize("wrong", [refused_board, refused_topic, refused_camera])
def test_bad_input_writes_nothing(run: Run, folder: Path, tmp_path: Path, wrong: Callable[[Path, Path], tuple[object, ...]]) -> None:
    before = set(tmp_path.iterdir())
    words = wrong(folder, tmp_path)
    before = before | set(tmp_path.iterdir())
    assert run(*words, "-o", tmp_path / "rig.yaml", "--report", tmp_path / "report").mistake
    assert set(tmp_path.iterdir()) == before


def test_outputs_are_asked_about_before_the_work(run: Run, asked: tuple[object, ...], tmp_path: Path) -> None:
    out = tmp_path / "rig.yaml"
    out.write_text("mine")
    assert "--force" in run(*asked, "-o", out).mistake
    assert out.read_text() == "mine"
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "report.html").write_text("mine")
    assert "--force" in run(*asked, "-o", tmp_path / "new.yaml", "--report", tmp_path / "report").mistake
    assert not (tmp_path / "new.yaml").exists()


@pytest.mark.usefixtures("undrawn")
def test_a_lens_that_is_not_known_ends_it_with_3(
    run: Run, session: Session, asked: tuple[object, ...], folder: Path, tmp_path: Path
) -> None:
    """A board that stands still before the camera tells no lens: later stages are not run on a guess."""
    header, *rows = (folder / "corners.csv").read_text().splitlines()
    corners = {row.split(",", 1)[0]: [] for row in rows}
    for row in rows:
        corners[row.split(",", 1)[0]].append(row.split(",", 1)[1])
    first = next(iter(corners.values()))
    still = tmp_path / "corners.csv"
    rng = np.random.default_rng(0)

    def seen(row: str) -> str:
        tag, corner, u, v = row.split(",")
        du, dv = 0.1 * rng.standard_normal(2)
        return f"{tag},{corner},{float(u) + du:.4f},{float(v) + dv:.4f}"

    still.write_text("\n".join([header, *(f"{t},{seen(row)}" for t in corners for row in first)]) + "\n")
    out = tmp_path / "rig.yaml"
    said = run(*(still if word == folder / "corners.csv" else word for word in asked), "-o", out)
    assert said.code == 3, said
    assert stages_of(out) == ["intrinsics"]
    assert "joint was not run: " in said.err
    assert "is not observable" in said.err
