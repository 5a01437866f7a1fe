"""Bags of every format: what rosbags wrote comes back; order, times, damage and hostile sizes."""

import bz2
import sqlite3
import struct
import tracemalloc
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from recording_helper import FORMATS, Make, store, write
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from calibkit.errors import BadInputError
from calibkit.io.recording import open_recording
from calibkit.io.ros_messages import IMU, KINDS, STANDARD_MD5, decode_imu, header_ns, starts_with_header, typestore
from calibkit.io.topic_pass import restamp
from calibkit.io.unpack import unpack, zstd

VIDEO = "foxglove_msgs/msg/CompressedVideo"
T0 = 1_700_000_000_000_000_000
LATENCY = 3_000_000


@contextmanager
def at_most(allowed: int) -> Iterator[None]:
    """Fail when Python objects take more than so many bytes at once."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < allowed
    finally:
        tracemalloc.stop()


def _messages(form: str, n: int = 40) -> list[tuple[str, int, object]]:
    make, rng = Make(form), np.random.default_rng(1)
    messages = []
    for i in range(n):
        t = T0 + i * 5_000_000
        messages.append(("/imu", t + LATENCY, make.imu(t, rng.normal(size=3), rng.normal(size=3))))
        if i % 4 == 0:
            messages.append(("/cam", t + LATENCY, make.image(t, rng.integers(0, 255, (12, 16), np.uint8), "mono8")))
            messages.append(("/pose", t + LATENCY, make.pose(t, rng.normal(size=3), (0, 0, 0.6, 0.8))))
    return messages


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_gives_back_what_was_written(tmp_path: Path, form: str) -> None:
    written = _messages(form)
    recording = open_recording([write(tmp_path, form, written)])
    assert {(t.name, t.kind, t.count) for t in recording.topics} == {("/imu", "imu", 40), ("/cam", "image", 10), ("/pose", "pose", 10)}
    imu = recording.imu(recording.choose("imu"))
    sent = [m for topic, _, m in written if topic == "/imu"]
    assert imu.t_ns.tolist() == [T0 + i * 5_000_000 for i in range(40)]
    np.testing.assert_array_equal(imu.gyro, [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in sent])
    np.testing.assert_array_equal(imu.accel[:, 2], [m.linear_acceleration.z for m in sent])
    frames = list(recording.images("/cam"))
    sent = [m for topic, _, m in written if topic == "/cam"]
    assert [f.t_ns for f in frames] == [T0 + i * 20_000_000 for i in range(10)]
    for frame, image in zip(frames, sent, strict=True):
        np.testing.assert_array_equal(frame.decode().ravel(), image.data)
    assert len({f.payload for f in frames}) == 10
    poses = recording.poses("/pose")
    np.testing.assert_allclose(poses.q, np.tile([0, 0, 0.6, 0.8], (10, 1)), atol=1e-15)
    assert (poses.parent, poses.child) == ("world", "/pose")
    assert recording.warnings == []


@pytest.mark.parametrize("form", ["ros1", "mcap", "db3"])
def test_twists_are_rates_and_an_odometry_is_poses(tmp_path: Path, form: str) -> None:
    make, rates = Make(form), np.random.default_rng(2).normal(size=(20, 3))
    messages: list[tuple[str, int, object]] = []
    for i, rate in enumerate(rates):
        t = T0 + i * 20_000_000
        messages.append(("/arm", t + LATENCY, make.twist_with_covariance(t, rate)))
        messages.append(("/wheels", t + LATENCY, make.twist(t if i != 3 else 0, rate * (0, 0, 1) if i != 5 else (0, 0, np.nan))))
        messages.append(("/odom", t + LATENCY, make.odometry(t, rate, (0, 0, 0, 1), rate)))
    recording = open_recording([write(tmp_path, form, messages)])
    assert {t.name: t.kind for t in recording.topics} == {"/arm": "twist", "/wheels": "twist", "/odom": "pose"}
    arm = recording.twist("/arm")
    assert arm.t_ns.tolist() == [T0 + i * 20_000_000 for i in range(20)]
    np.testing.assert_array_equal(arm.gyro, rates)
    assert (arm.has_accel, arm.unit) == (False, "SI")
    wheels = recording.twist("/wheels")
    np.testing.assert_array_equal(wheels.gyro, np.delete(rates, 5, axis=0) * (0, 0, 1))
    assert wheels.t_ns[3] == T0 + 60_000_000  # of the record time, on the header's clock
    assert any("/wheels: 1 rate is not finite" in warning for warning in recording.warnings)
    assert len(recording.poses("/odom").t_ns) == 20
    assert recording.survey()["/wheels"].header_ns is not None
    with pytest.raises(BadInputError, match=r"which twist topic.*choose with --of"):
        recording.choose("twist")


def test_imu_with_frames_of_different_lengths_falls_back(tmp_path: Path) -> None:
    make = Make("db3")
    frames = ["imu", "imu_longer_name", "", "imu"]
    path = write(tmp_path, "db3", [("/imu", T0 + i, make.imu(T0 + i, (i, 0, 0), (0, 0, i), name)) for i, name in enumerate(frames)])
    imu = open_recording([path]).imu("/imu")
    np.testing.assert_array_equal(imu.gyro[:, 0], range(4))
    np.testing.assert_array_equal(imu.accel[:, 2], range(4))


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_bulk_imu_is_bit_identical_and_skips_damage(encoding: str) -> None:
    make, rng = Make("ros1" if encoding == "ros1" else "db3"), np.random.default_rng(3)
    values = rng.normal(size=(50, 6)) * 10.0 ** rng.integers(-300, 300, (50, 6))
    types = store("ros1" if encoding == "ros1" else "db3")
    serialize = types.serialize_ros1 if encoding == "ros1" else types.serialize_cdr
    for frame in ("", "a", "imu_link", "imu_link_9"):  # CDR pads each differently
        payloads = [bytes(serialize(make.imu(T0, v[:3], v[3:], frame), IMU)) for v in values]
        gyro, accel, whole = decode_imu(payloads, encoding)
        assert np.hstack([gyro, accel]).tobytes() == values.tobytes()
        assert whole.all()
        gyro, accel, whole = decode_imu([*payloads, payloads[0][:100], b""], encoding)
        assert np.hstack([gyro, accel])[:50].tobytes() == values.tobytes()
        assert whole.tolist() == [True] * 50 + [False] * 2


def test_big_endian_cdr_is_read() -> None:
    make, types = Make("db3"), store("db3")
    payload = bytes(types.serialize_cdr(make.imu(T0, (1, 2, 3), (4, 5, 6)), IMU, little_endian=False))
    gyro, accel, _ = decode_imu([payload] * 3, "cdr")
    np.testing.assert_array_equal(np.hstack([gyro, accel]), np.tile([1.0, 2, 3, 4, 5, 6], (3, 1)))
    assert header_ns(payload, "cdr") == T0


def test_header_times_count_and_record_times_stand_in_for_zeros(tmp_path: Path) -> None:
    make = Make("ros1")
    times = [0, 0, T0 + 2, 0, T0 + 4]
    path = write(tmp_path, "ros1", [("/imu", T0 + i + 1000, make.imu(t, (0, 0, 0), (0, 0, 9.8))) for i, t in enumerate(times)])
    recording = open_recording([path])
    assert recording.imu("/imu").t_ns.tolist() == [T0, T0 + 1, T0 + 2, T0 + 3, T0 + 4]  # the latency of 1000 ns is taken off
    assert any("3 header stamps are zero" in warning for warning in recording.warnings)


def test_without_any_header_time_record_times_are_used() -> None:
    zeros: list[int] = []
    assert list(restamp([(0, T0 + i, i) for i in range(30)], zeros)) == [(T0 + i, i) for i in range(30)]
    assert len(zeros) == 30


def test_several_bags_are_one_recording_in_time_order(tmp_path: Path) -> None:
    make = Make("mcap")
    parts = []
    for part in (1, 0):
        (tmp_path / str(part)).mkdir()
        start = T0 + part * 10**9
        messages = [("/imu", start + i, make.imu(start + i, (part, 0, 0), (0, 0, 0))) for i in range(5)]
        parts.append(write(tmp_path / str(part), ("mcap", "db3")[part], messages))
    imu = open_recording(parts).imu("/imu")
    assert np.all(np.diff(imu.t_ns) > 0)
    assert imu.gyro[:, 0].tolist() == [0.0] * 5 + [1.0] * 5


def test_a_recording_given_twice_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "ros1", _messages("ros1"))
    (tmp_path / "link.bag").symlink_to(path)
    (tmp_path / "other").mkdir()
    for sources in ([path, path], [path, tmp_path / "other" / ".." / "rec.bag"], [path, tmp_path / "link.bag"], [tmp_path, path]):
        with pytest.raises(BadInputError, match=r"rec\.bag is given twice: give each recording once"):
            open_recording(sources)


def test_a_folder_of_ros_1_bags_needs_no_metadata(tmp_path: Path) -> None:
    write(tmp_path, "ros1", _messages("ros1"))
    assert open_recording([tmp_path]).warnings == []


def test_a_topic_is_chosen_or_the_candidates_are_named(tmp_path: Path) -> None:
    make = Make("mcap")
    image = np.zeros((4, 4), np.uint8)
    path = write(tmp_path, "mcap", [(topic, T0, make.image(T0, image, "mono8")) for topic in ("/left", "/right")])
    recording = open_recording([path])
    assert recording.choose("image", "/right") == "/right"
    with pytest.raises(BadInputError, match=r"which image topic.*?/left, /right"):
        recording.choose("image")
    with pytest.raises(BadInputError, match="there is no topic /middle; it has /left, /right"):
        recording.choose("image", "/middle")
    with pytest.raises(BadInputError, match="there is no topic \\(empty\\)"):
        recording.choose("image", "")
    with pytest.raises(BadInputError, match="it has no imu topic \\(calibkit info lists what it has\\)"):
        recording.choose("imu")
    with pytest.raises(BadInputError, match="/left is sensor_msgs/msg/Image, not an imu topic"):
        recording.imu("/left")


def test_video_topics_are_refused_by_name(tmp_path: Path) -> None:
    types = store("mcap")
    types.register(get_types_from_msg("builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n", VIDEO))
    stamp = types.types["builtin_interfaces/msg/Time"](1, 0)
    message = types.types[VIDEO](stamp, "cam", np.zeros(4, np.uint8), "h264")
    recording = open_recording([write(tmp_path, "mcap", [("/cam/video", T0, message)])])
    for ask in (lambda: recording.choose("image"), lambda: recording.choose("image", "/cam/video"), lambda: recording.images("/cam/video")):
        with pytest.raises(BadInputError, match="/cam/video is video- or depth-coded"):
            ask()
    make = Make("mcap")
    (tmp_path / "b").mkdir()
    recording = open_recording([write(tmp_path / "b", "mcap", [("/cam", T0, make.compressed(T0, "h264", b"\0\0\0\1abc"))])])
    with pytest.raises(BadInputError, match="'h264' is no still image"):
        next(recording.images("/cam")).decode()


def test_definitions_in_a_file_are_never_compiled(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", _messages("mcap"))
    file = next(path.glob("*.mcap"))
    raw = file.read_bytes()
    assert raw.count(b"std_msgs/Header header") > 1
    file.write_bytes(raw.replace(b"std_msgs/Header header", b"std_msgs/Header h;{}@r"))
    assert len(open_recording([path]).imu("/imu").t_ns) == 40


def test_message_layouts_do_not_depend_on_the_ros_2_distribution() -> None:
    for kind in KINDS:
        seen = {repr(fields) for s in Stores if "ROS2" in s.name and (fields := get_typestore(s).fielddefs.get(kind))}
        assert len(seen) <= 1, kind


def test_what_is_known_of_standard_types_is_as_rosbags_has_it() -> None:
    store = typestore("ros1")
    known = [kind for kind in KINDS if kind in store.fielddefs]
    assert {kind: store.generate_msgdef(kind)[1] for kind in known} == STANDARD_MD5
    headed = {kind for kind in known if store.fielddefs[kind][1][0][1][1] == "std_msgs/msg/Header"}
    assert {kind for kind in known if starts_with_header(kind)} == headed


def test_an_unknown_distribution_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "db3", _messages("db3"))
    assert len(open_recording([path], ros_distro="jazzy").imu("/imu").t_ns) == 40
    with pytest.raises(BadInputError, match=r"--ros-distro rolling is not known: give one of .*humble"):
        open_recording([path], ros_distro="rolling")


def test_a_claim_of_the_metadata_that_the_files_do_not_meet_is_told(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", _messages("mcap"))
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 60", "message_count: 99"))
    assert any("claims 99 messages, the data files hold 60" in w for w in open_recording([path]).warnings)
    metadata.write_text("rosbag2_bagfile_information: [1, 2")
    recording = open_recording([path])
    assert len(recording.imu("/imu").t_ns) == 40
    assert any("metadata.yaml is not readable" in w for w in recording.warnings)


@pytest.mark.parametrize("names", ["5", "[metadata.yaml]", "[[a, b], {c: d}]", "[../other.mcap]", "[., ..]"])
def test_a_list_of_files_that_is_none_leaves_the_files_of_the_folder(tmp_path: Path, names: str) -> None:
    path = write(tmp_path, "mcap", _messages("mcap"))
    (path / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {{relative_file_paths: {names}, ros_distro: [1]}}")
    assert len(open_recording([path]).imu("/imu").t_ns) == 40


def test_a_metadata_file_that_grows_when_read_is_given_up(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", _messages("mcap"))
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    (path / "metadata.yaml").write_text("\n".join([*rows, "rosbag2_bagfile_information: {relative_file_paths: [*a11]}"]))
    assert any("holds more than" in w for w in open_recording([path]).warnings)


@pytest.mark.parametrize("form", ["ros1", "ros1-bz2", "ros1-lz4", "mcap", "mcap-zstd", "db3"])
def test_damaged_files_are_saved_or_refused_in_one_line(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, form, _messages(form, 400))
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    raw = file.read_bytes()
    copy = tmp_path / f"copy{file.suffix}"
    rng = np.random.default_rng(0)
    flipped = [bytes(b) for b in _flip(raw, rng, 12)]
    for damaged in [raw[: len(raw) * part // 100] for part in (0, 1, 10, 50, 90, 99)] + flipped:
        copy.write_bytes(damaged)
        refusal = _refusal(copy)
        assert refusal is None or (copy.name in refusal and "\n" not in refusal)


def _refusal(path: Path) -> str | None:
    """Read all that can be read; return the refusal, if there is one."""
    try:
        recording = open_recording([path])
        recording.survey()
        for topic in recording.topics:
            if topic.kind == "imu":
                recording.imu(topic.name)
    except BadInputError as error:
        return str(error)
    return None


def _flip(raw: bytes, rng: np.random.Generator, n: int) -> list[bytearray]:
    copies = []
    for _ in range(n):
        damaged = bytearray(raw)
        for at in rng.integers(0, len(raw), 20):
            damaged[at] = rng.integers(0, 256)
        copies.append(damaged)
    return copies


@pytest.mark.parametrize("form", ["ros1", "ros1-lz4", "mcap", "db3"])
def test_what_a_cut_file_holds_is_saved_and_counted(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, form, _messages(form, 4000))
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    copy = tmp_path / f"copy{file.suffix}"
    raw = file.read_bytes()
    copy.write_bytes(raw[: len(raw) // 2])
    recording = open_recording([copy])
    whole = open_recording([path]).imu("/imu")
    saved = recording.imu("/imu")
    assert 1200 < len(saved.t_ns) < 2200
    np.testing.assert_array_equal(saved.gyro, whole.gyro[np.searchsorted(whole.t_ns, saved.t_ns)])
    count = sum(topic.count for topic in recording.topics)
    assert any(f"{count} messages saved" in warning for warning in recording.warnings)


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_of_a_cut_chunk_its_whole_blocks_are_saved(compression: str) -> None:
    data = np.random.default_rng(0).bytes(3_000_000)
    packed = {"bz2": bz2.compress, "lz4": lz4.frame.compress}[compression](data)
    saved = unpack(compression, packed[: len(packed) // 2], len(data), partial=True)
    assert 0.25 * len(data) < len(saved) < 0.55 * len(data)
    assert data.startswith(saved)


@pytest.mark.parametrize("form", ["ros1-bz2", "ros1-lz4"])
def test_a_bag_cut_in_its_first_block_says_why_nothing_is_saved(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, form, _messages(form))
    path.write_bytes(path.read_bytes()[:4400])
    told = rf"nothing can be saved of this bag \(it was not closed.*chunk at byte 4109 is damaged \({form[5:]} data ends too soon"
    with pytest.raises(BadInputError, match=told):
        open_recording([path])


def _ros1_record(header: dict[bytes, bytes], data: bytes) -> bytes:
    fields = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in header.items())
    return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data


@pytest.mark.parametrize(("declared", "told"), [(2**31, "declares 2147483648 bytes"), (1000, "more than the 1000 bytes declared")])
def test_decompression_bombs_in_ros1_chunks_are_refused(tmp_path: Path, declared: int, told: str) -> None:
    bomb = bz2.compress(b"\0" * 50_000_000)
    head = {b"op": b"\x03", b"index_pos": bytes(8), b"conn_count": bytes(4), b"chunk_count": bytes(4)}
    chunk = _ros1_record({b"op": b"\x05", b"compression": b"bz2", b"size": struct.pack("<I", declared)}, bomb)
    path = tmp_path / "bomb.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + _ros1_record(head, b"") + chunk)
    with at_most(5_000_000), pytest.raises(BadInputError, match=told):
        open_recording([path])


@pytest.mark.parametrize(("declared", "told"), [(2**40, "declares 1099511627776 bytes"), (1000, "nothing can be saved")])
def test_decompression_bombs_in_mcap_chunks_are_refused(tmp_path: Path, declared: int, told: str) -> None:
    bomb = zstd.compress(b"\0" * 50_000_000)
    chunk = struct.pack("<QQQI", 0, 1, declared, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(bomb)) + bomb
    path = tmp_path / "bomb.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(chunk)) + chunk)
    with at_most(5_000_000), pytest.raises(BadInputError, match=told):
        open_recording([path])


def test_a_packed_bag_that_unpacks_without_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.db3.zstd"
    path.write_bytes(zstd.compress(b"\0" * 50_000_000))
    with pytest.raises(BadInputError, match=r"bomb\.db3\.zstd unpacks to more than"):
        open_recording([path])


def test_a_bag_is_read_chunk_by_chunk(tmp_path: Path) -> None:
    make, rng = Make("ros1"), np.random.default_rng(0)
    pixels = rng.integers(0, 255, (400, 500), np.uint8)
    path = write(tmp_path, "ros1", [("/cam", T0 + i, make.image(T0 + i, pixels, "mono8")) for i in range(100)])
    assert path.stat().st_size > 20_000_000
    recording = open_recording([path])
    with at_most(8_000_000):
        assert sum(frame.decode().shape == (400, 500) for frame in recording.images("/cam")) == 100


def test_terminal_codes_in_topics_are_made_harmless(tmp_path: Path) -> None:
    make = Make("ros1")
    path = write(tmp_path, "ros1", [("/cam\x1b[31m\nred", T0, make.image(T0, np.zeros((2, 2), np.uint8), "mono8"))])
    assert open_recording([path]).topics[0].name == "/cam [31m red"


def test_sources_that_are_none_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "notes.pdf").write_text("x")
    (tmp_path / "empty").mkdir()
    for source, told in (
        (tmp_path / "gone.bag", "does not exist"),
        (tmp_path / "notes.pdf", "no recording"),
        (tmp_path / "empty", "nothing that"),
    ):
        with pytest.raises(BadInputError, match=told):
            open_recording([source])


def test_a_db3_that_computes_its_messages_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "computed.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("CREATE TABLE messages (topic_id INTEGER, timestamp INTEGER, data GENERATED ALWAYS AS (zeroblob(900000000)))")
        database.execute("INSERT INTO topics VALUES (1, '/imu', 'sensor_msgs/msg/Imu', 'cdr')")
        database.execute("INSERT INTO messages (topic_id, timestamp) VALUES (1, 5)")
        database.commit()
    with pytest.raises(BadInputError, match="computes columns of its table messages"):
        open_recording([path])


def test_a_files_name_cannot_speak_to_the_terminal(tmp_path: Path) -> None:
    path = write(tmp_path, "mcap", _messages("mcap", 400))
    data = next(path.glob("*.mcap"))
    (path / "metadata.yaml").unlink()
    data.with_name("\x1b[2Jbag\udc9b.mcap").write_bytes(data.read_bytes()[:-100])
    data.unlink()
    warnings = open_recording([path]).warnings
    assert any("is damaged" in w for w in warnings)
    assert all(w.isprintable() for w in warnings)
