"""What a path given as SOURCE is: a bag, a folder of images, an ASL folder, a folder of several of these, or CSV."""

import os
from collections import Counter
from pathlib import Path

from calibkit.errors import BadInputError, one_line
from calibkit.io import ros_messages
from calibkit.io.csv_streams import csv_source
from calibkit.io.folder import asl_camera, image_folder, is_asl_camera, is_image
from calibkit.io.imu_options import ImuOptions
from calibkit.io.imu_text import pair_halves
from calibkit.io.ros2_folder import METADATA, is_bag_file, open_bag_file, open_folder
from calibkit.io.ros_bag import bag_source
from calibkit.io.source import Source
from calibkit.io.text_table import is_table, stem


def open_sources(paths: list[Path], distro: str | None, options: ImuOptions) -> list[Source]:
    """Open all paths; folders and CSV files of one name are told apart by the folders that they lie in."""
    names = _names([Path(path).absolute() for path in paths])
    sources = [
        source for path, name in zip(paths, names, strict=True) for source in _open(Path(path), one_line(name, 120), distro, options)
    ]
    if len(paths) > 1:
        _refuse_repeats(sources)
        _refuse_one_name([stem(name) for path, name in zip(paths, names, strict=True) if is_table(path)])
    return pair_halves(sources)


def _names(paths: list[Path]) -> list[str]:
    """Return the end of each path that is long enough to tell folders and tables apart: what a topic is called has no suffix."""
    ends = [[stem(path.name) if is_table(path) else path.name, *path.parts[-2::-1]] for path in paths]
    unclear = [end for path, end in zip(paths, ends, strict=True) if path.is_dir() or is_table(path)]
    names = []
    for path, end in zip(paths, ends, strict=True):
        apart = (depth for depth in range(1, len(path.parts)) if sum(other[:depth] == end[:depth] for other in unclear) < 2)
        names.append("/".join(path.parts[-next(apart, 1) :]))
    return names


def _refuse_one_name(names: list[str]) -> None:
    """The rows of two tables of one name would be taken for one stream's."""
    if repeated := next((name for name, n in Counter(names).items() if n > 1), None):
        raise BadInputError(f"two files would both be called {one_line(repeated, 120)}: rename one of them")


def _refuse_repeats(sources: list[Source]) -> None:
    """What is read twice would count twice, and every sigma come out too small."""
    seen: set[str] = set()
    for source in sources:
        files = {os.path.realpath(file) for file in source.files}
        if repeated := min(files & seen, default=None):
            raise BadInputError(f"{one_line(Path(repeated).name, 120)} is given twice: give each recording once")
        seen |= files


def _open(path: Path, name: str, distro: str | None, options: ImuOptions) -> list[Source]:
    try:
        if path.is_dir():
            return _open_folder(path, name, distro, options)
        if not path.is_file():
            what = "is no regular file" if path.exists() else "does not exist"
            raise BadInputError(f"{one_line(path)} {what}: give a recording (.bag, .mcap, .db3, a folder or CSV)")
        if is_bag_file(path):
            container = open_bag_file(path)
            return [bag_source(name, [path], [container], _distro(getattr(container, "distro", None), distro), [], options)]
        if is_table(path):
            return [csv_source(path, stem(name), options)]
    except OSError as error:
        raise BadInputError(f"{one_line(path)} cannot be read ({one_line(error.strerror)})") from error
    raise BadInputError(f"{name} is no recording that is known: give a .bag, .mcap, .db3, a folder of images, an ASL folder or CSV")


def _open_folder(path: Path, name: str, distro: str | None, options: ImuOptions) -> list[Source]:
    entries = sorted(path.iterdir())
    if (path / METADATA).is_file() or any(is_bag_file(entry) for entry in entries):
        files, containers, stated, warnings = open_folder(path)
        return [bag_source(name, files, containers, _distro(stated, distro), warnings, options)]
    if is_asl_camera(path):
        return [asl_camera(path, name)]
    if (path / "mav0").is_dir():
        entries = sorted((path / "mav0").iterdir())
    found = [image_folder(path, name)] if any(map(is_image, entries)) else []
    refused = []
    for entry in entries:
        try:
            found += _open_entry(entry, name, options)
        except BadInputError as error:
            refused.append(str(error))
    if not found:
        reason = refused[0] if refused else "no images, no bag files, no CSV, no cam0/ or imu0/ with data.csv"
        raise BadInputError(f"{name} holds nothing that can be read: {reason}")
    for text in refused:
        found[0].warn(text)
    return found


def _open_entry(entry: Path, name: str, options: ImuOptions) -> list[Source]:
    """Open what lies in a folder of several streams: a sensor's folder of ASL, a folder of images, CSV; nothing else."""
    topic = one_line(stem(entry.name), 120)
    table = entry / "data.csv" if entry.is_dir() else entry
    if entry.is_dir() and is_asl_camera(entry):
        return [asl_camera(entry, topic)]
    if entry.is_dir() and any(map(is_image, entry.iterdir())):
        return [image_folder(entry, f"{name}/{topic}")]
    return [csv_source(table, topic, options)] if is_table(table) and table.is_file() else []


def _distro(stated: str | None, asked: str | None) -> str | None:
    return stated if stated and ros_messages.known_distro(stated) else asked
