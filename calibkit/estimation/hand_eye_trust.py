"""How far X may be trusted: covariance, what the poses leave open and which to add in words, what more would bring, a suspected lag."""

from dataclasses import dataclass

import numpy as np

from calibkit.estimation.hand_eye_data import HandEyeData
from calibkit.estimation.hand_eye_refine import SCALES, Normal, Refined, believed, normal
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array
from calibkit.solver import trust

TILT = np.deg2rad(30.0)
SHIFT = 0.2  # m
MORE = 10  # poses that advice reckons with
_MOST_BLOCKS = 200
_LITTLE = 1e-12  # information that keeps what no pose tells of finite
_PURE = 0.1  # of a direction of unit length: less than this is not in it
_SAME_AXIS = 0.98
_MOST_ADVICE = 3
_LAG_SIGMAS = 5.0
_NEIGHBOURS = 0.5  # s, between whose poses there is a velocity


@dataclass(frozen=True)
class Open:
    """A direction of X that the poses tell little or nothing of."""

    text: str  # "p of T_gripper_cam along the gripper's (0.1, 0.9, 0.3)"
    sigma: float  # in 1 mm and 1 mrad
    grade: trust.Grade
    vector: Array  # (6,) of unit length in X's right tangent, m and rad


@dataclass(frozen=True)
class Advice:
    """Poses to add and what ten of them would do to the weakest direction."""

    text: str
    sigma: float  # today, in 1 mm and 1 mrad
    sigma_then: float


@dataclass(frozen=True)
class Lag:
    """dt_1_2, t_1 = t_2 + dt_1_2, that the residuals call for: they grow with speed."""

    dt: float  # s
    sigma: float
    share: float  # of chi-squared that it explains


@dataclass(frozen=True)
class Trust:
    """All that the information says."""

    cov_X: Array  # (6, 6) right tangent, corrected
    plain_X: Array
    cov_Z: Array  # of the first world
    plain_Z: Array
    open: tuple[Open, ...]  # the weakest first
    advice: tuple[Advice, ...]
    both: Array  # (12, 12) covariance of (x, z of the largest world)
    inflation: float  # mean of corrected over plain variance

    def predict(self, poses: Array) -> Array:
        """Return X's covariance (6, 6) with more poses of information (12, 12)."""
        return _with(self.both, poses)[:6, :6] * self.inflation


def judge(data: HandEyeData, fit: Refined) -> Trust:
    """Return the covariance and what follows from it; along what is not told apart from noise it is that of 10 m and 10 rad."""
    known, system = believed(data, fit.C, fit.C_P, fit.kept, normal(data, fit.M, fit.C, fit.e, fit.kept))
    white, corrected = _sandwich(data, fit, system)
    corrected = corrected * _few(fit.freedom)
    follow = np.concatenate([np.eye(6), system.follow[0]])
    extra = follow @ (known - system.cov) @ follow.T
    plain, cov = white + extra, corrected + extra
    X, Z = slice(0, 6), slice(6, 12)
    k = system.free.shape[1]
    inflation = float(np.trace(system.S @ corrected[X, X])) / k if k else 1.0
    largest = int(np.argmax(np.bincount(data.world, fit.kept, data.n_worlds)))
    follow = np.concatenate([np.eye(6), system.follow[largest]])
    both = follow @ known @ follow.T
    both[6:, 6:] += np.linalg.inv(system.A[largest])
    leaves_open = open_directions(data, fit.X, cov[X, X])
    advice = _advice(data, fit, both, largest) if leaves_open else ()
    return Trust(cov[X, X], plain[X, X], cov[Z, Z], plain[Z, Z], leaves_open, advice, both, inflation)


def _few(freedom: int) -> float:
    """Return the variance of Student's t for either kind of noise, rotation and translation, told by half of the residuals."""
    return freedom / (freedom - 4) if freedom > 4 else 1.0


