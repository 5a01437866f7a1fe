"""A gyroscope or an accelerometer that repeats one value while its stamps run on: frozen, and no measurement."""

from dataclasses import dataclass

import numpy as np

from calibkit.data.observations import ImuSamples
from calibkit.errors import BadInputError

WORDS = {"gyro": "gyroscope", "accel": "accelerometer"}
_LONG_S, _MANY = 0.5, 10  # s and samples of one value: noise, were it of a few steps of the values only, would have changed it
_LEFT = 0.2  # of the samples at least


@dataclass(frozen=True)
class Frozen:
    """One stretch of one value."""

    kind: str  # of WORDS
    start_ns: int
    end_ns: int

    @property
    def seconds(self) -> float:
        return (self.end_ns - self.start_ns) * 1e-9


def without_frozen(imu: ImuSamples) -> tuple[ImuSamples, tuple[Frozen, ...]]:
    """Return the samples, in order of time, without those that repeat a frozen sensor's last value, and where it was frozen.

    BadInputError where an axis never changes, or nearly all of the recording is frozen.
    """
    keep, found = np.ones(len(imu.t_ns), bool), []
    for kind, values in (("gyro", imu.gyro), ("accel", imu.accel)):
        dead = [axis for axis, column in zip("xyz", values.T, strict=True) if len(column) >= _MANY and np.all(column == column[0])]
        if dead:
            axes = "" if len(dead) == 3 else f"'s {' and '.join(dead)} {'axis' if len(dead) == 1 else 'axes'}"
            text = f"the {WORDS[kind]}{axes} gives one and the same value throughout"
            raise BadInputError(f"{text}: is it frozen, or not filled by its driver? mend that, and record again")
        same = np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1), [False]])
        for first, last in np.flatnonzero(np.diff(same)).reshape(-1, 2).tolist():
            stretch = Frozen(kind, int(imu.t_ns[first]), int(imu.t_ns[last]))
            if last - first >= _MANY and stretch.seconds >= _LONG_S:
                found.append(stretch)
                keep[first + 1 : last + 1] = False
    if np.mean(keep) < _LEFT:
        which = " and ".join(dict.fromkeys(f"the {WORDS[each.kind]}" for each in found))
        text = f"{which} repeat one value through {100 * (1 - np.mean(keep)):.0f} % of the recording"
        raise BadInputError(f"{text}: frozen; mend the driver or the cable, and record again")
    return imu.select(keep), tuple(found)
