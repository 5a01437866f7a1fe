"""`calibkit timeoffset` from the command line: every pair, every way to name it, signs to the last export, one line for every mistake."""

import json
import re
from collections.abc import Iterable
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import Run, Said
from matplotlib.figure import Figure
from recorded_files import table, write_imu, write_poses, write_session
from recording_helper import Make, write
from time_offset_samples import R_OF_TO, camera_session, constant_rate, lens, path, pose_imu, seen_gyro, seen_poses, stamps, wheels_imu

from calibkit.data.observations import FeatureTracks, ImageFrame, ImuSamples, PoseSamples
from calibkit.data.result import ResidualSet
from calibkit.data.rig import Estimate, Rig
from calibkit.data.transforms import make_time_offset, make_transform
from calibkit.data.verdict import Status, Verdict
from calibkit.detection.tracks import track_features
from calibkit.geometry import se3
from calibkit.io.bag_writer import ImuPayload, Sample, Stream, write_bag
from calibkit.io.residual_file import load_result
from calibkit.io.rig_file import load_rig, save_rig
from calibkit.io.target_file import dump_target
from calibkit.report import page
from calibkit.simulation.trajectory import Trajectory
from calibkit.stages import sensor_turns

SAMPLES = Path(__file__).parent.parent / "sample_bags"
README = Path(__file__).parent.parent / "README.md"
TD = 0.025  # s: what every recording here has, t_to = t_of + td
DURATION_S = 15.0


# What the sensors of one rig saw, in files.


class Files:
    """A camera before a board and an IMU: what a person has after recording."""

    def __init__(self, folder: Path, motion: str = "rich", td: float = TD) -> None:
        self.folder = folder
        self.session = camera_session(0, td, duration_s=DURATION_S, motion=motion)
        self.imu, self.corners = write_session(folder, self.session)
        self.target = folder / "target.yaml"
        self.target.write_text(dump_target(self.session.board_told))
        self.lens = save(Rig(cameras={"cam0": lens(self.session).model_copy(update={"topic": "corners"})}), folder / "lens.yaml")

    @property
    def asked(self) -> tuple[object, ...]:
        return (self.imu, self.corners, "--target", self.target, "--rig", self.lens)


def save(rig: Rig, file: Path) -> Path:
    save_rig(rig, file)
    return file


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> Files:
    return Files(tmp_path_factory.mktemp("rich"))


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the report's pictures out: one run here lays them out, and the report has tests of its own."""
    monkeypatch.setattr(page, "draw", lambda view, formats: [])


@pytest.fixture(scope="module")
def body() -> Trajectory:
    return path(0)


