"""Where cameras or IMU told nothing for a while, with its time: what is left holds the trajectory alone there."""

import numpy as np

from calibkit.data.plural import counted
from calibkit.data.verdict import Reason, Verdict
from calibkit.estimation.joint import Joint
from calibkit.estimation.joint_frozen import WORDS
from calibkit.geometry.so3 import Array

_IMU_S, _CAMERA_S = 0.9, 1.0
_SLOW = 2.5  # usual intervals: less is no gap of a slow camera


def gaps_of_imu(joint: Joint, imu: str, j: int = 0) -> list[Reason]:
    """Return where IMU j gave nothing, and where a sensor of it gave one and the same value."""
    t, frozen, found = joint.fit.problem.imus[j].t, joint.imus[j].frozen, []
    start, gap = t[:-1], np.diff(t)
    if frozen:
        stretches = np.array([(each.start_ns, each.end_ns) for each in frozen]) - joint.origin_ns
        begin, end = np.unique(stretches * 1e-9, axis=0).T
        gap = np.where(np.any((start[:, None] >= begin - 1e-6) & (start[:, None] < end), axis=1), 0.0, gap)
        which = " and ".join(dict.fromkeys(WORDS[each.kind] for each in frozen))
        text = f"{imu}'s {which} gave one and the same value, {_told(begin, end - begin, 'time')}: frozen, and left out"
        found.append(Reason(Verdict.CHECK, f"{text}; mend its driver or cable"))
    if gap.max() > _IMU_S:
        told = _told(start[gap > _IMU_S], gap[gap > _IMU_S], "gap")
        found.append(Reason(Verdict.CHECK, f"{imu} has {told}: images alone hold the trajectory there"))
    return found


def gaps_of_camera(joint: Joint, c: int, name: str) -> list[Reason]:
    """Return where a camera saw no board."""
    t = np.sort(joint.fit.problem.cameras[c].t)
    start, gap = t[:-1], np.diff(t)
    long = gap > max(_CAMERA_S, _SLOW * float(np.median(gap)))
    if not np.any(long):
        return []
    told = _told(start[long], gap[long], "gap")
    return [Reason(Verdict.CHECK, f"{name} has {told}, images missing or without the board: the IMU alone holds the trajectory there")]


def never_together(joint: Joint, c: int, name: str, imu: str) -> str:
    """Say where by their stamps a camera and the IMU were never recorded at once."""
    t_ns, track = joint.poses[c].t_ns, joint.seeds[c].track
    before = (track.origin_ns - int(t_ns.max())) * 1e-9
    after = (int(t_ns.min()) - track.origin_ns) * 1e-9 - track.duration
    if max(before, after) <= 0:
        return ""
    order = f"{name} ends {before:.3g} s before {imu} begins" if before > 0 else f"{name} begins {after:.3g} s after {imu} ends"
    return f"{name} and {imu} share no time by their stamps ({order}), and no offset lays one on the other: record both at once"


def _told(start: Array, length: Array, noun: str) -> str:
    at = int(np.argmax(length))
    return f"{counted(len(start), noun)} of up to {length[at]:.2g} s, the longest {start[at]:.4g} s in"
