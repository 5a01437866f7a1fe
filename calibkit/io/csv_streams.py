"""IMU, pose and corner streams in CSV (or TUM's blank-separated) files, recognised by their header or their shape."""

import re
from collections.abc import Callable, Mapping
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples, PoseSamples
from calibkit.data.progress import Progress
from calibkit.errors import BadInputError, one_line
from calibkit.io.folder import stamp_ns
from calibkit.io.ros_bag import unit_poses
from calibkit.io.source import CornerRows, Look, Source, Stamps, TopicInfo
from calibkit.io.topic_pass import plausible

Array = NDArray[np.float64]
Times = NDArray[np.int64]
_MAX_FILE = 2**31
_MAX_DIGITS = 20  # of a time before its point
G = 9.80665  # m/s^2
# What columns are called, without their units: EuRoC/ASL, TUM, and the short names of everyday files.
_NAMES = {
    "t": ("t", "ts", "time", "timestamp", "stamp", "#timestamp", "#ts", "#time", "#t"),
    "wx": ("wx", "gx", "w_x", "w_rs_s_x", "gyro_x", "omega_x", "angular_velocity_x"),
    "wy": ("wy", "gy", "w_y", "w_rs_s_y", "gyro_y", "omega_y", "angular_velocity_y"),
    "wz": ("wz", "gz", "w_z", "w_rs_s_z", "gyro_z", "omega_z", "angular_velocity_z"),
    "ax": ("ax", "a_x", "a_rs_s_x", "accel_x", "acc_x", "linear_acceleration_x"),
    "ay": ("ay", "a_y", "a_rs_s_y", "accel_y", "acc_y", "linear_acceleration_y"),
    "az": ("az", "a_z", "a_rs_s_z", "accel_z", "acc_z", "linear_acceleration_z"),
    "x": ("x", "tx", "px", "p_x", "p_rs_r_x"),
    "y": ("y", "ty", "py", "p_y", "p_rs_r_y"),
    "z": ("z", "tz", "pz", "p_z", "p_rs_r_z"),
    "qx": ("qx", "q_x", "q_rs_x"),
    "qy": ("qy", "q_y", "q_rs_y"),
    "qz": ("qz", "q_z", "q_rs_z"),
    "qw": ("qw", "q_w", "q_rs_w"),
    "tag_id": ("tag_id",),
    "corner_idx": ("corner_idx",),
    "u": ("u",),
    "v": ("v",),
    "sigma_px": ("sigma_px", "sigma"),
}
_CANONICAL = {name: key for key, names in _NAMES.items() for name in names}
_GYRO, _ACCEL, _XYZ, _Q = ("wx", "wy", "wz"), ("ax", "ay", "az"), ("x", "y", "z"), ("qx", "qy", "qz", "qw")
# Units as headers write them, lower case; of none SI is meant, and a time's is guessed from its size.
_TIME_UNITS = {"": 0, "ns": 1, "us": 10**3, "µs": 10**3, "ms": 10**6, "s": 10**9, "sec": 10**9}
_GYRO_UNITS = {**dict.fromkeys(("", "rad/s", "rad s^-1"), 1.0), **dict.fromkeys(("deg/s", "deg s^-1", "dps"), np.pi / 180)}
_ACCEL_UNITS = {**dict.fromkeys(("", "m/s^2", "m s^-2", "m/s2", "m/s²", "m/s/s"), 1.0), "g": G, "mg": G / 1000}
_LENGTH_UNITS = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
_UNITS: dict[str, Mapping[str, float]] = {
    "t": _TIME_UNITS,
    **dict.fromkeys(_GYRO, _GYRO_UNITS),
    **dict.fromkeys(_ACCEL, _ACCEL_UNITS),
    **dict.fromkeys(_XYZ, _LENGTH_UNITS),
}


class _Table(NamedTuple):
    """The lines of one file, where its columns are by their canonical names, and their units where stated."""

    name: str
    lines: list[str]
    delimiter: str | None
    columns: dict[str, int]
    units: dict[str, str]

    def numbers(self, *names: str) -> Array:
        """Return the named columns (n, k)."""
        columns = [self.columns[name] for name in names]
        try:
            return np.loadtxt(self.lines, np.float64, comments=None, delimiter=self.delimiter, usecols=columns, ndmin=2).reshape(
                -1, len(names)
            )
        except ValueError as error:
            raise BadInputError(f"{self.name}: columns {', '.join(names)} must hold numbers ({one_line(error, 100)})") from error

    def times(self) -> Times:
        """Return the time column in ns, exactly; its unit is the header's, else what the first value's size means, else s."""
        texts = [line.split(self.delimiter)[self.columns["t"]].strip() for line in self.lines]
        try:
            first = stamp_ns(texts[0])
            unit = int(self.unit("t")) or (round(first / Decimal(texts[0])) if first else 10**9)
            if unit == 1 and all(map(str.isdecimal, texts)):  # the same, and faster
                return np.array(list(map(int, texts)), np.int64)
            return np.array([_whole(Decimal(text), unit) for text in texts], np.int64)
        except (ArithmeticError, ValueError) as error:
            raise BadInputError(f"{self.name}: its time column must hold numbers of ns, us, ms or s ({one_line(error, 80)})") from error

    def scaled(self, *names: str) -> Array:
        """Return the named columns (n, k) in SI."""
        return self.numbers(*names) * [self.unit(name) for name in names]

    def unit(self, name: str) -> float:
        """Return what the unit of a column is worth in ns or SI; BadInputError where it is none that is known."""
        stated, known = self.units[name], _UNITS[name]
        if stated not in known:
            choice = ", ".join(filter(None, known))
            raise BadInputError(f"{self.name}: the unit [{one_line(stated, 40)}] of column {name} is not known: use one of {choice}")
        return known[stated]


