"""What differs between two calibrations of one rig, and which differences are more than their uncertainties explain.

Both come from recordings of their own: the covariance of a change is the sum of both. An entry is judged as a whole, by
d^T (C_old + C_new)^-1 d, and entries are called changed by Holm's rule (1979), so that of two calibrations of the same rig one in a hundred
has any entry called so.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc, gammaln, ndtri

from calibkit.data.rig import Camera, Imu, ImuIntrinsics, Rig, TimeOffset, Transform
from calibkit.estimation.model_conversion import convert
from calibkit.estimation.pixel_grid import grid
from calibkit.estimation.rig_makers import shared_recordings
from calibkit.estimation.rig_values import Values, named_as, of_estimates, of_transform
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CAMERAS

FALSE_ALARM = 0.01  # family-wise: of any entry of the file
_NO_DIRECTION = 1e-12  # of a correlation matrix: below, rounding
_MISFIT = 0.3  # of the sigma of a pixel: how well one lens model must hold the other for their difference to be judged
_STARTS_ANEW = ("b_a_", "b_g_")  # an IMU's biases, which change from start to start
_DENSITIES = ("gyro_noise_density", "gyro_random_walk", "accel_noise_density", "accel_random_walk")
_NOISE = ("white", "flicker", "walk", "quantisation", "ramp")


@dataclass(frozen=True)
class Change:
    """One parameter then and now; None where a file does not know it."""

    name: str
    unit: str
    old: float | None
    new: float | None
    sigma: float | None  # of new - old
    note: str = ""

    @property
    def change(self) -> float | None:
        return None if self.old is None or self.new is None else self.new - self.old

    @property
    def z(self) -> float | None:
        return None if self.change is None or not self.sigma else self.change / self.sigma


@dataclass(frozen=True)
class EntryChange:
    """One entry of the rig then and now, judged as a whole."""

    name: str  # cam0, T_cam0_imu0, dt_imu0_cam0, imu0
    what: str  # lens, line delay, transform, time offset, noise, scale and axes
    parameters: tuple[Change, ...]
    chi2: float | None = None  # None: there is no sigma, or nothing to compare
    freedom: int = 0
    changed: bool = False
    same: bool = False  # to the last digit, the sigmas too
    notes: tuple[str, ...] = ()

    @property
    def p(self) -> float | None:
        """Return how often chance alone does as much."""
        return None if self.chi2 is None else float(chdtrc(self.freedom, self.chi2))

    @property
    def z(self) -> float | None:
        """Return p as the sigmas of one normal number, two-sided."""
        return None if self.chi2 is None else _sigmas(self.chi2, self.freedom)


@dataclass(frozen=True)
class Difference:
    """All entries that both rigs have, and the names of those, and of their parts, that only one has."""

    entries: tuple[EntryChange, ...]
    only_old: tuple[str, ...]
    only_new: tuple[str, ...]
    new: Rig  # its transforms and time offsets named as the old one's
    notes: tuple[str, ...] = ()

    @property
    def changed(self) -> bool:
        return any(entry.changed for entry in self.entries)


def difference(old: Rig, new: Rig) -> Difference:
    """Compare every entry that both have."""
    turned = named_as(old, new)
    entries, only_old, only_new = list[EntryChange](), list[str](), list[str]()
    for section, compare in _SECTIONS.items():
        before, after = getattr(old, section), getattr(turned, section)
        both = [name for name in before if name in after]
        entries += [found for name in both for found in compare(name, before[name], after[name])]
        only_old += [name for name in before if name not in after]
        only_new += [name for name in after if name not in before]
        if section in _PARTS:
            only_old += [part for name in both for part in _PARTS[section](name, before[name], after[name])]
            only_new += [part for name in both for part in _PARTS[section](name, after[name], before[name])]
    return Difference(_holm(entries), tuple(only_old), tuple(only_new), turned, _same_recording(old, new, entries))


def _holm(entries: list[EntryChange]) -> tuple[EntryChange, ...]:
    """Return the entries, those marked that changed: in rising order of p, while p is below FALSE_ALARM over the number left."""
    judged = sorted((i for i, entry in enumerate(entries) if entry.p is not None), key=lambda i: entries[i].p or 0.0)
    out = list(entries)
    for k, i in enumerate(judged):
        if (entries[i].p or 0.0) > FALSE_ALARM / (len(judged) - k):
            break
        out[i] = replace(entries[i], changed=True)
    return tuple(out)


def _judged(name: str, what: str, old: Values, new: Values, notes: tuple[str, ...] = ()) -> EntryChange:
    """Compare the numbers that both have, and judge those together that both know and one has a sigma of."""
    old, new = (values.of(key for key in old.names if key in new.names) for values in (old, new))
    same = old.x.tobytes() == new.x.tobytes() and np.array_equal(old.cov, new.cov)
    cov = old.cov + new.cov
    sigma, d = np.sqrt(np.diag(cov)), new.x - old.x
    changes = tuple(
        Change(
            key,
            old.units[i],
            None if np.isnan(old.x[i]) else float(old.x[i]),
            None if np.isnan(new.x[i]) else float(new.x[i]),
            float(sigma[i]) if sigma[i] > 0 and np.isfinite(d[i]) else None,
            _note(key, old, new, i),
        )
        for i, key in enumerate(old.names)
    )
    use = np.array([np.isfinite(d[i]) and sigma[i] > 0 and not key.startswith(_STARTS_ANEW) for i, key in enumerate(old.names)], bool)
    if same:
        return EntryChange(name, what, changes, same=True, notes=(*notes, "the same in both: taken over, not measured anew"))
    if not use.any():
        unjudged = "neither file has a sigma: not judged" if np.isfinite(d).any() else "not observable: nothing to compare"
        return EntryChange(name, what, changes, notes=(*notes, unjudged))
    chi2, freedom = _chi_squared(d[use], cov[np.ix_(use, use)])
    return EntryChange(name, what, changes, chi2, freedom, notes=(*notes, *_one_sided(old, new, use)))


def _note(key: str, old: Values, new: Values, i: int) -> str:
    gone = [file for file, values in (("OLD", old), ("NEW", new)) if np.isnan(values.x[i])]
    if gone:
        return f"not observable in {' and '.join(gone)}"
    if key.startswith(_STARTS_ANEW):
        return "changes from start to start: not judged"
    silent = [file for file, values in (("OLD", old), ("NEW", new)) if values.cov[i, i] == 0]
    return f"no sigma in {' and '.join(silent)}" if silent else ""


def _one_sided(old: Values, new: Values, use: Array) -> Iterator[str]:
    for file, values in (("OLD", old), ("NEW", new)):
        if not np.diag(values.cov)[use].any():
            yield f"{file} has no sigma: it is taken as exact"


def _chi_squared(d: Array, cov: Array) -> tuple[float, int]:
    """Return d^T cov^-1 d and its degrees of freedom, without the directions that have no variance of their own."""
    sigma = np.sqrt(np.diag(cov))
    values, vectors = np.linalg.eigh(cov / sigma / sigma[:, None])
    known = values > _NO_DIRECTION * len(d)
    whitened = (vectors.T @ (d / sigma))[known] / np.sqrt(values[known])
    return float(whitened @ whitened), int(known.sum())


def _sigmas(chi2: float, freedom: int) -> float:
    """Return z with P(|N(0, 1)| > z) = P(chi-squared > chi2); from the leading terms of both tails where p underflows."""
    if freedom == 1:
        return float(np.sqrt(chi2))
    p = chdtrc(freedom, chi2)
    if p > 1e-290:
        return float(-ndtri(p / 2))
    log_p = (freedom / 2 - 1) * np.log(chi2 / 2) - chi2 / 2 - gammaln(freedom / 2)
    z = float(np.sqrt(-2 * log_p))
    for _ in range(5):  # 2 phi(z) / z = p
        z = float(np.sqrt(-2 * (log_p + np.log(z) + 0.5 * np.log(np.pi / 2))))
    return z


def _cameras(name: str, old: Camera, new: Camera) -> Iterator[EntryChange]:
    if tuple(old.resolution) != tuple(new.resolution):
        sizes = " and ".join(f"{camera.resolution[0]}x{camera.resolution[1]}" for camera in (old, new))
        yield EntryChange(name, "lens", (), changed=True, notes=(f"images of {sizes}: nothing of the lens can be compared",))
        return
    if old.model == new.model:
        yield _judged(name, "lens", _lens(old), _lens(new))
    else:
        yield _other_model(name, old, new)
    if old.line_delay is not None and new.line_delay is not None:
        yield _judged(name, "line delay", of_estimates({"line_delay": old.line_delay}), of_estimates({"line_delay": new.line_delay}))


def _lens(camera: Camera) -> Values:
    names = CAMERAS[camera.model].parameter_names
    return of_estimates({name: camera.parameters[name] for name in names}, camera.covariance)


def _other_model(name: str, old: Camera, new: Camera) -> EntryChange:
    """Judge lenses of two models in the terms of the one with more parameters, where that can hold the other."""
    pair = {"OLD": old, "NEW": new}
    file, less = min(pair.items(), key=lambda item: len(item[1].parameters))
    more = new if less is old else old
    told = f"{old.model} then, {new.model} now"
    mine, whole = _lens(less), _lens(more)
    if np.isnan(mine.x).any() or np.isnan(whole.x).any():
        return EntryChange(name, "lens", (), notes=(told, "not observable in part: nothing to compare"))
    source, target = CAMERAS[less.model], CAMERAS[more.model]
    found = convert(source, mine.x, less.resolution, target)
    rays, valid = source.unproject(grid(less.resolution), mine.x)
    J_source, J_target = (
        np.nan_to_num(model.project(rays[valid], x, jacobians=True).J_params).reshape(-1, len(x))  # type: ignore[arg-type]
        for model, x in ((source, mine.x), (target, found.params))
    )
    carry = np.linalg.lstsq(J_target, J_source, rcond=None)[0]  # the nearest of the one model to the other's small changes
    carried = replace(whole, x=found.params, cov=carry @ mine.cov @ carry.T)
    told = f"{told}; {file} as {more.model} is off by {found.rms_px:.2g} px rms"
    cov = whole.cov + carried.cov
    J = J_target.reshape(-1, 2, len(found.params))
    sigma_px = np.sqrt(np.mean(np.einsum("gik,kl,gil->g", J, cov, J)))
    entry = _judged(name, "lens", *((carried, whole) if less is old else (whole, carried)), notes=(told,))
    if found.rms_px > _MISFIT * sigma_px or found.lost:
        unlike = "the models themselves differ by more than a pixel is known to: not judged, see the pixel shift"
        return replace(entry, chi2=None, notes=(told, unlike))
    return entry


def _transforms(name: str, old: Transform, new: Transform) -> Iterator[EntryChange]:
    r_old = so3.log(np.array(old.matrix)[:3, :3])
    yield _judged(name, "transform", of_transform(old), of_transform(new, r_old))


def _time_offsets(name: str, old: TimeOffset, new: TimeOffset) -> Iterator[EntryChange]:
    yield _judged(name, "time offset", of_estimates({"offset": old.offset}), of_estimates({"offset": new.offset}))


def _imus(name: str, old: Imu, new: Imu) -> Iterator[EntryChange]:
    before, after = (_noise(imu, by_axis=bool(old.noise and new.noise)) for imu in (old, new))
    if set(before.names) & set(after.names):
        yield _judged(name, "noise", before, after)
    if old.intrinsics is not None and new.intrinsics is not None:
        yield _scale_and_axes(name, old.intrinsics, new.intrinsics)


def _noise(imu: Imu, by_axis: bool) -> Values:
    """Return the coefficients of all axes, or the four densities, which are made of them."""
    if by_axis:
        found = {f"{axis} {key}": getattr(noise, key) for axis, noise in imu.noise.items() for key in _NOISE}
    else:
        found = {key: getattr(imu, key) for key in _DENSITIES}
    return of_estimates({key: estimate for key, estimate in found.items() if estimate is not None})


def _scale_and_axes(name: str, old: ImuIntrinsics, new: ImuIntrinsics) -> EntryChange:
    if old.unit != new.unit:
        return EntryChange(name, "scale and axes", (), notes=(f"{old.unit} then, {new.unit} now: nothing to compare",))
    before, after = (of_estimates(intrinsics.parameters, intrinsics.covariance) for intrinsics in (old, new))
    return _judged(name, "scale and axes", before, after)


def _camera_parts(name: str, one: Camera, other: Camera) -> Iterator[str]:
    if one.line_delay is not None and other.line_delay is None:
        yield f"{name}'s line delay"


def _imu_parts(name: str, one: Imu, other: Imu) -> Iterator[str]:
    mine, its = (_noise(imu, by_axis=bool(one.noise and other.noise)) for imu in (one, other))
    yield from _names(name, "noise", mine.names, its.names)
    mine_, its_ = ([] if imu.intrinsics is None else list(imu.intrinsics.parameters) for imu in (one, other))
    yield from _names(name, "scale and axes", mine_, its_)


def _names(entry: str, what: str, mine: Sequence[str], its: Sequence[str]) -> Iterator[str]:
    """Yield the numbers that one alone has, all as one where the other has none."""
    yield from (f"{entry}'s {key}" for key in mine if key not in its) if its or not mine else [f"{entry}'s {what}"]


def _same_recording(old: Rig, new: Rig, entries: Iterable[EntryChange]) -> tuple[str, ...]:
    """Say so where entries were made from one recording: their errors are shared, and the sigma of a change is too large."""
    names = {_KEYS[entry.what].format(entry.name): entry.name for entry in entries if entry.chi2 is not None}
    shared = shared_recordings(old, new, names)
    said = []
    for recording, keys in shared.items():
        which = list(dict.fromkeys(names[key] for key in keys))
        of = "" if len(keys) == len(names) else f" ({', '.join(which)})"
        said.append(f"both were made from {recording}{of}: errors in common cancel, and what differs is judged too mildly")
    return tuple(said)


_KEYS = {  # of what a stage made
    "lens": "cameras.{}",
    "line delay": "cameras.{}",
    "transform": "transforms.{}",
    "time offset": "time_offsets.{}",
    "noise": "imus.{}.noise",
    "scale and axes": "imus.{}.intrinsics",
}
_PARTS: Mapping[str, Callable[[str, Any, Any], Iterator[str]]] = {"cameras": _camera_parts, "imus": _imu_parts}  # what one alone may have
_SECTIONS: Mapping[str, Callable[[str, Any, Any], Iterator[EntryChange]]] = {
    "cameras": _cameras,
    "transforms": _transforms,
    "time_offsets": _time_offsets,
    "imus": _imus,
}
