"""Motions between poses: which pairs are worth taking, what their rotations can determine, and how well two sensors' screws agree."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibkit.estimation.hand_eye_linear import near_half_turn
from calibkit.geometry import se3, so3
from calibkit.geometry.so3 import Array

Index = NDArray[np.intp]

_MAX_CANDIDATES = 50_000
_MAX_POSES = 6_000


@dataclass(frozen=True)
class Spectrum:
    """What motions A know about X, per unit variance of the rows: eigenvalues descending, directions as columns in frame 1.

    `axes` is sum alpha alpha^T, alpha = log R_A: two must rise above the noise, or X's turn about the first direction is not known.
    `shift` is sum (R_A - I)^T (R_A - I), the information about t_X: its last direction is the least known (about one axis only, that axis).
    """

    axes: Array  # (..., 3) rad^2
    axis_directions: Array  # (..., 3, 3)
    shift: Array  # (..., 3)
    shift_directions: Array  # (..., 3, 3)
    n: int

    @property
    def turn(self) -> Array:
        """The information about a turn of X about each of `axis_directions`, sum |alpha x e|^2 (..., 3) rad^2: the first is the least."""
        out: Array = self.axes.sum(axis=-1, keepdims=True) - self.axes
        return out

    def rank(self, sigma: float) -> Index:
        """Return how many axes (...) rise above the noise of alpha, sigma rad a coordinate: a closed form needs 2 or 3.

        Noise across one axis shows no eigenvalue over (sqrt(n) + sqrt(2) + 3)^2 sigma^2 in 99 of 100 sets (Davidson and Szarek 2001,
        theorem II.13).
        """
        highest = (np.sqrt(self.n) + np.sqrt(2) + 3) * max(sigma, 1e-14)  # rounding's share, where there is no noise
        out: Index = np.count_nonzero(self.axes > highest**2, axis=-1)
        return out


def spectrum(A: Array) -> Spectrum:
    """Return the spectra of motions A (..., n, 4, 4): those about one axis alone, or without rotation, show here."""
    A = np.asarray(A, float)
    alpha = so3.log(A[..., :3, :3])
    M = A[..., :3, :3] - np.eye(3)
    # Singular values of the rows: eigenvalues of their squares lose half the digits. Rows of zeros give one motion three directions.
    _, axes, axis_directions = np.linalg.svd(np.concatenate([alpha, np.zeros((*A.shape[:-3], 3, 3))], axis=-2), full_matrices=False)
    _, shift, shift_directions = np.linalg.svd(M.reshape(*A.shape[:-3], -1, 3), full_matrices=False)
    return Spectrum(axes**2, np.swapaxes(axis_directions, -1, -2), shift**2, np.swapaxes(shift_directions, -1, -2), A.shape[-3])


def screw_mismatch(A: Array, B: Array) -> tuple[Array, Array]:
    """Return angle_A - angle_B (..., n) rad and slide_A - slide_B along the axes (..., n) m: 0 whatever X is (Chen 1991).

    Near 180 deg, where the axis's sign and with it the slide's is open, the better agreement counts; below 1e-6 rad the slide is noise
    and 0 is returned.
    """
    A, B = np.asarray(A, float), np.asarray(B, float)
    qa, qb = so3.to_quat(A[..., :3, :3]), so3.to_quat(B[..., :3, :3])
    sine_a, sine_b = np.linalg.norm(qa[..., :3], axis=-1), np.linalg.norm(qb[..., :3], axis=-1)
    slide_a = np.sum(qa[..., :3] * A[..., :3, 3], axis=-1) / np.maximum(sine_a, 1e-300)
    slide_b = np.sum(qb[..., :3] * B[..., :3, 3], axis=-1) / np.maximum(sine_b, 1e-300)
    slide = np.where(near_half_turn(qa, qb), np.abs(slide_a) - np.abs(slide_b), slide_a - slide_b)
    slide = np.where(np.minimum(sine_a, sine_b) < 5e-7, 0.0, slide)
    return 2 * (np.arctan2(sine_a, qa[..., 3]) - np.arctan2(sine_b, qb[..., 3])), slide


def motions(poses: Array, pairs: Index) -> Array:
    """Return T_w_s(i)^-1 T_w_s(j) (k, 4, 4) of poses (m, 4, 4) for pairs (k, 2) of i and j."""
    poses = np.asarray(poses, float)
    out: Array = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
    return out


def choose_pairs(poses: Array, count: int, min_angle: float = 0.01) -> Index:
    """Return up to `count` pairs (k, 2) of poses T_w_s (m, 4, 4) that turn far and about different axes, the best first.

    Every pair is a candidate; of more than 316 poses those at spread distances, 50 000 in all; more than 6000 poses are thinned evenly.
    No pose is used much more often than others: its error would be in all of them.
    """
    poses = np.asarray(poses, float)
    taken = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _MAX_POSES)).round().astype(np.intp))
    m = len(taken)
    if m < 2:
        return np.zeros((0, 2), np.intp)
    lags = np.arange(1, m)
    if m * (m - 1) // 2 > _MAX_CANDIDATES:
        lags = np.unique(np.geomspace(1, m - 1, _MAX_CANDIDATES // m).astype(np.intp))
    first = np.concatenate([np.arange(m - lag) for lag in lags])
    pairs = taken[np.stack([first, first + np.repeat(lags, m - lags)], axis=-1)]
    chosen: Index = pairs[choose_motions(motions(poses, pairs), count, min_angle, pairs)]
    return chosen


def choose_motions(A: Array, count: int, min_angle: float = 0.01, pairs: Index | None = None) -> Index:
    """Return up to `count` indices (k,) of motions A (n, 4, 4), each the one that lifts det(sum v v^T) most, v = sin(angle / 2) axis.

    Motions of less than min_angle rad, pure translations among them, are never taken. With `pairs` (n, 2) of poses, no pose is in more
    than about twice its share of them.
    """
    v = so3.to_quat(np.asarray(A, float)[:, :3, :3])[:, :3]
    poses = np.zeros((len(v), 0), np.intp) if pairs is None else pairs
    uses = np.zeros(poses.max(initial=-1) + 1, np.intp)
    share = max(2, -(-4 * count // max(len(np.unique(poses)), 1)))
    inverse = np.eye(3) * 1e6  # of the information: next to nothing is known before
    gain = np.where(np.linalg.norm(v, axis=-1) >= np.sin(min_angle / 2), np.einsum("ni,ij,nj->n", v, inverse, v), -np.inf)
    chosen: list[int] = []
    while len(chosen) < min(count, len(v)):
        k = int(np.argmax(gain))
        if gain[k] == -np.inf:
            break
        chosen.append(k)
        step = inverse @ v[k] / np.sqrt(1 + v[k] @ inverse @ v[k])
        inverse = inverse - np.outer(step, step)
        gain -= (v @ step) ** 2  # v^T inverse v as it is now
        gain[k] = -np.inf
        uses[poses[k]] += 1
        if (full := poses[k][uses[poses[k]] >= share]).size:
            gain[np.isin(poses, full).any(axis=-1)] = -np.inf
    return np.array(chosen, np.intp)
