"""`calibkit allan` from the command line: recordings of an IMU at rest in, noise out, and one line for every mistake."""

import csv
import gzip
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import Run
from numpy.typing import NDArray

from calibkit.data.rig import Estimate, Imu, ImuIntrinsics, Rig
from calibkit.data.verdict import Status, Verdict
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.models.imu import ImuModel
from calibkit.models.noise import FLOOR
from calibkit.simulation.noise import SimNoise, simulate_noise

Array = NDArray[np.float64]

RATE = 50.0
GYRO = SimNoise(white=2e-4, flicker=1e-4)
ACCEL = SimNoise(white=2e-3, flicker=1e-3)


def rest(seconds: float, seed: int = 0) -> Array:
    """Return samples (n, 6) rad/s, m/s^2 of an IMU that lies still."""
    rng, n = np.random.default_rng(seed), int(seconds * RATE)
    noise = np.hstack([simulate_noise(kind, n, RATE, rng, 3) for kind in (GYRO, ACCEL)])
    return noise + np.array([0.004, -0.003, 0.002, 0.05, -0.03, 9.81])


def write(path: Path, samples: Array, units: tuple[str, str] = ("rad/s", "m/s^2"), start_ns: int = 1_700_000_000 * 10**9) -> Path:
    names = [f"w{a} [{units[0]}]" for a in "xyz"] + [f"a{a} [{units[1]}]" for a in "xyz"]
    rows = [",".join(["t [ns]", *names])]
    rows += [f"{start_ns + round(k * 1e9 / RATE)}," + ",".join(f"{v:.7g}" for v in row) for k, row in enumerate(samples)]
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("rest") / "imu.csv", rest(1200))


def test_rest_in_noise_out(run: Run, recording: Path, tmp_path: Path) -> None:
    out, report = tmp_path / "rig.yaml", tmp_path / "report"
    said = run("allan", recording, "-o", out, "--report", report, "--json", tmp_path / "all.json", "--table", tmp_path / "curve.csv")
    assert said.code == 3, said  # 20 minutes do not tell a random walk that is not there
    rig = load_rig(out)
    imu = rig.imus["imu0"]
    assert imu.rate_hz == pytest.approx(RATE)
    for axis in ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"):
        white, truth = imu.noise[axis].white, GYRO.white if axis.startswith("gyro") else ACCEL.white
        assert white.value is not None
        assert white.sigma is not None
        assert abs(white.value - truth) < 4 * white.sigma
        assert white.sigma < 0.02 * truth
        assert imu.noise[axis].walk.status is Status.NOT_OBSERVABLE
    assert imu.gyro_noise_density is not None
    assert imu.gyro_noise_density.value == pytest.approx(np.sqrt(np.mean([imu.noise[f"gyro_{a}"].white.value ** 2 for a in "xyz"])))
    assert imu.gyro_random_walk is not None
    assert imu.gyro_random_walk.value is None
    assert imu.verdict is Verdict.FAIL
    assert "gyro_x walk (K) is not observable in this recording" in said.out
    assert " h needed to tell " in said.out
    assert "deg/sqrt(h)" in said.out
    assert {path.name for path in report.rglob("*.*")} >= {"report.html", "report.json", "imu0-allan-allan.png"}
    data = json.loads((tmp_path / "all.json").read_text())
    assert data["facts"]["allan"]["axes"]["gyro_x"]["walk"]["upper95"] > 0
    with (tmp_path / "curve.csv").open() as stream:
        table = list(csv.reader(stream))
    assert table[0][:4] == ["tau [s]", "gyro_x deviation [rad/s]", "gyro_x low [rad/s]", "gyro_x high [rad/s]"]
    at_1_s = min(table[1:], key=lambda row: abs(np.log(float(row[0]))))
    tau, deviation = map(float, at_1_s[:2])
    assert tau == pytest.approx(1, rel=0.05)
    assert deviation == pytest.approx(np.sqrt(GYRO.white**2 / tau + (FLOOR * GYRO.flicker) ** 2), rel=0.03)
    again = run("report", out)
    assert again.code == 1
    assert "accel_z walk" in again.out


def test_export_gives_kalibr_what_is_known_and_refuses_what_is_not(run: Run, recording: Path, tmp_path: Path) -> None:
    assert run("allan", recording, "-o", tmp_path / "rig.yaml").code == 3
    said = run("export", tmp_path / "rig.yaml", "--to", "kalibr", "-o", tmp_path / "kalibr")
    assert "random_walk" in said.mistake
    assert "not observable" in said.mistake


