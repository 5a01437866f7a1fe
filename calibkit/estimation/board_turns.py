"""How a camera turned between its frames, from the poses of a board that stands still."""

import numpy as np

from calibkit.errors import BadInputError
from calibkit.estimation.board_poses import BoardPoses
from calibkit.estimation.turns import Turns, in_order, turns_of_orientations
from calibkit.geometry import so3


def turns_of_board(poses: BoardPoses) -> Turns:
    """Return the camera's turns in its own axes between consecutive frames: exp(hat(angle)) = R_board_cam(i)^T R_board_cam(j).

    With R_cam_board = R exp(phi), R_board_cam = exp(-phi) R^T = R^T exp(-R phi): its error is -R phi, of covariance R cov_phi R^T.
    Of frames with one stamp the first is taken. Raises BadInputError where the frames have no stamps.
    """
    if len(poses.t_ns) > 1 and not poses.t_ns.any():
        raise BadInputError(f"{poses.camera}: its images have no stamps: give a recording, or name the images by their time in ns")
    rows = in_order(poses.t_ns)
    R = poses.T_cam_board[rows, :3, :3]
    R_board_cam = np.swapaxes(R, 1, 2)
    return turns_of_orientations(poses.t_ns[rows], so3.to_quat(R_board_cam), R @ poses.cov[rows, 3:, 3:] @ R_board_cam)
