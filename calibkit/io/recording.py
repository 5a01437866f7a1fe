"""One `Recording` for everything that sensors were recorded in: bags, folders and CSV files, on one clock.

Nothing is read before it is asked for; what had to be mended is told in `warnings`.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from calibkit.data.observations import BoardViews, ImageFrame, ImuSamples, Lost, PoseSamples
from calibkit.data.progress import Progress, silent
from calibkit.errors import BadInputError, one_line
from calibkit.io import ros_messages, tf_tree
from calibkit.io.board_corners import board_views
from calibkit.io.imu_options import ImuOptions
from calibkit.io.open_source import open_sources
from calibkit.io.source import CameraInfo, Edge, Look, Source, Stamps, TopicInfo
from calibkit.models.board import Board

T = TypeVar("T")
_OPTIONS = {  # that choose a topic of this kind
    "image": "--camera",
    "corners": "--camera",
    "imu": "--imu",
    "pose": "--pose",
    "twist": "--of or --to",
}


class Recording:
    """Topics of one or several sources on one clock, and their messages as observations."""

    def __init__(self, sources: list[Source]) -> None:
        self._sources = sorted(sources, key=lambda source: source.start_ns)
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
        """What was salvaged, left out or replaced so far, damage as `Lost`; complete once the topics have been read."""
        said = [warning for source in self._sources for warning in source.warnings]
        return list(dict.fromkeys((Lost if isinstance(text, Lost) else str)(one_line(text, 1000)) for text in said))

    @property
    def recorded(self) -> dict[str, int]:
        """How many stamps of a topic are times of recording, its header having none; complete once the topics have been read."""
        found: dict[str, int] = {}
        for source in self._sources:
            for topic, many in source.recorded.items():
                found[topic] = found.get(topic, 0) + many
        return found

    def choose(self, kind: str, asked: str | None = None) -> str:
        """Return the topic of a kind: the one asked for, or the only one; BadInputError lists the candidates."""
        candidates = [topic.name for topic in self.topics if topic.kind == kind]
        offered = f"it has {', '.join(candidates)}" if candidates else f"it has no {kind} topic (calibkit info lists what it has)"
        if asked is not None:
            self._refuse_video([topic for topic in self.topics if topic.name == asked])
            if asked in candidates:
                return asked
            found = next((topic.type for topic in self.topics if topic.name == asked), None)
            wanted = f"{'an' if kind[0] in 'aeiou' else 'a'} {kind} topic"
            what = f"{one_line(asked)} is {found}, not {wanted}" if found else f"there is no topic {one_line(asked) or '(empty)'}"
            raise BadInputError(f"{self.name}: {what}; {offered}")
        if len(candidates) == 1:
            return candidates[0]
        if kind == "image" and not candidates:
            self._refuse_video([topic for topic in self.topics if topic.kind == "video"])
        remedy = f"; choose with {_OPTIONS[kind]}" if kind in _OPTIONS else ""
        raise BadInputError(f"{self.name}: " + (f"which {kind} topic? {offered}{remedy}" if candidates else offered))

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

    def imu(self, topic: str, progress: Progress = silent, *, counts: bool = False, partial: bool = False) -> ImuSamples:
        """Return all samples of an IMU; raw counts, and a gyroscope or an accelerometer alone, only for those who can use them."""
        readers = self._readers("imu", topic, (source.imu for source in self._sources))
        samples = _join_imu([read(progress) for read in readers], topic)
        if samples.unit == "counts" and not counts:
            raise BadInputError(
                f"{self.name}: {topic} holds raw counts: state what they are in (--gyro-unit, --accel-unit), or give SI units"
            )
        if not partial and not (samples.has_gyro and samples.has_accel):
            missing = "gyroscope" if samples.has_accel else "accelerometer"
            raise BadInputError(f"{self.name}: {topic} has no {missing}: give a recording with both, or the other file beside it")
        return samples

    def poses(self, topic: str) -> PoseSamples:
        """Return all poses of a topic."""
        return _join([read() for read in self._readers("pose", topic, (source.poses for source in self._sources))])

    def twist(self, topic: str) -> ImuSamples:
        """Return the rates of turn of a topic as a gyroscope's, in the body's axes; an axis that is 0 throughout is not measured."""
        return _join_imu([read() for read in self._readers("twist", topic, (source.twist for source in self._sources))], topic)

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

    def survey(self, progress: Progress = silent, looks: Mapping[str, Look] | None = None) -> dict[str, Stamps]:
        """Return the times of every topic's messages and the samples of IMUs, read in one pass; show images of some topics by the way."""
        parts: dict[str, list[Stamps]] = {}
        for source in self._sources:
            for name, stamps in (source.survey(progress, looks or {}) if source.survey else {}).items():
                parts.setdefault(name, []).append(stamps)
        return {name: _join_stamps(found, name) for name, found in parts.items()}

    def inputs(self) -> list[tuple[str, str | None]]:
        """Return name and SHA-256 of every source; of a folder, the hash of its files' hashes in order."""
        return [(source.name, _digest(source.files)) for source in self._sources]

    def _readers(self, kind: str, topic: str, tables: Iterable[dict[str, T]]) -> list[T]:
        found = [table[topic] for table in tables if topic in table]
        if not found:
            self.choose(kind, topic)
        return found


def _join(parts: list[PoseSamples]) -> PoseSamples:
    t_ns, q, p = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "q", "p"))
    return PoseSamples(t_ns, q, p, parts[0].parent, parts[0].child)


def _join_imu(parts: list[ImuSamples], topic: str) -> ImuSamples:
    if len(parts) == 1:
        return parts[0]  # as it is: hours of samples are not copied for nothing
    if len({(part.unit, part.has_gyro, part.has_accel) for part in parts}) > 1:
        raise BadInputError(f"{topic} holds other sensors or units in one file than in another: give one of them")
    t_ns, gyro, accel = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t_ns", "gyro", "accel"))
    return ImuSamples(t_ns, gyro, accel, parts[0].unit, any(part.interpolated for part in parts))


def _join_stamps(parts: list[Stamps], topic: str) -> Stamps:
    headers = [part.header_ns for part in parts if part.header_ns is not None]
    samples = [part.imu for part in parts if part.imu is not None]
    return Stamps(
        np.concatenate(headers) if len(headers) == len(parts) else None,
        np.concatenate([part.record_ns for part in parts]),
        _join_imu(samples, topic) if samples else None,
    )


def _digest(files: list[Path]) -> str:
    digests = []
    for path in files:
        digest = hashlib.sha256()
        with path.open("rb") as file:
            while block := file.read(2**20):
                digest.update(block)
        digests.append(digest.hexdigest())
    return digests[0] if len(digests) == 1 else hashlib.sha256("\n".join(digests).encode()).hexdigest()


def open_recording(sources: list[Path], ros_distro: str | None = None, imu: ImuOptions = ImuOptions()) -> Recording:
    """Open recordings of any kind as one, on one clock; what the files do not say is in `ros_distro` (of ROS 2) and `imu`."""
    if not sources:
        raise BadInputError("no recording is given: name a .bag, .mcap, .db3, a folder or a CSV file")
    ros_messages.check_distro(ros_distro)  # an unknown name is told before anything is read
    return Recording(open_sources(sources, ros_distro, imu))
