"""What two sensors disagree in although an offset was found: how far they turn, the sign of an axis, the offset of single axes."""

import numpy as np

from calibkit.data.verdict import Verdict
from calibkit.estimation.alignment_axes import axis_offsets, length_of_axis, turned_by
from calibkit.estimation.time_offset import TimeOffsetFit
from calibkit.estimation.turn_comparison import raw_residuals
from calibkit.geometry.so3 import Array

_SCALE, _OTHER_UNIT = 0.03, 0.2  # of the turns' sizes
_SURE = 10.0  # sigmas
_ALIKE_IN_FORM = 0.5  # squared correlation; of strangers' turns no scale is told
_CONTRARY = 1.4  # of an axis' turns is left by a prediction of the wrong sign: 2; by one that has nothing to do with it, 1
_EXPLAINED = 0.3
_TURNING = 0.2  # of the liveliest axis' turns: about one that hardly turns there is noise alone
_APART = 16.0  # chi-squared of the axes' own offsets about their mean
_SAME_S = 1e-5  # axes may be so far apart: a gyroscope's integration leaves that at 4 rad/s, and a tenth of SCALES["s"] matters to nobody
INVERSE = "poses those of the world seen from the sensor (--inverse-poses)"


def unlike(fit: TimeOffsetFit) -> float:
    """Return the share of the turns, their mean rate apart, that the fit leaves."""
    left, turned = _left_of_turns(fit)
    return float(np.sum(left**2) / max(np.sum(turned**2), 1e-300))


def _left_of_turns(fit: TimeOffsetFit) -> tuple[Array, Array]:
    """Return what the fit leaves of the kept turns, and the turns less their stretch's median (n, d) rad."""
    a = fit.alignment
    left = [raw_residuals(part, a.track, a.R, a.shift(part.stretch.t))[0] for part in a.parts]
    angles = [part.stretch.turns.angle[:, part.stretch.axes] for part in a.parts]
    return np.concatenate(left), np.concatenate([angle - np.median(angle, axis=0) for angle in angles])


def scale(of: str, to: str, fit: TimeOffsetFit) -> list[tuple[Verdict, str]]:
    """Say so where one turns by more than the other: s = sum alpha . R beta / sum |R beta|^2 of whitened turns, for one axis |R|."""
    own, other = turned_by(fit.alignment)
    information = max(float(np.sum(other**2)), 1e-300)
    size = float(np.sum(own * other)) / information if len(fit.alignment.R) == 3 else length_of_axis(fit.alignment)
    sigma = np.sqrt(fit.covariance.variance_factor / information)
    alike = size**2 * information > _ALIKE_IN_FORM * float(np.sum(own**2)) or len(fit.alignment.R) == 1
    if not alike or size < _SURE * sigma or abs(size - 1) < max(_SCALE, _SURE * sigma, fit.noise_share):
        return []
    verdict = Verdict.FAIL if abs(np.log(size)) > _OTHER_UNIT else Verdict.CHECK
    degrees = abs(abs(np.log(size)) - np.log(180 / np.pi)) < _OTHER_UNIT
    cause = (
        "degrees taken for radians, or the other way round: check --gyro-unit"
        if degrees
        else "a gyroscope's scale or unit, or a wrong focal length; calibrate that first"
    )
    return [(verdict, f"{of} turns {size:.3g} times as far as {to}: {cause}")]


def contrary(of: str, to: str, fit: TimeOffsetFit) -> list[str]:
    """Say which axes the prediction makes worse while it explains others: a flipped sign that no rotation makes."""
    left, turned = _left_of_turns(fit)
    size = np.sqrt(np.maximum(np.mean(turned**2, axis=0), 1e-300))
    share = np.sqrt(np.mean(left**2, axis=0)) / size
    turning = size > _TURNING * size.max()
    worse = [axis for axis, each, turns in zip("xyz", share, turning, strict=False) if each > _CONTRARY and turns]
    if len(share) < 3 or not worse or share.min() > _EXPLAINED:
        return []
    axes = f"about {' and '.join(worse)} while it goes with it about the others"
    return [f"{of} turns against {to} {axes}: one axis or all three with a flipped sign, a left-handed frame, or {INVERSE}"]


def by_axis(fit: TimeOffsetFit) -> tuple[Array, Array]:
    """Return the offset that each measured axis of the turns has less the common one (d,) s, and their covariance (d, d) s^2."""
    off, cov = axis_offsets(fit.alignment)
    return off, cov * float(fit.covariance.corrected[0, 0] / fit.covariance.plain[0, 0]) * fit.covariance.variance_factor


def axes_apart(of: str, fit: TimeOffsetFit) -> list[str]:
    """Say so where the axes disagree: a rolling shutter, or poses that are wrong in a way that goes with the motion."""
    off, cov = by_axis(fit)
    information = np.linalg.inv(cov + _SAME_S**2 * np.eye(len(off)))
    apart = off - information.sum(axis=0) @ off / information.sum()
    if len(off) < 2 or float(apart @ information @ apart) < _APART:
        return []
    sigma = np.sqrt(np.diag(cov))
    each = ", ".join(f"{axis} {1e3 * (fit.td + d):+.2f} +- {1e3 * s:.2g}" for axis, d, s in zip("xyz", off, sigma, strict=True))
    return [f"the axes of {of} disagree: {each} ms: a rolling shutter, or poses whose errors go with the motion"]
