"""The conventions of pose files: which column is what, in which unit, and how a rotation is made of it.

| --pose-format | columns | unit | rotation |
|---|---|---|---|
| ros | x y z qx qy qz qw | m | Hamilton quaternion |
| tum | t x y z qx qy qz qw | s, m | the same |
| matrix | 4x4 or its upper 3x4, row by row | m | |
| matrix-columns | 4x4, column by column | m | |
| rpy | x y z roll pitch yaw | m, rad | R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF |
| kuka-abc | X Y Z A B C | mm, deg | R = Rz(A) Ry(B) Rx(C) |
| fanuc-wpr | X Y Z W P R | mm, deg | R = Rz(R) Ry(P) Rx(W) |
| ur-rotvec | x y z and a rotation vector v | m, rad | R = exp(v) |
| abb-quat | x y z q1 q2 q3 q4 | mm | Hamilton quaternion, w first |

Every pose is T_parent_child, its columns the child's axes in the parent's frame: a robot's flange or TCP in its base.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibkit.errors import BadInputError, one_line
from calibkit.geometry import se3, so3
from calibkit.geometry.euler import from_zyx
from calibkit.io.pose_names import ABC, R9, ROTVEC, RPY, WPR, Array, PoseRows
from calibkit.io.text_table import XYZ, Q

LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
_NO_ROTATION = 0.02  # a quaternion's length, or R^T R, further from 1: two digits give 0.01
_REACH = 50.0  # m: no robot's
_AT_BASE = 10.0  # mm: robots do not keep that near their base, but in m they do


@dataclass(frozen=True)
class PoseFormat:
    """One convention: its columns (constants as "0" and "1"; 16 or 12 for matrices) and the units meant where none is stated."""

    layouts: tuple[tuple[str, ...], ...]
    length: str = "m"
    angle: str = ""

    @property
    def says(self) -> str:
        """The columns and units, for people."""
        return f"{' '.join(self.layouts[0])} in {', '.join(filter(None, (self.length, self.angle)))}"


_ROWS = (*R9[:3], "x", *R9[3:6], "y", *R9[6:], "z")
_COLUMNS = (*R9[0::3], "0", *R9[1::3], "0", *R9[2::3], "0", *XYZ, "1")
FORMATS = {
    "ros": PoseFormat(((*XYZ, *Q),)),
    "tum": PoseFormat((("t", *XYZ, *Q),)),
    "matrix": PoseFormat(((*_ROWS, "0", "0", "0", "1"), _ROWS)),
    "matrix-columns": PoseFormat((_COLUMNS,)),
    "rpy": PoseFormat(((*XYZ, *RPY),), "m", "rad"),
    "kuka-abc": PoseFormat(((*XYZ, *ABC),), "mm", "deg"),
    "fanuc-wpr": PoseFormat(((*XYZ, *WPR),), "mm", "deg"),
    "ur-rotvec": PoseFormat(((*XYZ, *ROTVEC),), "m", "rad"),
    "abb-quat": PoseFormat(((*XYZ, "qw", "qx", "qy", "qz"),), "mm"),
}


@dataclass(frozen=True)
class _Rotation:
    """How columns become R (n, 3, 3); those of angles are in rad by then."""

    names: tuple[str, ...]
    make: Callable[[Array], Array]
    angles: bool = False


_ROTATIONS = (
    _Rotation(Q, so3.from_quat),
    _Rotation(R9, lambda values: so3.project(values.reshape(-1, 3, 3))),
    _Rotation(ABC, from_zyx, True),
    _Rotation(WPR[::-1], from_zyx, True),
    _Rotation(RPY[::-1], from_zyx, True),
    _Rotation(ROTVEC, so3.exp, True),
)


def fault(rows: PoseRows) -> tuple[int, str] | None:
    """Return the first row of named columns whose rotation is none, and why; None where all are rotations."""
    bad: list[tuple[int, str]] = []
    for name, values in zip(rows.columns or (), rows.numbers.T, strict=True):
        if name in ("0", "1") and (wrong := np.flatnonzero(np.abs(values - int(name)) > 1e-6)).size:
            what = f"{values[wrong[0]]:g} stands where a matrix has {name}"
            bad.append((int(wrong[0]), f"{what}: 16 numbers must end with the row 0 0 0 1 (matrix), or each column (matrix-columns)"))
    held = set(rows.columns or ())
    if held >= set(Q):
        norm = np.linalg.norm(rows.take(*Q), axis=1)
        if (wrong := np.flatnonzero(~(np.abs(norm - 1) < _NO_ROTATION))).size:
            what = f"the quaternion {_shown(rows.take(*Q)[wrong[0]])} (x y z w) has length {norm[wrong[0]]:.4g}, not 1"
            bad.append((int(wrong[0]), f"{what}: check the order of the columns, or leave this pose out"))
    if held >= set(R9):
        R = rows.take(*R9).reshape(-1, 3, 3)
        off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
        if (wrong := np.flatnonzero(~(off < _NO_ROTATION))).size:
            what = f"its 3 x 3 part is no rotation (R^T R is {off[wrong[0]]:.2g} off the identity)"
            bad.append((int(wrong[0]), f"{what}: check the order of the numbers, or leave this pose out"))
        elif (wrong := np.flatnonzero(np.linalg.det(R) < 0)).size:
            what = "its 3 x 3 part has determinant -1, a mirror and no rotation"
            bad.append((int(wrong[0]), f"{what}: write it with right-handed axes"))
    return min(bad, default=None)


def _shown(values: Array) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def to_poses(rows: PoseRows, format_name: str, length_unit: str | None, angle_unit: str | None) -> Array:
    """Return T (n, 4, 4) in m of named columns; BadInputError where one is none or the unit cannot be as meant."""
    if found := fault(rows):
        raise rows.error(*found)
    held, form = set(rows.columns or ()), FORMATS[format_name]
    rotation = next(rotation for rotation in _ROTATIONS if held >= set(rotation.names))
    unit, sure = _unit(rows, XYZ, length_unit, "--pose-unit", LENGTHS, form.length)
    p = rows.take(*XYZ)
    if not sure:
        _check_length(rows, p, unit)
    values = rows.take(*rotation.names)
    if rotation.angles:
        angle, sure = _unit(rows, rotation.names, angle_unit, "--angle-unit", ANGLES, form.angle)
        _check_angles(rows, values, angle, sure)
        values = values * ANGLES[angle]
    return se3.make(rotation.make(values), p * LENGTHS[unit])


def _unit(rows: PoseRows, names: tuple[str, ...], option: str | None, flag: str, known: dict[str, float], meant: str) -> tuple[str, bool]:
    """Return the unit of columns by option or header, else the one that the format means, and whether it was stated."""
    if option is not None and option not in known:
        raise BadInputError(f"{flag} {one_line(option, 40)}: is no known unit; use one of {', '.join(known)}")
    stated = sorted({rows.units[name] for name in names if rows.units.get(name)})
    if len(stated) > 1 or (stated and stated[0] not in known):
        units = ", ".join(one_line(unit, 20) for unit in stated)
        raise BadInputError(
            f"{one_line(rows.path)}: the columns {', '.join(names)} are in [{units}]: use one of {', '.join(known)} for all"
        )
    if stated and option and stated[0] != option:
        raise BadInputError(
            f"{one_line(rows.path)}: says that {', '.join(names)} are in {stated[0]}, and {flag} says {option}: leave it out"
        )
    return option or (stated[0] if stated else meant), bool(option or stated)


def _check_length(rows: PoseRows, p: Array, unit: str) -> None:
    """Refuse positions that cannot be in the unit that is only meant."""
    distance = np.linalg.norm(p, axis=1)
    far = int(np.argmax(distance))
    if distance[far] * LENGTHS[unit] > _REACH:
        guess = "looks like mm: add --pose-unit mm (--pose-unit m if it is m)" if unit == "m" else f"add --pose-unit {unit} if it is so"
        raise rows.error(far, f"its position is {distance[far]:.4g} {unit} away, which {guess}")
    if unit == "mm" and 0 < distance[far] < _AT_BASE:
        raise rows.error(
            far, f"no position is further away than {distance[far]:.4g} mm: looks like m: add --pose-unit m (or mm if it is mm)"
        )


def _check_angles(rows: PoseRows, values: Array, unit: str, sure: bool) -> None:
    """Refuse angles beyond a turn, and those within half a radian's turn that are only meant to be degrees."""
    largest = np.abs(values).max(axis=1)
    row = int(np.argmax(largest))
    if largest[row] * ANGLES[unit] > 2 * np.pi + 1e-6:
        guess = "looks like degrees: add --angle-unit deg" if unit == "rad" and not sure else "check the order of the columns and the unit"
        raise rows.error(row, f"an angle is {largest[row]:.4g} {unit}, more than a turn: {guess}")
    if unit == "deg" and not sure and 0 < largest[row] <= np.pi:
        raise rows.error(
            row, f"no angle is larger than {largest[row]:.4g} deg: looks like radians: add --angle-unit rad (or deg if it is deg)"
        )
