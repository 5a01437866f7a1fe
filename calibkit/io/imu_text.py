"""IMUs in text files: with or without times, in units or raw counts, both sensors in one file or each in its own."""

from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples, ImuUnit
from calibkit.data.plural import counted
from calibkit.data.progress import Progress, silent
from calibkit.errors import BadInputError
from calibkit.io.imu_options import ImuOptions, unit_of
from calibkit.io.source import Look, Source, Stamps, TopicInfo
from calibkit.io.text_table import ACCEL, GYRO, XYZ, Q, TextTable
from calibkit.io.topic_pass import plausible

Array = NDArray[np.float64]
_ENOUGH = 100  # samples that are all whole numbers: below, chance
_HALVES = {"gyro": GYRO, "accel": ACCEL}


def find_imu(table: TextTable, options: ImuOptions) -> str | None:
    """Return which sensors a table holds ("both", "gyro", "accel"; None: it is no IMU's), its columns named and all that is stated checked.

    Three axes without a name of their own are told apart by acc or gyr in the file's name.
    """
    if table.holds(*XYZ) and not table.holds(*GYRO) and not table.holds(*ACCEL) and not any(q in table.columns for q in ("tag_id", *Q)):
        named = [half for half in _HALVES if half[:3] in table.name.lower()]
        if len(named) != 1:
            raise BadInputError(
                f"{table.name} is not recognised: three axes, but of what? give it a header (t,gx,gy,gz or t,ax,ay,az), "
                "or put acc or gyr into its name"
            )
        table.rename(XYZ, _HALVES[named[0]])
    held = [half for half, axes in _HALVES.items() if table.holds(*axes)]
    if not held:
        return None
    _state_units(table, options)
    if "t" in table.columns:
        table.scale("t")
    elif options.rate_hz is None:
        raise BadInputError(f"{table.name} has no time column: add --rate HZ, or a column t")
    return "both" if len(held) == 2 else held[0]


def _state_units(table: TextTable, options: ImuOptions) -> None:
    """Take the options' units where the header has none; refuse what contradicts it or is not known."""
    for axes, option, unit in ((GYRO, "--gyro-unit", options.gyro_unit), (ACCEL, "--accel-unit", options.accel_unit)):
        for axis in filter(table.columns.__contains__, axes):
            stated = table.units[axis]
            table.scale(axis)  # refused now, so that a folder's other files are still read
            if stated and unit and stated != unit.lower():
                raise BadInputError(f"{table.name}: column {axis} is in [{stated}] by its header, and {option} says {unit}: leave it out")
            table.units[axis] = stated or (unit or "").lower()


def imu_source(table: TextTable, topic: str, source: Source, held: str, options: ImuOptions) -> None:
    """Add the IMU of a table to its source."""
    read = partial(_read, table, source, held, options)
    source.part = "" if held == "both" else held
    _add(source, topic, "IMU CSV", table.count, read)


def _add(source: Source, topic: str, title: str, count: int, read: "partial[ImuSamples]") -> None:
    source.topics.append(TopicInfo(topic, title, "imu", count))
    source.imu[topic] = read

    def survey(progress: Progress, looks: Mapping[str, Look]) -> dict[str, Stamps]:
        samples = read(progress)
        return {topic: Stamps(None, samples.t_ns, samples)}

    source.survey = survey


def _read(table: TextTable, source: Source, held: str, options: ImuOptions, progress: Progress = silent) -> ImuSamples:
    axes = [axis for half, names in _HALVES.items() if held in ("both", half) for axis in names]
    t_ns, values = table.read(*axes, with_times=options.rate_hz is None, progress=progress)
    if options.rate_hz is not None:
        if "t" in table.columns:
            source.warn(f"{table.name}: its time column is not used, but --rate {options.rate_hz:g}")
        t_ns = np.rint(np.arange(len(values)) * (1e9 / options.rate_hz)).astype(np.int64)
    elif len(t_ns) > 1 and np.all(t_ns == t_ns[0]):
        raise BadInputError(f"{table.name}: all its stamps are {t_ns[0]} ns: add --rate HZ, which replaces them")
    unit = _unit(table, source, axes, values)
    good = plausible(values)
    if not good.all():
        source.warn(f"{table.name}: {counted(int(np.sum(~good)), 'sample is', 'samples are')} not finite and left out")
        t_ns, values = t_ns[good], values[good]
    first = 3 if held != "accel" else 0
    return ImuSamples(t_ns, values[:, :first], values[:, first:], unit)


