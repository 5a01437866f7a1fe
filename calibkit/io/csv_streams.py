"""IMU, pose, yaw rate and corner streams in CSV (or TUM's blank-separated) files, recognised by their header or their shape."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from calibkit.data.observations import ImuSamples, PoseSamples
from calibkit.data.progress import Progress
from calibkit.errors import BadInputError, one_line
from calibkit.io.imu_options import COUNTS, ImuOptions
from calibkit.io.imu_text import find_imu, imu_source
from calibkit.io.ros_bag import rate_samples, unit_poses
from calibkit.io.source import CornerRows, Look, Source, Stamps, TopicInfo
from calibkit.io.text_table import ACCEL, GYRO, WANTED, XYZ, Q, TextTable, stem

_CORNER = ("tag_id", "corner_idx", "u", "v")


def csv_source(path: Path, topic: str, options: ImuOptions) -> Source:
    """Return the stream in a CSV file; BadInputError where it is none that is known."""
    name = one_line(path.name, 120)
    source = Source(name if stem(path.name) == topic else f"{topic}/{name}", [path])
    table = TextTable(path, source.name, source.warn)
    if table.holds("t", *_CORNER):  # corner files have x, y, z as well, so they are looked for first
        return _corner_source(table, topic, source)
    if table.holds("t", *XYZ, *Q) and not table.holds(*GYRO, *ACCEL):  # with rates beside the poses, it is an odometry and no gyroscope
        return _pose_source(table, topic, source)
    if table.holds("t", "wz") and not table.columns.keys() & {"wx", "wy", *ACCEL}:
        return _yaw_source(table, topic, source)
    if held := find_imu(table, options):
        imu_source(table, topic, source, held, options)
        return source
    raise BadInputError(f"{source.name} is not recognised: {WANTED}")


def _pose_source(table: TextTable, topic: str, source: Source) -> Source:
    for column in ("t", *XYZ):
        table.scale(column)  # refused now, so that a folder's other files are still read
    source.topics.append(TopicInfo(topic, "pose CSV", "pose", table.count))
    source.poses[topic] = partial(_poses, table, topic, source)
    source.survey = lambda progress, looks: {topic: Stamps(None, table.times())}
    return source


def _poses(table: TextTable, topic: str, source: Source) -> PoseSamples:
    t_ns, values = table.read(*Q, *XYZ)
    samples, lost = unit_poses(t_ns, values[:, :4], values[:, 4:], "world", topic)
    if lost:
        source.warn(f"{table.name}: {lost} poses have no proper rotation or are not finite, and are left out")
    return samples


def _yaw_source(table: TextTable, topic: str, source: Source) -> Source:
    table.scale("t")
    table.scale("wz")
    if table.units["wz"] in COUNTS:
        raise BadInputError(f"{table.name}: its yaw rate is in raw counts: give it in rad/s or deg/s")
    source.topics.append(TopicInfo(topic, "yaw rate CSV", "twist", table.count))
    source.twist[topic] = partial(_yaw_rates, table, source)
    source.survey = lambda progress, looks: {topic: Stamps(None, table.times())}
    return source


def _yaw_rates(table: TextTable, source: Source) -> ImuSamples:
    t_ns, rate = table.read("wz")
    return rate_samples(t_ns, np.hstack([np.zeros((len(rate), 2)), rate]), table.name, source)


def _corner_source(table: TextTable, topic: str, source: Source) -> Source:
    for column in {"t", *XYZ} & table.columns.keys():
        table.scale(column)
    source.topics.append(TopicInfo(topic, "corner CSV", "corners", table.count))
    source.corners[topic] = partial(_corners, table)

    def survey(progress: Progress, looks: Mapping[str, Look]) -> dict[str, Stamps]:
        t_ns = table.times()
        t_ns = t_ns[np.flatnonzero(np.diff(t_ns, prepend=t_ns[:1] - 1))]  # one stamp a frame, not one a corner
        return {topic: Stamps(None, t_ns)}

    source.survey = survey
    return source


def _corners(table: TextTable) -> CornerRows:
    points = XYZ if table.holds(*XYZ) else ()
    sigmas = ("sigma_px",) if table.holds("sigma_px") else ()
    t_ns, values = table.read(*_CORNER, *points, *sigmas)
    tag, index, uv = values[:, 0], values[:, 1], values[:, 2:4]
    if not (np.all((tag >= 0) & (tag < 1e6) & (index >= 0) & (index < 4)) and np.isfinite(uv).all()):
        raise BadInputError(f"{table.name}: tag_id must be from 0, corner_idx from 0 to 3, u and v finite")
    return CornerRows(
        file=table.name,
        t_ns=t_ns,
        corner=np.rint(4 * tag + index).astype(np.int64),
        uv=uv,
        xyz=values[:, 4:7] if points else None,
        sigma_px=values[:, -1] if sigmas else None,
    )
