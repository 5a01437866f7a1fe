"""A ROS 2 bag's folder: metadata.yaml says which files, the files say what is in them.

rosbags' folder reader matches topics of metadata.yaml and data files by their QoS too, and yields nothing where they differ;
here the data files are read, and a claim of metadata.yaml that they do not meet is told.
"""

import shutil
import tempfile
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

from calibkit.data.observations import Lost
from calibkit.errors import BadInputError, one_line
from calibkit.io.container import Container
from calibkit.io.db3 import Db3File
from calibkit.io.mcap import McapFile
from calibkit.io.ros1_bag import Ros1Bag
from calibkit.io.unpack import zstd
from calibkit.io.yaml_file import load_yaml

BAG_FILES: dict[str, Callable[[Path], Container]] = {".bag": Ros1Bag, ".mcap": McapFile, ".db3": Db3File}
PACKED = (".zstd", ".zst")
METADATA = "metadata.yaml"
_MAX_METADATA = 2**24
_MAX_RATIO = 200  # of a packed file; rosbag2's own are below 20


def is_bag_file(path: Path) -> bool:
    """Tell by its name whether a file is a bag, packed or not."""
    return _kind(path) in BAG_FILES and path.is_file()


def _kind(path: Path) -> str:
    """Return .bag, .mcap or .db3 of a file that may be packed, or be a .bag.active that was never closed."""
    return (Path(path.stem) if path.suffix in (*PACKED, ".active") else path).suffix.lower()


def open_bag_file(path: Path) -> Container:
    """Open one .bag, .mcap or .db3; a packed one is unpacked to a temporary file that goes with the container."""
    if path.suffix not in PACKED:
        return BAG_FILES[_kind(path)](path)
    folder = Path(tempfile.mkdtemp(prefix="calibkit-"))
    try:
        unpacked = folder / path.stem
        _unpack_file(path, unpacked)
        container = BAG_FILES[_kind(path)](unpacked)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    weakref.finalize(container, shutil.rmtree, folder, ignore_errors=True)
    return container


def _unpack_file(path: Path, out: Path) -> None:
    limit = min(_MAX_RATIO * path.stat().st_size, shutil.disk_usage(out.parent).free - 2**28)
    written = 0
    try:
        with path.open("rb") as packed, zstd.open(packed, "rb") as source, out.open("wb") as target:
            while block := source.read(2**20):
                written += len(block)
                if written > limit:
                    raise BadInputError(f"{path.name} unpacks to more than {limit} bytes: unpack it yourself (zstd -d) where there is room")
                target.write(block)
    except (zstd.ZstdError, EOFError) as error:
        if written == 0:
            raise BadInputError(f"{path.name} is no readable zstd file ({one_line(error)}): unpack it yourself (zstd -d)") from error


def open_folder(folder: Path) -> tuple[list[Path], list[Container], str | None, list[str]]:
    """Return data files, containers, ROS distribution (where stated) and warnings of a ROS 2 bag's folder."""
    warnings: list[str] = []
    metadata = _metadata(folder / METADATA, warnings)
    names = metadata.get("relative_file_paths")
    listed = [folder / Path(name).name for name in names if isinstance(name, str)] if isinstance(names, list) else []
    files = [path for path in listed if is_bag_file(path)]
    if missing := [path.name for path in listed if path not in files]:
        warnings.append(Lost(f"{folder.name}: {len(missing)} files of {METADATA} are missing: {one_line(', '.join(missing), 120)}"))
    files = files or sorted(path for path in folder.iterdir() if is_bag_file(path))
    containers, refused = [], []
    for path in files:
        try:
            containers.append(open_bag_file(path))
        except BadInputError as error:
            refused.append(str(error))
    if not containers:
        raise BadInputError(f"{folder.name} holds no readable bag file: {refused[0] if refused else 'no .mcap, .db3 or .bag in it'}")
    warnings += map(Lost, refused)
    held = sum(sum(container.counts.values()) for container in containers)
    claimed = metadata.get("message_count")
    if isinstance(claimed, int) and claimed != held:
        warnings.append(Lost(f"{folder.name}: {METADATA} claims {claimed} messages, the data files hold {held}"))
    stated = [metadata.get("ros_distro"), *(c.distro for c in containers if isinstance(c, Db3File))]
    distro = next((name for name in stated if name and isinstance(name, str)), None)
    return files, containers, one_line(distro, 40) if distro else None, warnings


def _metadata(path: Path, warnings: list[str]) -> dict[str, Any]:
    """Return rosbag2_bagfile_information, or nothing where it cannot be read: the data files stand by themselves."""
    if not path.exists():
        if not any(_kind(file) in (".mcap", ".db3") for file in path.parent.iterdir()):
            return {}  # ROS 1 has none
        warnings.append(f"{path.parent.name}: no {METADATA}; the data files in the folder are read")
        return {}
    try:
        data = load_yaml(path, _MAX_METADATA).data
    except BadInputError as error:
        warnings.append(f"{path.parent.name}/{METADATA} is not readable ({one_line(error, 200)}); the data files in the folder are read")
        return {}
    found = data.get("rosbag2_bagfile_information") if isinstance(data, dict) else None
    if not isinstance(found, dict):
        warnings.append(f"{path.parent.name}/{METADATA} holds no rosbag2_bagfile_information; the data files in the folder are read")
        return {}
    return found