def _sandwich(data: HandEyeData, fit: Refined, system: Normal) -> tuple[Array, Array]:
    """Return the covariance (12, 12) of what is free of x, and of the first z, for white residuals and for residuals as they are.

    Of more worlds than one, each is a block about x alone.
    """
    used = np.flatnonzero(fit.kept & system.active)
    one, free = data.n_worlds == 1, system.free
    k = free.shape[1]
    given_x = np.zeros((12, 12))
    if one:
        J = np.concatenate([-np.broadcast_to(free, (len(used), 6, k)), system.J_Z[used] * SCALES], axis=2)
        back = np.block([[free, np.zeros((6, 6))], [np.zeros((6, k)), np.diag(SCALES)]])
    else:
        J, back = system.J_X[used] @ free, np.concatenate([free, system.follow[0] @ free])
        given_x[6:, 6:] = np.linalg.inv(system.A[0])
    if J.shape[2] == 0 or len(used) == 0:
        return given_x, given_x
    JW = np.swapaxes(J, 1, 2) @ np.linalg.inv(fit.C[used])
    S, scores = JW @ J, (JW @ fit.e[used][:, :, None])[:, :, 0]
    units, prior = np.ones(J.shape[2]), _LITTLE * np.eye(J.shape[2])
    if data.t_s is not None and one:
        found = trust.covariance_in_time(S, scores, data.t_s[used], 1.0, units, prior)
    else:
        block = np.arange(len(used)) if one else np.unique(data.world[used], return_inverse=True)[1]
        count = int(block.max()) + 1
        block = block * min(count, _MOST_BLOCKS) // count
        count = int(block.max()) + 1
        S_blocks, g_blocks = np.zeros((count, *S.shape[1:])), np.zeros((count, S.shape[-1]))
        np.add.at(S_blocks, block, S)
        np.add.at(g_blocks, block, scores)
        found = trust.covariance(S_blocks, g_blocks, 1.0, units, prior, least=min(1.0, trust.FEW_BLOCKS / count))
    return back @ found.plain @ back.T + given_x, back @ found.corrected @ back.T + given_x


def open_directions(data: HandEyeData, X: Array, cov_X: Array) -> tuple[Open, ...]:
    """Return what is not observable and what is weak, in words, the weakest first."""
    found = trust.directions(cov_X, SCALES)
    out: list[Open] = []
    for grade in ("not observable", "weak"):
        those = [d for d in found if d.grade == grade]
        if those:
            out += _named(data, X, np.stack([d.vector for d in those], axis=1), cov_X, grade)
    return tuple(out)


def _named(data: HandEyeData, X: Array, basis: Array, cov_X: Array, grade: trust.Grade) -> list[Open]:
    """Return the directions of a subspace (6, k) apart: those of p alone, and turns, with p where it goes with them."""
    one, two, _, _ = data.words.frames
    name, R = f"T_{one}_{two}", X[:3, :3]
    _, s, Vt = np.linalg.svd(basis[3:])
    columns, turns = (basis @ Vt.T).T, np.append(s, np.zeros(len(Vt)))[: len(Vt)] > _PURE
    p_alone = columns[~turns, :3]
    # What p alone may do anyway is no part of a turn.
    across = np.eye(3) - p_alone.T @ np.linalg.pinv(p_alone.T)
    out = []
    for v, turn in zip(columns, turns, strict=True):
        follows = ", and p with it" if np.linalg.norm(across @ v[:3]) > _PURE else ""
        text = f"R of {name} about {_axis_of(one, R @ v[3:])}{follows}" if turn else f"p of {name} along {_axis_of(one, R @ v[:3])}"
        out.append(Open(text, float(np.sqrt(v / SCALES @ cov_X @ (v / SCALES))), grade, v))
    return sorted(out, key=lambda direction: -direction.sigma)


def _axis_of(frame: str, v: Array) -> str:
    v = v / max(float(np.linalg.norm(v)), 1e-300)
    i = int(np.argmax(np.abs(v)))
    if abs(v[i]) > _SAME_AXIS:
        return f"the {frame}'s {'xyz'[i]} axis"
    v = v * np.sign(v[i])
    return f"the {frame}'s ({v[0]:.1f}, {v[1]:.1f}, {v[2]:.1f})".replace("-0.0", "0.0")


def moved(data: HandEyeData, fit: Refined, world: int, step: Array) -> Array:
    """Return M (k, 4, 4) where the mover is moved by steps (k, 6) in its own frame from its middle pose."""
    own = np.flatnonzero(fit.kept & (data.world == world))
    own = own if len(own) else np.arange(len(data.P))
    turn = so3.log(so3.project(fit.M[own, :3, :3].sum(axis=0)).T @ fit.M[own, :3, :3])
    middle = fit.M[own[np.argmin(np.linalg.norm(turn, axis=1))]]
    Z = fit.Z[world]
    P = Z @ middle @ se3.inverse(fit.X)
    P = se3.inverse(se3.retract(se3.inverse(P), step)) if data.words.P_at_world else se3.retract(P, step)
    out: Array = se3.inverse(Z) @ P @ fit.X
    return out


def information(M: Array, C: Array) -> Array:
    """Return the mean information (12, 12) of poses M (k, 4, 4) about (x, z) under noise C (6, 6)."""
    J = np.concatenate([np.broadcast_to(-np.eye(6), (len(M), 6, 6)), se3.adjoint(se3.inverse(M))], axis=2)
    return np.asarray(np.mean(np.swapaxes(J, 1, 2) @ np.linalg.inv(C) @ J, axis=0))


