"""What the parts of a pose are called in headers and keys, and the record of a pose file whose convention is not yet known."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.errors import BadInputError, one_line
from calibkit.io.text_table import CANONICAL, XYZ, Q

Array = NDArray[np.float64]
R9 = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))  # by rows
ABC, WPR, RPY, ROTVEC = ("a", "b", "c"), ("w", "p", "r"), ("roll", "pitch", "yaw"), ("rotvec_x", "rotvec_y", "rotvec_z")
RXYZ = ("rx", "ry", "rz")  # a rotation vector with some, angles with others
ROTATIONS = (Q, R9, ABC, WPR, RPY, ROTVEC, RXYZ)
LABELS = ("image", "img", "image_name", "image_file", "image_path", "file", "filename", "file_name", "name", "id", "index", "frame")
POSITIONS = ("position", "translation", "pos", "trans", "xyz", "p", "t")
QUATERNIONS = ("quaternion", "quat", "q", "orientation", "rotation")
_NAMES = {
    **{name: key for name, key in CANONICAL.items() if key in ("t", *XYZ, *Q)},
    **{f"{word}_{axis}": axis for word in POSITIONS for axis in XYZ},
    **{f"{word}{name}": name for word in ("", "orientation_", "rotation_", "rpy_") for names in (ABC, WPR, RPY, RXYZ) for name in names},
    **{f"{word}_{axis}": f"q{axis}" for word in QUATERNIONS for axis in "xyzw"},  # after WPR: rotation_w is a quaternion's
    **{f"{word}_{axis}": f"rotvec_{axis}" for word in ("rotvec", "rvec") for axis in XYZ},
    **{name: name for name in R9},
    **dict.fromkeys(LABELS, "label"),
}
_AROUND = re.compile(r"^(pose_|transform_)+")
_UNIT = re.compile(r"(?P<name>.*?)(\s*[\[(](?P<bracket>.*)[\])]|_(?P<suffix>mm|cm|m|deg|rad|ns|us|ms|s|sec))?")
_MAX_TITLE = 100  # characters
_LARGEST = 1e12  # of any number in a pose


def name_of(title: str) -> tuple[str | None, str]:
    """Return the canonical name of a header's title or a key (t, x, qx, a, rx, r11, label, ...; None: unknown), and its unit or ""."""
    plain = title.strip(" \"'").lower()[:_MAX_TITLE]
    if not re.search(r"[\[(]", plain):  # m/s is a unit, position.x a name
        plain = re.sub(r"[./\s]+", "_", plain)
    parts = _UNIT.fullmatch(plain)
    if parts is None:  # a line break in a key
        return None, ""
    for name, unit in ((plain, ""), (parts["name"], parts["bracket"] or parts["suffix"] or "")):
        if known := _NAMES.get(_AROUND.sub("", name.strip())):
            return known, unit.strip()
    return None, ""


@dataclass(frozen=True)
class PoseRows:
    """The numbers of a pose file, one row a pose, and what the file says about their meaning."""

    path: Path
    numbers: Array  # (n, k) finite
    places: tuple[str, ...]  # (n,) where each pose begins: "line 3"
    firsts: tuple[str, ...]  # (n,) the first number of each as written, for times
    columns: tuple[str, ...] | None = None  # (k,) canonical names, where the file gives them
    units: Mapping[str, str] = field(default_factory=dict)  # of columns, "t" too, where the file gives them
    labels: tuple[str, ...] | None = None  # (n,) image names
    stamps: tuple[str, ...] | None = None  # (n,) times as written

    def __post_init__(self) -> None:
        bad = ~(np.abs(self.numbers) <= _LARGEST)
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise self.error(row, f"{self.numbers[row, column]:g} is no part of a pose: leave this pose out, or mend it")

    def error(self, row: int, text: str) -> BadInputError:
        """Return the error that says `text` about a row."""
        return BadInputError(f"{one_line(self.path)}, {self.places[row]}: {text}")

    def take(self, *names: str) -> Array:
        """Return the named columns (n, m)."""
        assert self.columns is not None
        return self.numbers[:, [self.columns.index(name) for name in names]]
