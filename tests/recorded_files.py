"""What sensors saw, as the CSV files that calibkit reads."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples, PoseSamples, Times
from calibkit.simulation.session import Session, simulate_views


def table(file: Path, header: str, t_ns: Times, *columns: NDArray[Any], form: str = "%.9f") -> Path:
    rows = np.column_stack(columns)
    lines = [f"{t}," + ",".join(form % value for value in row) for t, row in zip(t_ns, rows, strict=True)]
    file.write_text("\n".join([header, *lines]) + "\n")
    return file


def write_imu(file: Path, imu: ImuSamples) -> Path:
    return table(file, "t [ns],wx [rad/s],wy [rad/s],wz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]", imu.t_ns, imu.gyro, imu.accel)


def write_poses(file: Path, poses: PoseSamples) -> Path:
    return table(file, "t [ns],x,y,z,qx,qy,qz,qw", poses.t_ns, poses.p, poses.q)


def write_session(folder: Path, session: Session) -> tuple[Path, Path]:
    """Return the files of its IMU and of its first camera's corners."""
    assert session.imu is not None
    return write_imu(folder / "imu.csv", session.imu), write_corners(folder / "corners.csv", session)


def write_corners(file: Path, session: Session) -> Path:
    views, _ = simulate_views(session)
    columns = (views.t_ns[views.frame], views.corner // 4, views.corner % 4, views.uv)
    return table(file, "t [ns],tag_id,corner_idx,u [px],v [px]", *columns, form="%.4f")