def _whole(value: Decimal, unit: int) -> int:
    """Return value * unit without its fraction; an exponent beyond any time is refused before its digits fill the memory."""
    if value.adjusted() >= _MAX_DIGITS:
        raise OverflowError("a number too large for a time")
    return int(value * unit)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _table(path: Path, name: str, warn: Callable[[str], None]) -> _Table:
    if path.stat().st_size > _MAX_FILE:
        raise BadInputError(f"{name} is larger than {_MAX_FILE} bytes: split it, or record a bag")
    lines = [line for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines() if line.strip()]
    data = next((row for row, line in enumerate(lines) if _is_number(re.split(r"[,;\s]", line.strip(), maxsplit=1)[0])), None)
    if data is None:
        raise BadInputError(f"{name} holds no rows of numbers: {_WANTED}")
    delimiter = next((mark for mark in ",;" if mark in lines[data]), None)
    width = len(lines[data].split(delimiter))
    body = [line for line in lines[data:] if len(line.split(delimiter)) == width]
    if len(body) < len(lines) - data:
        warn(f"{name}: {len(lines) - data - len(body)} lines have not {width} columns and are left out")
    header = [line.lstrip("# ").lower().split(delimiter) for line in lines[:data]]
    titles = next((row for row in reversed(header) if len(row) == width), None)
    if titles is None:  # a header that does not fit the rows names other columns: their number alone tells nothing then
        titles = [] if delimiter and any(len(row) > width for row in header) else _SHAPES.get(width, [])
    columns, units = {}, {}
    for column, title in enumerate(titles):
        title, _, unit = title.partition("[")
        if key := _CANONICAL.get(title.strip(' "')):
            columns[key], units[key] = column, unit.strip(' ]"')
    return _Table(name, body, delimiter, columns, units)


_SHAPES = {8: ["t", *_XYZ, *_Q], 7: ["t", *_GYRO, *_ACCEL]}  # of files without a header: TUM poses, and an IMU as EuRoC has it
_WANTED = (
    "wanted are columns t,wx,wy,wz,ax,ay,az (IMU), t,x,y,z,qx,qy,qz,qw (poses) or timestamp,tag_id,corner_idx,u,v (corners), "
    "named so in a header, the first two also without one"
)


def _imu(path: Path, name: str, warn: Callable[[str], None]) -> ImuSamples:
    table = _table(path, name, warn)
    t_ns = table.times()
    gyro, accel = table.scaled(*_GYRO), table.scaled(*_ACCEL)
    good = plausible(gyro) & plausible(accel)
    if not good.all():
        warn(f"{name}: {np.sum(~good)} samples are not finite and left out")
    return ImuSamples(t_ns[good], gyro[good], accel[good])


def _poses(path: Path, name: str, topic: str, warn: Callable[[str], None]) -> PoseSamples:
    table = _table(path, name, warn)
    samples, lost = unit_poses(table.times(), table.numbers(*_Q), table.scaled(*_XYZ), "world", topic)
    if lost:
        warn(f"{name}: {lost} poses have no proper rotation or are not finite, and are left out")
    return samples


def _corners(path: Path, name: str, warn: Callable[[str], None]) -> CornerRows:
    table = _table(path, name, warn)
    tag, index = table.numbers("tag_id", "corner_idx").T
    uv = table.numbers("u", "v")
    if not (np.all((tag >= 0) & (tag < 1e6) & (index >= 0) & (index < 4)) and np.isfinite(uv).all()):
        raise BadInputError(f"{name}: tag_id must be from 0, corner_idx from 0 to 3, u and v finite")
    xyz = table.scaled(*_XYZ) if set(_XYZ) <= table.columns.keys() else None
    sigma = table.numbers("sigma_px")[:, 0] if "sigma_px" in table.columns else None
    return CornerRows(name, table.times(), np.rint(4 * tag + index).astype(np.int64), uv, xyz, sigma)


# Corner files have x, y, z as well, so they are looked for first.
_KINDS = (
    ("corners", "corner CSV", {"t", "tag_id", "corner_idx", "u", "v"}),
    ("imu", "IMU CSV", {"t", *_GYRO, *_ACCEL}),
    ("pose", "pose CSV", {"t", *_XYZ, *_Q}),
)


def csv_source(path: Path, topic: str) -> Source:
    """Return the stream in a CSV file; BadInputError where it is none that is known."""
    name = one_line(path.name, 120)
    source = Source(name if path.stem == topic else f"{topic}/{name}", [path])
    table = _table(path, source.name, source.warn)
    found = next((entry for entry in _KINDS if entry[2] <= table.columns.keys()), None)
    if found is None:
        raise BadInputError(f"{source.name} is not recognised: {_WANTED}")
    kind, title, needed = found
    for column in sorted(needed & _UNITS.keys()):
        table.unit(column)  # refused now, so that a folder's other files are still read
    source.topics.append(TopicInfo(topic, title, kind, len(table.lines)))
    source.corners.update({topic: partial(_corners, path, source.name, source.warn)} if kind == "corners" else {})
    source.imu.update({topic: partial(_imu, path, source.name, source.warn)} if kind == "imu" else {})
    source.poses.update({topic: partial(_poses, path, source.name, topic, source.warn)} if kind == "pose" else {})

    def survey(progress: Progress, looks: Mapping[str, Look]) -> dict[str, Stamps]:
        t_ns = _table(path, source.name, source.warn).times()
        if kind == "corners":
            t_ns = t_ns[np.flatnonzero(np.diff(t_ns, prepend=t_ns[:1] - 1))]  # one stamp a frame, not one a corner
        return {topic: Stamps(None, t_ns, _imu(path, source.name, source.warn) if kind == "imu" else None)}

    source.survey = survey
    return source
