"""IMU recordings as people have them: without times, in counts, in two files, gzipped, and hours long."""

import gzip
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from recording_helper import FORMATS, Make, write

from calibkit.data.observations import ImuSamples
from calibkit.errors import BadInputError
from calibkit.io import text_table
from calibkit.io.bag_writer import ImuPayload, Sample, Stream, write_bag
from calibkit.io.imu_options import G, ImuOptions
from calibkit.io.recording import Recording, open_recording
from calibkit.stages.info import info

T0 = 1_700_000_000_000_000_000
_UNTIMED = "gx [deg/s],gy [deg/s],gz [deg/s],ax [g],ay [g],az [g]\n"


def _file(folder: Path, text: str, name: str = "imu.csv") -> Path:
    (folder / name).write_text(text)
    return folder / name


def _rows(values: np.ndarray, times: np.ndarray | None = None) -> str:
    rows = values if times is None else np.column_stack([times, values])
    return "\n".join(",".join(map(repr, row)) for row in rows.tolist()) + "\n"


def _read(recording: Recording, **accepted: bool) -> ImuSamples:
    return recording.imu(recording.choose("imu"), **accepted)


def test_without_a_time_column_the_rate_decides(tmp_path: Path) -> None:
    path = _file(tmp_path, _UNTIMED + "180,0,0,0,0,1\n0,90,0,0,0.5,1\n0,0,45,0,0,1\n")
    with pytest.raises(BadInputError, match=r"^imu\.csv has no time column: add --rate HZ"):
        open_recording([path])
    imu = _read(open_recording([path], imu=ImuOptions(rate_hz=128)))
    assert imu.t_ns.tolist() == [0, 7_812_500, 15_625_000]
    np.testing.assert_allclose(imu.gyro, np.diag([np.pi, np.pi / 2, np.pi / 4]))
    np.testing.assert_allclose(imu.accel, np.array([[0, 0, 1], [0, 0.5, 1], [0, 0, 1]]) * G)


def test_six_columns_without_a_header_are_gyroscope_and_accelerometer(tmp_path: Path) -> None:
    imu = _read(open_recording([_file(tmp_path, "1 2 3 4 5 6\n", "imu.txt")], imu=ImuOptions(rate_hz=1)))
    np.testing.assert_array_equal(np.hstack([imu.gyro, imu.accel]), [[1, 2, 3, 4, 5, 6]])


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf, 1e9])
def test_a_rate_that_is_none_is_refused(rate: float) -> None:
    with pytest.raises(BadInputError, match=r"--rate .* is no rate"):
        ImuOptions(rate_hz=rate)


def test_a_rate_replaces_stamps_that_are_all_the_same(tmp_path: Path) -> None:
    path = _file(tmp_path, "t,wx,wy,wz,ax,ay,az\n0,1,2,3,4,5,6\n0,1,2,3,4,5,6\n")
    with pytest.raises(BadInputError, match=r"all its stamps are 0 ns: add --rate HZ"):
        _read(open_recording([path]))
    recording = open_recording([path], imu=ImuOptions(rate_hz=50))
    assert _read(recording).t_ns.tolist() == [0, 20_000_000]
    assert any("its time column is not used, but --rate 50" in w for w in recording.warnings)


def test_options_say_the_units_that_a_header_does_not(tmp_path: Path) -> None:
    path = _file(tmp_path, "t,gx,gy,gz,ax,ay,az\n1,180,0,0,0,0,1\n")
    imu = _read(open_recording([path], imu=ImuOptions(gyro_unit="deg/s", accel_unit="g")))
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), [[np.pi, 0, 0, 0, 0, G]])
    with pytest.raises(BadInputError, match=r"--gyro-unit rpm is not known: use one of rad/s, .*deg/s.*counts"):
        ImuOptions(gyro_unit="rpm")
    stated = _file(tmp_path, "t,gx [rad/s],gy [rad/s],gz [rad/s],ax,ay,az\n1,1,0,0,0,0,1\n", "stated.csv")
    with pytest.raises(BadInputError, match=r"column wx is in \[rad/s\] by its header, and --gyro-unit says deg/s: leave it out"):
        open_recording([stated], imu=ImuOptions(gyro_unit="deg/s"))


def test_options_convert_a_driver_that_publishes_degrees(tmp_path: Path) -> None:
    make = Make("mcap")
    path = write(tmp_path, "mcap", [("/imu", T0 + i, make.imu(T0 + i, (180, 0, 0), (0, 0, 1))) for i in range(3)])
    recording = open_recording([path], imu=ImuOptions(rate_hz=9, gyro_unit="deg/s", accel_unit="g"))
    imu = _read(recording)
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), [[np.pi, 0, 0, 0, 0, G]] * 3)
    assert any("its messages have stamps, so --rate is not used" in w for w in recording.warnings)


