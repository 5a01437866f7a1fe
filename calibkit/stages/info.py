"""What a recording holds, what is wrong with it, and what each topic could be used for."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImageFrame, ImuSamples
from calibkit.data.plural import counted
from calibkit.data.progress import Progress, silent
from calibkit.errors import BadInputError, one_line
from calibkit.estimation import doctor
from calibkit.estimation.doctor import Finding
from calibkit.io.atomic import refuse_unwritable, write_json
from calibkit.io.imu_options import ImuOptions
from calibkit.io.recording import Recording, open_recording
from calibkit.io.source import Look, Stamps, TopicInfo

_DEFAULT = ImuOptions()
_SAMPLE = 20  # images of a topic that are decoded and judged
_TIMED = ("image", "imu", "pose", "twist", "camera_info", "corners", "cloud")  # kinds whose times matter


@dataclass(frozen=True)
class ImageSummary:
    """What the sampled images of a topic look like."""

    width: int
    height: int
    bits: int
    sampled: int
    brightness: float  # mean gray over full scale, median of the sample
    sharpness: float  # see doctor.sharpness, median of the sample


@dataclass(frozen=True)
class TopicReport:
    """One topic: what was claimed, what was found."""

    topic: TopicInfo
    held: int  # messages that could be read
    rate_hz: float | None
    start_ns: int | None
    end_ns: int | None
    image: ImageSummary | None
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class Info:
    """All that `calibkit info` says."""

    sources: tuple[str, ...]
    topics: tuple[TopicReport, ...]
    findings: tuple[Finding, ...]  # that concern several topics
    warnings: tuple[str, ...]  # of reading: what was mended or left out

    @property
    def duration_s(self) -> float:
        """From the first to the last stamp of topics that have stamps."""
        spans = [(t.start_ns, t.end_ns) for t in self.topics if t.start_ns is not None and t.end_ns]
        return (max(end for _, end in spans) - min(start for start, _ in spans)) * 1e-9 if spans else 0.0

    @property
    def problems(self) -> int:
        """How many findings and warnings of reading may spoil a calibration."""
        return len(self.warnings) + sum(f.problem for f in self.findings) + sum(f.problem for t in self.topics for f in t.findings)


def info(
    sources: list[Path],
    ros_distro: str | None = None,
    json_path: Path | None = None,
    force: bool = False,
    progress: Progress = silent,
    imu: ImuOptions = _DEFAULT,
) -> Info:
    """Look through a recording and write what was found as JSON where asked; BadInputError where nothing can be read."""
    if json_path is not None:
        refuse_unwritable(json_path, force)
    recording = open_recording(sources, ros_distro, imu)
    judges = {topic.name: _ImageJudge() for topic in recording.topics if topic.kind == "image"}
    looks = {topic.name: Look(max(1, topic.count // _SAMPLE), judges[topic.name].see) for topic in recording.topics if topic.name in judges}
    survey = recording.survey(progress, looks)
    topics = [_examine(topic, survey[topic.name], judges.get(topic.name)) for topic in recording.topics]
    names = tuple(dict.fromkeys(one_line(path.name or path.resolve().name, 120) for path in sources))
    spans = {t.topic.name: (t.start_ns, t.end_ns) for t in topics if t.topic.kind in _TIMED and t.start_ns is not None and t.end_ns}
    findings = (*doctor.check_clocks(_latencies(recording, survey)), *doctor.check_overlap(spans))
    result = Info(names, tuple(topics), findings, tuple(recording.warnings))
    if json_path is not None:
        write_json(json_path, as_json(result), force)
    return result


def _latencies(recording: Recording, survey: dict[str, Stamps]) -> dict[str, float]:
    """Return how long after their stamps the messages of each sensor were recorded, in s."""
    found = {}
    for topic in recording.topics:
        stamps = survey[topic.name]
        if topic.kind in _TIMED and stamps.header_ns is not None:
            latency = doctor.latency_s(stamps.header_ns, stamps.record_ns)
            if latency is not None:
                found[topic.name] = latency
    return found


def _examine(topic: TopicInfo, stamps: Stamps, images: "_ImageJudge | None") -> TopicReport:
    headers = stamps.header_ns if stamps.header_ns is not None and np.any(stamps.header_ns) else None
    times = stamps.record_ns if headers is None else headers[headers != 0]
    stamped = bool(np.any(times))
    findings = [] if topic.count else [Finding("empty", True, "holds no messages")]
    if topic.kind in _TIMED:
        findings += doctor.check_times(times) if stamped else []
        findings += doctor.check_headers(stamps.header_ns, stamps.record_ns) if stamps.header_ns is not None else []
    findings += _imu_findings(stamps.imu) if stamps.imu is not None and len(stamps.imu.t_ns) else []
    findings += images.findings() if images else []
    return TopicReport(
        topic=topic,
        held=len(stamps.record_ns) if topic.kind != "corners" else topic.count,
        rate_hz=doctor.rate_hz(times),
        start_ns=int(times.min()) if stamped else None,
        end_ns=int(times.max()) if stamped else None,
        image=images.summary() if images else None,
        findings=tuple(findings),
    )


def _imu_findings(samples: ImuSamples) -> list[Finding]:
    si = samples.unit == "SI"
    return [
        *(doctor.check_accel(samples.accel) if si and samples.has_accel else []),
        *(doctor.check_gyro_unit(samples.t_ns, samples.gyro, samples.accel) if si and samples.has_accel and samples.has_gyro else []),
        *doctor.check_saturation("the gyroscope", samples.gyro),
        *doctor.check_saturation("the accelerometer", samples.accel),
        *doctor.check_frozen(np.hstack([samples.gyro, samples.accel])),
    ]


class _ImageJudge:
    """Decodes images spread over a topic while they pass, and judges them."""

    def __init__(self) -> None:
        self._sizes: list[tuple[int, int, int]] = []
        self._bright: list[float] = []
        self._sharp: list[float] = []
        self._broken: list[str] = []

    def see(self, frame: ImageFrame) -> None:
        """Decode an image and note what it looks like."""
        try:
            gray: NDArray[np.generic] = frame.decode()
        except BadInputError as error:
            self._broken.append(str(error))
            return
        self._sizes.append((gray.shape[1], gray.shape[0], gray.dtype.itemsize * 8))
        self._bright.append(doctor.brightness(gray))
        self._sharp.append(doctor.sharpness(gray))

    def summary(self) -> ImageSummary | None:
        """Return what the images look like, None where none can be read."""
        if not self._sizes:
            return None
        return ImageSummary(*self._sizes[0], len(self._sizes), float(np.median(self._bright)), float(np.median(self._sharp)))

    def findings(self) -> list[Finding]:
        """Return what is wrong with the images."""
        findings, sizes, broken = [], self._sizes, self._broken
        if broken:
            text = f"{len(broken)} of {counted(len(broken) + len(sizes), 'sampled image')} cannot be read; the first: {broken[0]}"
            findings.append(Finding("unreadable", True, text))
        if len(set(sizes)) > 1:
            listed = ", ".join(f"{width} x {height} ({bits} bit)" for width, height, bits in sorted(set(sizes))[:4])
            findings.append(Finding("mixed_sizes", True, f"images differ in size: {listed}"))
        return findings + (doctor.check_images(np.array(self._bright), np.array(self._sharp)) if sizes else [])


def as_json(result: Info) -> dict[str, object]:
    """Return everything as JSON of a stable schema, version 1; times in ns, rates in Hz."""

    def finding(f: Finding) -> dict[str, object]:
        return {"code": f.code, "problem": f.problem, "text": f.text}

    return {
        "format": "calibkit-info",
        "version": 1,
        "sources": list(result.sources),
        "duration_s": result.duration_s,
        "problems": result.problems,
        "topics": [
            {
                "name": t.topic.name,
                "type": t.topic.type,
                "kind": t.topic.kind,
                "count_claimed": t.topic.count,
                "count": t.held,
                "rate_hz": t.rate_hz,
                "start_ns": t.start_ns,
                "end_ns": t.end_ns,
                "usable_for": t.topic.usable_for,
                "image": None if t.image is None else vars(t.image),
                "findings": [finding(f) for f in t.findings],
            }
            for t in result.topics
        ],
        "findings": [finding(f) for f in result.findings],
        "warnings": list(result.warnings),
    }
