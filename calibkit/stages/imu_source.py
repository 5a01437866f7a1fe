"""The IMU that a stage is asked for: its name, its topic, its samples."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calibkit.data.observations import ImuSamples
from calibkit.data.progress import Progress
from calibkit.errors import BadInputError, one_line
from calibkit.io.imu_options import ImuOptions
from calibkit.io.recording import Recording, open_recording

_NAME = re.compile("[A-Za-z][A-Za-z0-9]{0,39}")  # as the rig file has it


@dataclass(frozen=True)
class ImuSource:
    """An IMU in a recording."""

    name: str  # imu0
    topic: str
    samples: ImuSamples
    recording: Recording


def open_imu(
    sources: Sequence[Path],
    asked: str | None,
    options: ImuOptions,
    ros_distro: str | None,
    progress: Progress,
    *,
    counts: bool,
    partial: bool,
) -> ImuSource:
    """Return the IMU asked for as /topic or imu0=/topic, else the only one there is."""
    recording = open_recording(list(sources), ros_distro, options)
    name, _, topic = (asked or "").rpartition("=") if "=" in (asked or "") else ("imu0", "", asked)
    if not _NAME.fullmatch(name):
        raise BadInputError(
            f"--imu {one_line(asked)}: {one_line(name) or 'nothing'} is no name of letters a-z and digits; write imu0=/topic"
        )
    chosen = recording.choose("imu", topic or None)
    samples = recording.imu(chosen, progress, counts=counts, partial=partial)
    return ImuSource(name, chosen, samples, recording)