def _counts() -> np.ndarray:
    return np.random.default_rng(0).integers(32000, 33000, (120, 6))


@pytest.mark.parametrize(
    ("header", "options", "told"),
    [
        ("t,gx,gy,gz,ax,ay,az\n", ImuOptions(), True),
        ("t,gx [counts],gy [counts],gz [raw],ax [LSB],ay [lsb],az [counts]\n", ImuOptions(), False),
        ("t,gx,gy,gz,ax,ay,az\n", ImuOptions(gyro_unit="counts", accel_unit="counts"), False),
    ],
)
def test_raw_counts_say_so_and_are_refused_where_si_is_needed(tmp_path: Path, header: str, options: ImuOptions, told: bool) -> None:
    values = _counts()
    recording = open_recording([_file(tmp_path, header + _rows(values, np.arange(120) * 0.01))], imu=options)
    imu = _read(recording, counts=True)
    assert imu.unit == "counts"
    np.testing.assert_array_equal(np.hstack([imu.gyro, imu.accel]), values)
    assert any("taken for raw counts" in w for w in recording.warnings) == told
    with pytest.raises(BadInputError, match=r"imu\.csv: imu holds raw counts: state what they are in \(--gyro-unit, --accel-unit\)"):
        _read(recording)


def test_whole_numbers_are_no_counts_where_a_unit_is_stated_or_nothing_varies(tmp_path: Path) -> None:
    text = "t,gx [deg/s],gy [deg/s],gz [deg/s],ax [mg],ay [mg],az [mg]\n" + _rows(_counts(), np.arange(120))
    assert _read(open_recording([_file(tmp_path, text)])).unit == "SI"
    still = "t,gx,gy,gz,ax,ay,az\n" + _rows(np.tile([0, 0, 0, 0, 0, 10], (120, 1)), np.arange(120))
    assert _read(open_recording([_file(tmp_path, still)])).unit == "SI"


def test_counts_beside_units_are_refused(tmp_path: Path) -> None:
    path = _file(tmp_path, "t,gx [counts],gy [counts],gz [counts],ax [g],ay [g],az [g]\n1,1,2,3,4,5,6\n")
    with pytest.raises(BadInputError, match=r"imu\.csv: one sensor is in raw counts and the other is not"):
        _read(open_recording([path]), counts=True)


def test_gzipped_text_is_read_and_its_size_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(1).normal(size=(50, 6))
    path = tmp_path / "imu_100hz.csv.gz"
    path.write_bytes(gzip.compress(("t,wx,wy,wz,ax,ay,az\n" + _rows(values, np.arange(50))).encode()))
    recording = open_recording([path])
    assert [(t.name, t.count) for t in recording.topics] == [("imu_100hz", 50)]
    imu = _read(recording)
    np.testing.assert_array_equal(np.hstack([imu.gyro, imu.accel]), values)
    packed = path.read_bytes()
    for damaged in (packed[:-20], packed[:40] + b"\xff" * 9 + packed[49:], b"no gzip"):
        path.write_bytes(damaged)
        with pytest.raises(BadInputError, match=r"imu_100hz\.csv\.gz is damaged"):
            _read(open_recording([path]))
    path.write_bytes(gzip.compress(b"t,wx,wy,wz,ax,ay,az\n" + b"1,1,1,1,1,1,1\n" * 10**5))
    monkeypatch.setattr(text_table, "_MAX_FILE", 10**6)
    monkeypatch.setattr(text_table, "_BLOCK", 10**5)
    with pytest.raises(BadInputError, match="is larger than 1000000 bytes: split it"):
        open_recording([path])


def test_blocks_break_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(2).normal(size=(40, 6))
    text = "\ufeff# a comment\r\n\r\nt,wx,wy,wz,ax,ay,az\r\n" + _rows(values, np.arange(40)).replace("\n", "\r\n")
    (tmp_path / "imu.csv").write_bytes(text.encode())
    for block in (1, 7, 100):
        monkeypatch.setattr(text_table, "_BLOCK", block)
        imu = _read(open_recording([tmp_path / "imu.csv"]))
        np.testing.assert_array_equal(np.hstack([imu.gyro, imu.accel]), values)