def good_poses(data: HandEyeData, fit: Refined) -> Array:
    """Return the mean information (12, 12) of one more pose, turned about any of the mover's axes by 30 deg or as far as the others."""
    world = int(np.argmax(np.bincount(data.world, fit.kept, data.n_worlds)))
    own = fit.M[fit.kept & (data.world == world), :3, :3]
    turn = so3.log(so3.project(own.sum(axis=0)).T @ own) if len(own) else np.zeros((1, 3))
    angle = max(TILT, float(np.sqrt(np.mean(np.sum(turn**2, axis=1)))))
    steps = np.concatenate([np.zeros((6, 3)), angle * np.concatenate([np.eye(3), -np.eye(3)])], axis=1)
    return information(moved(data, fit, world, steps), fit.C[fit.kept].mean(axis=0) if fit.kept.any() else fit.C.mean(axis=0))


def _advice(data: HandEyeData, fit: Refined, both: Array, world: int) -> tuple[Advice, ...]:
    """Return the elementary motions that, ten poses of each, lift the weakest direction most, one after the other until none is weak."""
    who = data.words.mover
    C = fit.C[fit.kept].mean(axis=0) if fit.kept.any() else fit.C.mean(axis=0)
    choices = []
    for i, axis in enumerate("xyz"):
        tilts, shifts = np.zeros((2, 6)), np.zeros((2, 6))
        tilts[:, 3 + i], shifts[:, i] = [TILT, -TILT], [SHIFT, -SHIFT]
        for text, steps in (
            (f"add poses tilted about the {who}'s {axis} axis by 30 deg or more", tilts),
            (f"add poses moved along the {who}'s {axis} axis by {SHIFT:g} m or more", shifts),
        ):
            choices.append((text, MORE * information(moved(data, fit, world, steps), C)))
    out: list[Advice] = []
    while len(out) < _MOST_ADVICE:
        weakest = trust.directions(both[:6, :6], SCALES)[0]
        if weakest.grade == "determined":
            break
        v = weakest.vector / SCALES
        after = [_with(both, more) for _, more in choices]
        then = [float(np.sqrt(max(v @ cov[:6, :6] @ v, 0.0))) for cov in after]
        best = int(np.argmin(then))
        out.append(Advice(choices[best][0], weakest.sigma, then[best]))
        both = after[best]
    return tuple(out)


def _with(cov: Array, information: Array) -> Array:
    """Return (cov^-1 + information)^-1: of a cov that holds 10 m beside 1 um, no inverse."""
    values, vectors = np.linalg.eigh(information)
    R = (vectors * np.sqrt(np.maximum(values, 0))).T
    RP = R @ cov
    out: Array = cov - RP.T @ np.linalg.solve(np.eye(len(R)) + RP @ R.T, RP)
    return out


def lag(data: HandEyeData, fit: Refined, inflation: float) -> Lag | None:
    """Return the time offset that the residuals show, where they do by five sigmas.

    P stamped dt early is P(t) = P(t + dt) exp(-v dt): e gains -v dt, v the twist of M in its right tangent.
    """
    if data.t_s is None:
        return None
    order = np.lexsort([data.t_s, data.world])
    before, here, after = order[:-2], order[1:-1], order[2:]
    span = data.t_s[after] - data.t_s[before]
    near = (span > 0) & (span < 2 * _NEIGHBOURS) & (data.world[before] == data.world[after]) & fit.kept[before] & fit.kept[after]
    v, known = np.zeros((len(data.P), 6)), np.zeros(len(data.P), bool)
    v[here[near]] = se3.local(fit.M[before[near]], fit.M[after[near]]) / span[near, None]
    known[here[near]] = True
    known &= fit.kept
    if known.sum() < 10:
        return None
    system = believed(data, fit.C, fit.C_P, known, normal(data, fit.M, fit.C, v, known))[1]
    x = system.cov @ system.gradient
    z = system.apart + system.follow @ x
    v = v + x - (system.J_Z @ z[data.world][:, :, None])[:, :, 0]
    Wv = np.linalg.solve(fit.C[known], v[known][:, :, None])[:, :, 0]
    tells = float(np.sum(Wv * v[known]))
    dt = -float(np.sum(Wv * fit.e[known])) / max(tells, 1e-300)
    sigma = float(np.sqrt(inflation / max(tells, 1e-300)))
    share = dt**2 * tells / max(float(np.sum(fit.chi2[known])), 1e-300)
    return Lag(dt, sigma, share) if abs(dt) > _LAG_SIGMAS * sigma else None
