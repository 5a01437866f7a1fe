"""Bags that we write: rosbags reads back what went in, our own reader too, and the same input gives the same bytes."""

import hashlib
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from calibkit.errors import BadInputError
from calibkit.io.bag_writer import KINDS, STORAGES, CompressedPayload, ImuPayload, PosePayload, Sample, Stream, write_bag
from calibkit.io.recording import open_recording

T_0 = 1_700_000_000_123_456_789
IMAGE = np.arange(48, dtype=np.uint8).reshape(6, 8)
POSE = PosePayload(np.array([0.5, -0.5, 0.5, 0.5]), np.array([1.0, 2.0, 3.0]), "hand")
PAYLOADS = {
    "imu": ImuPayload(np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 9.0])),
    "compressed": CompressedPayload("jpeg", b"\xff\xd8 not a real one \xff\xd9"),
    "mono8": IMAGE,
    "pose": POSE,
    "tf": POSE,
}


def streams(n: int = 5) -> list[Stream]:
    def samples(kind: str, period: int) -> Iterator[Sample]:
        for k in range(n):
            yield Sample(T_0 + k * period, T_0 + k * period - 3_000_000, PAYLOADS[kind])

    return [Stream(f"/{kind}", kind, "base", samples(kind, 10_000_000 * (i + 1))) for i, kind in enumerate(KINDS)]


def bag(folder: Path, storage: str) -> Path:
    return folder / f"out{STORAGES[storage].suffix}"


@pytest.mark.parametrize("storage", STORAGES)
def test_rosbags_reads_back_what_was_written(storage: str, tmp_path: Path) -> None:
    path = bag(tmp_path, storage)
    write_bag(path, streams(), storage)
    got: dict[str, list[tuple[int, object]]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        times = []
        for connection, record_ns, raw in reader.messages():
            times.append(record_ns)
            got.setdefault(connection.topic, []).append((record_ns, reader.deserialize(raw, connection.msgtype)))
    assert times == sorted(times)
    assert {topic: len(rows) for topic, rows in got.items()} == {f"/{kind}": 5 for kind in KINDS}
    for record_ns, message in (row for topic in got if topic != "/tf" for row in got[topic]):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == record_ns - 3_000_000
        assert message.header.frame_id == "base"
    imu = got["/imu"][0][1]
    assert (imu.angular_velocity.y, imu.linear_acceleration.z, imu.orientation_covariance[0]) == (0.2, 9.0, -1.0)
    image = got["/mono8"][0][1]
    assert (image.height, image.width, image.step, image.encoding) == (6, 8, 8, "mono8")
    assert np.array_equal(image.data, IMAGE.ravel())
    assert bytes(got["/compressed"][0][1].data) == PAYLOADS["compressed"].data
    pose = got["/pose"][0][1].pose
    assert (pose.orientation.y, pose.orientation.w, pose.position.z) == (-0.5, 0.5, 3.0)
    transform = got["/tf"][0][1].transforms[0]
    assert (transform.child_frame_id, transform.transform.translation.x, transform.transform.rotation.y) == ("hand", 1.0, -0.5)


@pytest.mark.parametrize("storage", STORAGES)
def test_our_own_reader_agrees(storage: str, tmp_path: Path) -> None:
    path = bag(tmp_path, storage)
    write_bag(path, streams(), storage)
    recording = open_recording([path])
    imu = recording.imu("/imu")
    assert imu.t_ns.tolist() == [T_0 - 3_000_000 + k * 10_000_000 for k in range(5)]
    assert np.array_equal(imu.accel[0], PAYLOADS["imu"].accel)
    frames = list(recording.images("/mono8"))
    assert len(frames) == 5
    assert np.array_equal(frames[0].decode(), IMAGE)
    assert np.array_equal(recording.poses("/pose").q, np.tile(POSE.q, (5, 1)))
    assert recording.warnings == []


@pytest.mark.parametrize("storage", STORAGES)
def test_same_input_same_bytes(storage: str, tmp_path: Path) -> None:
    digests = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_bag(bag(tmp_path / name, storage), streams(), storage)
        files = sorted(f for f in (tmp_path / name).rglob("*") if f.is_file())
        digests.append([(f.name, hashlib.sha256(f.read_bytes()).hexdigest()) for f in files])
    assert digests[0] == digests[1]


@pytest.mark.parametrize("storage", STORAGES)
def test_nothing_is_overwritten_and_nothing_half_written_stays(storage: str, tmp_path: Path) -> None:
    path = bag(tmp_path, storage)
    path.write_text("mine")
    with pytest.raises(BadInputError, match="exists already"):
        write_bag(path, streams(), storage)
    assert path.read_text() == "mine"
    path.unlink()

    def breaking() -> Iterator[Sample]:
        yield Sample(T_0, T_0, IMAGE)
        raise RuntimeError("camera fell off")

    with pytest.raises(RuntimeError, match="fell off"):
        write_bag(path, [Stream("/image", "mono8", "cam", breaking())], storage)
    assert list(tmp_path.iterdir()) == []


def test_streams_are_not_held_in_memory(tmp_path: Path) -> None:
    def samples(n: int) -> Iterator[Sample]:
        for k in range(n):
            yield Sample(T_0 + k, T_0 + k, np.zeros((480, 752), np.uint8))

    def peak(n: int) -> int:
        tracemalloc.start()
        write_bag(tmp_path / f"{n}.bag", [Stream("/image", "mono8", "cam", samples(n))], "ros1")
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    assert peak(120) < peak(30) + 1_000_000  # 32 MB more of images