@pytest.mark.parametrize(
    ("content", "told"),
    [(b"MATLAB 5.0 MAT-file\0\0\0\x01IM", r"\(it is binary, not text\)"), (b"x" * 10**5, "a line is longer than 65536 bytes")],
)
def test_what_is_no_text_is_refused(tmp_path: Path, content: bytes, told: str) -> None:
    (tmp_path / "acc.mat").write_bytes(content)
    with pytest.raises(BadInputError, match=rf"acc\.mat holds no rows of numbers .*{told}"):
        open_recording([tmp_path / "acc.mat"])


def _halves(folder: Path, names: tuple[str, str] = ("s_acc.mat", "s_gyro.mat"), shift_s: float = 0.0) -> list[Path]:
    t = np.arange(200) * 0.01
    accel, gyro = (np.column_stack([t + by, np.outer(t + by, [1, 2, 3]) + offset]) for by, offset in ((0.0, 5.0), (shift_s, 0.0)))
    return [_file(folder, _rows(rows).replace(",", "  "), name) for rows, name in zip((accel, gyro), names, strict=True)]


@pytest.mark.parametrize("turned", [False, True])
def test_an_accelerometers_file_and_a_gyroscopes_are_one_imu(tmp_path: Path, turned: bool) -> None:
    files = _halves(tmp_path)
    recording = open_recording(files[::-1] if turned else files)
    assert [(t.name, t.kind, t.count) for t in recording.topics] == [("s_acc+s_gyro", "imu", 200)]
    imu = _read(recording)
    t = np.arange(200) * 0.01
    assert imu.t_ns.tolist() == (np.arange(200) * 10_000_000).tolist()
    np.testing.assert_allclose(
        np.hstack([imu.gyro, imu.accel]), np.hstack([np.outer(t, [1, 2, 3]), np.outer(t, [1, 2, 3]) + 5]), atol=1e-14
    )
    assert recording.warnings == []
    assert recording.survey()["s_acc+s_gyro"].imu is not None
    assert len(recording.inputs()) == 1


def test_a_folder_of_the_two_is_one_imu_too(tmp_path: Path) -> None:
    _halves(tmp_path, ("accel.csv", "gyro.csv"))
    assert [t.name for t in open_recording([tmp_path]).topics] == ["accel+gyro"]


def test_other_stamps_are_interpolated_over_the_common_span_and_told(tmp_path: Path) -> None:
    recording = open_recording(_halves(tmp_path, shift_s=0.503))
    imu = _read(recording)
    t = np.arange(51, 200) * 0.01  # 0.503 .. 1.99 s
    np.testing.assert_array_equal(imu.t_ns, np.arange(51, 200) * 10_000_000)
    np.testing.assert_allclose(imu.gyro, np.outer(t, [1, 2, 3]), atol=1e-9)  # a line stays a line
    np.testing.assert_allclose(imu.accel, np.outer(t, [1, 2, 3]) + 5, atol=1e-12)
    assert any("have different stamps: the gyroscope is interpolated" in w and "over the 1.48 s" in w for w in recording.warnings)
    with pytest.raises(BadInputError, match=r"s_acc\.mat \+ s_gyro\.mat share no time"):
        _read(open_recording(_halves(tmp_path, shift_s=7)))


def test_which_file_is_which_must_be_said(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"one\.mat is not recognised: three axes, but of what\? give it a header"):
        open_recording(_halves(tmp_path, ("one.mat", "two.mat")))
    by_header = [
        _file(tmp_path, "t,ax [g],ay [g],az [g]\n1,0,0,1\n2,0,0,1\n", "one.csv"),
        _file(tmp_path, "t,gx [deg/s],gy [deg/s],gz [deg/s]\n1,180,0,0\n2,180,0,0\n", "two.csv"),
    ]
    np.testing.assert_allclose(_read(open_recording(by_header)).gyro, [[np.pi, 0, 0]] * 2)
    third = _file(tmp_path, "t,x,y,z\n1,0,0,1\n2,0,0,1\n", "third_acc.csv")
    with pytest.raises(BadInputError, match=r"which accelerometer belongs to which gyroscope\? one\.csv, third_acc\.csv, two\.csv"):
        open_recording([*by_header, third])


def test_one_sensor_alone_is_told_by_its_shape_and_refused_where_both_are_needed(tmp_path: Path) -> None:
    path = _file(tmp_path, "t,gx,gy,gz\n1,1,2,3\n2,1,2,3\n")
    recording = open_recording([path])
    imu = _read(recording, partial=True)
    assert (imu.has_gyro, imu.has_accel, imu.accel.shape) == (True, False, (2, 0))
    assert imu.select(slice(1)).accel.shape == (1, 0)
    with pytest.raises(BadInputError, match="imu has no accelerometer: give a recording with both"):
        _read(recording)
    with pytest.raises(ValueError, match="accel has shape"):
        ImuSamples(imu.t_ns, imu.gyro, np.zeros((2, 2)))


