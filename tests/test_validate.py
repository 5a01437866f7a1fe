"""A calibration on other recordings: what is right passes, what is wrong fails with its cause; residuals against the rate of turn."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Run
from recorded_files import write_session
from time_offset_samples import camera_session

from calibkit.data.rig import Rig
from calibkit.data.transforms import make_transform
from calibkit.estimation.speed_sweep import sweep
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.simulation.truth import true_rig
from calibkit.stages.validate import Measured, _distance

TARGET = Path(__file__).resolve().parent.parent / "sample_bags" / "target.yaml"
TD = 0.005


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("validate")
    session = camera_session(3, TD, duration_s=12.0)
    write_session(folder, session)
    rig = true_rig(session, "test")
    save_rig(rig, folder / "rig.yaml")
    dt = rig.time_offsets["dt_imu0_cam0"]
    late = dt.model_copy(update={"offset": dt.offset.model_copy(update={"value": TD + 0.002})})
    save_rig(rig.model_copy(update={"time_offsets": {"dt_imu0_cam0": late}}), folder / "late.yaml")
    return folder


def ask(folder: Path, rig: str, *more: object) -> tuple[object, ...]:
    sources = (folder / "corners.csv", folder / "imu.csv", "--camera", "corners", "--imu", "imu")
    return ("validate", folder / rig, *sources, "--target", TARGET, *more)


def test_what_is_right_passes(run: Run, files: Path, tmp_path: Path) -> None:
    js = tmp_path / "found.json"
    said = run(*ask(files, "rig.yaml", "--json", js, "--distance", "cam0:imu0=69mm"))
    assert said.code == 0, said
    assert "ok  distance, cam0 to imu0: 69.04 +- 0 mm by the rig file, 69.00 +- 1 mm as measured" in said.out
    assert "PASS: the calibration fits this recording" in said.out
    found = json.loads(js.read_text())
    assert all(check["good"] for check in found["checks"])
    assert {check["name"] for check in found["checks"]} >= {"repeatability", "gravity", "board"}
    assert found["speed"]["cam0's corners"]["at_rest"] == pytest.approx(0.2 * np.sqrt(2), rel=0.05)
    assert said.err.count("\n") == 1  # the corners' file without sigmas


def test_distances_that_are_wrong_or_no_distances(run: Run, files: Path) -> None:
    assert (
        "--distance cam0 to cam7: no transform of the rig file joins the two"
        in run(*ask(files, "rig.yaml", "--distance", "cam0:cam7=1m")).mistake
    )
    assert "write two sensors and their distance" in run(*ask(files, "rig.yaml", "--distance", "69mm")).mistake
    assert "write a number with its unit" in run(*ask(files, "rig.yaml", "--distance", "cam0:imu0=69")).mistake


def test_a_measured_distance_speaks_against_a_rig(files: Path) -> None:
    """69.04 mm, known to 0.5 mm along itself, against 75 +- 1 mm and against 71 +- 1 mm."""
    rig = load_rig(files / "rig.yaml")
    T = rig.transforms["T_imu0_cam0"]
    known = Rig(transforms={"T_imu0_cam0": make_transform("imu0", "cam0", T.matrix, np.diag([0.25e-6] * 3 + [1e-6] * 3))})
    far, near = (_distance(known, Measured("imu0", "cam0", size, 0.001)) for size in (0.075, 0.071))
    assert (far.good, near.good) == (False, True)
    assert "69.04 +- 0.5 mm by the rig file" in far.text


def test_what_is_wrong_fails_with_its_cause(run: Run, files: Path) -> None:
    said = run(*ask(files, "late.yaml"))
    assert said.code == 1
    assert "FAIL: cam0's stamps are " in said.out
    assert "later than dt_imu0_cam0 says" in said.out


def test_outputs_are_refused_before_the_work(run: Run, files: Path) -> None:
    said = run(*ask(files, "rig.yaml", "--json", files / "rig.yaml"))
    assert said.code == 2
    assert "rig.yaml" in said.err
    said = run(*ask(files, "none.yaml"))
    assert said.code == 2


def test_a_sweep_tells_noise_from_what_grows_with_the_rate() -> None:
    rng = np.random.default_rng(0)
    rate = rng.uniform(0, 3, 20000)
    noise = 0.2 * rng.standard_normal((20000, 2))
    flat = sweep(rate, noise)
    assert flat is not None
    assert abs(flat.slope) < 4 * flat.slope_sigma
    assert flat.at_rest == pytest.approx(0.2 * np.sqrt(2), rel=0.02)
    grows = sweep(rate, noise + 0.3 * rate[:, None] * rng.choice([-1, 1], 20000)[:, None] * [1.0, 0.0])
    assert grows is not None
    assert abs(grows.slope - 0.3) < 4 * grows.slope_sigma
    assert abs(grows.at_rest - 0.2 * np.sqrt(2)) < 0.02
    assert sweep(np.full(1000, 1.0), noise[:1000]) is None
    assert sweep(rate[:0], noise[:0]) is None
