"""A calibration that was right, and what happened to the rig since: named, with its size; and nothing where nothing happened.

`pytest -m slow -s tests/test_diagnose.py` prints the confusion matrix of docs/diagnose.md.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Run
from diagnosis_samples import check_many, right_size, seeds_of
from joint_samples import TD, Recording, of_camera
from recorded_files import table, write_imu
from scipy.optimize import least_squares
from time_offset_samples import camera_session

from calibkit.estimation.diagnosis import Cause, Diagnosis, Evidence, Suspect, diagnose, log_tail
from calibkit.estimation.diagnosis_signature import courses, signatures
from calibkit.estimation.diagnosis_words import About, bending, in_words
from calibkit.estimation.joint import Joint
from calibkit.estimation.joint_problem import Drift
from calibkit.estimation.joint_state import CameraState
from calibkit.estimation.joint_suspects import Known, evidence, mount, with_trajectory
from calibkit.estimation.joint_trust import joint_trust
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.io.rig_file import save_rig
from calibkit.models.board import AprilGrid
from calibkit.models.cameras import CAMERAS
from calibkit.models.imu import ImuModel
from calibkit.simulation.corners import views_of_poses
from calibkit.simulation.session import START_NS, Session
from calibkit.simulation.truth import true_rig

TARGET = Path(__file__).resolve().parent.parent / "sample_bags" / "target.yaml"
LONG_S, SHORT_S = 30.0, 12.0
KELVIN = 12.0  # by which it warms up within a recording, faster at first
Times = Array
CREEP = np.radians(0.2)  # in a minute, or by 10 K


def warm(t: Times) -> Array:
    """K above the start."""
    out: Array = KELVIN * (1 - np.exp(-t / 8.0))
    return out


@dataclass(frozen=True)
class Fault:
    """What happened to a rig since its calibration: as functions of time, s, what its parameters moved by."""

    cause: str  # the suspect's key
    size: tuple[float, ...] = ()
    turn: Callable[[Times], Array] | None = None  # (n, 3) rad about the camera's own axes
    shift: Callable[[Times], Array] | None = None  # (n, 3) m along the IMU's axes
    offset: Callable[[Times], Array] | None = None  # (n,) s
    lens: tuple[float, ...] = ()  # what is added to it
    board: float = 1.0  # its size over what its file says
    noise_px: float = 0.2


def along(axis: int, size: float) -> Callable[[Times], Array]:
    return lambda t: np.tile(size * np.eye(3)[axis], (len(t), 1))


FAULTS: dict[str, Fault] = {
    **{f"td {ms} ms": Fault("dt 0", (ms * 1e-3,), offset=lambda t, ms=ms: np.full(len(t), ms * 1e-3)) for ms in (1, 2, 5)},  # type: ignore[misc]
    **{
        f"R {axis} {deg} deg": Fault(f"R_{axis} 0", (np.radians(deg),), turn=along(i, np.radians(deg)))
        for i, axis in enumerate("xyz")
        for deg in (0.2, 1.0)
    },
    **{
        f"p {axis} {mm} mm": Fault(f"p_{axis} 0", (mm * 1e-3,), shift=along(i, mm * 1e-3)) for i, axis in enumerate("xyz") for mm in (5, 20)
    },
    "focal 0.5 %": Fault("focal 0", (2.3025,), lens=(2.306, 2.299, 0, 0, 0, 0, 0, 0)),
    "radial": Fault("distortion 0", (0.01, -0.01, 0.0, 0.0), lens=(0, 0, 0, 0, 0.01, -0.01, 0, 0)),
    "board 1 %": Fault("board scale", (0.01,), board=1.01),
    "pitch with time": Fault("R_x 0 with time", (CREEP,), turn=lambda t: CREEP * t[:, None] / 60 * [[1.0, 0, 0]]),
    "clock with time": Fault("dt 0 with time", (0.002,), offset=lambda t: 0.002 * t / 60),
    "pitch with temperature": Fault("R_x 0 with temperature", (CREEP,), turn=lambda t: CREEP * warm(t)[:, None] / 10 * [[1.0, 0, 0]]),
    "noise x 2": Fault("", noise_px=0.4),
    "nothing": Fault(""),
}
TWO = Fault("dt 0", (0.002,), offset=lambda t: np.full(len(t), 0.002), turn=along(1, np.radians(0.5)))


def recorded_with(fault: Fault, session: Session) -> Recording:
    """What a rig records to which that has happened."""
    track = session.tracks[0]
    t = np.asarray((track.t_true_ns - START_NS) * 1e-9, np.float64)
    T = np.broadcast_to(se3.inverse(track.camera.T_imu_cam), (len(t), 4, 4))
    turns, shifts = mount(T[0])
    for motion, columns in ((fault.turn, turns), (fault.shift, shifts)):
        if motion is not None:
            T = se3.retract(T, motion(t) @ columns.T)
    T_cam_board = T @ se3.inverse(session.trajectory.at(t).T_world_imu) @ session.T_world_board
    camera = replace(track.camera, params=track.camera.params + np.array(fault.lens or np.zeros(8)))
    late = np.zeros(len(t)) if fault.offset is None else fault.offset(t)
    stamps = track.stamp_ns - np.round(late * 1e9).astype(np.int64)
    board = session.board_told
    views, _ = views_of_poses(camera, session.scenario.board, T_cam_board, session.rng(3), fault.noise_px, stamps)
    assert isinstance(board, AprilGrid)
    told = replace(board, tag_size=board.tag_size / fault.board)
    assert session.imu is not None
    return Recording(session, replace(views, board=told), session.imu)


def found_in(fault: Fault, seed: int, duration_s: float = LONG_S) -> tuple[Diagnosis, float]:
    """The diagnosis of a calibration as good as this recording's own, and how the corners' noise came out over what was told."""
    session = camera_session(seed, TD, duration_s=duration_s)
    recording = recorded_with(fault, session)
    told = replace(recording, views=replace(recording.views, sigma_px=np.full(len(recording.views.uv), 0.2)))
    joint = told.fitted()
    where, cov = of_camera(joint, joint_trust(joint.fit))
    T, dt, lens = slice(0, 6), slice(6, 7), slice(7, 15)
    d = np.linalg.cholesky(cov) @ np.random.default_rng((seed, 9)).standard_normal(len(cov))
    camera = session.tracks[0].camera
    was = CameraState(se3.retract(se3.inverse(camera.T_imu_cam), d[T]), TD + float(d[dt][0]), camera.params + d[lens])
    known = Known((was,), ImuModel(), ((cov[T, T], float(cov[6, 6]), cov[lens, lens]),))  # what a rig file keeps of it
    t = np.linspace(0, duration_s, 200)
    drifts = [Drift("time", t[[0, -1]], t[[0, -1]] / 60), Drift("temperature", t, warm(t) / 10)]
    diagnosis = diagnose(*evidence(joint.fit, known, drifts))
    assert where.stop == joint.fit.problem.border.size
    return diagnosis, joint.fit.factors["camera 0"]


@pytest.mark.parametrize("name", ["R y 0.2 deg"])
def test_the_cause_is_named_with_its_size(name: str) -> None:
    fault = FAULTS[name]
    diagnosis, _ = found_in(fault, 0, SHORT_S)
    assert [cause.key for cause in diagnosis.causes] == [fault.cause]
    assert right_size(diagnosis.causes[0], fault.size, 3)
    assert diagnosis.causes[0].share > 0.9


def test_nothing_is_named_where_there_is_only_noise() -> None:
    diagnosis, factor = found_in(FAULTS["noise x 2"], 1, SHORT_S)
    assert diagnosis.causes == ()
    assert factor == pytest.approx(2.0, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_causes_over_many_seeds(name: str) -> None:
    """The top cause is the injected one in 19 of 20, its size right; of noise alone none is named in 99 of 100."""
    fault, found = FAULTS[name], []
    for seed in range(seeds_of(fault.cause)):
        diagnosis, factor = found_in(fault, seed)
        assert factor == pytest.approx(fault.noise_px / 0.2, rel=0.05)
        found.append(diagnosis)
    check_many(name, fault.cause, fault.size, found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_two_causes_at_once_are_both_named(seed: int) -> None:
    diagnosis, _ = found_in(TWO, seed)
    assert {cause.key for cause in diagnosis.causes[:2]} == {"dt 0", "R_y 0"}
    for cause, size in zip(diagnosis.causes, {"dt 0": 0.002, "R_y 0": np.radians(0.5)}.items(), strict=False):
        assert right_size(cause, (dict([size, size])[cause.key],) if cause.key == size[0] else tuple(cause.theta), 4)


def test_the_fewest_causes_are_taken_and_those_that_are_alike_are_told() -> None:
    """Four numbers and a suspect that moves two of them at once; then two that are hardly told apart."""
    rng = np.random.default_rng(0)
    cov = np.eye(4)
    suspects = [Suspect(name, np.eye(4)[:, [k]]) for k, name in enumerate("abcd")]
    suspects.append(Suspect("a and c", np.array([[1.0], [0], [1], [0]])))
    delta = 20 * np.array([1.0, 0, 1, 0]) + rng.standard_normal(4)
    found = diagnose(Evidence(delta, cov, np.linalg.inv(cov), np.ones(4), 1e6), suspects)
    assert [cause.key for cause in found.causes] == ["a and c"]
    assert found.causes[0].theta[0] == pytest.approx(20, abs=2.1)  # 3 sigma of the mean of two
    assert found.causes[0].alike == ()
    mixed = np.array([[1.0, 0.99], [0.99, 1.0]])
    alike = [Suspect("a", np.array([[1.0], [0]])), Suspect("b", np.array([[0.0], [1]]))]
    cov = np.linalg.inv(mixed)
    found = diagnose(Evidence(np.array([10.0, 0.0]), cov, mixed, np.ones(2), 1e6), alike)
    assert [cause.key for cause in found.causes] == ["a"]
    assert found.causes[0].alike == ("b",)


@pytest.mark.slow
def test_a_lens_that_bends_otherwise_is_told_by_what_turning_and_focusing_anew_leaves() -> None:
    """Against a search of the turn and of fx fy cx cy that leave least, over the corners alone."""
    model, lens = CAMERAS["pinhole-radtan"], np.array([460.0, 458, 366, 248, -0.28, 0.07, 0, 0])
    step, uv = np.array([0.003, -0.002, 1e-4, 0.0]), np.random.default_rng(0).uniform([60, 40], [690, 440], (300, 2))
    rays, _ = model.unproject(uv, lens)

    def left(x: Array) -> Array:
        return model.project(rays @ so3.exp(x[:3]).T, lens + np.concatenate([x[3:], step])).uv - uv

    best = least_squares(lambda x: left(x).ravel(), np.zeros(7), x_scale=[1e-3] * 3 + [1.0] * 4, xtol=1e-14).x
    about = About(("cam0",), "imu0", (model,), (lens,), (uv,))
    found = bending(step, about, 0)[1]
    np.testing.assert_allclose(found, left(best), atol=0.02 * np.abs(found).max())
    told = in_words(Cause("distortion 0", step, 1e-8 * np.eye(4), -50.0, 0.9), about)
    assert f"corners are off by {np.sqrt(np.mean(np.sum(found**2, axis=1))):.2g} px rms" in told.text


@pytest.mark.parametrize(
    ("axis", "said", "point", "seen"),
    [
        ("x", "up", (0, 0, 1), (0, 1)),  # who looks up sees what was ahead lower in the image, y points down
        ("y", "to the right", (0, 0, 1), (-1, 0)),
        ("z", "clockwise", (1, 0, 1), (0, -1)),  # turned clockwise, the image turns back
    ],
)
def test_which_way_a_camera_has_turned(axis: str, said: str, point: tuple[float, ...], seen: tuple[int, int]) -> None:
    """T_imu_cam' = T_imu_cam exp(w): the camera stays where it is, and the words are what somebody behind it sees."""
    rng = np.random.default_rng(0)
    T = se3.make(so3.exp(rng.standard_normal(3)), rng.standard_normal(3))
    w = 0.01 * np.eye(3)["xyz".index(axis)]
    turned = se3.retract(T, mount(T)[0] @ w)
    np.testing.assert_allclose(se3.inverse(turned), se3.inverse(T) @ se3.make(so3.exp(w), np.zeros(3)), atol=1e-4)
    before = np.array(point, float)
    after = se3.transform(turned @ se3.inverse(T), before[None])[0]
    assert np.sign(np.round(after[:2] - before[:2], 3)).tolist() == list(seen)
    about = About(("cam0",), "imu0", (CAMERAS["pinhole-radtan"],), (np.ones(8),), (np.zeros((0, 2)),))
    for sign in (1, -1):
        cause = Cause(f"R_{axis} 0", sign * np.array([0.01]), np.array([[1e-8]]), -50.0, 1.0)
        assert (f"cam0 is turned {said} by 0.5730 +- 0.0057 deg about its own {axis} axis" in in_words(cause, about).text) == (sign > 0)


