"""One `Recording` for everything that sensors were recorded in: bags, folders and CSV files, on one clock.

Nothing is read before it is asked for; what had to be mended is told in `warnings`.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from calibkit.data.observations import BoardViews, ImageFrame, ImuSamples, PoseSamples
from calibkit.data.progress import Progress, silent
from calibkit.errors import BadInputError, one_line
from calibkit.io import ros_messages, tf_tree
from calibkit.io.board_corners import board_views
from calibkit.io.csv_streams import csv_source
from calibkit.io.folder import asl_camera, image_folder, is_asl_camera, is_image
from calibkit.io.ros2_folder import METADATA, is_bag_file, open_bag_file, open_folder
from calibkit.io.ros_bag import bag_source
from calibkit.io.source import CameraInfo, Edge, Source, Stamps, TopicInfo
from calibkit.models.board import Board

T = TypeVar("T")
_TABLES = (".csv", ".txt", ".tum")
_SENSORS = "cam0/, imu0/ with data.csv inside"


class Recording:
    """Topics of one or several sources on one clock, and their messages as observations."""

    def __init__(self, sources: list[Source]) -> None:
        self._sources = sources
        merged: dict[str, TopicInfo] = {}
        for topic in (topic for source in sources for topic in source.topics):
            known = merged.get(topic.name)
            if known and known.type != topic.type:
                raise BadInputError(f"topic {topic.name} is {known.type} in one file and {topic.type} in another: give one of them")
            merged[topic.name] = replace(topic, count=topic.count + (known.count if known else 0))
        self.topics: tuple[TopicInfo, ...] = tuple(merged.values())

    @property
    def name(self) -> str:
        """What to call the recording in one line."""
        return ", ".join(source.name for source in self._sources)

    @property
    def warnings(self) -> list[str]:
        """What was salvaged, left out or replaced so far; complete once the topics have been read."""
        return list(dict.fromkeys(warning for source in self._sources for warning in source.warnings))

    def choose(self, kind: str, asked: str | None = None) -> str:
        """Return the topic of a kind: the one asked for, or the only one; BadInputError lists the candidates."""
        candidates = [topic.name for topic in self.topics if topic.kind == kind]
        offered = f"it has {', '.join(candidates)}" if candidates else f"it has no {kind} topic"
        if asked is not None:
            self._refuse_video([topic for topic in self.topics if topic.name == asked])
            if asked in candidates:
                return asked
            found = next((topic.type for topic in self.topics if topic.name == asked), None)
            what = f"{one_line(asked)} is {found}, not a {kind} topic" if found else f"there is no topic {one_line(asked)}"
            raise BadInputError(f"{self.name}: {what}; {offered}")
        if len(candidates) == 1:
            return candidates[0]
        if kind == "image" and not candidates:
            self._refuse_video([topic for topic in self.topics if topic.kind == "video"])
        raise BadInputError(f"{self.name}: " + (f"which {kind} topic? {offered}" if candidates else offered))

    def _refuse_video(self, topics: list[TopicInfo]) -> None:
        if topics and topics[0].kind == "video":
            raise BadInputError(
                f"{self.name}: {topics[0].name} is video- or depth-coded ({topics[0].type}) and not read: "
                "record sensor_msgs/CompressedImage (jpeg or png), or convert it"
            )

    def images(self, topic: str) -> Iterator[ImageFrame]:
        """Yield the images of a topic, not yet decoded, in the order of the recording."""
        readers = self._readers("image", topic, (source.images for source in self._sources))
        return (frame for read in readers for frame in read())

    def imu(self, topic: str) -> ImuSamples:
        """Return all samples of an IMU."""
        parts = [read() for read in self._readers("imu", topic, (source.imu for source in self._sources))]
        return ImuSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "gyro", "accel")))

    def poses(self, topic: str) -> PoseSamples:
        """Return all poses of a topic."""
        return _join([read() for read in self._readers("pose", topic, (source.poses for source in self._sources))])

    def tf(self, parent: str, child: str) -> PoseSamples:
        """Return T_parent_child over time, chained through the recording's tf topics."""
        edges: dict[tuple[str, str], list[Edge]] = {}
        for source in self._sources:
            for key, edge in (source.edges() if source.edges else {}).items():
                edges.setdefault(key, []).append(edge)
        joined = {key: Edge(_join([e.poses for e in parts]), any(e.static for e in parts)) for key, parts in edges.items()}
        return tf_tree.chain(joined, parent.strip("/"), child.strip("/"), self.name)

    def camera_info(self, topic: str) -> CameraInfo:
        """Return the first CameraInfo of a topic."""
        return next(read() for read in self._readers("camera_info", topic, (source.camera_info for source in self._sources)))

    def board_views(self, board: Board, image_size: tuple[int, int], topic: str | None = None) -> BoardViews:
        """Return the corners of a corner file laid against the board."""
        chosen = self.choose("corners", topic)
        rows = [read() for read in self._readers("corners", chosen, (source.corners for source in self._sources))]
        return board_views(rows, board, image_size)

    def survey(self, progress: Progress = silent) -> dict[str, Stamps]:
        """Return the times of every topic's messages, read in one pass."""
        parts: dict[str, list[Stamps]] = {}
        for source in self._sources:
            for name, stamps in (source.survey(progress) if source.survey else {}).items():
                parts.setdefault(name, []).append(stamps)
        return {name: _join_stamps(found) for name, found in parts.items()}

    def inputs(self) -> list[tuple[str, str | None]]:
        """Return name and SHA-256 of every source; of a folder, the hash of its files' hashes in order."""
        return [(source.name, _digest(source.files)) for source in self._sources]

    def _readers(self, kind: str, topic: str, tables: Iterable[dict[str, Callable[[], T]]]) -> list[Callable[[], T]]:
        found = [table[topic] for table in tables if topic in table]
        if not found:
            self.choose(kind, topic)
        return found


