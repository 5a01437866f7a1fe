"""ROS 1 and ROS 2 bags as a `Source`: files opened by what they are, messages decoded into observations when asked."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImageFrame, ImuSamples, Lost, PoseSamples
from calibkit.data.plural import counted
from calibkit.data.progress import Progress, silent
from calibkit.errors import BadInputError, one_line
from calibkit.io import images, ros_messages
from calibkit.io.container import Container, Message
from calibkit.io.imu_options import ImuOptions
from calibkit.io.rows import Rows
from calibkit.io.source import CameraInfo, Edge, Look, Source, Stamps, TopicInfo, seconds_text
from calibkit.io.topic_pass import TopicPass, plausible, restamp
from calibkit.io.unpack import UnpackError, unpack_message

Array = NDArray[np.float64]
_END_OF_TIME = 2**62  # ns, in 2116: later record times are damage


class _Bag:
    """All bag files of one recording, read topic by topic."""

    def __init__(self, containers: list[Container], distro: str | None, source: Source, options: ImuOptions) -> None:
        self.containers = sorted(containers, key=lambda c: c.start_ns)
        self.distro = distro
        self.source = source
        self.options = options

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some topics, compressed ones unpacked; count what is lost or missing."""
        for container in self.containers:
            claimed = sum(count for channel, count in container.counts.items() if channel.topic in topics)
            seen = broken = 0
            for message in container.messages(topics):
                seen += 1
                try:
                    payload = unpack_message(message.payload)
                except UnpackError:
                    payload = None
                if payload is None or not 0 <= message.record_ns < _END_OF_TIME:
                    broken += 1
                else:
                    yield message if payload is message.payload else message._replace(payload=payload)
            if broken:
                self.source.warn(Lost(f"{container.path.name}: {broken} messages are damaged and left out"))
            if seen < claimed:
                self.source.warn(Lost(f"{container.path.name} claims {claimed} messages of {_names(topics)} but holds {seen}"))
            for warning in container.warnings:
                self.source.warn(warning)

    def stamped(self, topic: str) -> Iterator[tuple[int, Message]]:
        """Yield the messages of a topic with their times."""
        zeros: list[int] = []
        triples = ((ros_messages.header_ns(m.payload, m.channel.encoding), m.record_ns, m) for m in self.messages([topic]))
        yield from restamp(triples, zeros)
        self._warn_of_zeros(topic, len(zeros))

    def decoded(self, messages: Iterable[tuple[int, Message]], topic: str) -> Iterator[tuple[int, Any]]:
        """Yield the messages that can be decoded; count the others."""
        broken = 0
        for t_ns, message in messages:
            try:
                decoded = ros_messages.deserialize(message.payload, message.channel.type, message.channel.encoding, self.distro)
            except ros_messages.DECODE_ERRORS:
                broken += 1
                continue
            yield t_ns, decoded
        if broken:
            self.source.warn(Lost(f"{topic}: {broken} damaged messages are left out"))

    def images(self, topic: str) -> Iterator[ImageFrame]:
        return (self._frame(t_ns, message) for t_ns, message in self.stamped(topic))

    def _frame(self, t_ns: int, message: Message) -> ImageFrame:
        label = seconds_text(t_ns)
        where = f"{self.source.name}: {message.channel.topic} at {label}"
        return ImageFrame(t_ns, label, message.payload, partial(decode_image, message, where, self.distro))

    def imu(self, topic: str, progress: Progress = silent) -> ImuSamples:
        samples = self._pass({topic: "imu"}, progress, {})[topic].imu
        assert samples is not None, "a pass reads the samples of every IMU"
        return samples

    def poses(self, topic: str) -> PoseSamples:
        rows: list[tuple[int, ros_messages.Pose]] = []
        for t_ns, message in self.decoded(self.stamped(topic), topic):
            rows.append((t_ns, ros_messages.POSES[message.__msgtype__](message)))
        samples, lost = pose_samples(rows, topic)
        if lost:
            self.source.warn(f"{topic}: {lost} poses have no proper rotation or are not finite, and are left out")
        return samples

    def twist(self, topic: str) -> ImuSamples:
        times, rates = Rows((), np.int64), Rows((3,), np.float64)
        for t_ns, message in self.decoded(self.stamped(topic), topic):
            rate = ros_messages.TWISTS[message.__msgtype__](message)
            times.add(np.array([t_ns], np.int64))
            rates.add(np.array([[rate.x, rate.y, rate.z]]))
        return rate_samples(times.take(), rates.take(), topic, self.source)

    def camera_info(self, topic: str) -> CameraInfo:
        for _, message in self.decoded(self.stamped(topic), topic):
            fields = {name.lower(): value for name, value in vars(message).items()}  # ROS 1 has K and D, ROS 2 k and d
            return CameraInfo(
                message.width,
                message.height,
                one_line(message.distortion_model, 60),
                np.array(fields["k"], float).reshape(3, 3),
                np.array(fields["d"], float),
                one_line(message.header.frame_id, 100),
            )
        raise BadInputError(f"{self.source.name}: {topic} holds no readable CameraInfo")

    def edges(self) -> dict[tuple[str, str], Edge]:
        """Read every tf topic once; a topic called ...static holds transforms that are valid always."""
        rows: dict[tuple[str, str, bool], list[tuple[int, ros_messages.Pose]]] = {}
        for topic in (t.name for t in self.source.topics if t.kind == "tf"):
            for record_ns, message in self.decoded(((m.record_ns, m) for m in self.messages([topic])), topic):
                for entry in message.transforms:
                    t_ns = entry.header.stamp.sec * 10**9 + entry.header.stamp.nanosec or record_ns
                    pose = ros_messages.transform(entry)
                    key = pose[2].strip("/"), pose[3].strip("/"), topic.endswith("static")
                    rows.setdefault(key, []).append((t_ns, pose))
        return {(parent, child): Edge(pose_samples(found, child)[0], static) for (parent, child, static), found in rows.items()}

    def survey(self, progress: Progress, looks: Mapping[str, Look]) -> dict[str, Stamps]:
        return self._pass({topic.name: topic.kind for topic in self.source.topics}, progress, looks)

    def _pass(self, kinds: Mapping[str, str], progress: Progress, looks: Mapping[str, Look]) -> dict[str, Stamps]:
        """Read some topics at once, whatever their kinds."""
        channels = {c for container in self.containers for c in container.counts if c.topic in kinds}
        headed = {c for c in channels if ros_messages.starts_with_header(c.type)}
        total = sum(topic.count for topic in self.source.topics if topic.name in kinds)
        passes = {name: TopicPass(kind, self.options) for name, kind in kinds.items()}
        for message in progress(self.messages(passes.keys()), "reading", total):
            name = message.channel.topic
            if name in looks and len(passes[name]) % looks[name].every == 0:
                t_ns = ros_messages.header_ns(message.payload, message.channel.encoding) or message.record_ns
                looks[name].show(self._frame(t_ns, message))
            passes[name].add(message, message.channel in headed)
        found = {name: of_topic.stamps() for name, of_topic in passes.items()}
        for name, of_topic in passes.items():
            if of_topic.kind in ("image", "imu"):
                self._warn_of_zeros(name, of_topic.zeros)
            if of_topic.lost:
                self.source.warn(f"{name}: {of_topic.lost} samples are damaged or not finite and left out")
        return found

    def _warn_of_zeros(self, topic: str, zeros: int) -> None:
        if zeros:
            self.source.recorded[topic] = zeros
            self.source.warn(f"{topic}: {zeros} header stamps are zero: record times are used for them")


