"""How far the board's corners lie from where the other side's poses put them: what a hand-eye calibration is worth in the image."""

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.data.rig import Camera
from calibkit.estimation.board_poses import BoardPoses
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CAMERAS


def corner_rms(views: BoardViews, poses: BoardPoses, camera: Camera, T_cam_board: Array) -> Array:
    """Return sqrt(sum |uv - project(T_cam_board p)|^2 / N) px over each posed frame's kept corners (f,); NaN where none projects.

    T_cam_board (f, 4, 4) is that of the poses' frames.
    """
    model = CAMERAS[camera.model]
    lens = np.array([camera.parameters[name].value for name in model.parameter_names], float)
    number = np.full(views.n_frames, -1)
    number[poses.frame] = np.arange(len(poses.frame))
    rows = np.flatnonzero(poses.kept)
    at = number[views.frame[rows]]
    points = se3.transform(T_cam_board[at], views.board.points[views.corner[rows]][:, None, :])[:, 0]
    seen = model.project(points, lens)
    squares = np.where(seen.valid, np.sum((views.uv[rows] - seen.uv) ** 2, axis=1), 0.0)
    sums, counts = (np.bincount(at, weights, len(poses.frame)) for weights in (squares, seen.valid.astype(float)))
    out: Array = np.sqrt(np.where(counts > 0, sums, np.nan) / np.maximum(counts, 1))
    return out