def _unit(table: TextTable, source: Source, axes: list[str], values: Array) -> ImuUnit:
    """Return what the values hold; whole numbers throughout are raw counts where nothing else is stated."""
    stated = [table.units[axis] for axis in axes]
    if any(stated):
        return unit_of(table.name, stated)
    whole = len(values) >= _ENOUGH and bool(np.all(values == np.rint(values))) and bool(np.any(values != values[0]))
    if whole:
        source.warn(f"{table.name}: whole numbers without a unit are taken for raw counts (--gyro-unit, --accel-unit say otherwise)")
    return "counts" if whole else "SI"


def pair_halves(sources: list[Source]) -> list[Source]:
    """Join an accelerometer's file and a gyroscope's into one IMU; a file of one sensor alone stays as it is."""
    accel, gyro = ([source for source in sources if source.part == part] for part in ("accel", "gyro"))
    if not (accel and gyro):
        return sources
    if len(accel) + len(gyro) > 2:
        names = ", ".join(source.name for source in accel + gyro)
        raise BadInputError(f"which accelerometer belongs to which gyroscope? {names}: give one file of each")
    at = sources.index(accel[0])
    others = [source for source in sources if source not in (accel[0], gyro[0])]
    return [*others[:at], _pair(accel[0], gyro[0]), *others[at:]]


def _pair(accel: Source, gyro: Source) -> Source:
    ((accel_topic, read_accel),), ((gyro_topic, read_gyro),) = accel.imu.items(), gyro.imu.items()
    source = Source(f"{accel.name} + {gyro.name}", accel.files + gyro.files, warnings=accel.warnings)
    accel.warnings += gyro.warnings
    gyro.warnings = accel.warnings  # one list for the three

    def read(progress: Progress = silent) -> ImuSamples:
        return _joined(source, read_accel(progress), read_gyro(progress))

    _add(source, f"{accel_topic}+{gyro_topic}", "IMU CSV", accel.topics[0].count, partial(read))
    return source


def _joined(source: Source, accel: ImuSamples, gyro: ImuSamples) -> ImuSamples:
    """Return both as one: the gyroscope at the accelerometer's times, over the time that they share."""
    if accel.unit != gyro.unit:
        raise BadInputError(f"{source.name}: one is in raw counts and the other is not: state both in counts, or both in units")
    if np.array_equal(accel.t_ns, gyro.t_ns):
        return ImuSamples(accel.t_ns, gyro.gyro, accel.accel, accel.unit)
    t_gyro, first = np.unique(gyro.t_ns, return_index=True)
    inside = np.zeros(0, bool) if not len(t_gyro) else (accel.t_ns >= t_gyro[0]) & (accel.t_ns <= t_gyro[-1])
    if not inside.any():
        raise BadInputError(f"{source.name} share no time: give files of one recording, on one clock")
    t_ns, origin = accel.t_ns[inside], t_gyro[0]
    at, known = (t_ns - origin).astype(np.float64), (t_gyro - origin).astype(np.float64)
    turned = np.stack([np.interp(at, known, axis) for axis in gyro.gyro[first].T], axis=1)
    source.warn(
        f"{source.name} have different stamps: the gyroscope is interpolated at the accelerometer's, "
        f"over the {(t_ns.max() - t_ns.min()) * 1e-9:.6g} s that they share"
    )
    return ImuSamples(t_ns, turned, accel.accel[inside], accel.unit, interpolated=True)
