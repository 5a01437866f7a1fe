"""One residual set made ready to be read: rows with a prediction only, frames numbered and named, the image they lie in."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import Camera, ImuAxis, Noise
from calibkit.errors import one_line
from calibkit.models.cameras import CAMERAS, CameraModel
from calibkit.report.hand_eye_view import HandEye, hand_eye_of

Array = NDArray[np.float64]
Index = NDArray[np.intp]
T = TypeVar("T")

_ABSURD = 1e9  # in any unit: larger residuals mean nothing, and their squares would overflow
_HUGE = 1e6  # m, rad
_UNIT = 1e-3  # a quaternion's length from 1
_COSTLY = 1e18  # of a chi-squared, which is a square already


@dataclass(frozen=True)
class Bottom:
    """The bottom of a V: t_a = t_b + offset, with its 95 % interval; a second one that the cost cannot tell from it."""

    offset: float  # s
    low: float
    high: float
    second: float | None = None


@dataclass(frozen=True)
class ClockLine:
    """What the model of a clock does over time."""

    skew: float | None  # s/s; None: no drift to speak of
    jumps: tuple[tuple[float, float], ...]  # when, s since the stage's zero, and by how much, s


@dataclass(frozen=True)
class KnownLens:
    """A lens with what is known of it."""

    model: CameraModel
    params: Array  # (p,)
    cov: Array  # (p, p)


@dataclass(frozen=True)
class View:
    """Residuals of one sensor in one stage; what the stage did not record is None."""

    stage: str
    sensor: str
    unit: str
    raw: Array  # (n, d) measured minus predicted
    kept: NDArray[np.bool_]  # (n,)
    frame: Index | None = None  # (n,) index into labels
    labels: tuple[str, ...] = ()  # (f,)
    uv: Array | None = None  # (n, 2) px measured
    corner: Index | None = None  # (n,)
    tilt: Array | None = None  # (n,) rad
    image_size: tuple[int, int] | None = None  # width, height px
    centre: Array | None = None  # (2,) px, principal point, else the middle of the image
    held_out_rms: float | None = None
    axis: Index | None = None  # (n,) index into the names that the stage gives
    tau: Array | None = None  # (n,) s
    deviation: Array | None = None  # (n,) measured Allan deviation in `units` of its axis
    fitted: Array | None = None  # (n,) the noise model's
    low: Array | None = None  # (n,) 95 % interval
    high: Array | None = None
    attitude: Array | None = None  # (n, 3) unit vector of gravity's reaction in the IMU's frame
    noise: Mapping[ImuAxis, Noise] = field(default_factory=dict)  # of an IMU, by axis
    t: Array | None = None  # (n,) s since the stage's own zero, or since the first residual of this sensor
    zeroed: bool = False  # whether the stage gave a zero
    rate: Array | None = None  # (n,) rad/s |omega| of `a` of dt_a_b, at b's stamps plus the offset; here and below NaN where unknown
    rate_before: Array | None = None  # (n,) rad/s the same at b's stamps as they are
    of_rate: Array | None = None  # (n,) rad/s |omega| of `b`
    before: Array | None = None  # (n, 3) the residual with b's stamps as they are
    delay: Array | None = None  # (n,) s the offset that was tried: raw is its chi-squared above the bottom's
    window_offset: Array | None = None  # (n,) s of one window alone: raw is that less the clock's
    window_sigma: Array | None = None  # (n,) s
    clock: Array | None = None  # (n,) s the offset that the model of the clock has there
    clock_line: ClockLine | None = None
    bottom: Bottom | None = None  # None: there is none, or the rig says that the offset is not observable
    turn: Array | None = None  # (n, 3) rad of a pose beside raw's m, local(Z Q, P X)
    place: Array | None = None  # (n, 3) m, and
    rotation: Array | None = None  # (n, 4) xyzw of T_w1_1
    px: Array | None = None  # (n,) rms of the image's corners against the other side's pose
    motion: Array | None = None  # (n, 3) rad, rotation vector of a pair of poses
    measured: Array | None = None  # (n, 3) what raw is left of
    bias: Array | None = None  # (n, 6) rad/s, m/s^2 of an IMU at `place`
    bias_sigma: Array | None = None  # (n, 6)
    temperature: Array | None = None  # (n,) deg C
    distance: Array | None = None  # (n,) m of a corner from the camera; NaN where unknown
    lens: KnownLens | None = None  # None: a number or the covariance is not known
    hand_eye: HandEye | None = None  # the transform that these residuals are of
    n_lost: int = 0  # rows that have no prediction (behind the camera, outside the model's domain)

    @property
    def name(self) -> str:
        return f"{self.sensor} ({self.stage})"

    def has(self, needs: frozenset[str]) -> bool:
        """Whether something was kept and everything that `needs` names was recorded."""
        return bool(self.kept.any()) and all(getattr(self, need) is not None for need in needs)

    @property
    def moments(self) -> Array | None:
        """The times of frames that have stamps: t, where it is not one for all."""
        return self.t if self.t is not None and len(self.t) and np.ptp(self.t) > 0 else None

    @cached_property
    def frame_rms(self) -> Array:
        """Rms (f,) over the kept rows of each frame, NaN for a frame without any."""
        frame = given(self.frame)[self.kept]
        squares = np.bincount(frame, np.sum(self.raw[self.kept] ** 2, axis=1), len(self.labels))
        counts = np.bincount(frame, minlength=len(self.labels))
        return np.sqrt(np.where(counts > 0, squares, np.nan) / np.maximum(counts, 1))


def given(value: T | None) -> T:
    """Return a column of a View that `View.has` was asked for beforehand."""
    if value is None:
        raise ValueError("the residuals do not hold this column")
    return value


def rms(raw: Array) -> float:
    """Return sqrt(sum |r|^2 / n) over rows (n, d), as OpenCV prints it; NaN for none."""
    return float(np.sqrt(np.sum(raw**2) / len(raw))) if len(raw) else float("nan")


def views(result: Result) -> list[View]:
    """Return a View of each residual set of the result that has rows."""
    made = [_view(result, residuals) for residuals in result.residuals]
    return [view for view in made if len(view.raw)]


def _view(result: Result, residuals: ResidualSet) -> View:
    camera = result.rig.cameras.get(residuals.sensor)
    context = residuals.context
    good = np.all(np.abs(residuals.raw) < (_COSTLY if "delay" in context else _ABSURD), axis=1)  # NaN is not
    if "axis" in context:
        good &= np.isin(context["axis"], np.arange(len(get_args(ImuAxis))))
    for key in ("tau", "deviation", "fitted", "low", "high"):  # drawn in logarithms
        if key in context:
            value = context[key].astype(float)
            good &= np.isfinite(value) & (value > 0)
    for key in ("turn", "place", "rotation", "motion", "measured", "bias", "bias_sigma"):
        if key in context:
            value = context[key].astype(float)
            good &= value.ndim == 2 and np.all(np.abs(value) < _HUGE, axis=1)
            if key == "rotation":
                good &= np.abs(np.linalg.norm(value, axis=1) - 1) < _UNIT
    for key in ("delay", "window_offset"):  # where to draw the row
        if key in context:
            good &= np.abs(context[key].astype(float)) < _ABSURD
    if "uv" in context:
        good &= np.all(np.isfinite(context["uv"].astype(float)), axis=1)

    def column(key: str) -> NDArray[np.generic] | None:
        return context[key][good] if key in context else None

    def floats(key: str, width: int | None = None) -> Array | None:
        found = column(key)
        return None if found is None or (width and found.shape[1:] != (width,)) else found.astype(float)

    def partly(key: str, width: int | None = None) -> Array | None:
        """Return a column that may be unknown in some rows, NaN there; None where it is unknown in all."""
        found = floats(key, width)
        if found is None:
            return None
        found = np.where(np.abs(found) < _ABSURD, found, np.nan)
        return found if np.isfinite(found).any() else None

    kept, corner, tilt, axis = column("kept"), column("corner"), column("tilt"), column("axis")
    uv = column("uv") if residuals.raw.shape[1] == 2 else None
    frame, labels = _frames(result.facts, residuals.sensor, column("frame"))
    size = camera.resolution if camera else None
    centre = None
    if camera and size:
        at = [camera.parameters.get(name) for name in ("cx", "cy")]
        middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
        centre = np.array([a.value if a is not None and a.value is not None else m for a, m in zip(at, middle, strict=True)])
    return View(
        stage=result.stage,
        sensor=residuals.sensor,
        unit=residuals.unit,
        raw=residuals.raw[good],
        kept=np.ones(int(good.sum()), bool) if kept is None else kept.astype(bool),
        frame=frame,
        labels=labels,
        uv=None if uv is None else uv.astype(float),
        corner=None if corner is None else corner.astype(np.intp),
        tilt=None if tilt is None else tilt.astype(float),
        image_size=size,
        centre=centre,
        held_out_rms=_held_out(result, residuals.sensor, camera),
        n_lost=int(np.sum(~good)),
        noise=result.rig.imus[residuals.sensor].noise if residuals.sensor in result.rig.imus else {},
        axis=None if axis is None else axis.astype(np.intp),
        tau=floats("tau"),
        deviation=floats("deviation"),
        fitted=floats("fitted"),
        low=floats("low"),
        high=floats("high"),
        attitude=floats("attitude", 3),
        t=_seconds(result, residuals)[good],
        zeroed=_zero(result, residuals.sensor) is not None,
        temperature=partly("temperature"),
        distance=partly("distance"),
        lens=_lens(camera),
        rate=partly("rate"),
        rate_before=partly("rate_before"),
        of_rate=partly("of_rate"),
        before=partly("before", 3),
        delay=floats("delay"),
        window_offset=floats("window_offset"),
        window_sigma=partly("window_sigma"),
        clock=partly("clock"),
        clock_line=_clock_line(result, residuals.sensor),
        bottom=_bottom(result, residuals.sensor),
        turn=floats("turn", 3),
        place=floats("place", 3),
        rotation=floats("rotation", 4),
        px=partly("px"),
        motion=floats("motion", 3),
        measured=floats("measured", 3) if residuals.raw.shape[1] == 3 else None,
        bias=floats("bias", 6),
        bias_sigma=floats("bias_sigma", 6),
        hand_eye=hand_eye_of(result, residuals.sensor),
    )


def _held_out(result: Result, sensor: str, camera: Camera | None) -> float | None:
    """Return facts["held_out_px"][sensor], as a later stage may have made the camera anew, else what the rig says of it."""
    by_sensor = result.facts.get("held_out_px")
    if isinstance(by_sensor, Mapping) and sensor in by_sensor:
        return _number(by_sensor[sensor])
    return camera.reprojection.held_out_rms_px if camera and camera.reprojection else None


def _lens(camera: Camera | None) -> KnownLens | None:
    if camera is None or camera.covariance is None:
        return None
    model = CAMERAS[camera.model]
    values = [camera.parameters[name].value for name in model.parameter_names]
    if None in values or set(camera.covariance.order) != set(model.parameter_names):
        return None
    at = [camera.covariance.order.index(name) for name in model.parameter_names]
    return KnownLens(model, np.array(values, float), np.array(camera.covariance.matrix, float)[np.ix_(at, at)])


def _seconds(result: Result, residuals: ResidualSet) -> Array:
    """Return the rows' times since the sensor's zero or first residual; as floats (to 256 ns), because a stranger's stamps may overflow."""
    firsts = [float(r.t_ns.min()) for r in result.residuals if r.sensor == residuals.sensor and len(r.t_ns) and "delay" not in r.context]
    zero = _zero(result, residuals.sensor)
    return (residuals.t_ns.astype(float) - (min(firsts, default=0.0) if zero is None else zero)) * 1e-9


