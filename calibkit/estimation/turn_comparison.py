"""Turns of one sensor laid against the orientation of another: alpha = R beta(t + shift) + c duration + noise, R and c eliminated.

Each stretch of some seconds has a bias c of its own: it takes up what drifts slowly (a gyroscope's bias, an odometry's heading, a
lens that is slightly wrong), which tells nothing of the clocks. Whitened and with the bias projected out, stretches simply add up.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import Times
from calibkit.data.plural import counted
from calibkit.estimation.orientation_track import OrientationTrack
from calibkit.estimation.turn_noise import NoiseLevels, TurnNoise, Whitener, turn_noise
from calibkit.estimation.turns import Turns
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

STRETCH_S = 5.0
LEAST_TURNS = 8  # in a stretch
FEWEST_TURNS = 20  # that can be compared
_UNEVEN = 0.5  # of the time the track must be known for as long as a turn takes
TILT = 0.5  # rad; what a rotation that nothing tells may be off by: keeps its elimination finite

Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Stretch:
    """Some seconds of turns."""

    turns: Turns
    origin_ns: int  # of the track
    free_bias: bool = True

    @cached_property
    def t(self) -> Array:
        """Return its stamps (m,) in s of the track's time, before any shift."""
        return _seconds(self.turns.t_ns, self.origin_ns)

    @property
    def middle(self) -> Array:
        """Return the middle of each turn (n,) s."""
        return (self.t[self.turns.first] + self.t[self.turns.last]) / 2

    @property
    def axes(self) -> NDArray[np.intp]:
        return np.flatnonzero(self.turns.axes)

    @property
    def drift(self) -> Array:
        """Return what a bias adds to its turns, (rows, d); without columns where it has none."""
        d = len(self.axes)
        columns = (self.turns.duration[:, None, None] * np.eye(d)).reshape(-1, d)
        return columns if self.free_bias else columns[:, :0]

    def beta(self, track: OrientationTrack, shift: Array) -> Array:
        """Return the track's turns (n, k, 3) between stamps shifted by `shift` (m, k) s."""
        q = track.orientation(self.t[:, None] + shift)
        return so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[self.turns.first]), q[self.turns.last]))

    def left(self, track: OrientationTrack, R: Array, shift: Array) -> Array:
        """Return alpha - R beta (n, k, d) rad for stamps shifted by `shift` (m, k) s."""
        return np.asarray(self.turns.angle[:, None, self.axes] - self.beta(track, shift) @ R.T, np.float64)

    def noise(self, track: OrientationTrack, R: Array, shift: Array, shape: Array) -> TurnNoise:
        """Return the noise of its turns, its sensor turning at R omega."""
        omega = np.zeros((len(self.t), 3))
        omega[:, self.axes] = track.rate_at(self.t + shift) @ R.T
        return turn_noise(self.turns, omega, shape)


@dataclass(frozen=True)
class Weighed:
    """A stretch with its noise whitened: columns come out with unit variance and without the bias."""

    stretch: Stretch
    whiten: Whitener
    bias: Array  # (rows, d) orthonormal: what the whitened bias spans
    root: Array  # (d, d): bias @ root is the whitened bias

    @property
    def own(self) -> Array:
        """Return its turns (rows,), clean."""
        return self.clean(self.stretch.turns.angle[:, self.stretch.axes])

    def clean(self, x: Array) -> Array:
        """Return whitened columns for x (n, d, ...), as (rows, ...), with the bias taken out."""
        rows = self.whiten(x.reshape(x.shape[0] * x.shape[1], -1))
        rows -= self.bias @ (self.bias.T @ rows)
        return rows.reshape(rows.shape[0], *x.shape[2:])


def split(turns: Turns, origin_ns: int, free_bias: bool = True) -> list[Stretch]:
    """Return the turns in stretches of about 5 s, at times from `origin_ns`; those with few turns are joined to the one before."""
    start = _seconds(turns.t_ns[turns.first], origin_ns)
    number = ((start - start[0]) / STRETCH_S).astype(np.int64)
    ends = [0]
    for edge in (*(np.flatnonzero(np.diff(number)) + 1).tolist(), len(number)):
        if edge - ends[-1] >= LEAST_TURNS:
            ends.append(edge)
    ends = [*(ends[:-1] if len(ends) > 1 else ends), len(number)]
    parts = [turns.select(slice(a, b)) for a, b in pairwise(ends)]
    return [Stretch(part, origin_ns, free_bias) for part in parts]


def _seconds(t_ns: Times, origin_ns: int) -> Array:
    return np.asarray((t_ns - origin_ns) * 1e-9, np.float64)