def decode_image(message: Message, where: str, distro: str | None) -> images.Gray:
    """Return a message's image as gray; BadInputError when it is damaged or coded as video."""
    try:
        image = ros_messages.deserialize(message.payload, message.channel.type, message.channel.encoding, distro)
    except ros_messages.DECODE_ERRORS as error:
        raise BadInputError(f"{where}: the message is damaged ({one_line(error, 120)})") from error
    if message.channel.type == ros_messages.COMPRESSED:
        if ros_messages.is_video(image.format):
            raise BadInputError(f"{where}: format {one_line(image.format, 60)!r} is no still image: record it as jpeg or png")
        return images.decode_compressed(image.data, where)
    return images.decode_raw(image.width, image.height, image.encoding, bool(image.is_bigendian), image.step, image.data, where)


def pose_samples(rows: list[tuple[int, ros_messages.Pose]], child: str) -> tuple[PoseSamples, int]:
    """Return the poses with unit quaternions, and how many had none and were left out."""
    t_ns = np.array([t for t, _ in rows], np.int64)
    p = np.array([(p.x, p.y, p.z) for _, (p, _, _, _) in rows], float).reshape(-1, 3)
    q = np.array([(q.x, q.y, q.z, q.w) for _, (_, q, _, _) in rows], float).reshape(-1, 4)
    frames = [(parent, name) for _, (_, _, parent, name) in rows[:1]] or [("", "")]
    return unit_poses(t_ns, q, p, one_line(frames[0][0], 100), one_line(frames[0][1], 100) or child)


