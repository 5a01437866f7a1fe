"""Thousands of views say little more than the best few hundred: choose those that add most to what is known of lenses and rig."""

from collections.abc import Sequence

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.estimation.camera_problem import CameraProblem, LensState
from calibkit.estimation.camera_rig_seed import Instants, seed_rig
from calibkit.estimation.lens_fit import MIN_CORNERS, dense_views, renumber, rows_of
from calibkit.estimation.lens_seed import seed_camera
from calibkit.geometry.so3 import Array

_FIRST = 20
_FAR = 4.0  # a seed's pose that fits so many times worse than usual tells nothing


def choose_views(cameras: Sequence[BoardViews], models: Sequence[str], instants: Instants, most: int) -> tuple[list[BoardViews], Instants]:
    """Return the views of at most `most` instants of cameras that share some, greedily those that raise log det of S = sum_i S_i most.

    S is about the lenses and the camera positions together, so instants that cameras share count for both.
    """
    if max(views.n_frames for views in cameras) <= most:
        return list(cameras), instants
    grids, lenses, poses, errors, rows = [], [], [], [], []
    for views, model, instant in zip(cameras, models, instants, strict=True):
        enough = np.bincount(views.frame, minlength=views.n_frames) >= MIN_CORNERS
        grid = rows_of(dense_views(views, model, instant), enough)
        lens, seeds = seed_camera(grid, views.board.points)
        good = np.isfinite(seeds.error) & (seeds.error <= _FAR * np.median(seeds.error[np.isfinite(seeds.error)]))
        grids.append(rows_of(grid, good))
        lenses.append(lens)
        poses.append(seeds.T_cam_board[good])
        errors.append(seeds.error[good])
        rows.append(np.flatnonzero(enough)[good])
    renumber(grids)
    T_cam_cam0, T_cam0_board = seed_rig(tuple(grid.instant for grid in grids), poses, errors)
    S, _ = CameraProblem(cameras[0].board.points, tuple(grids)).information(LensState(tuple(lenses), T_cam_cam0, T_cam0_board))
    chosen = greedy_log_det(S, most)
    rows = [row[np.isin(grid.instant, chosen)] for row, grid in zip(rows, grids, strict=True)]
    views_chosen = [views.select(row) for views, row in zip(cameras, rows, strict=True)]
    return views_chosen, tuple(instant[row] for instant, row in zip(instants, rows, strict=True))


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
