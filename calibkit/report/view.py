"""One residual set made ready to be read: rows with a prediction only, frames numbered and named, the image they lie in."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from calibkit.data.result import ResidualSet, Result
from calibkit.data.rig import ImuAxis, Noise
from calibkit.errors import one_line

Array = NDArray[np.float64]
Index = NDArray[np.intp]
T = TypeVar("T")

_ABSURD = 1e9  # in any unit: larger residuals mean nothing, and their squares would overflow


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
    n_lost: int = 0  # rows that have no prediction (behind the camera, outside the model's domain)

    @property
    def name(self) -> str:
        return f"{self.sensor} ({self.stage})"

    def has(self, needs: frozenset[str]) -> bool:
        """Whether something was kept and everything that `needs` names was recorded."""
        return bool(self.kept.any()) and all(getattr(self, need) is not None for need in needs)

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
    good = np.all(np.abs(residuals.raw) < _ABSURD, axis=1)  # NaN is not
    if "axis" in context:
        good &= np.isin(context["axis"], np.arange(len(get_args(ImuAxis))))
    for key in ("tau", "deviation", "fitted", "low", "high"):  # drawn in logarithms
        if key in context:
            value = context[key].astype(float)
            good &= np.isfinite(value) & (value > 0)
    if "uv" in context:
        good &= np.all(np.isfinite(context["uv"].astype(float)), axis=1)

    def column(key: str) -> NDArray[np.generic] | None:
        return context[key][good] if key in context else None

    def floats(key: str, width: int | None = None) -> Array | None:
        found = column(key)
        return None if found is None or (width and found.shape[1:] != (width,)) else found.astype(float)

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
        held_out_rms=camera.reprojection.held_out_rms_px if camera and camera.reprojection else None,
        n_lost=int(np.sum(~good)),
        noise=result.rig.imus[residuals.sensor].noise if residuals.sensor in result.rig.imus else {},
        axis=None if axis is None else axis.astype(np.intp),
        tau=floats("tau"),
        deviation=floats("deviation"),
        fitted=floats("fitted"),
        low=floats("low"),
        high=floats("high"),
        attitude=floats("attitude", 3),
    )


def _frames(facts: Mapping[str, object], sensor: str, frame: NDArray[np.generic] | None) -> tuple[Index | None, tuple[str, ...]]:
    """Number the frames that occur 0..f-1 and name them by facts["frame_labels"][sensor], else by their number."""
    if frame is None:
        return None, ()
    by_sensor = facts.get("frame_labels")
    names = by_sensor.get(sensor) if isinstance(by_sensor, Mapping) else None
    numbers, index = np.unique(frame.astype(np.int64), return_inverse=True)
    known = names if isinstance(names, list | tuple) else []
    return index.reshape(-1), tuple(one_line(known[i], 60) if 0 <= i < len(known) else f"frame {i}" for i in numbers)
