"""What one pass over a bag gathers of a topic while its messages go by: times, and the samples of an IMU."""

from array import array
from collections.abc import Iterable, Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import ImuSamples
from calibkit.io import ros_messages
from calibkit.io.container import Message
from calibkit.io.imu_options import ImuOptions
from calibkit.io.rows import Rows
from calibkit.io.source import Array, Stamps

T = TypeVar("T")
_ABSURD = 1e9  # in SI units
_BATCH = 4096  # Imu messages decoded at once
_PATIENCE = 10  # messages without a stamp to hold back until one has a stamp


def restamp(messages: Iterable[tuple[int, int, T]], zeros: list[int]) -> Iterator[tuple[int, T]]:
    """Yield (time, item) from (header, record, item): header times; where they are zero, record times on the header's clock.

    A zero stamp takes its record time plus the latest known difference of the two clocks (0 when no header has a time).
    The record times of zero stamps are appended to `zeros`. The order stays.
    """
    difference: int | None = None
    held: list[tuple[int, T]] = []
    for header, record, item in messages:
        if header == 0:
            zeros.append(record)
            held.append((record, item))
        else:
            difference = header - record
        if held and (difference is not None or len(held) > _PATIENCE):
            yield from ((time + (difference or 0), waiting) for time, waiting in held)
            held.clear()
        if header != 0:
            yield header, item
    yield from ((time + (difference or 0), waiting) for time, waiting in held)


def plausible(values: Array) -> NDArray[np.bool_]:
    """Tell which rows are finite and of a size that any sensor can mean; what damage leaves can be anything."""
    rows: NDArray[np.bool_] = np.all(np.abs(values) < _ABSURD, axis=1)
    return rows


class TopicPass:
    """One topic's messages on their way: `kind` is a key of source.USES."""

    def __init__(self, kind: str, options: ImuOptions) -> None:
        self.kind = kind
        self.lost = 0  # IMU samples that are damaged, once `stamps` was asked for
        self._options = options
        self._headers = array("q")
        self._records = array("q")
        self._waiting: list[Message] = []
        self._gyro, self._accel, self._whole = Rows((3,), np.float64), Rows((3,), np.float64), Rows((), np.bool_)

    def __len__(self) -> int:
        return len(self._records)

    def add(self, message: Message, headed: bool) -> None:
        """Take in a message; `headed` when its type begins with a Header."""
        self._records.append(message.record_ns)
        if headed:
            self._headers.append(ros_messages.header_ns(message.payload, message.channel.encoding))
        if self.kind == "imu":
            self._waiting.append(message)
            if len(self._waiting) == _BATCH:
                self._decode()

    @property
    def zeros(self) -> int:
        """How many header stamps are zero."""
        return self._headers.count(0)

    def stamps(self) -> Stamps:
        """Return what was gathered."""
        headers = _flat(self._headers) if len(self._headers) == len(self._records) else None
        return Stamps(headers, _flat(self._records), self._imu() if self.kind == "imu" else None)

    def _decode(self) -> None:
        gyro, accel, whole = ros_messages.decode_imu([m.payload for m in self._waiting], self._waiting[0].channel.encoding)
        self._whole.add(whole & plausible(gyro) & plausible(accel))
        self._gyro.add(gyro * self._options.gyro_scale)
        self._accel.add(accel * self._options.accel_scale)
        self._waiting.clear()

    def _imu(self) -> ImuSamples:
        if self._waiting:
            self._decode()
        t_ns = _flat(self._headers)
        if self.zeros:
            t_ns = np.array([t for t, _ in restamp(zip(self._headers, self._records, self._records, strict=True), [])], np.int64)
        gyro, accel, whole = self._gyro.take(), self._accel.take(), self._whole.take()
        self.lost = int(np.sum(~whole))
        if self.lost:
            t_ns, gyro, accel = t_ns[whole], gyro[whole], accel[whole]
        return ImuSamples(t_ns, gyro, accel, self._options.unit)


def _flat(numbers: "array[int]") -> NDArray[np.int64]:
    return np.frombuffer(numbers, np.int64) if numbers else np.zeros(0, np.int64)