def test_causes_beyond_all_doubt_are_still_ranked() -> None:
    """Chances below the smallest number: of two degrees of freedom they are x^(f/2) exactly."""
    for chi2, freedom in ((3.0, 10.0), (1e5, 600.0), (5000.0, 1e5)):
        assert log_tail(chi2, 2, freedom) == pytest.approx(freedom / 2 * np.log(freedom / (freedom + chi2)), rel=1e-12)
    mixed = np.array([[1.0, 0.9], [0.9, 1.0]])
    suspects = [Suspect("follows", np.array([[1.0], [0.0]])), Suspect("guilty", np.array([[0.0], [1.0]]))]
    found = diagnose(Evidence(np.array([0.0, 1000.0]), np.linalg.inv(mixed), mixed, np.ones(2), 600.0), suspects)
    assert [cause.key for cause in found.causes] == ["guilty"]


def test_chance_names_a_cause_in_one_of_a_hundred() -> None:
    rng = np.random.default_rng(1)
    A = rng.standard_normal((8, 8))
    cov = A @ A.T + np.eye(8)
    suspects = [Suspect(str(k), np.eye(8)[:, [k]]) for k in range(8)]
    L = np.linalg.cholesky(cov)
    named = sum(
        bool(diagnose(Evidence(L @ rng.standard_normal(8), cov, np.linalg.inv(cov), np.ones(8), 1e6), suspects).causes) for _ in range(400)
    )
    assert named <= 12


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording whose camera is 3 ms later than its rig file says, that rig file, and a temperature."""
    folder = tmp_path_factory.mktemp("diagnose")
    session = camera_session(0, TD, duration_s=SHORT_S)
    recording = recorded_with(replace(FAULTS["td 2 ms"], offset=lambda t: np.full(len(t), -0.003)), session)
    views = recording.views
    columns = (views.t_ns[views.frame], views.corner // 4, views.corner % 4, views.uv)
    table(folder / "corners.csv", "t [ns],tag_id,corner_idx,u [px],v [px]", *columns, form="%.4f")
    write_imu(folder / "imu.csv", recording.imu)
    rig = true_rig(session, "test")
    save_rig(rig, folder / "rig.yaml")
    save_rig(rig.model_copy(update={"transforms": {}}), folder / "lens.yaml")
    t = np.arange(0, SHORT_S + 1)
    table(folder / "warm.csv", "t [ns],temperature [C]", START_NS + (t * 1e9).astype(np.int64), 20 + t)
    table(folder / "even.csv", "t [ns],temperature [C]", START_NS + (t * 1e9).astype(np.int64), 20 + 0 * t)
    table(folder / "later.csv", "t [ns],temperature [C]", START_NS + ((t + 100) * 1e9).astype(np.int64), 20 + t)
    return folder


def ask(folder: Path, *more: object, rig: str = "rig.yaml") -> tuple[object, ...]:
    sources = ("diagnose", folder / "corners.csv", folder / "imu.csv", "--target", TARGET, "--rig", folder / rig)
    return (*sources, "--camera", "corners", "--imu", "imu", *more)


def test_the_command_says_what_is_wrong_and_what_to_do(run: Run, late: Path, tmp_path: Path) -> None:
    js = tmp_path / "found.json"
    said = run(*ask(late, "--json", js, "--temperature", late / "warm.csv"))
    assert said.code == 1
    assert re.search(r"FAIL: cam0's stamps are (2\.9|3\.0)\d* \+- 0\.0", said.out)
    assert "later than dt_imu0_cam0 says" in said.out
    assert "run calibkit timeoffset or joint again" in said.out
    assert '"key": "dt 0"' in js.read_text()


@pytest.mark.parametrize(
    ("more", "rig", "why"),
    [
        ((), "lens.yaml", "the rig file has no T_cam0_imu0: run calibkit joint first"),
        (("--temperature", "even.csv"), "rig.yaml", "even.csv: the temperature changes by 0 K within the recording"),
        (("--temperature", "later.csv"), "rig.yaml", "later.csv: its times lie outside of the recording"),
        (("--temperature", "imu.csv"), "rig.yaml", "imu.csv is no table of temperatures"),
        (("--temperature", "none.csv"), "rig.yaml", "none.csv: is not a file"),
    ],
)
def test_mistakes_are_one_line(run: Run, late: Path, more: tuple[str, ...], rig: str, why: str) -> None:
    said = run(*ask(late, *(late / word if word.endswith(".csv") else word for word in more), rig=rig))
    assert said.code == 2
    assert why in said.err
    assert said.err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("command", ["diagnose", "validate"])
def test_the_report_shows_the_causes_and_their_signatures(run: Run, late: Path, tmp_path: Path, command: str) -> None:
    """One page for each command, no request from it, and a picture of what the clock does to the gyroscope."""
    out = tmp_path / "report"
    asked = ask(late, "--report", out, "--temperature", late / "warm.csv")
    if command == "validate":
        asked = ("validate", late / "rig.yaml", *(word for word in asked[1:] if word not in ("--rig", late / "rig.yaml")))
    said = run(*asked)
    assert said.code == 1
    assert said.out.endswith(f"written: {out / 'report.html'}\n")
    page = (out / "report.html").read_text()
    assert len(page) < 3e6
    assert re.search(r"FAIL</span> cam0&#39;s stamps are (2\.9|3\.0)", page.split("</header>")[0])
    assert not re.search(r'(src|href)="(?!data:)', page)
    names = {path.name for path in (out / "pictures").iterdir()}
    assert {"Causes-suspects.png", "Cause_1__dt_imu0_cam0-signature.png", "Cause_1__dt_imu0_cam0-course.png"} <= names
    assert {"cam0-" + command + "-over_time.png", "imu0_gyro-" + command + "-imu_fit.png"} <= names
    assert ({"Checks-speed.png", "Checks-halves.png"} <= names) is (command == "validate")
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "FAIL"
    assert report["facts"][command]["found"]["causes"][0]["key"] == "dt 0"
    again = run(*asked)
    assert again.code == 2
    assert "report.html" in again.err


def against_the_truth(name: str, seed: int) -> tuple[Joint, Known, Evidence, tuple[Suspect, ...]]:
    """Return what a recording with that fault says of the true calibration, taken as exact."""
    session = camera_session(seed, TD, duration_s=LONG_S)
    joint = recorded_with(FAULTS[name], session).fitted()
    camera = session.tracks[0].camera
    was = CameraState(se3.inverse(camera.T_imu_cam), TD, camera.params)
    known = Known((was,), ImuModel(), ((np.zeros((6, 6)), 0.0, np.zeros((8, 8))),))
    return joint, known, *evidence(joint.fit, known, [])


@pytest.mark.slow
def test_a_cause_is_as_large_in_each_window_and_in_the_residuals_as_it_is_named() -> None:
    """A clock that is late all along is level; its gyroscope's residuals are what is predicted, in size and in place."""
    joint, known, found, suspects = against_the_truth("td 2 ms", 2)
    cause = diagnose(found, suspects).causes[0]
    assert cause.key == "dt 0"
    column = next(each.columns for each in suspects if each.key == "dt 0")
    course = courses(joint.fit, [], {"dt 0": column[:, 0]}, {"dt 0": float(cause.theta[0])})["dt 0"]
    assert len(course.t) > 20
    assert 0.6 < np.sqrt(np.mean(((course.theta - 0.002) / course.sigma) ** 2)) < 1.5
    held = with_trajectory(joint.fit.problem, replace(joint.fit.x, cameras=known.cameras))
    by_sensor = signatures(joint.fit, held, [], column @ cause.theta)
    for each in by_sensor.values():
        squares = np.sum(each.predicted**2)
        sigma = np.sqrt(np.sum(each.sigma[:, None] ** 2 * each.predicted**2)) / squares
        assert np.sum(each.left * each.predicted) / squares == pytest.approx(1.0, abs=3 * sigma)
        assert sigma < 0.02


@pytest.mark.slow
def test_a_creeping_mount_has_a_slope_in_its_windows() -> None:
    joint, _, _, suspects = against_the_truth("pitch with time", 3)
    column = next(each.columns for each in suspects if each.key == "R_x 0")
    course = courses(joint.fit, [], {"R_x 0": column[:, 0]}, {"R_x 0": 0.0})["R_x 0"]
    slope, _ = np.polyfit(course.t, course.theta, 1, w=1 / course.sigma)
    assert slope * 60 == pytest.approx(CREEP, rel=0.15)  # its sigma is a tenth of it: 30 s tell a creep of a minute no better