def test_noise_is_added_to_what_a_rig_file_knows(run: Run, recording: Path, tmp_path: Path) -> None:
    values = {name: Estimate(value=value) for name, value in ImuModel().values().items()}
    before = Rig(imus={"imu0": Imu(topic="/imu", intrinsics=ImuIntrinsics(gravity=9.81, parameters=values)), "imu1": Imu(rate_hz=100.0)})
    path = tmp_path / "rig.yaml"
    save_rig(before, path)
    assert run("allan", recording, "--rig", path, "-o", path).code == 3
    after = load_rig(path)
    assert after.imus["imu0"].intrinsics == before.imus["imu0"].intrinsics
    assert after.imus["imu0"].noise
    assert after.imus["imu1"] == before.imus["imu1"]


def test_units_and_gzip_and_no_times(run: Run, tmp_path: Path) -> None:
    samples = rest(300)
    run("allan", write(tmp_path / "si.csv", samples), "-o", tmp_path / "si.yaml")
    people = samples * np.repeat([180 / np.pi, 1 / 9.80665], 3)
    body = "\n".join(
        [",".join(["gx [deg/s]", "gy [deg/s]", "gz [deg/s]", "ax [g]", "ay [g]", "az [g]"])]
        + [",".join(f"{v:.9g}" for v in row) for row in people]
    )
    (tmp_path / "people.csv.gz").write_bytes(gzip.compress(body.encode()))
    assert "--rate" in run("allan", tmp_path / "people.csv.gz").mistake
    run("allan", tmp_path / "people.csv.gz", "--rate", RATE, "-o", tmp_path / "people.yaml")
    si, others = (load_rig(tmp_path / f"{name}.yaml").imus["imu0"].noise for name in ("si", "people"))
    for axis, noise in si.items():
        assert others[axis].white.value == pytest.approx(noise.white.value, rel=1e-4)


@pytest.mark.slow
def test_what_spoils_a_recording_is_named_and_cut(run: Run, tmp_path: Path) -> None:
    samples = rest(600)
    t = np.arange(len(samples)) / RATE
    knock = (t > 200) & (t < 203)
    samples[knock] += 0.5 * np.sin(40 * t[knock])[:, None]
    said = run("allan", write(tmp_path / "knocked.csv", samples), "-o", tmp_path / "rig.yaml")
    assert "motion" in said.out
    assert "cut out" in said.out
    white = load_rig(tmp_path / "rig.yaml").imus["imu0"].noise["gyro_x"].white
    assert white.value == pytest.approx(GYRO.white, rel=0.03)
    kept = run("allan", tmp_path / "knocked.csv", "--no-cut")
    assert "cut out" not in kept.out


def test_mistakes_are_one_line(run: Run, recording: Path, tmp_path: Path) -> None:
    moving = rest(120)
    moving += 0.3 * np.sin(np.arange(len(moving)) / RATE * np.array([[2.0], [3.1], [0.7], [1.3], [2.2], [0.9]])).T
    assert "not at rest" in run("allan", write(tmp_path / "moving.csv", moving)).mistake
    holes = write(tmp_path / "holes.csv", rest(60))
    holes.write_text("t [ns],wx,wy,wz,ax,ay,az\n" + "\n".join(f"{k},nan,nan,nan,nan,nan,nan" for k in range(100)))
    assert "holes.csv" in run("allan", holes).mistake
    (tmp_path / "poses.csv").write_text("t,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,1\n")
    assert "no imu topic" in run("allan", tmp_path / "poses.csv").mistake
    equal = write(tmp_path / "equal.csv", np.tile([0.01, 0.02, 0.03, 0.0, 0.0, 9.81], (3000, 1)))
    assert "no axis ever changes" in run("allan", equal).mistake
    stands = Path(__file__).parents[1] / "sample_bags" / "imu_stands.csv.gz"
    assert "that is a recording for calibkit imu" in run("allan", stands).mistake
    other = write(tmp_path / "imu_b.csv", rest(60, seed=1))
    assert "which imu topic" in run("allan", recording, other).mistake
    assert "--kind parabolic" in run("allan", recording, "--kind", "parabolic").mistake
    assert "absent.csv" in run("allan", tmp_path / "absent.csv").mistake
    out = tmp_path / "there.yaml"
    out.write_text("")
    assert "--force" in run("allan", recording, "-o", out).mistake
    assert "write imu0=/topic" in run("allan", recording, "--imu", "=x").mistake
    assert not list(tmp_path.glob("*.npz"))


def test_too_short_a_recording_says_what_it_cannot_tell(run: Run, tmp_path: Path) -> None:
    said = run("allan", write(tmp_path / "short.csv", rest(20)), "-o", tmp_path / "rig.yaml")
    assert said.code == 3
    assert "lasts 20 s" in said.out.replace("19.98", "20")
    noise = yaml.safe_load((tmp_path / "rig.yaml").read_text())["imus"]["imu0"]["noise"]["gyro_x"]
    assert noise["flicker"]["value"] is None
    assert noise["walk"]["value"] is None
    assert abs(noise["white"]["value"] - GYRO.white) < 4.5 * noise["white"]["sigma"]
    assert noise["white"]["sigma"] < 0.03 * GYRO.white


