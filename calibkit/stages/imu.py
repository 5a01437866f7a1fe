"""`calibkit imu`: an IMU put down in many attitudes to its scale, axes and biases."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples
from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Imu
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.imu_intrinsics import ImuCalibration, calibrate_imu
from calibkit.estimation.imu_result import imu_result
from calibkit.estimation.imu_table_fit import fit_table, table_alone, with_table
from calibkit.estimation.imu_times import in_order, rate_hz
from calibkit.estimation.static_intervals import NoStandsError
from calibkit.io.imu_options import ImuOptions
from calibkit.io.turntable_file import load_turntable
from calibkit.models.imu import STANDARD_GRAVITY, Gravity
from calibkit.stages.imu_source import open_imu
from calibkit.stages.outputs import Outputs, Saved, save

_DEFAULT = ImuOptions()


@dataclass(frozen=True)
class Options:
    """How to read the recording and what gravity is where it was made."""

    imu: str | None = None  # topic, or NAME=/topic
    reading: ImuOptions = _DEFAULT
    gravity: Gravity = STANDARD_GRAVITY
    sensitivity: bool = False  # of the gyroscope to acceleration, too
    turntable: Path | None = None  # its known rates
    ros_distro: str | None = None


def imu(sources: Sequence[Path], outputs: Outputs | None = None, options: Options | None = None, progress: Progress = silent) -> Saved:
    """Calibrate an IMU from a recording of still stands in many attitudes.

    BadInputError names the file, topic or option that is wrong, or that there are too few stands.
    """
    outputs, options = outputs or Outputs(), options or Options()
    base = outputs.open()
    source = open_imu(sources, options.imu, options.reading, options.ros_distro, progress, counts=True, partial=False)
    samples = in_order(source.samples)
    start_ns = int(samples.t_ns[0])
    t = np.asarray((samples.t_ns - start_ns) * 1e-9, np.float64)
    try:
        found = _calibrate(t, samples, options, source.name, progress)
    except BadInputError as error:
        raise BadInputError(f"{source.recording.name}: {one_line(source.topic)}: {str(error).removeprefix(f'{source.name}: ')}") from None
    before = base.imus.get(source.name, Imu())
    result = imu_result(source.name, source.topic, found, samples.unit, options.gravity, rate_hz(samples.t_ns), start_ns, before)
    result = replace(result, facts={**result.facts, "warnings": source.recording.warnings})
    told: dict[str, str | float | int | bool | None] = {
        "gravity": options.gravity.value,
        "gravity_from": options.gravity.source,
        "sensitivity": options.sensitivity,
    }
    table = options.turntable
    tables = [] if table is None else [(table.name, sha256(table.read_bytes()).hexdigest())]
    return save(result, base, outputs, [*source.recording.inputs(), *tables], told)


def _calibrate(t: NDArray[np.float64], samples: ImuSamples, options: Options, name: str, progress: Progress) -> ImuCalibration:
    """Return the calibration from stands, from a turntable's rates where they are given, or from both."""
    table = None if options.turntable is None else fit_table(samples, load_turntable(options.turntable))
    try:
        found = calibrate_imu(t, samples.gyro, samples.accel, options.gravity.value, options.sensitivity, name, progress)
    except NoStandsError:
        if table is None:
            raise
        return table_alone(table, name)  # a recording of the table alone has no stands
    return found if table is None else with_table(found, table, name)