@pytest.mark.parametrize("form", sorted(FORMATS))
def test_two_imu_topics_ask_which(tmp_path: Path, form: str) -> None:
    make = Make(form)
    path = write(tmp_path, form, [(topic, T0, make.imu(T0, (0, 0, 0), (0, 0, 9.8))) for topic in ("/a", "/b")])
    with pytest.raises(BadInputError, match=r"which imu topic\? it has /a, /b; choose with --imu$"):
        open_recording([path]).choose("imu")


def test_reading_reports_progress(tmp_path: Path) -> None:
    make = Make("ros1")
    bag = write(tmp_path, "ros1", [("/imu", T0 + i, make.imu(T0 + i, (0, 0, 0), (0, 0, 9.8))) for i in range(9)])
    seen: list[tuple[str, int | None, int]] = []

    def progress(items: Iterable[object], what: str, total: int | None = None) -> Iterator[object]:
        passed = list(items)
        seen.append((what, total, len(passed)))
        return iter(passed)

    open_recording([bag]).imu("/imu", progress)
    open_recording([_file(tmp_path, "t,wx,wy,wz,ax,ay,az\n1,1,2,3,4,5,6\n")]).imu("imu", progress)
    assert seen == [("reading", 9, 9), ("reading imu.csv", None, 1)]


_MEASURE = """
import resource, sys
from pathlib import Path
from calibkit.io.recording import open_recording
recording = open_recording([Path(sys.argv[1])])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
imu = recording.imu("/imu0")
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(len(imu.t_ns), imu.t_ns.nbytes + imu.gyro.nbytes + imu.accel.nbytes, (after - before) * 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in kB on Linux")
@pytest.mark.slow
def test_memory_stays_near_that_of_the_arrays(tmp_path: Path) -> None:
    n, payload = 150_000, ImuPayload(np.zeros(3), np.array([0, 0, 9.81]))
    samples = (Sample(T0 + i * 5_000_000, T0 + i * 5_000_000, payload) for i in range(n))
    write_bag(tmp_path / "long.bag", [Stream("/imu0", "imu", "imu", samples)], "ros1")
    out = subprocess.run([sys.executable, "-c", _MEASURE, str(tmp_path / "long.bag")], capture_output=True, text=True, check=True).stdout
    count, arrays, grown = map(int, out.split())
    assert count == n
    assert grown < 2 * arrays + 20e6  # the arrays, record times, a chunk and a batch of messages


def test_the_real_recording_without_times(data_dir: Path) -> None:
    imu = _read(open_recording([data_dir / "allan_adis16405" / "imu_100hz.csv.gz"], imu=ImuOptions(rate_hz=100)))
    assert len(imu.t_ns) == 10**6
    assert imu.t_ns[-1] == 999_999 * 10_000_000
    np.testing.assert_allclose(imu.gyro[0], np.deg2rad([-0.05, -0.3, 0.7]))
    assert abs(np.median(np.linalg.norm(imu.accel, axis=1)) / G - 1) < 0.03


def test_the_real_recording_in_two_files_of_counts(data_dir: Path) -> None:
    recording = open_recording([data_dir / "imu_xsens" / name for name in ("xsens_acc.mat", "xsens_gyro.mat")])
    imu = _read(recording, counts=True)
    assert (imu.unit, len(imu.t_ns)) == ("counts", 51175)
    assert imu.t_ns[:2].tolist() == [29_840_000, 39_857_000]
    np.testing.assert_array_equal([imu.accel[0], imu.gyro[0]], [[33108, 33329, 36429], [32786, 32429, 32499]])
    assert not any("different stamps" in w for w in recording.warnings)


def test_info_of_a_file_without_times(tmp_path: Path) -> None:
    path = tmp_path / "rest.csv"
    rows = np.random.default_rng(0).normal(size=(500, 6)) * 1e-2 + np.array([0, 0, 0, 0, 0, 9.81])
    np.savetxt(path, rows, "%.6f", ",", header="gx,gy,gz,ax,ay,az", comments="")
    found = info([path], imu=ImuOptions(rate_hz=50.0))
    assert found.duration_s == pytest.approx(9.98)
    assert "allan, imu" in found.topics[0].topic.usable_for
    with pytest.raises(BadInputError, match="--rate"):
        info([path])
