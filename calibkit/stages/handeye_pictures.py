"""The worst images of a hand-eye calibration: the board's corners as found, and where the robot's pose puts them."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import BoardViews
from calibkit.data.progress import Progress
from calibkit.data.result import Thumbnail
from calibkit.data.rig import Camera
from calibkit.detection.thumbnails import draw_corners
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_doubts import suspects
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.models.cameras import CAMERAS
from calibkit.stages.handeye_sides import Sides

_MOST = 10
_LEFT_OUT = 5  # at most as many are poses that were left out, where there are kept ones


def worst_images(fit: HandEyeFit, sides: Sides, camera: Camera, progress: Progress) -> tuple[Thumbnail, ...]:
    """Draw the images of poses that were left out, with a guess at why, then those of kept poses that fit worst."""
    board = sides.board
    if board is None or board.images is None or fit.Z is None:
        return ()
    labels, wrong = board.poses.labels, {s.row: s.why for s in suspects(fit)}
    kept = np.flatnonzero(fit.kept)
    kept = kept[np.argsort(-fit.chi2[kept], kind="stable")]
    order = [*list(wrong)[:_LEFT_OUT], *map(int, kept)][:_MOST]
    once = Counter(labels)  # under a stamp that repeats, which image it was cannot be told
    wanted = {labels[i]: i for i in order if once[labels[i]] == 1}
    size = np.linalg.norm(fit.residual.reshape(-1, 2, 3), axis=2)
    drawn: dict[int, Thumbnail] = {}
    for image in progress(board.images(), "worst images"):
        i = wanted.pop(image.label, None)
        if i is None:
            continue
        T_cam_board = se3.inverse(fit.X) @ se3.inverse(fit.data.P[i]) @ fit.Z  # Q = Z^-1 P X is T_board_cam
        found, predicted, good = _corners(board.views, int(board.poses.frame[i]), board.poses.kept, camera, T_cam_board)
        rms = float(np.sqrt(np.nanmean(np.sum((predicted - found) ** 2, axis=1)))) if np.isfinite(predicted).any() else np.nan
        caption = f"{image.label}: {np.degrees(size[i, 1]):.2g} deg, {1e3 * size[i, 0]:.2g} mm, {rms:.3g} px"
        why = "" if fit.kept[i] else f"; left out{f': {wrong[i]}' if wrong[i] else ''}"
        drawn[i] = Thumbnail(caption + why, draw_corners(image.decode(), found, predicted, good, caption))
        if not wanted:
            break
    return tuple(drawn[i] for i in order if i in drawn)


def _corners(
    views: BoardViews, frame: int, kept: NDArray[np.bool_], camera: Camera, T_cam_board: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return a frame's corners (n, 2) px as found and as predicted, NaN behind the camera, and which took part."""
    model = CAMERAS[camera.model]
    rows = np.flatnonzero(views.frame == frame)
    seen = model.project(
        se3.transform(T_cam_board, views.board.points[views.corner[rows]]),
        np.array([camera.parameters[name].value for name in model.parameter_names], float),
    )
    predicted = np.where(seen.valid[:, None], seen.uv, np.nan)
    return views.uv[rows].astype(float), predicted, kept[rows] & seen.valid
