"""Two pose streams of one rig, on clocks that may differ, made pairs: P_i = T_w1_1 and Q_i = T_w2_2 of one instant or one rest each.

The stamps of the slower stream are moved to the faster one's clock, t_P = t_Q + dt, and the faster one is read there.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import Times
from calibkit.data.plural import counted
from calibkit.data.verdict import Reason
from calibkit.errors import BadInputError
from calibkit.estimation.hand_eye_data import HandEyeData
from calibkit.estimation.pose_interpolation import held, interpolate, without_repeats
from calibkit.estimation.pose_offset import ClockOffset, Settings, Streams
from calibkit.estimation.pose_rests import LEAST_REST_S, averaged, common_rests, distinct
from calibkit.geometry import so3
from calibkit.geometry.so3 import Array

Index = NDArray[np.intp]

_FEWEST = 3  # pairs
_FEWEST_RESTS = 6
_DISTINCT = np.radians(3.0)
_REST_SHARE = 0.5  # of the moving poses' spread that rests must hold
_MARGIN_SIGMAS = 3.0
_MOST_MARGIN_S = 0.1
_PATH_STEP_S = 0.25  # turns are added up over steps as long: noise adds little


@dataclass(frozen=True)
class Pairing:
    """Pairs in the order of time, and what was done to get them."""

    P: Array  # (n, 4, 4) T_w1_1
    Q: Array  # (n, 4, 4) T_w2_2
    cov_P: Array | None  # (n, 6, 6) right tangent: the stream's own, without `extra`
    cov_Q: Array | None
    extra: Array  # (n, 6, 6) of the stream that was read between its stamps: its curve, and the offset's sigma
    twist: Array  # (n, 6) (m/s, rad/s) of that stream in its own axes, 0 at rest
    read_P: bool  # P was read between its stamps, else Q
    t_P_ns: Times  # (n,) stamp of P's nearest pose; of a rest, of the one in the middle
    t_Q_ns: Times
    labels: tuple[str, ...]
    offset: ClockOffset
    kind: str  # "rests" or "moving"
    lines: tuple[str, ...]
    reasons: tuple[Reason, ...]

    @property
    def t_s(self) -> Array:
        """Seconds (n,) from the first pair."""
        t_ns = self.t_Q_ns if self.read_P else self.t_P_ns
        return np.asarray((t_ns - t_ns[0]) * 1e-9, np.float64)

    def data(self, setup: str, frames: tuple[str, str, str, str] | None = None) -> HandEyeData:
        """Return the hand-eye problem in one world; a side without covariance holds `extra` in the sigmas that its residuals tell."""
        cov_P, cov_Q = self.cov_P, self.cov_Q
        if self.read_P and cov_P is not None:
            cov_P = cov_P + self.extra
        if not self.read_P and cov_Q is not None:
            cov_Q = cov_Q + self.extra
        t_s = None if self.kind == "rests" else self.t_s
        return HandEyeData(setup, self.P, self.Q, cov_P, cov_Q, self.labels, t_s, frames=frames)


def pair_poses(both: Streams, settings: Settings) -> Pairing:
    """Return pairs of aligned streams; BadInputError where fewer than three are left."""
    names, slow, fast = f"{both.P.name} and {both.Q.name}", both.slow, both.fast
    on_fast = both.offset.on_fast(slow.t_ns, both.read_P)
    if on_fast[-1] < fast.t_ns[0] or on_fast[0] > fast.t_ns[-1]:
        if both.offset.known == "assumed":
            reason = "".join(f" ({line.rpartition(': ')[2]})" for line in both.lines[:1])
            text = f"{names} share no time by their stamps, and turn alike at no other offset of their clocks{reason}"
            raise BadInputError(f"{text}: they do not belong to one body, or to one recording of it")
        apart = f"{names} share no time at dt = {both.offset.dt:.6g} s"
        raise BadInputError(f"{apart}, the offset of their clocks as it was given: correct it, or leave it out to have it estimated")
    moving = _moving(both, on_fast, settings)
    still = _at_rest(both, on_fast) if settings.rests is not False else None
    chosen, why = _choose(moving, still, settings, names)
    ours, other = (chosen.slow_T, chosen.slow_cov, chosen.slow), (chosen.fast_T, chosen.fast_cov, chosen.fast)
    (T_P, cov_P, row_P), (T_Q, cov_Q, row_Q) = (other, ours) if both.read_P else (ours, other)
    t_P, t_Q = both.P.t_ns[row_P], both.Q.t_ns[row_Q]
    return Pairing(
        P=T_P,
        Q=T_Q,
        cov_P=cov_P,
        cov_Q=cov_Q,
        extra=chosen.extra,
        twist=chosen.twist,
        read_P=both.read_P,
        t_P_ns=t_P,
        t_Q_ns=t_Q,
        labels=_labels(both, row_P, row_Q),
        offset=both.offset,
        kind=chosen.kind,
        lines=(both.offset.told(both.P.name, both.Q.name), *both.lines, *why),
        reasons=both.reasons,
    )


@dataclass(frozen=True)
class _Pairs:
    """Pairs of one kind, `fast` read at or averaged to the slow stream's rows."""

    kind: str
    slow: Index  # (n,) rows of the slow stream
    slow_T: Array
    slow_cov: Array | None
    fast: Index  # (n,) rows of the fast stream: the nearest, of a rest the middle one
    fast_T: Array
    fast_cov: Array | None
    twist: Array
    extra: Array
    told: str