def _zero(result: Result, sensor: str) -> float | None:
    """Return facts["t_zero_ns"][sensor], from where the stage counts its times."""
    by_sensor = result.facts.get("t_zero_ns")
    zero = by_sensor.get(sensor) if isinstance(by_sensor, Mapping) else None
    return float(zero) if isinstance(zero, int) and abs(zero) < 2**63 else None


def _bottom(result: Result, sensor: str) -> Bottom | None:
    """Return facts["v"][sensor] where it holds an offset and its interval, in order, and the rig does not mark it as not observable."""
    entry = result.rig.time_offsets.get(sensor)
    by_sensor = result.facts.get("v")
    found = by_sensor.get(sensor) if isinstance(by_sensor, Mapping) else None
    if not isinstance(found, Mapping) or (entry is not None and entry.offset.value is None):
        return None

    offset, low, high, second = (_number(found.get(key)) for key in ("offset", "low", "high", "second"))
    if offset is None or low is None or high is None or not low <= offset <= high or low == high:
        return None
    return Bottom(offset, low, high, second)


def _clock_line(result: Result, sensor: str) -> ClockLine | None:
    """Return facts["time_offset"][sensor]["clock"] where there is one and the stage gives the zero of its times."""
    found: object = result.facts
    for key in ("time_offset", sensor, "clock"):
        found = found.get(key) if isinstance(found, Mapping) else None
    if not isinstance(found, Mapping) or _zero(result, sensor) is None:
        return None
    told = found.get("jumps")
    told = [jump for jump in told if isinstance(jump, Mapping)] if isinstance(told, list) else []
    jumps = [(_number(jump.get("t")), _number(jump.get("size"))) for jump in told]
    known = tuple((t, size) for t, size in jumps if t is not None and size is not None)
    return ClockLine(_number(found.get("skew")) if found.get("drifts") is True else None, known)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and abs(value) < _ABSURD else None


def _frames(facts: Mapping[str, object], sensor: str, frame: NDArray[np.generic] | None) -> tuple[Index | None, tuple[str, ...]]:
    """Number the frames that occur 0..f-1 and name them by facts["frame_labels"][sensor], else by their number."""
    if frame is None:
        return None, ()
    by_sensor = facts.get("frame_labels")
    names = by_sensor.get(sensor) if isinstance(by_sensor, Mapping) else None
    numbers, index = np.unique(frame.astype(np.int64), return_inverse=True)
    known = names if isinstance(names, list | tuple) else []
    return index.reshape(-1), tuple(one_line(known[i], 60) if 0 <= i < len(known) else f"frame {i}" for i in numbers)
