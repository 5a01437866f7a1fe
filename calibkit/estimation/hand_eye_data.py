"""What a hand-eye problem is given: two sides' poses that P X = Z Q joins, the noise on both sides, and the setup's words."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from calibkit.errors import BadInputError
from calibkit.estimation.hand_eye_world import SETUPS
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array

Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

_ROTATION_ERROR = 1e-3  # of R^T R - I: text files keep 4 digits


@dataclass(frozen=True)
class Words:
    """A setup's frames, P = T_w1_1, Q = T_w2_2, X = T_1_2, Z = T_w1_w2, and the end at which each side's noise is isotropic.

    The end that moves is the one that a user turns: frame 1 in the hand and in `motion`, the gripper, P's other end, eye-to-hand.
    """

    frames: tuple[str, str, str, str]  # 1, 2, w1, w2
    mover: str
    P_at_world: bool  # noise and motion are those of P^-1's right tangent
    Q_at_world: bool  # a board's pose errs about the board
    arm: bool  # P is an arm's


WORDS: dict[str, Words] = {
    "eye-in-hand": Words(("gripper", "cam", "base", "target"), "gripper", False, True, True),
    "eye-to-hand": Words(("base", "cam", "gripper", "target"), "gripper", True, True, True),
    "motion": Words(("sensor1", "sensor2", "world1", "world2"), "sensor1", False, False, False),
}


@dataclass(frozen=True)
class HandEyeData:
    """n pairs of poses; those of one `world` share one Z. Motions without a common start are worlds of two poses each."""

    setup: str
    P: Array  # (n, 4, 4) T_w1_1
    Q: Array  # (n, 4, 4) T_w2_2
    cov_P: Array | None = None  # (n, 6, 6) right tangent, up to a factor; None: isotropic sigmas of rotation and translation
    cov_Q: Array | None = None
    labels: tuple[str, ...] = ()
    t_s: Array | None = None  # (n,) in a moving recording
    world: Index = field(default_factory=lambda: np.zeros(0, np.intp))  # (n,) 0 .. n_worlds - 1; empty: one world
    frames: tuple[str, str, str, str] | None = None  # the user's names of 1, 2, w1, w2

    def __post_init__(self) -> None:
        if self.setup not in WORDS:
            raise BadInputError(f"hand-eye: no setup '{self.setup}': choose one of {', '.join(WORDS)}")
        n = len(self.P)
        shapes = {"P": (4, 4), "Q": (4, 4), "cov_P": (6, 6), "cov_Q": (6, 6), "t_s": ()}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if np.shape(value) != (n, *shape):
                raise BadInputError(f"hand-eye: {name} must have the shape {(n, *shape)} and has {np.shape(value)}: give as many of each")
            if not np.isfinite(value).all():
                bad = int(np.argmin(np.isfinite(value).reshape(n, -1).all(axis=1)))
                raise BadInputError(f"hand-eye: {name} is not finite at pose {bad + 1}: correct or leave out that pose")
        for name in ("P", "Q"):
            R = getattr(self, name)[:, :3, :3]
            off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).reshape(n, 9).max(axis=1, initial=0) + np.where(np.linalg.det(R) < 0, 1, 0)
            if n and off.max() > _ROTATION_ERROR:
                raise BadInputError(f"hand-eye: {name} holds no rotation at pose {int(np.argmax(off)) + 1}: check the layout of the poses")
        if len(self.world) == 0:
            object.__setattr__(self, "world", np.zeros(n, np.intp))
        if not self.labels:
            object.__setattr__(self, "labels", tuple(f"pose {i + 1}" for i in range(n)))
        if len(self.labels) != n or len(self.world) != n:
            raise BadInputError(f"hand-eye: {n} poses with {len(self.labels)} names: give as many of each")

    @property
    def words(self) -> Words:
        words = WORDS[self.setup]
        if self.frames is None:
            return words
        mover = dict(zip(words.frames, self.frames, strict=True))[words.mover]
        return replace(words, frames=self.frames, mover=mover)

    @property
    def n_worlds(self) -> int:
        return int(self.world.max(initial=-1)) + 1

    def sum_by_world(self, values: Array) -> Array:
        """Return the sums (n_worlds, ...) of the poses' values (n, ...)."""
        n = len(values)
        member = sparse.csc_array((np.ones(n), self.world, np.arange(n + 1)), shape=(self.n_worlds, n))
        return np.asarray(member @ values.reshape(n, -1)).reshape(-1, *values.shape[1:])

    @property
    def slots(self) -> Index:
        """Return each world's poses as rows (n_worlds, most), -1 where a world has fewer."""
        order = np.argsort(self.world, kind="stable")
        count = np.bincount(self.world, minlength=self.n_worlds)
        within = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
        out = np.full((self.n_worlds, int(count.max(initial=0))), -1, np.intp)
        out[self.world[order], within] = order
        return out


def of_recording(
    setup: str, T_base_gripper: Array, T_cam_target: Array, cov_T_cam_target: Array | None = None, **more: object
) -> HandEyeData:
    """Return the problem of what people record; the camera's covariance (n, 6, 6) is T_cam_target's right tangent.

    In `motion` the two are T_world1_sensor1 and T_world2_sensor2.
    """
    maker: Callable[[Array, Array], tuple[Array, Array]] = SETUPS[setup]
    P, Q = maker(T_base_gripper, T_cam_target)
    if cov_T_cam_target is not None and WORDS[setup].Q_at_world:
        # Q = T_cam_target^-1: exp(-d) Q = Q exp(-Ad(T_cam_target) d).
        Ad = se3.adjoint(T_cam_target)
        cov_T_cam_target = Ad @ cov_T_cam_target @ np.swapaxes(Ad, -1, -2)
    return HandEyeData(setup, P, Q, cov_Q=cov_T_cam_target, **more)  # type: ignore[arg-type]


def of_motions(A: Array, B: Array, labels: tuple[str, ...] = (), frames: tuple[str, str, str, str] | None = None) -> HandEyeData:
    """Return the problem of ready-made motions A, B (k, 4, 4): each from a rest at I to A and B, with noise at both ends."""
    start = np.broadcast_to(np.eye(4), np.shape(A))
    P, Q = (np.stack([start, T], axis=1).reshape(-1, 4, 4) for T in (A, B))
    names = labels or tuple(f"motion {k + 1}" for k in range(len(A)))
    return HandEyeData("motion", P, Q, labels=tuple(n for n in names for _ in "12"), world=np.repeat(np.arange(len(A)), 2), frames=frames)
