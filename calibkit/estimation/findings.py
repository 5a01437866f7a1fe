"""What is found to be wrong with a static IMU recording."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One thing that spoils a recording, or that a reader of its result must know."""

    kind: str  # for machines
    text: str
    t_start_s: float  # from the recording's earliest stamp
    t_end_s: float
    cut: bool = False  # `imu_screening.clean` takes it out
