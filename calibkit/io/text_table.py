"""Text files of rows of numbers, plain or gzipped: columns by their canonical names, read in blocks and in bounded memory."""

import gzip
import re
import zlib
from collections.abc import Callable, Iterator, Mapping
from decimal import Decimal
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.data.progress import Progress, silent
from calibkit.errors import BadInputError, one_line
from calibkit.io.folder import stamp_ns
from calibkit.io.imu_options import ACCEL_UNITS, COUNTS, GYRO_UNITS
from calibkit.io.rows import Rows

Array = NDArray[np.float64]
Times = NDArray[np.int64]
SUFFIXES = (".csv", ".txt", ".tum", ".mat")  # .mat: text under the name of Matlab's, which is binary and refused
_MAX_FILE = 2**31  # bytes, unpacked
_BLOCK = 2**22  # bytes read at once
_MAX_ROWS = 30_000_000  # 41 h at 200 Hz, 2 GB as arrays
_MAX_LINE = 2**16  # bytes
_MAX_HEADER = 1000  # lines
_MAX_DIGITS = 20  # of a time before its point

GYRO, ACCEL, XYZ, Q = ("wx", "wy", "wz"), ("ax", "ay", "az"), ("x", "y", "z"), ("qx", "qy", "qz", "qw")
# What columns are called, without their units: EuRoC/ASL, TUM, and the short names of everyday files.
_NAMES = {
    "t": ("t", "ts", "time", "timestamp", "stamp", "#timestamp", "#ts", "#time", "#t"),
    "wx": ("wx", "gx", "w_x", "w_rs_s_x", "gyro_x", "omega_x", "angular_velocity_x"),
    "wy": ("wy", "gy", "w_y", "w_rs_s_y", "gyro_y", "omega_y", "angular_velocity_y"),
    "wz": ("wz", "gz", "w_z", "w_rs_s_z", "gyro_z", "omega_z", "angular_velocity_z", "angular_z", "yaw_rate", "yawrate"),
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
    "rate": ("rate", "table_rate"),
    "run": ("run",),
    "temperature": ("temperature", "temp", "celsius", "t_c"),
    "nx": ("nx", "axis_x"),
    "ny": ("ny", "axis_y"),
    "nz": ("nz", "axis_z"),
}
CANONICAL = {name: key for key, names in _NAMES.items() for name in names}
# Units as headers write them, lower case; of none SI is meant, and a time's is guessed from its size.
_TIME_UNITS = {"": 0, "ns": 1, "us": 10**3, "µs": 10**3, "ms": 10**6, "s": 10**9, "sec": 10**9}
_LENGTH_UNITS = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
_UNITS: dict[str, Mapping[str, float]] = {
    "t": _TIME_UNITS,
    **dict.fromkeys(GYRO, GYRO_UNITS),
    **dict.fromkeys(ACCEL, ACCEL_UNITS),
    **dict.fromkeys(XYZ, _LENGTH_UNITS),
    "rate": {unit: scale for unit, scale in GYRO_UNITS.items() if unit not in COUNTS},
}
# Columns of files without a header: TUM poses, an IMU as EuRoC has it, the same without times, three axes with and without times.
_SHAPES = {8: ["t", *XYZ, *Q], 7: ["t", *GYRO, *ACCEL], 6: [*GYRO, *ACCEL], 4: ["t", *XYZ], 3: [*XYZ]}
WANTED = (
    "wanted are columns t,wx,wy,wz,ax,ay,az (IMU), t,x,y,z,qx,qy,qz,qw (poses), t,yaw_rate (odometer) or timestamp,tag_id,corner_idx,u,v "
    "(corners), "
    "named so in a header, the first two also without one"
)


def is_table(path: Path) -> bool:
    """Tell by its name whether a file is such a table."""
    return path.with_suffix("").suffix.lower() in SUFFIXES if path.suffix.lower() == ".gz" else path.suffix.lower() in SUFFIXES