def _join(parts: list[PoseSamples]) -> PoseSamples:
    t_ns, q, p = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "q", "p"))
    return PoseSamples(t_ns, q, p, parts[0].parent, parts[0].child)


def _join_stamps(parts: list[Stamps]) -> Stamps:
    headers = [part.header_ns for part in parts if part.header_ns is not None]
    return Stamps(np.concatenate(headers) if len(headers) == len(parts) else None, np.concatenate([part.record_ns for part in parts]))


def _digest(files: list[Path]) -> str:
    digests = []
    for path in files:
        digest = hashlib.sha256()
        with path.open("rb") as file:
            while block := file.read(2**20):
                digest.update(block)
        digests.append(digest.hexdigest())
    return digests[0] if len(digests) == 1 else hashlib.sha256("\n".join(digests).encode()).hexdigest()


def open_recording(sources: list[Path], ros_distro: str | None = None) -> Recording:
    """Open recordings of any kind as one, on one clock; `ros_distro` names the ROS 2 distribution where the files do not."""
    if not sources:
        raise BadInputError("no recording is given: name a .bag, .mcap, .db3, a folder or a CSV file")
    ros_messages.typestore(ros_distro)  # an unknown name is told before anything is read
    opened = [source for path in sources for source in _open(Path(path), ros_distro)]
    names = Counter(topic.name for source in opened for topic in source.topics)
    if not names and not any(source.survey for source in opened):
        raise BadInputError(f"{', '.join(source.name for source in opened)}: nothing in it can be read")
    return Recording(opened)


def _open(path: Path, distro: str | None) -> list[Source]:
    name = one_line(path.name or path.resolve().name, 120)
    try:
        if path.is_dir():
            return _open_folder(path, name, distro)
        if not path.exists():
            raise BadInputError(f"{one_line(path)} does not exist: give a recording (.bag, .mcap, .db3, a folder or CSV)")
        if is_bag_file(path):
            container = open_bag_file(path)
            return [bag_source(name, [path], [container], _distro(getattr(container, "distro", None), distro), [])]
        if path.suffix.lower() in _TABLES:
            return [csv_source(path, name.rsplit(".", 1)[0])]
    except OSError as error:
        raise BadInputError(f"{one_line(path)} cannot be read ({one_line(error.strerror)})") from error
    raise BadInputError(f"{name} is no recording that is known: give a .bag, .mcap, .db3, a folder of images, an ASL folder or CSV")


def _open_folder(path: Path, name: str, distro: str | None) -> list[Source]:
    files = sorted(path.iterdir())
    if (path / METADATA).is_file() or any(is_bag_file(file) for file in files):
        data, containers, stated, warnings = open_folder(path)
        return [bag_source(name, data, containers, _distro(stated, distro), warnings)]
    if (path / "mav0").is_dir():
        path, files = path / "mav0", sorted((path / "mav0").iterdir())
    found = [asl_camera(path, name)] if is_asl_camera(path) else []
    found += [image_folder(path, name)] if any(map(is_image, files)) else []
    refused = []
    for entry in files:
        table = entry / "data.csv" if entry.is_dir() else entry
        topic = one_line(entry.stem, 120)
        try:
            if entry.is_dir() and is_asl_camera(entry):
                found.append(asl_camera(entry, topic))
            elif entry.is_dir() and any(map(is_image, entry.iterdir())):
                found.append(image_folder(entry, f"{name}/{topic}"))
            elif table.suffix.lower() in _TABLES and table.is_file() and not (entry == table and is_asl_camera(path)):
                found.append(csv_source(table, topic))
        except BadInputError as error:
            refused.append(str(error))
    if not found:
        reason = refused[0] if refused else f"no images, no bag files, no CSV, no {_SENSORS}"
        raise BadInputError(f"{name} holds nothing that can be read: {reason}")
    for text in refused:
        found[0].warn(text)
    return found


def _distro(stated: str | None, asked: str | None) -> str | None:
    return stated if stated and ros_messages.known_distro(stated) else asked
