"""`calibkit info`: what the doctor finds, and does not find in healthy data; the table, the JSON, the exit codes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recording_helper import Make, write

from calibkit.errors import BadInputError
from calibkit.estimation import doctor
from calibkit.geometry import so3
from calibkit.io.recording import open_recording
from calibkit.io.ros1_bag import Ros1Bag
from calibkit.opencv import cv2
from calibkit.stages.info import Info, as_json, info

T0 = 1_700_000_000_000_000_000
TOPIC_KEYS = {
    "name", "type", "kind", "count_claimed", "count", "rate_hz", "start_ns", "end_ns", "usable_for", "image", "findings"
}  # fmt: skip


def _codes(findings: list[doctor.Finding]) -> set[str]:
    return {finding.code for finding in findings if finding.problem}


def _times(n: int, hz: float, jitter_s: float = 0.0, seed: int = 0) -> np.ndarray:
    jitter = np.random.default_rng(seed).normal(size=n) * jitter_s
    return T0 + np.rint((np.arange(n) / hz + jitter) * 1e9).astype(np.int64)


def _imu(seconds: float = 30, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A hand-held rig: turns of 1 rad/s, accelerations of 1 m/s^2, consumer noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 0.005)
    phase = rng.uniform(0, 6, (3, 3))
    gyro = sum(np.sin(2 * np.pi * f * t[:, None] + phase[k]) for k, f in enumerate((0.2, 0.37, 0.61))) * 0.8
    R = np.eye(3)
    down = np.zeros((len(t), 3))
    for i, step in enumerate(so3.exp(gyro * 0.005)):
        down[i] = R.T @ [0, 0, 9.81]
        R = R @ step
    accel = down + np.sin(2 * np.pi * t[:, None] * (0.9, 1.3, 1.7)) + rng.normal(size=down.shape) * 0.03
    return T0 + np.rint(t * 1e9).astype(np.int64), gyro + rng.normal(size=gyro.shape) * 0.003, accel


@pytest.mark.parametrize(("hz", "n"), [(200, 4000), (20, 400), (4, 100)])
def test_healthy_times_have_no_findings(hz: float, n: int) -> None:
    for seed in range(20):
        t_ns = _times(n, hz, 0.01 / hz, seed)
        assert doctor.check_times(t_ns) == []
        latency = np.random.default_rng(seed).exponential(2e6, n).astype(np.int64)
        assert doctor.check_headers(t_ns, t_ns + latency) == []
    assert doctor.rate_hz(_times(n, hz)) == pytest.approx(hz, rel=1e-6)


def _changed(t_ns: np.ndarray, index: int, by_s: float) -> np.ndarray:
    out = t_ns.copy()
    out[index] += int(by_s * 1e9)
    return out


def test_faults_in_times_are_found() -> None:
    t_ns = _times(600, 20, 1e-4)
    assert _codes(doctor.check_times(_changed(t_ns, 300, 0.030))) == {"irregular"}
    assert _codes(doctor.check_times(_changed(t_ns, 300, -0.060))) == {"disorder"}
    assert _codes(doctor.check_times(_times(600, 20, 0.010))) == {"jitter"}
    assert _codes(doctor.check_times(np.delete(t_ns, slice(100, 160)))) == {"gap"}
    assert "3.05 s at 4.950 s" in doctor.check_times(np.delete(t_ns, slice(100, 160)))[0].text
    imu = _times(6000, 200, 2e-5)
    assert _codes(doctor.check_times(np.delete(imu, slice(100, 200)))) == {"gap"}
    assert _codes(doctor.check_times(np.repeat(imu[:500], 2))) == {"duplicate"}
    dropped = np.delete(imu, [7, 80, 900])
    (note,) = doctor.check_times(dropped)
    assert (note.code, note.problem) == ("gap", False)
    assert "3 gaps, about 3 samples missing" in note.text


def test_faults_in_headers_are_found() -> None:
    record = _times(6000, 200)
    header = record - 2_000_000
    assert doctor.check_headers(header, record) == []
    zero = header.copy()
    zero[[3, 4]] = 0
    (finding,) = doctor.check_headers(zero, record)
    assert (finding.code, finding.text[:18]) == ("zero_stamp", "2 of 6000 header s")
    assert _codes(doctor.check_headers(record + 50_000_000, record)) == {"future_stamp"}
    assert [f.code for f in doctor.check_headers(record - T0 + 10**9, record)] == ["other_clock"]
    drifting = header - 50_000_000 + ((record - record[0]) * 500e-6).astype(np.int64)
    (finding,) = doctor.check_headers(drifting, record)
    assert finding.code == "clock_drift"
    assert "500 ppm" in finding.text


def test_clocks_that_disagree_and_streams_that_never_meet() -> None:
    assert doctor.check_clocks({"/imu": 0.002, "/cam": 0.03}) == []
    (finding,) = doctor.check_clocks({"/imu": 0.002, "/cam": -4.97})
    assert "stamps of /imu lie 4.972 s before those of /cam" in finding.text
    assert doctor.check_overlap({"/imu": (0, 100), "/cam": (90, 110)}) == []
    (finding,) = doctor.check_overlap({"/imu": (0, 100), "/cam": (101, 110)})
    assert finding.text.startswith("/cam shares no time with /imu")


@pytest.mark.parametrize(
    ("factor", "code"), [(1, None), (1 / 9.80665, "accel_unit"), (1000 / 9.80665, "accel_unit"), (0.5, "accel_unit"), (0.001, "no_gravity")]
)
def test_units_of_the_accelerometer(factor: float, code: str | None) -> None:
    _, _, accel = _imu()
    assert _codes(doctor.check_accel(accel * factor)) == ({code} if code else set())


@pytest.mark.parametrize(("factor", "code"), [(1, None), (180 / np.pi, "gyro_unit"), (0.2, "gyro_scale"), (5, "gyro_scale")])
def test_units_of_the_gyroscope(factor: float, code: str | None) -> None:
    for seed in range(5):
        t_ns, gyro, accel = _imu(seed=seed)
        for unit in (1, 1 / 9.81):  # judged whatever the accelerometer's unit
            assert _codes(doctor.check_gyro_unit(t_ns, gyro * factor, accel * unit)) == ({code} if code else set())


def test_a_rig_at_rest_says_nothing_of_its_gyroscope() -> None:
    t_ns, _, _ = _imu()
    rng = np.random.default_rng(0)
    rest = rng.normal(size=(len(t_ns), 3)) * 0.003
    assert doctor.check_gyro_unit(t_ns, rest, rest + np.array([0, 0, 9.81])) == []


def test_clipping_is_found_and_quantisation_is_not() -> None:
    _, gyro, accel = _imu()
    assert doctor.check_saturation("gyro", gyro) == []
    (finding,) = doctor.check_saturation("the gyroscope", np.clip(gyro, None, (np.inf, 1.2, np.inf)))
    assert finding.text.startswith("the gyroscope is clipped: y at 1.2 (")
    assert doctor.check_saturation("gyro", np.round(gyro / 0.01) * 0.01) == []
    rest = np.random.default_rng(0).normal(size=(20000, 3))
    assert doctor.check_saturation("gyro", np.round(rest)) == []
    assert doctor.check_frozen(accel) == []
    assert _codes(doctor.check_frozen(np.repeat(accel, 2, axis=0))) == {"repeated"}


def _board(blur: int) -> np.ndarray:
    squares = np.kron(np.indices((12, 16)).sum(axis=0) % 2, np.ones((20, 20)))
    kernel = np.ones(2 * blur + 1) / (2 * blur + 1)
    for axis in (0, 1):
        squares = np.apply_along_axis(lambda line: np.convolve(line, kernel, "same"), axis, squares)
    return (30 + 180 * squares).astype(np.uint8)


def test_blurred_dark_and_overexposed_images_are_found() -> None:
    sharpness = [doctor.sharpness(_board(blur)) for blur in (0, 1, 2, 4)]
    assert np.all(np.diff(sharpness) < 0)
    assert doctor.sharpness(_board(1)) == pytest.approx(doctor.sharpness(_board(1) // 2), rel=0.1)
    assert doctor.sharpness(np.zeros((5, 5), np.uint8)) == 0
    sharp = np.array([doctor.sharpness(_board(0))] * 9 + [doctor.sharpness(_board(3))])
    assert [f.code for f in doctor.check_images(np.full(10, 0.4), sharp)] == ["blur"]
    assert _codes(doctor.check_images(np.full(10, 0.02), np.ones(10))) == {"dark"}
    assert _codes(doctor.check_images(np.full(10, 0.97), np.ones(10))) == {"overexposed"}
    assert doctor.check_images(np.full(10, 0.4), np.ones(10)) == []
    assert doctor.brightness(np.full((3, 3), 2048, np.uint16)) == pytest.approx(0.5, abs=0.01)  # 12 bits in 16


def _bag(folder: Path, late_s: float = 0.0, gyro_factor: float = 1.0, accel_factor: float = 1.0) -> Path:
    make = Make("ros1")
    t_ns, gyro, accel = _imu(12)
    messages = [
        ("/imu0", int(t) + 2_000_000, make.imu(int(t), w * gyro_factor, a * accel_factor))
        for t, w, a in zip(t_ns, gyro, accel, strict=True)
    ]
    image = _board(0)[:40, :60]
    messages += [("/cam[red]0", int(t) + 5_000_000, make.image(int(t + late_s * 1e9), image, "mono8")) for t in t_ns[::20]]
    return write(folder, "ros1-lz4", sorted(messages, key=lambda m: m[1]))


def _all_codes(result: Info) -> set[str]:
    return _codes([*result.findings, *(f for t in result.topics for f in t.findings)])


def test_a_healthy_bag_has_no_problems(tmp_path: Path) -> None:
    result = info([_bag(tmp_path)])
    assert result.problems == 0
    assert result.duration_s == pytest.approx(11.995)
    camera, imu = result.topics
    assert (camera.topic.kind, camera.held, camera.image.width, camera.image.height, camera.image.sampled) == ("image", 120, 60, 40, 20)
    assert (imu.held, imu.rate_hz) == (2400, pytest.approx(200))
    assert "allan" in imu.topic.usable_for


def test_a_recording_is_read_once_whatever_its_topics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = _bag(tmp_path)
    expected = open_recording([bag]).imu("/imu0")
    passes: list[object] = []
    read = Ros1Bag.messages
    monkeypatch.setattr(Ros1Bag, "messages", lambda self, topics: passes.append(topics) or read(self, topics))
    assert info([bag]).topics[0].image is not None
    assert len(passes) == 1
    found = open_recording([bag]).survey()["/imu0"].imu
    assert found is not None
    for name in ("t_ns", "gyro", "accel"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_of_a_folder_only_the_images_judged_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(100):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), _board(0))
    files: list[Path] = []
    read = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: files.append(self) or read(self))
    (topic,) = info([tmp_path]).topics
    assert topic.image is not None
    assert (topic.held, topic.image.sampled, len(files)) == (100, 20, 20)
    assert files[1].name == "5.png"


def test_faults_that_other_tools_take_for_a_calibration_are_named(tmp_path: Path) -> None:
    assert _all_codes(info([_bag(tmp_path, late_s=5)])) == {"clocks_apart", "future_stamp"}
    assert _all_codes(info([_bag(_folder(tmp_path / "g"), accel_factor=1 / 9.80665)])) == {"accel_unit"}
    assert _all_codes(info([_bag(_folder(tmp_path / "deg"), gyro_factor=180 / np.pi)])) == {"gyro_unit"}


def _folder(path: Path) -> Path:
    path.mkdir()
    return path


def test_unreadable_images_are_told_and_do_not_stop_the_rest(tmp_path: Path) -> None:
    make = Make("mcap")
    good, bad = make.image(T0, _board(0), "mono8"), make.image(T0, _board(0), "32FC1")
    result = info([write(tmp_path, "mcap", [("/cam", T0 + i, (bad, good)[i % 2]) for i in range(4)])])
    (topic,) = result.topics
    assert "2 of 4 sampled images cannot be read; the first: rec: /cam at" in next(f.text for f in topic.findings if f.code == "unreadable")
    assert topic.image is not None


def test_json_has_a_stable_schema(tmp_path: Path) -> None:
    bag = _bag(tmp_path)
    info([bag], json_path=tmp_path / "info.json")
    found = json.loads((tmp_path / "info.json").read_text())
    assert found == json.loads(json.dumps(as_json(info([bag]))))
    assert set(found) == {"format", "version", "sources", "duration_s", "problems", "topics", "findings", "warnings"}
    assert (found["format"], found["version"], found["sources"]) == ("calibkit-info", 1, ["rec.bag"])
    assert all(set(topic) == TOPIC_KEYS for topic in found["topics"])
    assert set(found["topics"][0]["image"]) == {"width", "height", "bits", "sampled", "brightness", "sharpness"}


def _run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from calibkit.cli.main import main; main()", "info", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_command_prints_a_table_and_text_of_files_is_no_markup(tmp_path: Path) -> None:
    bag = _bag(tmp_path)
    done = _run(bag, "--json", tmp_path / "out.json")
    assert (done.returncode, done.stderr) == (0, "")
    assert "/cam[red]0" in done.stdout
    assert "60 x 40, 8 bit" in done.stdout
    assert done.stdout.splitlines()[-2:] == ["rec.bag: 2 topics, 12.00 s, 0 problems", f"json: {tmp_path / 'out.json'}"]
    again = _run(bag, "--json", tmp_path / "out.json")
    assert again.returncode == 2
    assert "exists already" in again.stderr


def test_bad_input_is_one_line_and_code_2(tmp_path: Path) -> None:
    (tmp_path / "empty.bag").write_bytes(b"")
    for source, told in (("empty.bag", "empty.bag is empty"), ("gone.mcap", "does not exist")):
        done = _run(tmp_path / source)
        assert (done.returncode, done.stdout) == (2, "")
        assert told in done.stderr
        assert len(done.stderr.splitlines()) == 1


def test_real_recordings(data_dir: Path) -> None:
    def codes(*names: str) -> set[str]:
        return _all_codes(info([data_dir / name for name in names]))

    assert codes("bags/ardrone_imu.bag") == {"gap"}
    assert codes("euroc_imu_april/imu0.csv", "euroc_imu_april/cam0_corners.csv") == {"gap"}
    assert codes("pose_streams/tango_MARS.csv") == {"duplicate", "irregular"}
    assert codes("euroc_imu_april") == {"gap", "no_overlap"}
    imu = open_recording([data_dir / "euroc_imu_april" / "imu0.csv"]).imu("imu0")
    assert _codes(doctor.check_gyro_unit(imu.t_ns, imu.gyro * 180 / np.pi, imu.accel)) == {"gyro_unit"}


def test_stamps_in_the_wrong_unit_are_a_problem() -> None:
    assert _codes(doctor.check_times(np.arange(50) * 2)) == {"rate"}


def test_a_table_of_other_columns_is_not_taken_for_an_imu(tmp_path: Path) -> None:
    rows = "".join(f"{0.02 * 2**i},1,2,3,4,5,6\n" for i in range(12))
    (tmp_path / "adev.csv").write_text("# tau_s,gx_dev,gy_dev,gz_dev,ax_dev,ay_dev,az_dev (Allan deviation, overlapping)\n" + rows)
    with pytest.raises(BadInputError, match="is not recognised"):
        info([tmp_path / "adev.csv"])
