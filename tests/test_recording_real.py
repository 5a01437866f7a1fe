"""Real recordings: all open or are refused in one line, whole or cut, and hold what rosbags finds in them."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2

from calibkit.errors import BadInputError
from calibkit.io.db3 import Db3File
from calibkit.io.mcap import McapFile
from calibkit.io.recording import open_recording
from calibkit.io.ros1_bag import Ros1Bag
from calibkit.models.board import AprilGrid

KINDS = {".bag": (Ros1Bag, Reader1), ".mcap": (McapFile, Reader2), ".db3": (Db3File, Reader2)}
EMPTY = "empty-file.bag"


def _files(data_dir: Path) -> list[Path]:
    return sorted(path for path in (data_dir / "bags").rglob("*") if path.suffix in KINDS)


def test_our_readers_find_what_rosbags_finds(data_dir: Path) -> None:
    for path in _files(data_dir):
        if path.name == EMPTY:
            continue
        ours, theirs = KINDS[path.suffix]
        container = ours(path)
        mine = [(m.channel.topic, m.record_ns, m.payload) for m in container.messages({c.topic for c in container.counts})]
        with theirs(path) as reader:
            expected = [(connection.topic, t_ns, bytes(payload)) for connection, t_ns, payload in reader.messages()]
        assert [m[1] for m in mine] == [m[1] for m in expected], path.name
        assert sorted(mine) == sorted(expected), path.name
        assert sum(container.counts.values()) == len(expected)
        assert container.warnings == []


def test_every_bag_opens_or_is_refused_in_one_line(data_dir: Path) -> None:
    for path in sorted((data_dir / "bags").iterdir()):
        if path.name == EMPTY:
            with pytest.raises(BadInputError, match=r"empty-file\.bag is empty"):
                open_recording([path])
            continue
        recording = open_recording([path])
        survey = recording.survey()
        assert {t.name: t.count for t in recording.topics} == {name: len(stamps.record_ns) for name, stamps in survey.items()}, path.name


@pytest.mark.parametrize(
    ("folder", "messages"),
    [("ros2_mcap_silent_empty", 20), ("ros2_mcap_bad_definition", 10), ("ros2_db3_zstd_messages", 1127), ("ros2_mcap_split", 6074)],
)
def test_ros2_folders_hold_their_messages(data_dir: Path, folder: str, messages: int) -> None:
    recording = open_recording([data_dir / "bags" / folder])
    assert sum(len(stamps.record_ns) for stamps in recording.survey().values()) == messages
    assert recording.warnings == []


def _saved(path: Path) -> int | str:
    try:
        recording = open_recording([path])
        found = sum(len(stamps.record_ns) for stamps in recording.survey().values())
    except BadInputError as error:
        return str(error)
    assert any("damaged" in warning for warning in recording.warnings), path.name
    assert any(f"{sum(t.count for t in recording.topics)} messages saved" in warning for warning in recording.warnings)
    return found


def test_cut_copies_are_saved_or_refused_in_one_line(data_dir: Path, tmp_path: Path) -> None:
    saved = {}
    for path in _files(data_dir):
        raw = path.read_bytes()
        for part in (10, 50, 90) if raw else ():
            copy = tmp_path / path.name
            copy.write_bytes(raw[: len(raw) * part // 100])
            result = _saved(copy)
            assert isinstance(result, int) or (path.name in result and "\n" not in result), result
            saved[path.name, part] = result
    assert saved["example.bag", 10] == 819
    assert saved["example.bag", 50] == 4899
    assert saved["poses_ros1.bag", 90] == 24410
    assert saved["ardrone_imu.bag", 50] == 2843
    assert saved["message_compression_0.db3", 50] == 168
    assert saved["talker.mcap", 50] == 20


def test_the_imu_bag(data_dir: Path) -> None:
    imu = open_recording([data_dir / "bags" / "ardrone_imu.bag"]).imu("/ardrone/imu")
    assert len(imu.t_ns) == 4308
    assert 9 < np.median(np.linalg.norm(imu.accel, axis=1)) < 10


def test_tf_of_a_bag(data_dir: Path) -> None:
    poses = open_recording([data_dir / "bags" / "example.bag"]).tf("turtle1", "turtle2")
    assert len(poses.t_ns) == 1344


def test_euroc_corners_and_imu(data_dir: Path) -> None:
    recording = open_recording([data_dir / "euroc_imu_april" / name for name in ("cam0_corners.csv", "imu0.csv")])
    views = recording.board_views(AprilGrid(6, 6, 0.088, 0.3), (752, 480))
    assert views.n_frames == 1416
    assert np.bincount(views.frame).min() >= 4
    imu = recording.imu(recording.choose("imu"))
    assert imu.t_ns[0] == 1404733405747800064
    assert np.median(np.diff(imu.t_ns)) == 4_999_936  # the file's stamps went through a double


def test_pose_streams(data_dir: Path) -> None:
    for path in sorted((data_dir / "pose_streams").glob("*.csv")):
        poses = open_recording([path]).poses(path.stem)
        assert len(poses.t_ns) == len(path.read_text().splitlines())
        np.testing.assert_allclose(np.linalg.norm(poses.q, axis=1), 1, atol=1e-12)
    assert poses.t_ns[0] == 1491754390_480000000


def test_two_pose_streams_are_one_recording(data_dir: Path) -> None:
    recording = open_recording([data_dir / "pose_streams" / name for name in ("vicon_hand.csv", "camera_in_target.csv")])
    assert [(topic.name, topic.kind) for topic in recording.topics] == [("vicon_hand", "pose"), ("camera_in_target", "pose")]
    hand, camera = (recording.poses(topic.name) for topic in recording.topics)
    assert (len(hand.t_ns), len(camera.t_ns)) == (7093, 1533)
    # As recorded: repeats, gaps and flips of sign are for the estimator.
    assert np.sum(np.diff(hand.t_ns) == 0) == 5
    assert np.diff(camera.t_ns).max() == 703_757_100
    assert np.sum(np.sum(camera.q[1:] * camera.q[:-1], axis=1) < 0) == 18


def test_image_folders(data_dir: Path) -> None:
    for folder, count, shape in (("kuka2", 28, (1200, 1920)), ("mei_fisheye", 63, (960, 1280))):
        frames = list(open_recording([data_dir / folder]).images(folder))
        assert len(frames) == count
        assert frames[0].decode().shape == shape
    assert [frame.label for frame in frames[:3]] == ["img0.png", "img1.png", "img2.png"]
    wide = next(f for f in open_recording([data_dir / "aprilgrid_frames"]).images("aprilgrid_frames") if f.label == "TUM_VI.png")
    assert wide.decode().dtype == np.uint16