def _moving(both: Streams, on_fast: Times, settings: Settings) -> _Pairs:
    """Return pairs at the slow stream's own stamps, evenly spread over time and turning; held poses are none."""
    new, fast = ~held(both.slow), without_repeats(both.fast)
    at = interpolate(fast, on_fast[new])
    rows = np.flatnonzero(new)
    known = np.flatnonzero(at.known)
    taken = known[_spread_out(both.slow.t_ns[rows[known]], at.T[known], settings.most)]
    slow = both.slow.select(rows[taken])
    twist = at.twist[taken]
    extra = at.curve_cov[taken] + both.offset.sigma**2 * twist[:, :, None] * twist[:, None, :]
    told = f"{len(taken)} of {counted(len(new), 'pose')} of {slow.name} are paired in motion, {fast.name} read between its stamps"
    repeated, lost = len(new) - len(rows), len(rows) - len(known)
    why = [f"{lost} lie in its gaps or outside" if lost else "", f"{repeated} repeat the one before" if repeated else ""]
    why += [f"{len(known) - len(taken)} were thinned out" if len(taken) < len(known) else ""]
    told += "".join(f"; {text}" for text in why if text)
    cov = None if at.cov is None else at.cov[taken]
    nearest = _nearest(both.fast.t_ns, on_fast[rows[taken]])
    return _Pairs("moving", rows[taken], slow.T, slow.cov, nearest, at.T[taken], cov, twist, extra, told)


def _at_rest(both: Streams, on_fast: Times) -> _Pairs | None:
    """Return one pair for each rest, None where there is none."""
    slow = replace(both.slow, t_ns=on_fast)
    begin, end = common_rests(both.fast, slow, min(_MARGIN_SIGMAS * both.offset.sigma, _MOST_MARGIN_S))
    if not len(begin):
        return None
    still, moved = averaged(slow, begin, end), averaged(both.fast, begin, end)
    n = len(begin)
    told = (
        f"{counted(n, 'rest')} of {LEAST_REST_S:g} s or more are averaged, {np.median(still.count):.0f} poses of {slow.name} and "
        f"{np.median(moved.count):.0f} of {both.fast.name} each (median)"
    )
    return _Pairs("rests", still.middle, still.T, still.cov, moved.middle, moved.T, moved.cov, np.zeros((n, 6)), np.zeros((n, 6, 6)), told)


def _choose(moving: _Pairs, still: _Pairs | None, settings: Settings, names: str) -> tuple[_Pairs, list[str]]:
    """Return the pairs to use, and the choice in words."""
    n, m = len(moving.slow), 0 if still is None else len(still.slow)
    if max(n if not settings.rests else 0, m if settings.rests is not False else 0) < _FEWEST:
        kind = "rests in common" if settings.rests else "pairs"
        raise BadInputError(f"{names}: {m if settings.rests else max(n, m)} {kind} are too few: record both at once, 10 s or more")
    if still is None:
        return moving, [moving.told]
    different = distinct(still.fast_T, _DISTINCT)
    share = _spread(still.fast_T) / max(_spread(moving.fast_T), 1e-12) if n >= _FEWEST else 1.0
    holds = f"{different} of them differ by 3 deg or more and they hold {100 * min(share, 9.99):.0f} % of the moving poses' spread"
    if settings.rests or n < _FEWEST or (different >= _FEWEST_RESTS and share >= _REST_SHARE):
        return still, [f"{still.told}: {holds}, and what moves is left out"]
    return moving, [moving.told, f"{counted(m, 'rest')} are not enough by themselves: {holds}"]


def _spread(T: Array) -> float:
    """Return the mean square of the orientations' turns from their mean, rad^2, without that about the axis of most."""
    R = T[:, :3, :3]
    v = so3.log(so3.project(R.mean(axis=0)).T @ R)
    return float(np.linalg.eigvalsh(v.T @ v / len(v))[:2].sum())


def _spread_out(t_ns: Times, T: Array, most: int) -> Index:
    """Return up to `most` rows in equal steps of time and turning together, each as a share of its whole.

    Picking those that turn most from one another instead would pick the wrong poses first.
    """
    n = len(t_ns)
    if n <= most:
        return np.arange(n)
    t: Array = np.asarray((t_ns - t_ns[0]) * 1e-9, np.float64)
    knots = np.unique(np.searchsorted(t, np.arange(0, t[-1], _PATH_STEP_S)))
    turned = np.linalg.norm(so3.log(np.swapaxes(T[knots[:-1], :3, :3], 1, 2) @ T[knots[1:], :3, :3]), axis=1)
    path = np.interp(t, t[knots], np.concatenate([[0.0], np.cumsum(turned)]))
    along = t / t[-1] + path / max(path[-1], 1e-12)
    return np.unique(np.searchsorted(along, np.linspace(0, along[-1], most)).clip(0, n - 1))


def _nearest(stamps: Times, t_ns: Times) -> Index:
    """Return the rows of increasing stamps nearest to t_ns (n,)."""
    after = np.clip(np.searchsorted(stamps, t_ns), 1, len(stamps) - 1)
    return np.asarray(np.where(t_ns - stamps[after - 1] < stamps[after] - t_ns, after - 1, after))


def _labels(both: Streams, row_P: Index, row_Q: Index) -> tuple[str, ...]:
    """Return image names where a stream has them, else the slower stream's stamps in s."""
    for stream, rows in ((both.Q, row_Q), (both.P, row_P)):
        if stream.labels:
            return tuple(stream.labels[i] for i in rows)
    return tuple(f"{t * 1e-9:.3f} s" for t in both.slow.t_ns[row_Q if both.read_P else row_P].tolist())