def unit_poses(t_ns: NDArray[np.int64], q: Array, p: Array, parent: str, child: str) -> tuple[PoseSamples, int]:
    """Return poses with quaternions made unit, leaving out those further than 10 % from it or not finite; and how many."""
    good = plausible(p) & plausible(q)
    norm = np.linalg.norm(np.where(good[:, None], q, 0), axis=1)
    good &= np.abs(norm - 1) < 0.1
    return PoseSamples(t_ns[good], q[good] / norm[good, None], p[good], parent, child), int(np.sum(~good))


def rate_samples(t_ns: NDArray[np.int64], rates: Array, name: str, source: Source) -> ImuSamples:
    """Return the rates (n, 3) of a twist as a gyroscope's, without those that are not finite."""
    good = plausible(rates)
    if not good.all():
        source.warn(f"{name}: {counted(int(np.sum(~good)), 'rate is', 'rates are')} not finite and left out")
    return ImuSamples(t_ns[good], rates[good], np.zeros((int(np.sum(good)), 0)))


def _names(topics: Iterable[str]) -> str:
    names = sorted(topics)
    return names[0] if len(names) == 1 else f"{len(names)} topics"


def bag_source(
    name: str, files: list[Path], containers: list[Container], distro: str | None, warnings: list[str], options: ImuOptions
) -> Source:
    """Return the topics of bag files and how to read them; `distro` is the ROS 2 distribution, where known."""
    source = Source(name, files, min((c.start_ns for c in containers), default=0), warnings=list(warnings))
    bag = _Bag(containers, distro, source, options)
    counts: Counter[tuple[str, str, str]] = Counter()
    for container in containers:
        for warning in container.warnings:
            source.warn(warning)
        for channel, count in container.counts.items():
            counts[channel.topic, channel.type, channel.encoding] += count
            standard = ros_messages.STANDARD_MD5.get(channel.type) if channel.md5 not in ("", "*") else None
            if standard and channel.md5 != standard:
                source.warn(f"{channel.topic}: its definition of {channel.type} is not the standard one (md5 {one_line(channel.md5, 40)})")
    readers: dict[str, tuple[dict[str, Any], Any]] = {
        "image": (source.images, bag.images),
        "imu": (source.imu, bag.imu),
        "pose": (source.poses, bag.poses),
        "twist": (source.twist, bag.twist),
        "camera_info": (source.camera_info, bag.camera_info),
    }
    for (topic, kind_of, encoding), count in sorted(counts.items()):
        kind = ros_messages.KINDS.get(kind_of, "other") if encoding in ros_messages.ENCODINGS else "other"
        if kind == "image" and topic.endswith("/compressedDepth"):
            kind = "video"
        source.topics.append(TopicInfo(topic, kind_of, kind, count))
        if kind in readers:
            table, read = readers[kind]
            table[topic] = partial(read, topic)
    source.survey = bag.survey
    if source.imu and options.rate_hz is not None:
        source.warn(f"{name}: its messages have stamps, so --rate is not used")
    if any(topic.kind == "tf" for topic in source.topics):
        source.edges = bag.edges
    return source