def weigh(stretch: Stretch, noise: TurnNoise, levels: NoiseLevels) -> Weighed:
    """Return the stretch with its noise whitened."""
    whiten = noise.whitener(levels)
    return Weighed(stretch, whiten, *np.linalg.qr(whiten(stretch.drift)))


def raw_residuals(part: Weighed, track: OrientationTrack, R: Array, shift: Array) -> tuple[Array, Array]:
    """Return alpha - R beta - c duration (n, d) rad at one shift (m,), and the bias c (d,) rad/s."""
    left = part.stretch.left(track, R, shift[:, None])[:, 0]
    if not len(part.root):
        return left, np.zeros(left.shape[1])
    c = np.linalg.solve(part.root, part.bias.T @ part.whiten(left.reshape(-1, 1)))[:, 0]
    return left - part.stretch.turns.duration[:, None] * c, c


def residuals(part: Weighed, track: OrientationTrack, R: Array, shift: Array) -> Array:
    """Return whitened residuals (rows, k) for shifts (m, k)."""
    return part.clean(part.stretch.left(track, R, shift).swapaxes(1, 2))


def linearised(part: Weighed, track: OrientationTrack, R: Array, shift: Array, by_axis: bool = False) -> Array:
    """Return whitened columns (rows, 5) at one shift (m,): what rotation (3) and offset move predictions by, and the residuals.

    `by_axis`: with an offset for each of the d axes that are measured, (rows, 4 + d).

    R -> exp(hat(d)) R moves R beta by -hat(R beta) d; of a sensor with one axis R is that axis (1, 3), free in length, and moves by d.
    d beta / d shift = J_r(beta)^-1 omega_last - J_l(beta)^-1 omega_first.
    """
    stretch = part.stretch
    turned = stretch.beta(track, shift[:, None])[:, 0]
    predicted = turned @ R.T
    tilt = -so3.hat(predicted) if len(R) == 3 else turned[:, None]
    rate = track.rate_at(stretch.t + shift)[..., None]
    inverse = so3.right_jacobian_inverse(turned)
    slope = R @ (inverse @ rate[stretch.turns.last] - np.swapaxes(inverse, 1, 2) @ rate[stretch.turns.first])
    left = (stretch.turns.angle[:, stretch.axes] - predicted)[..., None]
    together: Array = np.concatenate([tilt, slope * np.eye(len(R)) if by_axis else slope, left], axis=2)
    return part.clean(together)


def moved(R: Array, d: Array) -> Array:
    """Return the rotation, or the one axis, moved by d (3,)."""
    return so3.exp(d) @ R if len(R) == 3 else R + d


def usable(turns: Turns, track: OrientationTrack, low: float, high: float) -> Mask:
    """Return the turns (n,) over which the track is known throughout, for every shift of low to high s of their stamps."""
    start, stop, inside = _spanned(turns, track, low, high)
    return np.asarray(inside & (track.unknown[stop] == track.unknown[start]), np.bool_)


def lost_to_gaps(turns: Turns, track: OrientationTrack, low: float, high: float) -> float:
    """Return the share of the turns within the track's span that are not usable: gaps of its samples take them."""
    start, stop, inside = _spanned(turns, track, low, high)
    return float(np.mean((track.unknown[stop] != track.unknown[start])[inside])) if inside.any() else 0.0


def why_so_few(turns: Turns, track: OrientationTrack, reach: float) -> str:
    """Say why hardly a turn can be compared, at whatever offset."""
    if (many := len(turns.first)) < FEWEST_TURNS <= len(turns.t_ns):
        return (
            f"only {counted(many, 'turn')} of the first could be told from its {len(turns.t_ns)} stamps: "
            "poses that come steadily are needed; "
            "a camera without a board must also move, before near things full of texture (or give --target, --plain)"
        )
    if len(turns.first) and track.followed(float(np.median(turns.duration)) + 2 * reach) < _UNEVEN:
        return (
            "the samples of the second come too unevenly to follow it through the turns of the first: "
            "record it without losses, with the sensor's own stamps"
        )
    return "they share too little time to be compared: record both at once, 10 s or more"


def _spanned(turns: Turns, track: OrientationTrack, low: float, high: float) -> tuple[Index, Index, Mask]:
    """Return the track's grid points about each turn (n,) for every shift of low to high s, and whether it has them."""
    t, last = _seconds(turns.t_ns, track.origin_ns), len(track.unknown) - 1
    start = np.floor(track.grid.place(t[turns.first] + low)).astype(np.intp)
    stop = np.ceil(track.grid.place(t[turns.last] + high)).astype(np.intp)
    return np.clip(start, 0, last), np.clip(stop, 0, last), (start >= 0) & (stop <= last)