@pytest.fixture(scope="module")
def imu_file(body: Trajectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    imu = seen_gyro(body, stamps(200, DURATION_S), np.random.default_rng(0))
    return write_imu(tmp_path_factory.mktemp("body") / "imu.csv", imu)


@pytest.fixture(scope="module")
def pose_file(body: Trajectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_poses(tmp_path_factory.mktemp("poses") / "arm.csv", poses_of(body))


def poses_of(body: Trajectory, rate_hz: float = 30, td: float = TD) -> PoseSamples:
    t_ns = stamps(rate_hz, DURATION_S - 2, 1.0123)
    return seen_poses(body, t_ns, 1e-3, np.random.default_rng(1), R_OF_TO.T, td)


def saved(out: Path) -> tuple[ResidualSet, ...]:
    """Return turns, V and windows as the report will read them."""
    rig = load_rig(out)
    return load_result(out, rig, rig.provenance[-1]).residuals


def offset(rig: Path, name: str = "dt_imu0_cam0") -> Estimate:
    return load_rig(rig).time_offsets[name].offset


def assert_found(estimate: Estimate, truth: float = TD, within: float = 1e-3) -> None:
    assert estimate.value is not None
    assert estimate.sigma is not None
    assert 0 < estimate.sigma < within
    assert abs(estimate.value - truth) < 4 * estimate.sigma, estimate
    assert estimate.status is Status.DETERMINED


def assert_told(said: Said, of: str, to: str, truth_ms: float = 1e3 * TD) -> None:
    """The answer in words: early or late, what to add, and the number with its interval."""
    assert said.code == 0, said
    found = re.search(rf"t_{to} = t_{of} \+ td: {of}'s stamps are ([\d.]+) ms (early|late): add ([+-])([\d.]+) ms to them", said.out)
    assert found, said.out
    assert found[2] == ("early" if truth_ms > 0 else "late")
    assert found[3] == ("+" if truth_ms > 0 else "-")
    assert float(found[1]) == float(found[4]) == pytest.approx(abs(truth_ms), abs=1.0)
    assert re.search(r"td [+-][\d.]+ \+- [\d.e-]+ ms; 95 %: [+-][\d.]+ to [+-][\d.]+ ms", said.out)


# Every pair.


def test_a_camera_before_a_board(run: Run, rich: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: None)  # the pictures are laid out all the same
    out, js, report = tmp_path / "rig.yaml", tmp_path / "td.json", tmp_path / "report"
    said = run("timeoffset", *rich.asked, "-o", out, "--json", js, "--report", report)
    assert_told(said, "cam0", "imu0")
    assert_found(offset(out), within=1e-4)
    entry = load_rig(out).time_offsets["dt_imu0_cam0"]
    assert entry.equation == "t_imu0 = t_cam0 + dt_imu0_cam0"
    assert entry.verdict is Verdict.PASS
    kept = load_rig(out)
    assert kept.cameras == load_rig(rich.lens).cameras  # what the rig file had is still there
    assert kept.provenance[-1].stage == "timeoffset"
    assert kept.provenance[-1].options["of"] == "cam0=corners"
    digests = {file.name: file.sha256 for file in kept.provenance[-1].inputs}
    assert digests["lens.yaml"] == sha256(rich.lens.read_bytes()).hexdigest()  # the lens decides
    found = json.loads(js.read_text())
    facts = found["facts"]["timeoffset"]["time_offset"]["dt_imu0_cam0"]
    assert facts["equation"] == "t_imu0 = t_cam0 + td"
    low, high = facts["interval_95"]
    assert low < TD < high
    assert high - low == pytest.approx(2 * 1.96 * facts["sigma"], rel=0.3)
    assert facts["td"] == offset(out).value
    # 5 ms at 1 rad/s and 500 px are 2.5 px (the SPEC's worked example 3)
    assert facts["px_at_max_rate"] == pytest.approx(461.2 * facts["rate_max"] * facts["td"])
    assert {path.name for path in report.rglob("*.*")} == {
        "report.html",
        "report.json",
        "report.md",
        *(f"dt_imu0_cam0-timeoffset-{name}.png" for name in ("v_curve", "rates", "residual_rate", "offset_over_time")),
    }
    turns, v, _ = saved(tmp_path / "rig.yaml")
    assert {"rate", "of_rate", "rate_before", "before", "kept"} <= turns.context.keys()
    assert v.context["delay"][int(np.argmin(v.raw[:, 0]))] == pytest.approx(TD, abs=5e-4)
    assert run("report", out).code == 0


@pytest.mark.usefixtures("undrawn")
def test_the_sample_bag_says_what_the_readme_says(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Digits may differ by the version of OpenCV, words may not; and the truth is known."""
    shown = re.search(r"    \$ calibkit (timeoffset .*)\n((?:    .*\n|\n)+)", README.read_text(encoding="utf-8"))
    assert shown
    lens_only = load_rig(SAMPLES / "truth.yaml")
    (tmp_path / "out").mkdir()
    save(Rig(cameras=lens_only.cameras), tmp_path / "out" / "rig.yaml")
    (tmp_path / "sample_bags").symlink_to(SAMPLES)
    monkeypatch.chdir(tmp_path)
    said = run(*shown[1].split())
    assert said.code == 0

    def words(text: str) -> str:
        return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?|[─ ]+", " ", text).replace("  ", " ").strip()

    assert [words(line) for line in said.out.splitlines()] == [words(line) for line in shown[2].rstrip().splitlines()]
    truth = load_rig(SAMPLES / "truth.yaml").time_offsets["dt_imu0_cam0"].offset.value
    assert truth is not None
    assert_found(offset(Path("out/rig.yaml")), truth, within=1e-4)
    printed = re.search(r"td ([+-][\d.]+) \+- ([\d.]+) ms", shown[2])
    assert printed
    assert abs(float(printed[1]) * 1e-3 - truth) < 3 * float(printed[2]) * 1e-3


def test_a_camera_without_a_board(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[FeatureTracks] = []  # the features are followed once for both runs, through two thirds of the images

    def followed(images: Iterable[ImageFrame], *others: Any) -> FeatureTracks:
        seen.extend([] if seen else [track_features(islice(images, 100), *others)])
        return seen[0]

    monkeypatch.setattr(sensor_turns, "track_features", followed)
    bag, rig = SAMPLES / "cam_imu.bag", SAMPLES / "truth.yaml"
    said = run("timeoffset", bag, "--rig", rig, "-o", tmp_path / "rig.yaml")
    assert_told(said, "cam0", "imu0", 5.0)
    assert "features, two views" in said.out
    assert_found(offset(tmp_path / "rig.yaml"), 0.005, within=2e-4)
    plain = run("timeoffset", bag, "--rig", rig, "--plain")
    assert "rotation only (plain: biased beside near things)" in plain.out


def test_poses_and_an_imu(run: Run, imu_file: Path, pose_file: Path, tmp_path: Path) -> None:
    said = run("timeoffset", imu_file, pose_file, "-o", tmp_path / "rig.yaml")
    assert_told(said, "pose0", "imu0")
    assert_found(offset(tmp_path / "rig.yaml", "dt_imu0_pose0"))
    v = re.search(r"R_pose0_imu0 = exp\(([-\d.]+), ([-\d.]+), ([-\d.]+)\) deg", said.out)
    assert v
    np.testing.assert_allclose(np.radians([float(x) for x in v.groups()]), [0.7, -1.9, 1.1], atol=2e-3)


def test_poses_the_other_way_round_need_an_option(run: Run, imu_file: Path, body: Trajectory, tmp_path: Path) -> None:
    poses = poses_of(body)
    turned = PoseSamples(poses.t_ns, poses.q * [-1, -1, -1, 1], poses.p, "body", "world")
    inverse = write_poses(tmp_path / "inverse.csv", turned)
    said = run("timeoffset", imu_file, inverse, "-o", tmp_path / "wrong.yaml")
    assert said.code in (1, 3), said
    assert "--inverse-poses" in said.out
    said = run("timeoffset", imu_file, inverse, "--inverse-poses", "-o", tmp_path / "rig.yaml")
    assert_told(said, "pose0", "imu0")
    assert_found(offset(tmp_path / "rig.yaml", "dt_imu0_pose0"))


def test_two_pose_files(run: Run, body: Trajectory, imu_file: Path, pose_file: Path, tmp_path: Path) -> None:
    """One of them TUM's, blank-separated and in seconds; the faster is the clock that counts."""
    fast = seen_poses(body, stamps(100, DURATION_S), 2e-4, np.random.default_rng(2), td=0.04)
    tum = tmp_path / "mocap.txt"
    rows = zip(fast.t_ns, np.hstack([fast.p, fast.q]), strict=True)
    tum.write_text("".join(f"{t // 10**9}.{t % 10**9:09d} " + " ".join(f"{x:.9f}" for x in row) + "\n" for t, row in rows))
    said = run("timeoffset", tum, pose_file, "-o", tmp_path / "rig.yaml")
    assert_told(said, "pose1", "pose0", -15.0)
    assert_found(offset(tmp_path / "rig.yaml", "dt_pose0_pose1"), TD - 0.04)
    # an IMU asked the other way round: the sign turns
    said = run("timeoffset", imu_file, tum, "--of", "imu0", "--to", "pose0", "-o", tmp_path / "turned.yaml")
    assert_told(said, "imu0", "pose0", -40.0)
    assert_found(offset(tmp_path / "turned.yaml", "dt_pose0_imu0"), -0.04)


def test_two_imus(run: Run, body: Trajectory, imu_file: Path, tmp_path: Path) -> None:
    slow = seen_gyro(body, stamps(100, DURATION_S - 2, 1.0023), np.random.default_rng(3), None, R_OF_TO.T, TD)
    second = write_imu(tmp_path / "headset.csv", slow)
    said = run("timeoffset", imu_file, second, "-o", tmp_path / "rig.yaml")
    assert_told(said, "imu1", "imu0")
    assert_found(offset(tmp_path / "rig.yaml", "dt_imu0_imu1"))


def test_times_of_recording_are_doubted(run: Run, body: Trajectory, imu_file: Path, tmp_path: Path) -> None:
    """An IMU whose header stamps are zero is dated by when it was recorded, which is no time of its own."""
    other = seen_gyro(body, stamps(100, DURATION_S - 2, 1.003), np.random.default_rng(5), None, R_OF_TO.T, TD)
    rows = zip(other.t_ns, other.gyro, other.accel, strict=True)
    messages = [Sample(int(t) + 3_000_000, 0, ImuPayload(gyro, accel)) for t, gyro, accel in rows]
    write_bag(tmp_path / "other.bag", [Stream("/imu", "imu", "imu", messages)], "ros1")
    said = run("timeoffset", imu_file, tmp_path / "other.bag", "-o", tmp_path / "rig.yaml")
    assert said.code == 0, said
    assert re.search(r"CHECK dt_\S+: 1300 stamps of imu1 are zero in the header and times of recording are used", said.out), said.out


def test_wheels_and_an_imu(run: Run, tmp_path: Path) -> None:
    sample = wheels_imu(0, TD, 40.0)
    assert isinstance(sample.reference, ImuSamples)
    imu = write_imu(tmp_path / "imu.csv", sample.reference)
    turns = sample.turns
    middle = (turns.t_ns[turns.first] + turns.t_ns[turns.last]) // 2
    wheels = table(tmp_path / "wheels.csv", "t [ns],yaw_rate [rad/s]", middle, turns.angle[:, 2] / turns.duration)
    said = run("timeoffset", imu, wheels, "-o", tmp_path / "rig.yaml")
    assert_told(said, "odom0", "imu0")
    assert_found(offset(tmp_path / "rig.yaml", "dt_imu0_odom0"), within=3e-3)
    assert "rotation found" not in said.out  # one axis does not tell it


def test_a_bag_of_tf_twists_and_imu(run: Run, body: Trajectory, tmp_path: Path) -> None:
    """tf is looked at where it is asked for; an IMU counts as the clock, a pair is found by itself where the topics are two."""
    make, poses = Make("ros1"), poses_of(body)
    imu = seen_gyro(body, stamps(200, DURATION_S), np.random.default_rng(0))
    wheels = seen_gyro(body, stamps(50, DURATION_S - 2, 1.003), np.random.default_rng(5), None, R_OF_TO.T, TD)
    messages = [("/imu", int(t), make.imu(int(t), w, a)) for t, w, a in zip(imu.t_ns, imu.gyro, imu.accel, strict=True)]
    messages += [("/tf", int(t), make.tf((int(t), "map", "tool", p, q))) for t, p, q in zip(poses.t_ns, poses.p, poses.q, strict=True)]
    messages += [("/odom", int(t), make.twist(int(t), w)) for t, w in zip(wheels.t_ns, wheels.gyro, strict=True)]
    bag = write(tmp_path, "ros1", sorted(messages, key=lambda message: message[1]))
    assert_told(
        run("timeoffset", bag, "--pose", "tf:map/tool", "-o", tmp_path / "tf.yaml", "--to", "imu0", "--of", "pose0"), "pose0", "imu0"
    )
    assert_found(offset(tmp_path / "tf.yaml", "dt_imu0_pose0"))
    assert_told(run("timeoffset", bag, "-o", tmp_path / "odom.yaml"), "odom0", "imu0")
    assert_found(offset(tmp_path / "odom.yaml", "dt_imu0_odom0"), within=5e-3)
    assert "the recording's frames: map, tool" in run("timeoffset", bag, "--pose", "tf:map/gone", "--of", "pose0").mistake
    for odd in ("/tf", "tf:", "tf:map"):
        assert "name two frames, --pose tf:PARENT/CHILD" in run("timeoffset", bag, "--pose", odd, "--of", "pose0").mistake


# How sensors are named.


def test_names_and_topics(run: Run, imu_file: Path, pose_file: Path, tmp_path: Path) -> None:
    third = write_poses(tmp_path / "leg.csv", poses_of(path(0), 25))
    three = (imu_file, pose_file, third)
    offered = run("timeoffset", *three).mistake
    assert "which two?" in offered
    assert all(name in offered for name in ("imu0 (imu)", "pose0 (arm)", "pose1 (leg)", "--of NAME --to NAME"))
    assert_told(run("timeoffset", *three, "--of", "pose1"), "pose1", "imu0")  # the IMU is the other one
    assert_told(run("timeoffset", *three, "--of", "arm", "--to", "imu"), "pose0", "imu0")
    said = run("timeoffset", *three, "--pose", "gripper=leg", "--imu", "base=imu", "-o", tmp_path / "named.yaml")
    assert_told(said, "gripper", "base")
    assert_found(offset(tmp_path / "named.yaml", "dt_base_gripper"))


def test_names_come_from_the_rig_file_by_topic(run: Run, rich: Files, tmp_path: Path) -> None:
    base = load_rig(rich.lens)
    named = save(Rig(cameras={"left": base.cameras["cam0"]}), tmp_path / "named.yaml")
    said = run("timeoffset", rich.imu, rich.corners, "--target", rich.target, "--rig", named, "-o", tmp_path / "rig.yaml")
    assert_told(said, "left", "imu0")
    assert_found(offset(tmp_path / "rig.yaml", "dt_imu0_left"))


# The rig file and what is exported: signs.


def true_rig(rich: Files, *transforms: str) -> Rig:
    base, T = load_rig(rich.lens), rich.session.tracks[0].camera.T_imu_cam
    known = {"T_imu0_cam0": make_transform("imu0", "cam0", T), "T_cam0_imu0": make_transform("cam0", "imu0", se3.inverse(T))}
    return base.model_copy(update={"transforms": {name: known[name] for name in transforms}})


def test_the_sign_through_every_export(run: Run, rich: Files, tmp_path: Path) -> None:
    """+25 ms injected: camera stamps are early, and Kalibr's timeshift_cam_imu is +0.025 beside its T_cam_imu, not that one's inverse."""
    rig = save(true_rig(rich, "T_imu0_cam0"), tmp_path / "rig.yaml")
    said = run("timeoffset", rich.imu, rich.corners, "--target", rich.target, "--rig", rig, "-o", rig)  # in place
    assert said.code == 0, said
    assert "the rotation of the rig file" not in said.out
    found = offset(rig)
    assert_found(found, within=1e-4)
    T_imu_cam = rich.session.tracks[0].camera.T_imu_cam
    for form, file in (("kalibr", "camchain.yaml"), ("openvins", "kalibr_imucam_chain.yaml")):
        assert run("export", rig, "--to", form, "-o", tmp_path / form).code == 0
        text = (tmp_path / form / file).read_text().removeprefix("%YAML:1.0\n")
        cam0 = yaml.safe_load(text)["cam0"]
        assert cam0["timeshift_cam_imu"] == pytest.approx(found.value, abs=1e-12)
        assert cam0["timeshift_cam_imu"] > 0.0245
        if "T_cam_imu" in cam0:
            np.testing.assert_allclose(cam0["T_cam_imu"], se3.inverse(T_imu_cam), atol=1e-9)
        else:
            np.testing.assert_allclose(cam0["T_imu_cam"], T_imu_cam, atol=1e-9)
        assert run("import", tmp_path / form / file, "-o", tmp_path / f"{form}.yaml").code == 0
        assert offset(tmp_path / f"{form}.yaml").value == pytest.approx(found.value, abs=1e-12)


def test_a_rig_file_that_has_it_the_other_way_round_keeps_its_name(run: Run, rich: Files, tmp_path: Path) -> None:
    turned = make_time_offset("cam0", "imu0", Estimate(value=0.1, unit="s"))
    rig = save(true_rig(rich, "T_cam0_imu0").model_copy(update={"time_offsets": {"dt_cam0_imu0": turned}}), tmp_path / "rig.yaml")
    said = run("timeoffset", rich.imu, rich.corners, "--target", rich.target, "--rig", rig, "-o", rig)
    assert_told(said, "cam0", "imu0")
    assert "the rotation of the rig file" not in said.out
    assert "the rig file has it the other way round: t_cam0 = t_imu0 + dt_cam0_imu0, dt_cam0_imu0 = -td" in said.out
    assert set(load_rig(rig).time_offsets) == {"dt_cam0_imu0"}
    assert_found(offset(rig, "dt_cam0_imu0"), -TD)
    assert load_rig(rig).time_offsets["dt_cam0_imu0"].equation == "t_cam0 = t_imu0 + dt_cam0_imu0"
    assert run("export", rig, "--to", "kalibr", "-o", tmp_path / "kalibr").code == 0
    assert yaml.safe_load((tmp_path / "kalibr" / "camchain.yaml").read_text())["cam0"]["timeshift_cam_imu"] > 0.0245


def test_the_rotation_of_the_rig_file(run: Run, rich: Files, tmp_path: Path) -> None:
    for name in ("T_imu0_cam0", "T_cam0_imu0"):
        rig = save(true_rig(rich, name), tmp_path / f"{name}.yaml")
        asked = (rich.imu, rich.corners, "--target", rich.target, "--rig", rig)
        assert_told(run("timeoffset", *asked, "--fix-rotation", "-o", tmp_path / f"{name}_td.yaml"), "cam0", "imu0")
        assert_found(offset(tmp_path / f"{name}_td.yaml"), within=1e-4)
    swapped = se3.inverse(rich.session.tracks[0].camera.T_imu_cam)
    wrong = load_rig(rich.lens).model_copy(update={"transforms": {"T_imu0_cam0": make_transform("imu0", "cam0", swapped)}})
    said = run("timeoffset", *rich.asked[:-1], save(wrong, tmp_path / "wrong.yaml"))
    assert re.search(r"CHECK .*the rotation of the rig file \(T_imu0_cam0\) is \d+\.\d deg off", said.out), said.out
    assert "nor a chain of transforms between them" in run("timeoffset", *rich.asked, "--fix-rotation").mistake


# Options that add to the answer.


def test_delays_that_are_no_clocks_fault(run: Run, rich: Files, tmp_path: Path) -> None:
    said = run(
        "timeoffset",
        *rich.asked,
        "--camera",
        "cam0=corners",
        "--gyro-bandwidth",
        40,
        "--exposure",
        8,
        "--readout",
        20,
        "--json",
        tmp_path / "td.json",
    )
    # 1 / (2 pi 40 Hz) = 3.98 ms, of second order sqrt(2) times as much; (8 + 20) / 2 = 14 ms
    assert "+3.98 to +5.63 ms by the low-pass of imu0 at 40 Hz, and +14.00 ms by exposure and readout of cam0" in said.out
    rest = re.search(r"the clocks would be ([+-][\d.]+) ms apart", said.out)
    assert rest
    assert float(rest[1]) == pytest.approx(25 - 3.98 - 14, abs=0.1)
    delays = json.loads((tmp_path / "td.json").read_text())["facts"]["timeoffset"]["time_offset"]["dt_imu0_cam0"]["delays"]
    assert delays == {"gyro_low_pass": pytest.approx(1 / (80 * np.pi)), "exposure_and_readout": pytest.approx(0.014)}


def test_bootstrap(run: Run, imu_file: Path, pose_file: Path, tmp_path: Path) -> None:
    long = pose_imu(path(0), 0, TD, 1e-3, 50.0)
    assert isinstance(long.reference, ImuSamples)
    poses = seen_poses(path(0), stamps(20, 48.0, 1.0123), 1e-3, np.random.default_rng(1), R_OF_TO.T, TD)
    asked = (write_imu(tmp_path / "imu.csv", long.reference), write_poses(tmp_path / "arm.csv", poses))
    said = run("timeoffset", *asked, "--bootstrap", 200, "-o", tmp_path / "rig.yaml")
    drawn = re.search(r"bootstrap over stretches: \+- ([\d.e-]+) ms", said.out)
    assert drawn
    sigma = offset(tmp_path / "rig.yaml", "dt_imu0_pose0").sigma
    assert sigma is not None
    assert float(drawn[1]) * 1e-3 == pytest.approx(sigma, rel=0.5)  # two sigmas: the spread of 9 stretches is itself known to 24 %
    few = run("timeoffset", imu_file, pose_file, "--bootstrap", 200)
    assert few.code == 0
    assert "bootstrap" not in few.out
    assert re.search(r"warning: --bootstrap: \d stretches of 5 s are too few to draw from, 9 are needed: record 45 s or more", few.err)


def test_reach_and_step(run: Run, rich: Files, tmp_path: Path) -> None:
    assert run("timeoffset", *rich.asked, "--reach", 80, "--step", 2, "-o", tmp_path / "rig.yaml").code == 0
    delay = saved(tmp_path / "rig.yaml")[1].context["delay"]
    np.testing.assert_allclose(np.diff(delay), 2e-3, atol=1e-9)
    assert delay[-1] - delay[0] == pytest.approx(0.16)


def test_an_offset_beyond_the_reach_is_found(run: Run, tmp_path: Path) -> None:
    far = Files(tmp_path, td=-7.98)
    said = run("timeoffset", *far.asked, "--reach", 5, "-o", tmp_path / "rig.yaml")
    assert said.code == 0, said
    assert "cam0's stamps are 7.9" in said.out or "cam0's stamps are 7.980" in said.out
    assert "late: add -7.9" in said.out
    assert_found(offset(tmp_path / "rig.yaml"), -7.98, within=1e-4)


# What cannot be known.


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("motion", ["static", pytest.param("translation", marks=pytest.mark.slow)])
def test_a_recording_that_does_not_turn_gives_no_number(run: Run, tmp_path: Path, motion: str) -> None:
    files = Files(tmp_path, motion)
    out, js = tmp_path / "rig.yaml", tmp_path / "td.json"
    said = run("timeoffset", *files.asked, "-o", out, "--json", js, "--report", tmp_path / "report")
    assert said.code == 3, said
    assert "not observable: the rig hardly turns" in said.out
    assert "turn the rig back and forth" in said.out
    assert not re.search(r"td [+-]|stamps are|95 %:", said.out)
    found = offset(out)
    assert (found.value, found.sigma, found.status) == (None, None, Status.NOT_OBSERVABLE)
    facts = json.loads(js.read_text())["facts"]["timeoffset"]
    assert facts["time_offset"] == {"dt_imu0_cam0": {"method": "poses of the board"}}
    assert "signal " not in said.out  # of what is not known
    assert said.out.count("FAIL  ") == 1  # one fault is told once
    assert set(facts["v"]["dt_imu0_cam0"].values()) == {None}
    assert json.loads(js.read_text())["not_observable"] == ["dt_imu0_cam0.offset"]
    assert run("report", out).code == 1
    assert "dt_imu0_cam0" in run("export", out, "--to", "kalibr", "-o", tmp_path / "kalibr").err
    assert not (tmp_path / "kalibr" / "camchain.yaml").exists()


def test_a_constant_rate_gives_no_number(run: Run, tmp_path: Path) -> None:
    spin = constant_rate(np.array([0.3, -0.5, 0.8]))
    imu = write_imu(tmp_path / "imu.csv", seen_gyro(spin, stamps(200, DURATION_S), np.random.default_rng(0)))
    poses = write_poses(tmp_path / "poses.csv", seen_poses(spin, stamps(20, DURATION_S - 2, 1.01), 1e-3, np.random.default_rng(1)))
    said = run("timeoffset", imu, poses, "-o", tmp_path / "rig.yaml")
    assert said.code == 3, said
    assert "the rate of turn hardly changes" in said.out
    assert offset(tmp_path / "rig.yaml", "dt_imu0_pose0").value is None


# Mistakes.


def test_mistakes_are_one_line(run: Run, rich: Files, imu_file: Path, pose_file: Path, tmp_path: Path) -> None:
    both = (rich.imu, rich.corners)
    assert "cam0 (corners) has no lens: run calibkit intrinsics" in run("timeoffset", *both, "--target", rich.target).mistake
    assert "--target" in run("timeoffset", *both, "--rig", rich.lens).mistake
    small = tmp_path / "small.yaml"
    small.write_text("target_type: aprilgrid\ntagCols: 2\ntagRows: 2\ntagSize: 0.088\ntagSpacing: 0.3\n")
    assert "check --target" in run("timeoffset", *both, "--rig", rich.lens, "--target", small).mistake
    assert "gone.yaml: cannot be read" in run("timeoffset", *both, "--rig", rich.lens, "--target", tmp_path / "gone.yaml").mistake
    pair = (imu_file, pose_file)
    assert "cam7 is no sensor of this recording: it has imu0 (imu), pose0 (arm)" in run("timeoffset", *pair, "--of", "cam7").mistake
    assert "there is no topic /odom" in run("timeoffset", *pair, "--pose", "/odom").mistake
    assert "both imu0: name two sensors" in run("timeoffset", *pair, "--of", "imu0", "--to", "imu").mistake
    assert "two sensors that turn are needed, the recording has imu0 (imu)" in run("timeoffset", imu_file).mistake
    assert "write NAME=/topic" in run("timeoffset", *pair, "--pose", "a b=arm", "--imu", "imu").mistake
    assert "--reach" in run("timeoffset", *pair, "--reach", "nan").mistake
    assert "--step" in run("timeoffset", *pair, "--step", 0).mistake
    assert "--gyro-bandwidth" in run("timeoffset", *pair, "--gyro-bandwidth", -3).mistake
    for many in (-1, 10_001):
        assert run("timeoffset", *pair, "--bootstrap", many).mistake == f"--bootstrap {many}: give 0 to 10000"
    assert "neither gives poses" in run("timeoffset", *rich.asked, "--inverse-poses").mistake
    assert not list(tmp_path.glob("*.npz"))


@pytest.mark.parametrize(
    ("option", "why"),
    [
        (("--target", SAMPLES / "target.yaml"), "neither is a camera"),
        (("--plain",), "it is for a camera's images without --target"),
        (("--gyro-bandwidth", 40, "--of", "imu0", "--to", "pose0"), "pose0 is no IMU; give the IMU as --to"),
        (("--exposure", 8), "pose0 is no camera; give the camera as --of"),
    ],
)
def test_an_option_that_cannot_count_is_refused(run: Run, imu_file: Path, pose_file: Path, option: tuple[object, ...], why: str) -> None:
    assert run("timeoffset", imu_file, pose_file, *option).mistake.endswith(why)


def test_recordings_that_cannot_be_used_are_one_line(run: Run, body: Trajectory, imu_file: Path, pose_file: Path, tmp_path: Path) -> None:
    later = write_poses(tmp_path / "later.csv", seen_poses(body, stamps(30, 0.5, 1.0), 1e-3, np.random.default_rng(1)))
    assert "share too little time" in run("timeoffset", imu_file, later).mistake
    cut = tmp_path / "cut.bag"
    cut.write_bytes((SAMPLES / "cam_imu.bag").read_bytes()[:300_000])
    lens = ("--rig", SAMPLES / "truth.yaml", "--target", SAMPLES / "target.yaml")
    assert re.search("share too little time.*cut.bag is damaged", run("timeoffset", cut, *lens).mistake)
    none = tmp_path / "accel.csv"
    table(none, "t [ns],ax,ay,az", stamps(100, 5.0), np.random.default_rng(0).standard_normal((500, 3)))
    assert "accel) has no gyroscope" in run("timeoffset", none, pose_file).mistake
    stood = poses_of(body)
    stood = write_poses(tmp_path / "stood.csv", PoseSamples(stood.t_ns, 0 * stood.q + stood.q[0], 0 * stood.p, "world", "arm"))
    assert "stood) gives one and the same value throughout" in run("timeoffset", imu_file, stood).mistake
    assert "stood) gives one and the same value throughout" in run("timeoffset", stood, pose_file, "--to", "stood").mistake
    slow = write_poses(tmp_path / "slow.csv", poses_of(body, 0.5))
    assert "slow) has no turns: its samples lie more than 1 s apart" in run("timeoffset", imu_file, slow).mistake
    zeros = table(tmp_path / "zeros.csv", "t [ns],yaw_rate", stamps(30, 10.0), np.zeros(300))
    assert "zeros) gives one and the same value throughout" in run("timeoffset", imu_file, zeros).mistake
    (tmp_path / "empty.csv").write_text("")
    assert "empty.csv" in run("timeoffset", imu_file, tmp_path / "empty.csv").mistake
    assert "gone.csv" in run("timeoffset", imu_file, tmp_path / "gone.csv").mistake
    cut = tmp_path / "cut.bag"
    cut.write_bytes((SAMPLES / "cam_imu.bag").read_bytes()[:3000])
    assert "cut.bag" in run("timeoffset", cut, "--rig", SAMPLES / "truth.yaml").mistake


def test_a_camera_alone_is_no_clock(run: Run) -> None:
    asked = (SAMPLES / "cam_imu.bag", "--rig", SAMPLES / "truth.yaml", "--of", "imu0", "--to", "cam0")
    assert "swap --of and --to, or give --target" in run("timeoffset", *asked).mistake


def test_outputs_are_kept_unless_forced(run: Run, imu_file: Path, pose_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "rig.yaml"
    assert run("timeoffset", imu_file, pose_file, "-o", out).code == 0
    before = out.read_bytes()
    assert "rig.yaml" in run("timeoffset", imu_file, pose_file, "-o", out).mistake
    assert out.read_bytes() == before
    assert run("timeoffset", imu_file, pose_file, "-o", out, "--force").code == 0


def test_info_names_who_can_be_compared(run: Run, rich: Files, imu_file: Path, pose_file: Path, tmp_path: Path) -> None:
    said = run("info", imu_file, pose_file, rich.corners, "--json", tmp_path / "info.json")
    assert said.code == 0, said
    topics = {topic["name"]: topic["usable_for"] for topic in json.loads((tmp_path / "info.json").read_text())["topics"]}
    assert set(topics) == {"imu", "arm", "corners"}
    assert all("timeoffset" in use for use in topics.values()), topics
