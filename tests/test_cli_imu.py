"""`calibkit imu` from the command line: stands in, scale and axes out, and one line for every mistake."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from commands import Run
from numpy.typing import NDArray

from calibkit.data.rig import Estimate, ImuIntrinsics
from calibkit.data.verdict import Status, Verdict
from calibkit.geometry import so3
from calibkit.io.rig_file import load_rig
from calibkit.models.imu import STANDARD_GRAVITY, Gravity, ImuModel, gravity_at
from calibkit.simulation.multi_position import MultiPosition, MultiPositionPlan, simulate_multi_position
from calibkit.stages.imu import Options
from calibkit.stages.imu import imu as calibrate

T = TypeVar("T")
Array = NDArray[np.float64]

G = 9.81
ODD = ImuModel(
    M_a=np.array([[1.01, 0, 0], [0.004, 0.99, 0], [-0.003, 0.006, 1.005]]),
    b_a=np.array([0.1, -0.08, 0.12]),
    M_g=np.array([[0.995, 0, 0], [0.003, 1.008, 0], [-0.004, 0.002, 1.002]]),
    C_g_i=so3.exp(np.array([0.004, -0.006, 0.008])),
    b_g=np.array([0.01, -0.02, 0.015]),
)


def write(path: Path, made: MultiPosition, most: int | None = None) -> Path:
    rows = np.column_stack([made.t, made.gyro, made.accel])[:most]
    np.savetxt(path, rows, "%.9f", ",", header="t [s],wx,wy,wz,ax,ay,az", comments="")
    return path


@pytest.fixture(scope="module")
def made() -> MultiPosition:
    return simulate_multi_position(MultiPositionPlan(model=ODD, gravity=G, rate_hz=50.0), seed=3)


@pytest.fixture(scope="module")
def recording(made: MultiPosition, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("stands") / "imu.csv", made)


def intrinsics(path: Path) -> ImuIntrinsics:
    found = load_rig(path).imus["imu0"].intrinsics
    assert found is not None
    return found


def assert_near(parameters: dict[str, Estimate], truth: dict[str, float], names: Iterable[str], sigmas: float = 4.5) -> None:
    for name in names:
        estimate = parameters[name]
        assert estimate.value is not None, name
        assert estimate.sigma is not None, name
        assert abs(estimate.value - truth[name]) < sigmas * estimate.sigma, name


def test_stands_in_scale_and_axes_out(run: Run, recording: Path, made: MultiPosition, tmp_path: Path) -> None:
    said = run("imu", recording, "--gravity", G, "-o", tmp_path / "rig.yaml", "--report", tmp_path / "report")
    assert said.code == 0, said
    found = intrinsics(tmp_path / "rig.yaml")
    assert {estimate.status for estimate in found.parameters.values()} == {Status.DETERMINED}
    assert_near(found.parameters, made.model.values(), found.parameters)
    assert found.verdict is Verdict.PASS
    assert found.correction in said.out
    assert {path.name for path in (tmp_path / "report").iterdir()} == {"pictures", "report.html", "report.json", "report.md"}
    values = {name: estimate.value for name, estimate in found.parameters.items() if estimate.value is not None}
    force, omega = np.array([[0.3, -9.0, 4.0]]), np.array([[0.5, -0.2, 0.9]])
    a, w = ImuModel.of(values).correct(*made.model.measure(force, omega))
    np.testing.assert_allclose(a, force, atol=0.01)
    np.testing.assert_allclose(w, omega, atol=0.005)
    assert run("report", tmp_path / "rig.yaml").code == 0


def test_the_fits_are_counted_while_they_run(recording: Path) -> None:
    counted: dict[str, tuple[int, int | None]] = {}

    def progress(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
        for k, item in enumerate(items, 1):
            counted[what] = (k, total)
            yield item

    loud = calibrate([recording], options=Options(gravity=Gravity(G, 0.0, "given")), progress=progress)
    fits, total = counted["fits to the stands"]
    assert fits >= 3  # the first, a robust one, the last
    assert total is None  # it hangs on what is left out
    assert loud.result.rig == calibrate([recording], options=Options(gravity=Gravity(G, 0.0, "given"))).result.rig


def test_raw_counts_in_two_files(run: Run, tmp_path: Path) -> None:
    device = ImuModel(
        M_a=415 * ODD.M_a, b_a=np.array([33123.0, 33276, 32360]), M_g=4778 * ODD.M_g, C_g_i=ODD.C_g_i, b_g=np.array([32768.0, 32466, 32485])
    )
    made = simulate_multi_position(MultiPositionPlan(model=device, gravity=G, rate_hz=50.0, counts=True), seed=1)
    for name, values in (("acc.txt", made.accel), ("gyro.txt", made.gyro)):
        np.savetxt(tmp_path / name, np.column_stack([made.t, values]), "%.6f")
    units = ("--gyro-unit", "counts", "--accel-unit", "counts")
    said = run("imu", tmp_path / "acc.txt", tmp_path / "gyro.txt", *units, "--gravity", G, "-o", tmp_path / "rig.yaml")
    assert said.code == 0, said
    found = intrinsics(tmp_path / "rig.yaml")
    assert found.unit == "counts"
    assert found.parameters["M_a_xx"].unit == "counts/(m/s^2)"
    assert_near(found.parameters, made.model.values(), ("M_a_xx", "M_a_zy", "b_a_z", "M_g_zz", "b_g_x"))
    assert "raw counts" in run("allan", tmp_path / "acc.txt", tmp_path / "gyro.txt", *units).mistake


def test_gravity_that_is_not_given_is_in_the_scales_sigma(run: Run, recording: Path, tmp_path: Path) -> None:
    scale = {}
    for name, options in (("given", ("--gravity", G)), ("place", ("--latitude", 47.4, "--altitude", 400)), ("none", ())):
        run("imu", recording, *options, "-o", tmp_path / f"{name}.yaml")
        scale[name] = intrinsics(tmp_path / f"{name}.yaml").parameters["M_a_xx"]
    alone, alone_plain = scale["given"].sigma, scale["given"].sigma_plain
    for name, gravity in (("place", gravity_at(47.4, 400)), ("none", STANDARD_GRAVITY)):
        # M goes as 1 / g, and so do the sigmas without gravity's share: these g differ from G by 3.4e-4 of it
        share = scale[name].value * gravity.sigma / gravity.value
        assert scale[name].sigma == pytest.approx(np.hypot(alone, share), rel=1e-3)
        assert scale[name].sigma_plain == pytest.approx(np.hypot(alone_plain, share), rel=1e-3)  # the factor speaks of residuals only
    # WGS 84's own normal gravity at the equator and the pole; the free-air gradient above them
    assert gravity_at(47.4, 400).value - gravity_at(47.4, 0).value == pytest.approx(-3.086e-6 * 400, abs=1e-12)
    assert gravity_at(0, 0).value == pytest.approx(9.7803253359, abs=1e-9)
    assert gravity_at(-90, 0).value == pytest.approx(9.8321849378, abs=1e-9)
    assert "give one of them" in run("imu", recording, "--gravity", G, "--latitude", 47).mistake
    assert "--altitude needs --latitude" in run("imu", recording, "--altitude", 400).mistake
    assert "is no gravity" in run("imu", recording, "--gravity", "nan").mistake


@pytest.mark.parametrize(
    ("sensor", "scale", "option", "unit"), [("accel", 1 / 9.80665, "--accel-unit", "g"), ("gyro", 180 / np.pi, "--gyro-unit", "deg/s")]
)
def test_a_unit_that_is_not_stated_is_told(
    run: Run, made: MultiPosition, tmp_path: Path, sensor: str, scale: float, option: str, unit: str
) -> None:
    path = write(tmp_path / "imu.csv", replace(made, **{sensor: getattr(made, sensor) * scale}))
    said = run("imu", path, "--gravity", G)
    assert "CHECK" in said.out
    assert f"is it in {unit}? then add {option} {unit}" in said.out
    assert "CHECK" not in run("imu", path, "--gravity", G, option, unit).out


def test_too_few_attitudes_are_said_and_what_to_add(run: Run, tmp_path: Path) -> None:
    flat = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.radians([0, 90, 180, 270, 45, 135, 225, 315])])
    made = simulate_multi_position(MultiPositionPlan(model=ODD, up=np.repeat(flat, 2, axis=0), gravity=G, rate_hz=50.0), seed=0)
    said = run("imu", write(tmp_path / "flat.csv", made), "--gravity", G, "-o", tmp_path / "rig.yaml")
    assert said.code == 3, said
    found = intrinsics(tmp_path / "rig.yaml")
    assert found.parameters["M_a_zz"].value is None
    assert found.parameters["M_a_xx"].value is not None
    assert "z scale of the accelerometer (M_a_zz)" in said.out or "M_a_zz" in said.out
    assert "not observable" in said.out
    assert "more position" in said.out


def test_mistakes_are_one_line(run: Run, made: MultiPosition, recording: Path, tmp_path: Path) -> None:
    assert "stand" in run("imu", write(tmp_path / "short.csv", made, 20 * 50)).mistake
    moving = np.column_stack([made.t, np.sin(made.t[:, None] * [2.0, 3.1, 0.7]), 9.8 * np.cos(made.t[:, None] * [1.3, 2.2, 0.9])])
    np.savetxt(tmp_path / "moving.csv", moving, "%.9f", ",", header="t [s],wx,wy,wz,ax,ay,az", comments="")
    assert "moving.csv: moving: the IMU never stood still" in run("imu", tmp_path / "moving.csv").mistake
    np.savetxt(tmp_path / "gyro.csv", moving[:, :4], "%.9f", ",", header="t [s],wx,wy,wz", comments="")
    assert "has no accelerometer" in run("imu", tmp_path / "gyro.csv").mistake
    assert "--gyro-unit furlongs" in run("imu", recording, "--gyro-unit", "furlongs").mistake
    assert "which imu topic" in run("imu", recording, tmp_path / "short.csv").mistake
    assert not list(tmp_path.glob("*.npz"))


def table_rates(path: Path, runs: list[tuple[float, Array]], unit: str = "deg/s") -> Path:
    """Write the rates of runs (begin s, axis) of 20 s each: 0, +60, -60, 0 deg/s at 0, 5, 15, 20 s."""
    scale = 1.0 if unit == "deg/s" else np.pi / 180
    lines = [f"t [s],rate [{unit}],run,nx,ny,nz"]
    for k, (begin, n) in enumerate(runs):
        lines += [f"{begin + dt:.3f},{rate * scale:.9f},{k},{n[0]},{n[1]},{n[2]}" for dt, rate in ((0, 0), (5, 60), (15, -60), (20, 0))]
    path.write_text("\n".join(lines) + "\n")
    return path


def on_the_table(begin: float, n: Array, model: ImuModel, rng: np.random.Generator) -> Array:
    """Return samples (k, 7) of one run at 50 Hz."""
    t = np.arange(begin, begin + 20, 0.02)
    rate = np.radians(np.interp(t - begin, [0, 5, 15, 20], [0, 60, -60, 0]))
    accel, gyro = model.measure(np.tile([0.0, 0.0, G], (len(t), 1)), rate[:, None] * n)
    return np.column_stack([t, gyro + 2e-3 * rng.standard_normal(gyro.shape), accel + 0.02 * rng.standard_normal(accel.shape)])


def test_a_turntable_tells_the_gyroscopes_scale(run: Run, made: MultiPosition, tmp_path: Path) -> None:
    rng, header = np.random.default_rng(0), "t [s],wx,wy,wz,ax,ay,az"
    axes = np.eye(3)
    begins = [made.t[-1] + 2 + 25 * k for k in range(3)]
    spun = np.concatenate([on_the_table(begin, n, made.model, rng) for begin, n in zip(begins, axes, strict=True)])
    stands = np.column_stack([made.t, made.gyro, made.accel])
    np.savetxt(tmp_path / "both.csv", np.concatenate([stands, spun]), "%.9f", ",", header=header, comments="")
    rates = table_rates(tmp_path / "rates.csv", list(zip(begins, axes, strict=True)))
    common = (tmp_path / "both.csv", "--gravity", G)
    run("imu", *common, "-o", tmp_path / "without.yaml")
    said = run("imu", *common, "--turntable", rates, "-o", tmp_path / "with.yaml")
    assert said.code == 0, said
    without, found = intrinsics(tmp_path / "without.yaml").parameters, intrinsics(tmp_path / "with.yaml").parameters
    told = ("M_g_xx", "M_g_yx", "M_g_yy", "M_g_zx", "M_g_zy", "M_g_zz", "phi_g_i_z", "M_a_xx")
    assert_near(found, made.model.values(), told)
    assert all(found[name].sigma <= without[name].sigma for name in told)
    assert "disagree" not in said.out
    twice = table_rates(tmp_path / "twice.csv", list(zip(begins, axes, strict=True)), unit="rad/s")
    twice.write_text(twice.read_text().replace("[rad/s]", "[deg/s]"))  # rates 57 times too small
    assert "turntable and stands disagree" in run("imu", *common, "--turntable", twice).out


def test_a_turntable_alone_tells_no_accelerometer(run: Run, tmp_path: Path) -> None:
    rng, axes = np.random.default_rng(1), np.eye(3)
    begins = [100.0, 125.0, 150.0]
    spun = np.concatenate([on_the_table(begin, n, ODD, rng) for begin, n in zip(begins, axes, strict=True)])
    np.savetxt(tmp_path / "table.csv", spun, "%.9f", ",", header="t [s],wx,wy,wz,ax,ay,az", comments="")
    rates = table_rates(tmp_path / "rates.csv", list(zip(begins, axes, strict=True)))
    said = run("imu", tmp_path / "table.csv", "--turntable", rates, "-o", tmp_path / "rig.yaml")
    assert said.code == 3, said
    found = intrinsics(tmp_path / "rig.yaml").parameters
    assert found["M_a_xx"].value is None
    assert found["phi_g_i_x"].value is None
    assert_near(found, ODD.values(), ("M_g_xx", "M_g_zy", "M_g_zz"))
    assert run("report", tmp_path / "rig.yaml").code == 1
    late = table_rates(tmp_path / "late.csv", [(begin + 1000, n) for begin, n in zip(begins, axes, strict=True)])
    assert "on the IMU's clock" in run("imu", tmp_path / "table.csv", "--turntable", late).mistake
    (tmp_path / "odd.csv").write_text("a,b\n1,2\n")
    assert "is no table of rates" in run("imu", tmp_path / "table.csv", "--turntable", tmp_path / "odd.csv").mistake
    assert "is not a file" in run("imu", tmp_path / "table.csv", "--turntable", tmp_path / "absent.csv").mistake