def stem(name: str) -> str:
    """Return a table's name without its .csv or .csv.gz."""
    return (name[:-3] if name.lower().endswith(".gz") else name).rsplit(".", 1)[0]


class TextTable:
    """One file, its header read: `columns` is where each is by its canonical name, `units` what the header says of it."""

    def __init__(self, path: Path, name: str, warn: Callable[[str], None]) -> None:
        self.path, self.name, self._warn = path, name, warn
        self.columns: dict[str, int] = {}
        self.units: dict[str, str] = {}
        if path.stat().st_size > _MAX_FILE:
            raise self._too_large()
        header, row = self._find_data()
        self._delimiter = next((mark for mark in ",;" if mark in row), None)
        self._width = len(row.split(self._delimiter))
        titles = [line.lstrip("# ").lower().split(self._delimiter) for line in header]
        named = next((row for row in reversed(titles) if len(row) == self._width), None)
        if named is None:  # a header that does not fit the rows names other columns: their number alone tells nothing then
            odd = self._delimiter and any(len(row) > self._width for row in titles)
            named = [] if odd else _SHAPES.get(self._width, [])
        for column, title in enumerate(named):
            title, _, unit = title.partition("[")
            if key := CANONICAL.get(title.strip(' "')):
                self.columns[key], self.units[key] = column, unit.strip(' ]"')

    @cached_property
    def count(self) -> int:
        """How many rows the file has."""
        return sum(map(len, self._blocks()))

    def holds(self, *names: str) -> bool:
        """Tell whether all these columns are there."""
        return set(names) <= self.columns.keys()

    def rename(self, old: tuple[str, ...], new: tuple[str, ...]) -> None:
        """Give columns other names, and so other units."""
        for a, b in zip(old, new, strict=True):
            self.columns[b], self.units[b] = self.columns.pop(a), self.units.pop(a)

    def scale(self, name: str) -> float:
        """Return what the unit of a column is worth in ns or SI; BadInputError where it is none that is known."""
        known, stated = _UNITS.get(name), self.units[name]
        if known is None:
            return 1.0
        if stated not in known:
            choice = ", ".join(filter(None, known))
            raise BadInputError(f"{self.name}: the unit [{one_line(stated, 40)}] of column {name} is not known: use one of {choice}")
        return known[stated]

    def times(self) -> Times:
        """Return the time column in ns, exactly."""
        return self.read()[0]

    def read(self, *names: str, with_times: bool = True, progress: Progress = silent) -> tuple[Times, Array]:
        """Return times in ns (n,), empty where they are not asked for, and the named columns (n, k) in SI, in one pass."""
        t_ns, values = Rows((), np.int64), Rows((len(names),), np.float64)
        scales, rows = np.array([self.scale(name) for name in names]), 0
        for lines in progress(self._blocks(), f"reading {self.name}"):
            if with_times:
                t_ns.add(self._times(lines))
            if names:
                values.add(self._numbers(lines, names) * scales)
            rows += len(lines)
            if rows > _MAX_ROWS:
                raise BadInputError(f"{self.name} has more than {_MAX_ROWS} rows: split it, or record a bag")
        return t_ns.take(), values.take()

    def _numbers(self, lines: list[str], names: tuple[str, ...]) -> Array:
        columns = [self.columns[name] for name in names]
        try:
            return np.loadtxt(lines, np.float64, comments=None, delimiter=self._delimiter, usecols=columns, ndmin=2)
        except ValueError as error:
            raise BadInputError(
                f"{self.name}: columns {', '.join(names)} must hold numbers ({one_line(str(error).split(' at row')[0], 100)})"
            ) from error

    def _times(self, lines: list[str]) -> Times:
        column = self.columns["t"]
        texts = [line.split(self._delimiter, column + 1)[column].strip() for line in lines]
        try:
            return times_ns(texts, self._time_unit)
        except (ArithmeticError, ValueError) as error:
            raise BadInputError(f"{self.name}: its time column must hold numbers of ns, us, ms or s ({one_line(error, 80)})") from error

    @cached_property
    def _time_unit(self) -> int:
        """The time column's unit in ns: the header's, else what the first value's size means."""
        first = next(self._blocks())[0].split(self._delimiter)[self.columns["t"]].strip()
        return int(self.scale("t")) or time_unit(first)

    def _find_data(self) -> tuple[list[str], str]:
        """Return the lines before the first row, and that row."""
        header: list[str] = []
        for line in (line for lines in self._lines() for line in lines):
            if "\0" in line:
                raise BadInputError(f"{self.name} holds no rows of numbers (it is binary, not text): {WANTED}")
            if _is_row(line):
                return header, line
            header.append(line)
            if len(header) > _MAX_HEADER:
                break
        raise BadInputError(f"{self.name} holds no rows of numbers: {WANTED}")

    def _blocks(self) -> Iterator[list[str]]:
        """Yield the rows, block by block; those of another width are left out and told."""
        lost, skipping = 0, True
        for lines in self._lines():
            if skipping:
                start = next((i for i, line in enumerate(lines) if _is_row(line)), len(lines))
                lines, skipping = lines[start:], start == len(lines)
            if self._delimiter is None:
                rows = [line for line in lines if len(line.split()) == self._width]
            else:
                rows = [line for line in lines if line.count(self._delimiter) == self._width - 1]
            lost += len(lines) - len(rows)
            if rows:
                yield rows
        if lost:
            self._warn(f"{self.name}: {lost} lines have not {self._width} columns and are left out")

    def _lines(self) -> Iterator[list[str]]:
        """Yield the lines that are not blank, some thousand at a time; the file's size is bounded while it is unpacked."""
        total, rest = 0, b""
        with gzip.open(self.path, "rb") if self.path.suffix.lower() == ".gz" else self.path.open("rb") as file:
            while True:
                try:
                    block = file.read(_BLOCK)
                except (EOFError, gzip.BadGzipFile, zlib.error) as error:
                    raise BadInputError(
                        f"{self.name} is damaged ({one_line(error, 80)}): unpack it with gzip -d, or copy it again"
                    ) from error
                total += len(block)
                if total > _MAX_FILE:
                    raise self._too_large()
                whole, found, rest = (rest + block).rpartition(b"\n") if block else (rest, b"", b"")
                if len(rest) > _MAX_LINE:
                    raise BadInputError(f"{self.name} holds no rows of numbers (a line is longer than {_MAX_LINE} bytes): {WANTED}")
                text = (whole + found).decode("utf-8", errors="replace").lstrip("\ufeff")
                lines = [line for line in map(str.strip, text.splitlines()) if line]
                if lines:
                    yield lines
                if not block:
                    return

    def _too_large(self) -> BadInputError:
        return BadInputError(f"{self.name} is larger than {_MAX_FILE} bytes: split it, or record a bag")


def time_unit(first: str) -> int:
    """Return the unit in ns that the size of a stream's first time means (s, ms, us or ns since 1970), else s."""
    t_ns = stamp_ns(first)
    return round(t_ns / Decimal(first)) if t_ns else 10**9


def times_ns(texts: list[str], unit: int) -> Times:
    """Return times of a unit (in ns) in whole ns, exactly; ArithmeticError or ValueError where one is none."""
    if unit == 1 and all(map(str.isdecimal, texts)):  # the same, and faster
        return np.array(list(map(int, texts)), np.int64)
    return np.array([_whole(Decimal(text), unit) for text in texts], np.int64)


def _whole(value: Decimal, unit: int) -> int:
    """Return value * unit without its fraction; an exponent beyond any time is refused before its digits fill the memory."""
    if value.adjusted() >= _MAX_DIGITS:
        raise OverflowError("a number too large for a time")
    return int(value * unit)


def _is_row(line: str) -> bool:
    """Tell whether a line begins with a number."""
    try:
        float(re.split(r"[,;\s]", line, maxsplit=1)[0])
    except ValueError:
        return False
    return True
