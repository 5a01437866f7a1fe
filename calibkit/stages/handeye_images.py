"""What `calibkit handeye` makes of corners and of a robot's stated noise: the refinement in the images, and a lens that is free."""

import math
from dataclasses import replace

import numpy as np

from calibkit.data.result import Result
from calibkit.data.rig import Camera, Estimate, Rig
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.hand_eye import HandEyeFit
from calibkit.estimation.hand_eye_free_lens import with_free_lens
from calibkit.estimation.hand_eye_images import Corners, corners_of
from calibkit.estimation.hand_eye_noise import RobotNoise
from calibkit.models.cameras import CAMERAS
from calibkit.stages.handeye_sides import Options, Sides

AUTO, EXACT = "auto", "exact"


def robot_noise(text: str) -> RobotNoise | None:
    """Return what `--robot-noise` says; None of auto."""
    if text == AUTO:
        return None
    if text == EXACT:
        return RobotNoise(0.0, 0.0)
    try:
        mm, deg = (float(part) for part in text.split(","))
    except ValueError:
        mm = deg = math.nan
    if not (0 < mm < 1e3 and 0 < deg < 90):
        raise BadInputError(f"--robot-noise {one_line(text)}: write auto, exact, or MM,DEG, sigmas of a coordinate, such as 0.1,0.02")
    return RobotNoise(math.radians(deg), 1e-3 * mm)


def check(options: Options) -> None:
    """Raise BadInputError for options that need a robot or corners and have none."""
    robot_noise(options.robot_noise)
    if options.free_intrinsics and (options.target is None or options.poses is None):
        raise BadInputError("--free-intrinsics needs images of a board, with --target and a robot's --poses")
    if options.robot_noise != AUTO and (options.motions or options.setup == "motion"):
        raise BadInputError("--robot-noise is for a robot's poses: leave it out of --setup motion")


def corners(sides: Sides, base: Rig, options: Options) -> Corners | None:
    """Return the corners of one image a pose; None of streams, whose poses are read between their stamps."""
    if sides.board is None or sides.fit is not None:
        if options.free_intrinsics or (options.robot_noise != AUTO and sides.fit is not None):
            raise BadInputError("--free-intrinsics and --robot-noise need one image for each of a robot's poses, no streams")
        return None
    board = sides.board
    own = {digest for _, digest in sides.inputs if digest is not None}
    same = board.lens is not None or any(file.sha256 in own for run in base.provenance for file in run.inputs)
    return corners_of(board.views, board.poses, board.camera, options.free_intrinsics, same)


def how(fit: HandEyeFit) -> list[str]:
    """Return in lines how X was refined."""
    found = fit.refined.corners
    lines = []
    if found is not None:
        used, seen, rms = int(np.sum(found.grid.weight > 0)), int(np.sum(found.found > 0)), found.rms(fit.refined.M)[0]
        lens = "free" if found.free else "held, its covariance in X's" if fit.lens else "held"
        lines.append(f"refined in the images: {used} of {seen} corners, rms {rms:.3g} px, the lens {lens}")
    if fit.by_reach:
        lines.append("the robot errs more in places than in turns, by its reach: its places count for less (docs: places by reach)")
    return lines


def with_images(result: Result, fit: HandEyeFit, sides: Sides, options: Options) -> Result:
    """Return the result with what refining in the images has shown, and the camera's entry where the lens was free, as asked for."""
    found = fit.refined.corners
    facts: dict[str, object] = {"robot_noise": options.robot_noise, "by_reach": fit.by_reach, "in_images": found is not None}
    if found is not None:
        used, rms = int(np.sum(found.grid.weight > 0)), found.rms(fit.refined.M)[0]
        facts |= {"corners": used, "rms_px": rms, "free_intrinsics": found.free}
    result = replace(result, facts={**result.facts, "refinement": facts})
    if found is None or not found.free or fit.lens is None or sides.board is None:
        return result
    return with_free_lens(result, fit, found, fit.lens, sides.board.views.camera, sides.board.camera)


def freed(fit: HandEyeFit, camera: Camera) -> Camera:
    """Return the camera as the refinement has it."""
    found = fit.refined.corners
    if found is None or not found.free:
        return camera
    names = CAMERAS[camera.model].parameter_names
    return camera.model_copy(
        update={"parameters": {name: Estimate(value=float(v)) for name, v in zip(names, found.lens, strict=True)}, "covariance": None}
    )
