"""What spoils a recording of an IMU at rest, found before any noise is estimated from it, and how it is cut out."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples
from calibkit.errors import BadInputError
from calibkit.estimation import imu_motion, imu_times, imu_values
from calibkit.estimation.findings import Finding
from calibkit.estimation.imu_times import rate_hz

__all__ = ["Finding", "clean", "rate_hz", "refuse_no_rest", "screen"]

Array = NDArray[np.float64]
_PARTS = 500  # of the recording, whose mean directions of gravity are compared
_TURNED, _OFTEN = np.radians(20.0), 0.2  # from the longest piece's, and how often that makes a recording of stands
_LEAST_S = 10.0  # pieces that are shorter say nothing


def screen(samples: ImuSamples) -> list[Finding]:
    """Return what is wrong with a static recording, in the order of time; BadInputError where there is nothing to judge."""
    ordered = imu_times.in_order(samples)
    t_s = (ordered.t_ns - ordered.t_ns[0]) * 1e-9
    rate, end, si = rate_hz(ordered.t_ns), float(t_s[-1]), ordered.unit == "SI"
    gyro, accel = _axes("gyroscope", ordered.gyro), _axes("accelerometer", ordered.accel)
    both, units = (
        gyro | accel,
        dict.fromkeys(gyro, " counts" if not si else " rad/s") | dict.fromkeys(accel, " counts" if not si else " m/s^2"),
    )
    found = imu_times.check_times(samples, ordered)
    windows = imu_motion.windows(t_s, both, rate, si)
    motion, disturbed = imu_motion.check_motion(windows)
    found += motion
    if not any(finding.kind == "moving" for finding in motion):
        found += imu_motion.check_levels(windows, disturbed)
        quiet = np.ones(len(t_s), bool)
        quiet[: len(disturbed) * windows.size] = ~np.repeat(disturbed, windows.size)
        found += imu_values.check_vibration(both, t_s, rate, quiet, units)
        found += imu_values.check_gyro_noise(gyro, rate, end) if si and gyro else []
    for name, axes in (("gyroscope", gyro), ("accelerometer", accel)):
        if axes:
            found += imu_values.check_quantisation(f"the {name}", units[f"{name} x"], axes, end)
    found += imu_values.check_saturation(both, t_s)
    found += imu_values.check_repeats(both, end)
    found += imu_values.check_gravity(ordered.accel, end) if si and accel else []
    return sorted(found, key=lambda finding: finding.t_start_s)


def refuse_no_rest(samples: ImuSamples, findings: list[Finding]) -> None:
    """Raise BadInputError where the IMU moves throughout, no axis ever changes, or gravity often points elsewhere than at its rest."""
    moving = next((finding for finding in findings if finding.kind == "moving"), None)
    if moving is not None:
        raise BadInputError(moving.text)
    if not any(np.ptp(array, axis=0).any() for array in (samples.gyro, samples.accel) if array.size):
        raise BadInputError("no axis ever changes: the driver does not fill it, or every sample is the same")
    if not samples.has_accel:
        return
    parts = np.array([part.mean(axis=0) for part in np.array_split(samples.accel, min(len(samples.t_ns), _PARTS))])
    parts /= np.maximum(np.linalg.norm(parts, axis=1, keepdims=True), 1e-12)
    at_rest = max(clean(samples, findings), key=lambda piece: len(piece.t_ns)).accel.mean(axis=0)
    if np.mean(parts @ at_rest < np.cos(_TURNED) * np.linalg.norm(at_rest)) > _OFTEN:
        raise BadInputError("it was put down in several attitudes: that is a recording for calibkit imu; leave it in one for hours")


def clean(samples: ImuSamples, findings: list[Finding]) -> list[ImuSamples]:
    """Return the contiguous pieces, in order of time, that remain without what is to be cut; BadInputError where none does."""
    ordered = imu_times.in_order(samples)
    cuts = [finding for finding in findings if finding.cut]
    if any(finding.kind == "duplicate" for finding in cuts):
        ordered = ordered.select(~imu_times.repeated(ordered))
    t_s = (ordered.t_ns - ordered.t_ns[0]) * 1e-9
    keep = np.ones(len(t_s), bool)
    breaks = {0, len(t_s)}
    for finding in cuts:
        if finding.kind == "duplicate":
            continue
        first, last = np.searchsorted(t_s, [finding.t_start_s, finding.t_end_s])
        if finding.kind == "gap":
            breaks.add(int(last))  # both samples beside it are good
        else:
            keep[first:last] = False
            breaks |= {int(first), int(last)}
    edges = sorted(breaks)
    pieces = [slice(a, b) for a, b in pairwise(edges) if keep[a:b].all() and b > a]
    least = min(_LEAST_S, t_s[-1] / 2)
    long = [ordered.select(piece) for piece in pieces if t_s[piece.stop - 1] - t_s[piece.start] >= least]
    if not long:
        raise BadInputError(f"nothing of {least:.3g} s or more is left of the recording once what spoils it is cut: record the IMU at rest")
    return long


def _axes(sensor: str, values: Array) -> dict[str, Array]:
    return {f"{sensor} {axis}": column for axis, column in zip("xyz", values.T, strict=False)}
