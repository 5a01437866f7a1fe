"""Thousands of views say little more than the best few hundred: choose those that add most to the information about the lens."""

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.estimation.camera_problem import CameraProblem, CameraViews, LensState
from calibkit.estimation.lens_fit import MIN_CORNERS, dense_views
from calibkit.estimation.lens_seed import seed_camera
from calibkit.geometry.so3 import Array

_FIRST = 20


def choose_views(views: BoardViews, model: str, most: int) -> BoardViews:
    """Return at most `most` views: greedily those that raise log det of the information S = sum_f S_f about the lens."""
    if views.n_frames <= most:
        return views
    enough = np.bincount(views.frame, minlength=views.n_frames) >= MIN_CORNERS
    views = views.select(enough)
    grid = dense_views(views, model, np.arange(views.n_frames))
    lens, poses = seed_camera(grid, views.board.points)
    good = np.flatnonzero(np.isfinite(poses.error) & (poses.error <= 4 * np.median(poses.error[np.isfinite(poses.error)])))
    part = CameraViews(grid.model, np.arange(len(good)), grid.uv[good], grid.weight[good], grid.image_size)
    state = LensState((lens,), np.eye(4)[None], poses.T_cam_board[good])
    S, _ = CameraProblem(views.board.points, (part,)).information(state)
    return views.select(good[greedy_log_det(S, most)])


def greedy_log_det(S: Array, most: int) -> Array:
    """Return indices of the matrices (m, p, p) chosen, most telling first; each step adds the one with the largest tr(T^-1 S_i).

    d log det T / d S_i = tr(T^-1 S_i) for the total T so far; a few at a time, since neighbours change it little.
    """
    scale = 1 / np.sqrt(np.maximum(np.einsum("mii->i", S), 1e-300))
    S = S * scale[:, None] * scale
    total = 1e-6 * np.eye(S.shape[-1])
    left = np.ones(len(S), bool)
    chosen: list[int] = []
    batch = max(1, most // 100)
    while len(chosen) < min(most, len(S)):
        gain = np.where(left, np.einsum("ij,mji->m", np.linalg.inv(total), S), -np.inf)
        step = 1 if len(chosen) < _FIRST else min(batch, most - len(chosen))
        # Views of one moment are alike: the batch is spread over the recording by taking every group's best.
        groups = np.array_split(np.arange(len(S)), step)
        for group in groups:
            best = int(group[np.argmax(gain[group])])
            if left[best]:
                chosen.append(best)
                left[best] = False
                total = total + S[best]
    return np.array(chosen[:most])
