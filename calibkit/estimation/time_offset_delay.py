"""What of a time offset is no clock's fault: a gyroscope's low-pass is late, and a stamp may not be mid-exposure of the middle row."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Delays:
    """What is known of the sensors' insides; None: not known."""

    gyro_bandwidth_hz: float | None = None  # -3 dB of its low-pass
    exposure_s: float | None = None  # of a camera whose stamps are the exposure's start
    readout_s: float | None = None  # from the first row to the last, of a camera whose stamps are the first row's

    @property
    def gyro_s(self) -> float:
        """Group delay at low frequencies of a first-order low-pass, 1 / (2 pi f); of second order (Butterworth) sqrt(2) times as much."""
        return 0.0 if self.gyro_bandwidth_hz is None else 1 / (2 * np.pi * self.gyro_bandwidth_hz)

    @property
    def camera_s(self) -> float:
        """Time from the stamp to mid-exposure of the middle row."""
        return ((self.exposure_s or 0.0) + (self.readout_s or 0.0)) / 2

    def told(self, of: str, to: str, td: float) -> list[str]:
        """Return how much of td they explain: both make td larger by their delay."""
        if self.gyro_s == 0 and self.camera_s == 0:
            return []
        parts = []
        if self.gyro_s:
            first, second = self.gyro_s * 1e3, np.sqrt(2) * self.gyro_s * 1e3
            parts.append(f"{first:+.2f} to {second:+.2f} ms by the low-pass of {to} at {self.gyro_bandwidth_hz:g} Hz")
        if self.camera_s:
            parts.append(f"{self.camera_s * 1e3:+.2f} ms by exposure and readout of {of}, if its stamps are their start")
        rest = (td - self.gyro_s - self.camera_s) * 1e3
        return [f"part of td may be {', and '.join(parts)}; the clocks would be {rest:+.2f} ms apart"]

    def facts(self) -> dict[str, float | None]:
        """Return them in s, for machines."""
        return {"gyro_low_pass": self.gyro_s or None, "exposure_and_readout": self.camera_s or None}