def test_degrees_taken_for_radians_and_g_for_metres_are_told(run: Run, tmp_path: Path) -> None:
    wrong = rest(120) * np.repeat([180 / np.pi, 1 / 9.80665], 3)
    said = run("allan", write(tmp_path / "wrong.csv", wrong))
    assert "CHECK imu0: " in said.out
    assert "--accel-unit g" in said.out


def test_a_dead_sensor_is_told_and_drawn_without(run: Run, tmp_path: Path) -> None:
    samples = rest(60)
    samples[:, :3] = 0
    report = tmp_path / "report"
    said = run("allan", write(tmp_path / "imu.csv", samples), "--report", report)
    assert said.code == 3, said
    assert "gyro_x white, gyro_x flicker and gyro_x walk are not observable: every sample has the same value" in said.out
    assert (report / "pictures" / "imu0-allan-allan.png").exists()


def test_a_density_of_fewer_than_three_axes_names_them(run: Run, tmp_path: Path) -> None:
    samples = rest(600)
    samples[:, :2] = simulate_noise(replace(GYRO, walk=1e-4), len(samples), RATE, np.random.default_rng(1), 2)
    samples[:, 5] = 0
    said = run("allan", write(tmp_path / "imu.csv", samples), "-o", tmp_path / "rig.yaml")
    assert "CHECK imu0: gyro_random_walk rests on x and y only: the recording does not tell K of z\n" in said.out
    assert "CHECK imu0: accel_noise_density rests on x and y only: the recording does not tell N of z\n" in said.out
    assert said.out.count(" rests on ") == 2  # of no K of the accelerometer, and of all N of the gyroscope
    imu = load_rig(tmp_path / "rig.yaml").imus["imu0"]
    assert imu.gyro_random_walk is not None
    assert imu.gyro_random_walk.value == pytest.approx(np.sqrt(np.mean([imu.noise[axis].walk.value ** 2 for axis in ("gyro_x", "gyro_y")])))
    assert "gyro_random_walk rests on x and y only" in run("report", tmp_path / "rig.yaml").out


@pytest.mark.parametrize("name", ["\u00fc0", "a" * 41, "0imu", ""])
def test_a_name_that_the_rig_file_would_refuse_is_refused(run: Run, recording: Path, name: str) -> None:
    assert "write imu0=/topic" in run("allan", recording, "--imu", f"{name}=").mistake


def test_two_files_of_different_rates_are_taken_one_by_one(run: Run, tmp_path: Path) -> None:
    samples = rest(400)
    t = np.arange(len(samples)) / RATE
    np.savetxt(tmp_path / "gyro.csv", np.column_stack([t, samples[:, :3]]), "%.9f", ",", header="t [s],gx,gy,gz", comments="")
    np.savetxt(tmp_path / "acc.csv", np.column_stack([t, samples[:, 3:]])[::4], "%.9f", ",", header="t [s],ax,ay,az", comments="")
    assert "give one file" in run("allan", tmp_path / "gyro.csv", tmp_path / "acc.csv").mistake  # every 4th rate would have twice the N
    run("allan", tmp_path / "gyro.csv", "-o", tmp_path / "one.yaml")
    run("allan", tmp_path / "acc.csv", "--rig", tmp_path / "one.yaml", "-o", tmp_path / "both.yaml")
    noise = load_rig(tmp_path / "both.yaml").imus["imu0"].noise
    assert noise["gyro_x"].white.value == pytest.approx(GYRO.white, rel=0.05)
    assert noise["accel_x"].white.value is not None


@pytest.mark.parametrize("fault", ["twice", "clock"])
def test_neither_repeated_samples_nor_a_clock_that_is_set_back_change_the_rate(run: Run, tmp_path: Path, fault: str) -> None:
    lines = write(tmp_path / "imu.csv", rest(400)).read_text().splitlines()
    if fault == "twice":
        lines = [lines[0], *(line for line in lines[1:] for _ in range(2))]
    else:
        late = write(tmp_path / "late.csv", rest(400), start_ns=1_699_999_500 * 10**9).read_text().splitlines()
        lines += late[1:]
    (tmp_path / "imu.csv").write_text("\n".join(lines) + "\n")
    run("allan", tmp_path / "imu.csv", "-o", tmp_path / "rig.yaml")
    imu = load_rig(tmp_path / "rig.yaml").imus["imu0"]
    assert imu.rate_hz == pytest.approx(RATE)
    assert imu.noise["gyro_x"].white.value == pytest.approx(GYRO.white, rel=0.05)
