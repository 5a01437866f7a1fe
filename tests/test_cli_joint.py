"""The command `joint` on small recordings: outputs, signs, exit codes, mistakes."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Run
from recorded_files import write_imu, write_session
from time_offset_samples import camera_session

from calibkit.data.rig import Estimate, ImuIntrinsics, Rig
from calibkit.geometry import se3
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.models.imu import PARAMETERS, ImuModel
from calibkit.simulation.session import Session
from calibkit.simulation.truth import true_rig

TARGET = Path(__file__).resolve().parent.parent / "sample_bags" / "target.yaml"
TD = 0.025


@pytest.fixture(scope="module")
def session() -> Session:
    return camera_session(0, TD, duration_s=12.0)


@pytest.fixture(scope="module")
def files(session: Session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("joint")
    write_session(folder, session)
    save_rig(true_rig(session, "test").model_copy(update={"transforms": {}, "time_offsets": {}}), folder / "rig.yaml")
    return folder


def ask(folder: Path, *more: object, imu: str = "imu.csv", rig: str = "rig.yaml") -> tuple[object, ...]:
    camera = ("--camera", "corners", "--imu", Path(imu).stem)
    return ("joint", folder / "corners.csv", folder / imu, "--target", TARGET, "--rig", folder / rig, *camera, *more)


def test_transform_offset_and_lens_come_out_with_their_signs(run: Run, session: Session, files: Path, tmp_path: Path) -> None:
    out, js = tmp_path / "out.yaml", tmp_path / "out.json"
    said = run(*ask(files, "-o", out, "--json", js))
    assert said.code == 0, said
    assert re.search(r"cam0's stamps are 2[45]\.\d+ ms early: add \+2[45]\.\d+ ms", said.out)
    rig = load_rig(out)
    T, camera = rig.transforms["T_cam0_imu0"], session.tracks[0].camera
    error = se3.local(se3.inverse(camera.T_imu_cam), np.array(T.matrix))
    assert T.covariance is not None
    assert np.abs(error / np.sqrt(np.diag(T.covariance.matrix))).max() < 4
    assert np.abs(error).max() < 3e-3
    offset = rig.time_offsets["dt_imu0_cam0"].offset
    fx = rig.cameras["cam0"].parameters["fx"]
    for found, true, most in ((offset, TD, 1.5e-4), (fx, camera.params[0], 0.25)):
        assert found.value is not None
        assert found.sigma is not None
        assert abs(found.value - true) < 4 * found.sigma < most
    assert rig.provenance[-1].stage == "joint"
    facts = json.loads(js.read_text())["facts"]["joint"]["joint"]
    assert facts["imu"] == "imu0"
    assert np.linalg.norm(facts["gravity"]) == pytest.approx(9.81, abs=0.03)
    exported = run("export", out, "--to", "kalibr", "-o", tmp_path / "kalibr")
    assert exported.code == 0
    assert re.search(r"timeshift_cam_imu: 0\.02", (tmp_path / "kalibr" / "camchain.yaml").read_text())


@pytest.mark.slow
def test_the_imus_known_intrinsics_are_used(run: Run, session: Session, files: Path, tmp_path: Path) -> None:
    model = ImuModel(M_a=np.diag([1.05, 0.97, 1.02]), M_g=np.diag([0.96, 1.03, 1.04]))
    assert session.imu is not None
    accel, gyro = model.measure(session.imu.accel, session.imu.gyro)
    write_imu(files / "scaled.csv", replace(session.imu, accel=accel, gyro=gyro))
    rig = load_rig(files / "rig.yaml")
    values = model.values()
    parameters = {name: Estimate(value=values[name], unit="") for name in PARAMETERS}
    known = rig.imus["imu0"].model_copy(update={"intrinsics": ImuIntrinsics(gravity=9.81, parameters=parameters)})
    save_rig(Rig.model_validate({**rig.model_dump(), "imus": {"imu0": known.model_dump()}}), files / "scaled.yaml")
    plain, corrected = tmp_path / "plain.yaml", tmp_path / "corrected.yaml"
    assert run(*ask(files, "-o", corrected, "--no-halves", imu="scaled.csv", rig="scaled.yaml")).code == 0
    assert "gyroscope is 8." in run(*ask(files, "-o", plain, "--no-halves", imu="scaled.csv")).out  # times noisier than told: a scale
    truth = se3.inverse(session.tracks[0].camera.T_imu_cam)
    errors = [np.abs(se3.local(truth, np.array(load_rig(file).transforms["T_cam0_imu0"].matrix))).max() for file in (corrected, plain)]
    assert errors[0] < 3e-3
    assert errors[0] < errors[1] / 3


@pytest.mark.slow
def test_two_imus_in_one_run(run: Run, session: Session, files: Path, tmp_path: Path) -> None:
    """imu1 is imu0 turned by a quarter, with stamps 10 ms late: T_imu1_imu0 is that turn back, dt_imu0_imu1 -10 ms."""
    assert session.imu is not None
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # R_imu0_imu1
    imu = session.imu
    write_imu(files / "imu_b.csv", replace(imu, t_ns=imu.t_ns + 10_000_000, gyro=imu.gyro @ turn, accel=imu.accel @ turn))
    out, report = tmp_path / "out.yaml", tmp_path / "report"
    both = ("joint", files / "corners.csv", files / "imu.csv", files / "imu_b.csv", "--target", TARGET, "--rig", files / "rig.yaml")
    both = (*both, "--camera", "corners", "--imu", "imu")
    for again in ("imu", "imu1=imu"):
        assert run(*both, "--imu", again).mistake == "--imu: the topic imu is given twice: drop one of them"
    assert "two IMUs of the name imu0: give each its own" in run(*both, "--imu", "imu0=imu_b").mistake
    said = run(*both, "--imu", "imu_b", "--no-halves", "-o", out, "--report", report)
    assert said.code == 0, said.out
    rig = load_rig(out)
    T = np.array(rig.transforms["T_imu1_imu0"].matrix)
    assert np.abs(T[:3, :3] - turn.T).max() < 5e-4
    assert np.abs(T[:3, 3]).max() < 1e-3
    assert rig.time_offsets["dt_imu0_imu1"].offset.value == pytest.approx(-0.010, abs=1e-5)
    assert set(rig.imus) == {"imu0", "imu1"}
    page = (report / "report.html").read_text()
    assert all(imu in page for imu in ("imu1_gyro", "imu1_accel"))
    assert run("export", out, "--to", "kalibr", "-o", tmp_path / "kalibr").code == 0
    assert (tmp_path / "kalibr" / "imu1.yaml").is_file()


def test_what_was_never_recorded_at_once_is_named(run: Run, session: Session, files: Path) -> None:
    """Corners of the first 5 s, the IMU of the last 5 s."""
    assert session.imu is not None
    t = (session.imu.t_ns - session.imu.t_ns[0]) * 1e-9
    write_imu(files / "last.csv", session.imu.select(t > 7))
    (files / "first").mkdir()
    head, *rows = (files / "corners.csv").read_text().splitlines()
    start = int(rows[0].split(",")[0])
    (files / "first" / "corners.csv").write_text(
        "\n".join([head, *(row for row in rows if int(row.split(",")[0]) - start < 5_000_000_000)])
    )
    asked = ("joint", files / "first" / "corners.csv", files / "last.csv", "--target", TARGET, "--rig", files / "rig.yaml")
    said = run(*asked, "--camera", "corners", "--imu", "last", "--no-halves")
    assert said.code in (1, 3)
    assert re.search(r"FAIL +cam0 and imu0 share no time by their stamps \(cam0 ends 2\.\d* s before imu0 begins\)", said.out)


def test_mistakes_are_one_line(run: Run, session: Session, files: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.yaml"
    save_rig(Rig(), bare)
    assert session.imu is not None
    write_imu(files / "in_g.csv", replace(session.imu, accel=session.imu.accel / 9.80665))
    assert "it is in g; say --accel-unit g" in run(*ask(files, imu="in_g.csv")).mistake
    write_imu(files / "in_deg.csv", replace(session.imu, gyro=np.degrees(session.imu.gyro)))
    assert "imu0 turns 57 times as fast as cam0: a gyroscope in deg/s" in run(*ask(files, imu="in_deg.csv")).mistake
    write_imu(files / "frozen.csv", replace(session.imu, gyro=session.imu.gyro * 0))
    assert "cam0 and imu0: the gyroscope gives one and the same value throughout" in run(*ask(files, imu="frozen.csv")).mistake
    assert "has no lens: run calibkit intrinsics" in run(*ask(files)[:5], "--rig", bare, "--camera", "corners", "--imu", "imu").mistake
    assert "there is no" in run(*ask(files)[:-4], "--camera", "cam7", "--imu", "imu").mistake
    assert "--knots 1: give 2 to 500 ms" in run(*ask(files, "--knots", 1)).mistake
    assert "--gravity and --latitude" in run(*ask(files, "--gravity", 9.8, "--latitude", 47)).mistake
    short = files / "short.csv"
    write_imu(short, session.imu.select(slice(0, 60)))
    assert "too little time" in run(*ask(files, imu="short.csv")).mistake
