"""Folders of images and EuRoC/ASL folders (sensor/data.csv with sensor/data/ beside it) as a `Source`."""

import re
from collections.abc import Iterator, Mapping
from decimal import Decimal
from functools import partial
from pathlib import Path

import numpy as np

from calibkit.data.observations import ImageFrame, Lost
from calibkit.data.progress import Progress
from calibkit.errors import BadInputError, one_line
from calibkit.io import images
from calibkit.io.source import Look, Source, Stamps, TopicInfo, seconds_text

_MAX_FILE = 2**30  # bytes of one image
_NUMBER = re.compile(r"[0-9]{1,20}(\.[0-9]{1,9})?")
# A number is a time since 1970 in the unit that its size allows; smaller ones are counters (up to 1e8 s: March 1973).
_UNITS = ((10**17, 1), (10**14, 10**3), (10**11, 10**6), (10**8, 10**9))
_END_OF_TIME = 2**62  # ns, in 2116: what lies beyond is no time, but a date such as 20230131120000, say

NO_STAMPS = "file names are no stamps"


def is_image(path: Path) -> bool:
    """Tell by its name whether a file is an image that can be read."""
    return path.suffix.lower() in images.SUFFIXES and not path.name.startswith(".") and path.is_file()


def stamp_ns(text: str) -> int | None:
    """Return the time in ns that a number of s, ms, us or ns since 1970 means; None where it is none."""
    if not _NUMBER.fullmatch(text):
        return None
    value = Decimal(text)
    t_ns = next((int(value * unit) for least, unit in _UNITS if value >= least), None)
    return t_ns if t_ns is not None and t_ns < _END_OF_TIME else None


def image_folder(folder: Path, name: str) -> Source:
    """Return the images of a folder in natural order, with stamps where every file name is one."""
    from natsort import natsorted  # slow to import

    files = natsorted((path for path in folder.iterdir() if is_image(path)), key=lambda path: path.name)
    stamps = [stamp_ns(path.stem) for path in files]
    source = Source(name, files)
    if None in stamps or len(set(stamps)) < len(stamps):
        source.warn(f"{name}: {NO_STAMPS} (s, ms, us or ns since 1970): all images have time 0")
        frames = [(0, path) for path in files]
    else:
        frames = sorted((t, path) for t, path in zip(stamps, files, strict=True) if t is not None)
    _add_images(source, name, "image folder", frames)
    return source


def asl_camera(folder: Path, name: str) -> Source:
    """Return an ASL camera folder: data.csv with `timestamp [ns],filename`, images in data/."""
    table = folder / "data.csv"
    source = Source(name, [table])
    frames: list[tuple[int, Path]] = []
    missing = bad = 0
    with table.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.startswith("#") or not line.strip():
                continue
            stamp, _, file = (part.strip() for part in line.partition(","))
            path = folder / "data" / Path(file).name  # only the name: the table may not point elsewhere
            is_stamp = stamp.isascii() and stamp.isdigit() and len(stamp) <= 19 and int(stamp) < _END_OF_TIME
            if not is_stamp or path.suffix.lower() not in images.SUFFIXES:
                bad += 1
            elif not path.is_file():
                missing += 1
            else:
                frames.append((int(stamp), path))
    if bad:
        source.warn(f"{name}: {bad} rows of data.csv are not `timestamp [ns],filename` and are left out")
    if missing:
        source.warn(Lost(f"{name}: {missing} images of data.csv are missing in data/"))
    source.files += [path for _, path in frames]
    _add_images(source, name, "ASL camera", frames)
    return source


def is_asl_camera(folder: Path) -> bool:
    """Tell whether a folder is an ASL camera's."""
    return (folder / "data.csv").is_file() and (folder / "data").is_dir()


def _add_images(source: Source, topic: str, kind: str, frames: list[tuple[int, Path]]) -> None:
    times = np.array([t for t, _ in frames], np.int64)
    source.topics.append(TopicInfo(topic, kind, "image", len(frames)))
    source.images[topic] = partial(_frames, source.name, frames)

    def survey(progress: Progress, looks: Mapping[str, Look]) -> dict[str, Stamps]:
        if look := looks.get(topic):
            chosen = frames[:: look.every]
            for frame in progress(_frames(source.name, chosen), f"images of {topic}", len(chosen)):
                look.show(frame)
        return {topic: Stamps(None, times)}

    source.survey = survey


def _frames(name: str, frames: list[tuple[int, Path]]) -> Iterator[ImageFrame]:
    for t_ns, path in frames:
        where = f"{one_line(name)}/{one_line(path.name, 120)}"
        if path.stat().st_size > _MAX_FILE:
            raise BadInputError(f"{where} is larger than {_MAX_FILE} bytes: give images of a camera")
        payload = path.read_bytes()
        label = one_line(path.name, 120) if t_ns == 0 else seconds_text(t_ns)
        yield ImageFrame(t_ns, label, payload, partial(images.decode_compressed, payload, where))
