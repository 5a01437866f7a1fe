"""Hand-eye of two pose streams: the offset of their clocks by how they turn, then together with X by the whole poses."""

from dataclasses import replace

import numpy as np

from calibkit.data.progress import Progress, silent
from calibkit.data.verdict import Reason, Verdict
from calibkit.estimation import hand_eye
from calibkit.estimation.hand_eye import HandEyeFit, calibrate_hand_eye
from calibkit.estimation.hand_eye_lag import eliminated
from calibkit.estimation.pose_interpolation import PoseStream
from calibkit.estimation.pose_offset import ClockOffset, Settings, aligned, milliseconds
from calibkit.estimation.pose_pairing import Pairing, pair_poses
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array

_ROUNDS = 4
_SETTLED = 0.2  # sigmas
_BLOCK_S = 2.0  # residuals farther apart are taken for independent
_DISAGREE = 4.0  # sigmas
_WORTH_S = 1e-3


def calibrate_streams(
    P: PoseStream,
    Q: PoseStream,
    setup: str,
    settings: Settings | None = None,
    fitting: hand_eye.Settings | None = None,
    frames: tuple[str, str, str, str] | None = None,
    progress: Progress = silent,
) -> tuple[Pairing, HandEyeFit]:
    """Return pairs and X; an offset that the turns told is moved to where P X = Z Q fits best, and its sigma is in X's covariance.

    P and Q are T_w1_1 and T_w2_2 as `hand_eye_world.SETUPS` means them.
    """
    settings, fitting = settings or Settings(), fitting or hand_eye.Settings()
    both = aligned(P, Q, settings, progress)
    first = both.offset
    pairing = pair_poses(both, settings)
    fit = calibrate_hand_eye(pairing.data(setup, frames), fitting)
    if pairing.kind == "moving":
        for _ in range(_ROUNDS if first.known == "turns" else 0):
            change, sigma, _ = offset_left(pairing, fit)
            both = replace(both, offset=both.offset.moved(change, sigma))
            pairing = pair_poses(both, replace(settings, rests=False))
            data = pairing.data(setup, frames)
            worlds = np.arange(len(data.P)) * fit.n_worlds // len(data.P)  # as they were chosen
            fit = calibrate_hand_eye(replace(data, world=worlds), replace(fitting, drift=False))
            if abs(change) < _SETTLED * sigma:
                break
        follow = offset_left(pairing, fit)[2]
        more = both.offset.sigma**2 * np.outer(follow, follow)
        fit = replace(fit, cov_X=fit.cov_X + more, plain_cov_X=fit.plain_cov_X + more)
    return replace(pairing, reasons=_one_offset(P.name, Q.name, first, both.offset, pairing.reasons, 1.0 if both.read_P else -1.0)), fit


def _one_offset(P: str, Q: str, turns: ClockOffset, whole: ClockOffset, reasons: tuple[Reason, ...], sign: float) -> tuple[Reason, ...]:
    """Return the reasons with one that says which offset is used, where turns and whole poses, or fast and slow turns, have others."""
    fast = turns.fit.by_fast_turns if turns.fit is not None and whole.known == "poses" else None
    apart = abs(whole.dt - turns.dt) > max(_DISAGREE * float(np.hypot(turns.sigma, whole.sigma)), _WORTH_S)
    if fast is None and not apart:
        return reasons
    others = [milliseconds(turns.dt, turns.sigma) + (" by turns of some tenths of a second" if fast else " by turns from pose to pose")]
    others += [milliseconds(sign * fast[0], fast[1]) + " from stamp to stamp"] if fast else []
    text = (
        f"dt_{P}_{Q}: use {milliseconds(whole.dt, whole.sigma)}, which whole poses have, places too; turns alone have "
        f"{' and '.join(others)}: a filter, blur or stamps that jitter in {P} or {Q}"
    )
    return (*(reason for reason in reasons if fast is None or reason != turns.doubt), Reason(Verdict.CHECK, text))


def offset_left(pairing: Pairing, fit: HandEyeFit) -> tuple[float, float, Array]:
    """Return by how much dt is to change, its sigma (s), and how X follows a change, x (6,) per s in X's right tangent.

    e_i + g_i d, g = Ad(X^-1) twist where P is read and twist where Q is: least squares with x and z eliminated; the sigma is by
    blocks of two seconds, whose residuals are alike (Liang and Zeger 1986), or that of white ones if larger.
    """
    g = pairing.twist @ se3.adjoint(se3.inverse(fit.X)).T if pairing.read_P else pairing.twist
    column = eliminated(fit.data, fit.refined, g, fit.refined.kept)
    block = (pairing.t_s[column.used] / _BLOCK_S).astype(np.intp)
    scores = np.bincount(block, column.pull + column.tells * column.dt)
    return column.dt, float(max(np.linalg.norm(scores) / column.whole, column.whole**-0.5)), column.x
