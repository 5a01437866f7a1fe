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


def test_mistakes_are_one_line(run: Run, session: Session, files: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.yaml"
    save_rig(Rig(), bare)
    assert session.imu is not None
    write_imu(files / "in_g.csv", replace(session.imu, accel=session.imu.accel / 9.80665))
    assert "it is in g; say --accel-unit g" in run(*ask(files, imu="in_g.csv")).mistake
    assert "has no lens: run calibkit intrinsics" in run(*ask(files)[:5], "--rig", bare, "--camera", "corners", "--imu", "imu").mistake
    assert "there is no" in run(*ask(files)[:-4], "--camera", "cam7", "--imu", "imu").mistake
    assert "--knots 1: give 2 to 500 ms" in run(*ask(files, "--knots", 1)).mistake
    assert "--gravity and --latitude" in run(*ask(files, "--gravity", 9.8, "--latitude", 47)).mistake
    short = files / "short.csv"
    write_imu(short, session.imu.select(slice(0, 60)))
    assert "too little time" in run(*ask(files, imu="short.csv")).mistake
