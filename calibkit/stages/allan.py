"""`calibkit allan`: hours of an IMU at rest to the noise of its axes."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples
from calibkit.data.progress import Progress, silent
from calibkit.data.rig import IMU_AXES, Imu, ImuAxis
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.allan import Deviation, deviation, log_spaced
from calibkit.estimation.imu_noise import AxisNoise, fit_noise
from calibkit.estimation.imu_screening import clean, rate_hz, refuse_no_rest, screen
from calibkit.estimation.noise_result import noise_result
from calibkit.estimation.noise_verdict import Rest
from calibkit.io.atomic import refuse_unwritable, write_atomic
from calibkit.io.imu_options import ImuOptions
from calibkit.models.noise import UNITS
from calibkit.stages.imu_source import open_imu
from calibkit.stages.outputs import Outputs, Saved, save

Array = NDArray[np.float64]

KINDS = ("overlapping", "modified", "hadamard")
_DEFAULT = ImuOptions()


@dataclass(frozen=True)
class Options:
    """How to read the recording and what of it to show."""

    imu: str | None = None  # topic, or NAME=/topic
    reading: ImuOptions = _DEFAULT
    kind: str = "overlapping"  # of the deviations shown; the noise is fitted to the recording itself
    exact: bool = False
    cut: bool = True  # leave out what spoils the recording
    table: Path | None = None  # CSV of the deviations
    ros_distro: str | None = None


def allan(sources: Sequence[Path], outputs: Outputs | None = None, options: Options | None = None, progress: Progress = silent) -> Saved:
    """Estimate the noise of an IMU from a recording of it at rest.

    BadInputError names the file, topic or option that is wrong, or that the recording moves throughout.
    """
    outputs, options = outputs or Outputs(), options or Options()
    if options.kind not in KINDS:
        raise BadInputError(f"--kind {options.kind}: choose one of {', '.join(KINDS)}")
    base = outputs.open()
    if options.table is not None:
        refuse_unwritable(options.table, outputs.force)
    source = open_imu(sources, options.imu, options.reading, options.ros_distro, progress, counts=False, partial=True)
    if source.samples.interpolated:
        raise BadInputError(
            f"{source.recording.name}: its two files have different stamps, and a gyroscope that is interpolated has another noise: "
            "give one file, then the other with --rig OUT.yaml"
        )
    try:
        findings = screen(source.samples)
        refuse_no_rest(source.samples, findings)
        pieces = clean(source.samples, findings if options.cut else [finding for finding in findings if finding.kind == "gap"])
        rate = rate_hz(np.concatenate([piece.t_ns for piece in pieces]))  # in order, each sample once
        fitted = _fit(pieces, rate, progress)
    except BadInputError as error:
        raise BadInputError(f"{source.recording.name}: {one_line(source.topic)}: {error}") from None
    has = {"gyro": source.samples.has_gyro, "accel": source.samples.has_accel}
    axes = [axis for axis in IMU_AXES if has[axis[:-2]]]
    noise = dict(zip(axes, fitted, strict=True))
    longest = max(pieces, key=lambda piece: len(piece.t_ns))
    curve = _deviation(longest, rate, "overlapping", options.exact)
    hours = [_hours(piece, rate) for piece in pieces]
    rest = Rest(source.name, source.topic, rate, axes, noise, curve, findings, hours, float(np.ptp(source.samples.t_ns)) / 3.6e12)
    result = noise_result(rest, base.imus.get(source.name, Imu()), options.cut)
    result = replace(result, facts={**result.facts, "warnings": source.recording.warnings})
    saved = save(result, base, outputs, source.recording.inputs(), _told(options))
    if options.table is None:
        return saved
    shown = curve if options.kind == "overlapping" else _deviation(longest, rate, options.kind, options.exact)
    write_atomic(options.table, _csv(shown, axes), outputs.force)
    return replace(saved, files=(*saved.files, options.table))


def _fit(pieces: Sequence[ImuSamples], rate: float, progress: Progress) -> list[AxisNoise]:
    """Return the noise of every axis, one after the other: each takes several times its samples' memory."""
    sensors = [[array for array in (piece.gyro, piece.accel) if array.shape[1]] for piece in pieces]
    axes = [[sensor[k][:, axis : axis + 1] for sensor in sensors] for k in range(len(sensors[0])) for axis in range(3)]
    return [fit_noise(x, rate)[0] for x in progress(axes, "noise of each axis", len(axes))]


def _deviation(samples: ImuSamples, rate: float, kind: str, exact: bool) -> Deviation:
    x = np.hstack([samples.gyro, samples.accel])
    return deviation(x, rate, log_spaced(len(x), rate), kind, exact)


def _hours(samples: ImuSamples, rate: float) -> float:
    return len(samples.t_ns) / rate / 3600


def _csv(curve: Deviation, axes: Sequence[ImuAxis]) -> str:
    """Return the table of deviations in SI: one line an averaging time, of each axis the deviation and its 95 % interval."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        ["tau [s]", *(f"{axis} {part} [{UNITS[axis[:-2]]['flicker']}]" for axis in axes for part in ("deviation", "low", "high"))]
    )
    for k, tau in enumerate(curve.tau):
        values = np.stack([curve.dev[k], curve.lower[k], curve.upper[k]], axis=1).ravel()
        writer.writerow([f"{tau:.9g}", *(f"{value:.6e}" for value in values)])
    return out.getvalue()


def _told(options: Options) -> dict[str, str | float | int | bool | None]:
    reading = options.reading
    return {
        "rate_hz": reading.rate_hz,
        "gyro_unit": reading.gyro_unit,
        "accel_unit": reading.accel_unit,
        "kind": options.kind,
        "exact": options.exact,
        "cut": options.cut,
    }
