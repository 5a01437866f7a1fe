"""Solve for a lens with its covariance, against cv2.calibrateCamera on the same corners (144 a frame, 0.2 px noise).

`--extended` adds calibrateCameraExtended at every size (minutes and gigabytes at 1000 frames); without it, at 100 frames only.
"""

import sys
import time
from functools import partial

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.estimation.lens_fit import fit_lenses
from calibkit.estimation.lens_trust import lens_covariance
from calibkit.models.board import AprilGrid
from calibkit.models.cameras import CAMERAS
from calibkit.opencv import cv2
from calibkit.simulation.camera import SimCamera, random_board_poses
from calibkit.simulation.corners import views_of_poses

SIZE = (752, 480)
LENS = np.array([461.6, 460.3, 363.0, 248.1, -0.28, 0.07, 2e-4, 2e-5])


def full_views(frames: int, seed: int = 0) -> BoardViews:
    """Return frames in which all 144 corners are seen, which is what OpenCV's solver is fastest with."""
    board, rng = AprilGrid(6, 6, 0.088, 0.3), np.random.default_rng(seed)
    camera = SimCamera(CAMERAS["pinhole-radtan"], LENS, SIZE)
    poses = random_board_poses(camera, board, 12 * frames, rng, fill=(0.3, 0.6))
    views, _ = views_of_poses(camera, board, poses, rng, noise_px=0.2)
    full = np.flatnonzero(np.bincount(views.frame) == len(board.points))[:frames]
    return views.select(full)


def ours(views: BoardViews, robust: bool) -> tuple[np.ndarray, np.ndarray]:
    fit = fit_lenses([views], ["pinhole-radtan"], (np.arange(views.n_frames),), robust=robust)
    return fit.state.lenses[0], np.sqrt(np.diag(lens_covariance(fit).plain))


def opencv(views: BoardViews, extended: bool) -> tuple[np.ndarray, np.ndarray | None]:
    points = np.ascontiguousarray(views.board.points, np.float32)
    corners = np.ascontiguousarray(views.uv.reshape(views.n_frames, -1, 1, 2), np.float32)
    arguments = ([points] * views.n_frames, list(corners), SIZE, None, None)
    if extended:
        found = cv2.calibrateCameraExtended(*arguments, flags=cv2.CALIB_FIX_K3)
        sigma = found[5].ravel()
    else:
        found, sigma = cv2.calibrateCamera(*arguments, flags=cv2.CALIB_FIX_K3), None
    K, d = found[1], found[2].ravel()
    order = [0, 1, 2, 3, 4, 5, 6, 7]
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d[:4]]), None if sigma is None else sigma[order]


def timed(call, repeats: int):  # type: ignore[no-untyped-def]
    wall, cpu, result = np.inf, np.inf, None
    for _ in range(repeats):
        w, c = time.perf_counter(), time.process_time()
        result = call()
        wall, cpu = min(wall, time.perf_counter() - w), min(cpu, time.process_time() - c)
    return wall, cpu, result


if __name__ == "__main__":
    everything = "--extended" in sys.argv
    print(f"{'frames':>6}  {'solver':<34}{'wall s':>9}{'CPU s':>9}{'ratio':>8}   fx, largest difference to ours in sigma")
    for frames in (100, 300, 1000):
        views = full_views(frames)
        wall, cpu, (lens, sigma) = timed(partial(ours, views, robust=False), 3)
        print(f"{views.n_frames:>6}  {'calibkit, with covariance':<34}{wall:>9.3f}{cpu:>9.3f}{1:>8.1f}   {lens[0]:.4f}")
        wall_r, cpu_r, (lens_r, _) = timed(partial(ours, views, robust=True), 2)
        print(f"{'':>6}  {'calibkit, robust, with covariance':<34}{wall_r:>9.3f}{cpu_r:>9.3f}{wall_r / wall:>8.1f}   {lens_r[0]:.4f}")
        for name, extended in (("cv2.calibrateCamera", False), ("cv2.calibrateCameraExtended", True)):
            if extended and frames > 100 and not everything:
                continue
            w, c, (theirs, _) = timed(partial(opencv, views, extended), 1)
            print(f"{'':>6}  {name:<34}{w:>9.3f}{c:>9.3f}{w / wall:>8.1f}   {theirs[0]:.4f}  {np.max(np.abs(theirs - lens) / sigma):.1e}")
