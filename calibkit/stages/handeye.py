"""`calibkit handeye`: two sides' poses to the transform between them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibkit.data.progress import Progress, silent
from calibkit.data.result import Result
from calibkit.data.verdict import Verdict
from calibkit.errors import BadInputError, NotConvergedError, NotObservableError, one_line
from calibkit.estimation.hand_eye import HandEyeFit, Settings, calibrate_hand_eye
from calibkit.estimation.hand_eye_asked import REFINED, Asked
from calibkit.estimation.hand_eye_data import HandEyeData, of_motions, of_recording
from calibkit.estimation.hand_eye_doubts import out_of_step, told_step
from calibkit.estimation.hand_eye_lengths import length_ratio
from calibkit.estimation.hand_eye_methods import METHODS
from calibkit.estimation.hand_eye_pixels import corner_rms
from calibkit.estimation.hand_eye_redrawn import by_closed_form
from calibkit.estimation.hand_eye_result import hand_eye_result
from calibkit.estimation.hand_eye_setup import SIGNS, Choice, choose_setup, refuse_copies
from calibkit.estimation.hand_eye_verdict import Doubts
from calibkit.estimation.hand_eye_world import WORLD_METHODS
from calibkit.geometry import se3
from calibkit.geometry.so3 import Array
from calibkit.stages.handeye_images import check, corners, freed, how, robot_noise, with_images
from calibkit.stages.handeye_pictures import worst_images
from calibkit.stages.handeye_poses import gather
from calibkit.stages.handeye_sides import Options, Sides
from calibkit.stages.outputs import Outputs, Saved, save

MAX_PREDICTED = 10_000


def hand_eye(sources: Sequence[Path], outputs: Outputs | None = None, options: Options | None = None, progress: Progress = silent) -> Saved:
    """Estimate X = T_gripper_cam, T_base_cam or T_sensor1_sensor2 from poses of both sides.

    BadInputError names the file, topic or option that is wrong, NotObservableError that the poses do not tell the setup.
    """
    outputs, options = outputs or Outputs(), options or Options()
    _check(options)
    base = outputs.open()
    sides = gather(sources, base, options, progress)
    try:
        refuse_copies(sides.first, sides.second)
        choice = _choice(sides, options)
        seen = corners(sides, base, options)
        fit = sides.fit or calibrate_hand_eye(_problem(sides, choice, options), Settings(robot=robot_noise(options.robot_noise)), seen)
        if options.method != REFINED:
            fit = by_closed_form(fit, options.method)
    except (BadInputError, NotObservableError) as error:
        raise type(error)(f"{', '.join(one_line(name, 80) for name, _ in sides.inputs)}: {error}") from None
    step = 0 if options.motions or sides.fit is not None else out_of_step(fit.data)
    told = told_step(step) if step else ""
    doubts = Doubts(choice.better, choice.times, length_ratio(fit), told, choice.unconfirmed or sides.unconfirmed)
    asked = Asked(
        options.method,
        options.predict,
        None if sides.t_ns is None or options.motions else sides.t_ns,
        _pixels(sides, fit),
        (*sides.lines, *([choice.line] if choice.line else []), *how(fit)),
        doubts,
    )
    result = hand_eye_result(fit, asked)
    if not fit.converged and result.verdict is not Verdict.FAIL:  # else the reasons tell why
        raise NotConvergedError("hand-eye: the refinement did not settle: look for poses that belong to other images, or give more")
    result = replace(
        result,
        rig=result.rig.model_copy(update={"time_offsets": sides.offsets}),
        reasons=(*result.reasons, *sides.reasons),
        facts={**result.facts, "warnings": list(sides.warnings)},
    )
    if sides.board is not None and sides.board.lens is not None:
        result = _with_lens(result, sides.board.lens)
    result = with_images(result, fit, sides, options)
    if sides.board is not None and (outputs.out is not None or outputs.report is not None):
        result = replace(result, thumbnails=worst_images(fit, sides, freed(fit, sides.board.camera), progress))
    return save(result, base, outputs, sides.inputs, _told(options, fit.data.setup))


def _check(options: Options) -> None:
    known = [REFINED, *METHODS, *WORLD_METHODS]
    if options.method not in known:
        raise BadInputError(f"--method {one_line(options.method)}: choose one of {', '.join(known)}")
    if options.setup is not None and options.setup not in SIGNS:
        raise BadInputError(f"--setup {one_line(options.setup)}: choose one of {', '.join(SIGNS)}")
    if not 0 <= options.predict <= MAX_PREDICTED:
        raise BadInputError(f"--predict {options.predict}: give 0 to {MAX_PREDICTED}")
    check(options)
    _refuse_idle(options)


def _refuse_idle(options: Options) -> None:
    """Refuse options that say nothing about what is given: a person who gives one expects it to count."""
    files, motion = bool(options.pose_files), options.motions or options.setup == "motion"
    idle = {
        "--motions": options.motions and not options.pairs and "it says what --pairs are",
        "--setup": options.motions and options.setup not in (None, "motion") and "motions of two sensors have no gripper: leave it out",
        "--inverse-second": options.inverse_second and options.poses is not None and "the board's poses are found here; --inverse-poses",
        "--pose": options.pose and files and "it chooses a stream of a recording, and a file of poses is given",
        "--base and --gripper": motion and (options.base or options.gripper) and "two sensors have neither",
        "--pose-format, --pose-unit and --angle-unit": (options.pose_format or options.pose_unit or options.angle_unit)
        and not files
        and "they are for --poses and --pairs; a stream is in m and quaternions",
    }
    for name, why in idle.items():
        if why:
            raise BadInputError(f"{name}: {why}")


def _choice(sides: Sides, options: Options) -> Choice:
    if options.motions:
        return Choice("motion")
    asked = options.setup if sides.fit is None else sides.fit.data.setup
    return choose_setup(sides.first, sides.second, asked, sides.candidates)


def _problem(sides: Sides, choice: Choice, options: Options) -> HandEyeData:
    frames = sides.words(choice.setup)
    if len(set(frames)) < len(frames):
        raise BadInputError(f"two frames would have one name, of {', '.join(frames)}: choose others with --base and --gripper")
    if options.motions:
        return of_motions(sides.first, sides.second, sides.labels, frames)
    t_s = None if sides.t_ns is None else np.asarray((sides.t_ns - sides.t_ns.min()) * 1e-9, np.float64)
    return of_recording(choice.setup, sides.first, sides.second, sides.cov_second, labels=sides.labels, t_s=t_s, frames=frames)


def _pixels(sides: Sides, fit: HandEyeFit) -> Array | None:
    """Return how far the corners of each pose's image lie from where the other side's pose puts them."""
    if sides.board is None or fit.Z is None:
        return None
    T_cam_board = se3.inverse(fit.X) @ se3.inverse(fit.data.P) @ fit.Z  # Q = Z^-1 P X is T_board_cam
    return corner_rms(sides.board.views, sides.board.poses, freed(fit, sides.board.camera), T_cam_board)


def _with_lens(result: Result, lens: Result) -> Result:
    """Return the result with the lens that was calibrated on the way."""
    mine, its = result.facts, lens.facts
    labels = {**_mapping(its.get("frame_labels")), **_mapping(mine.get("frame_labels"))}
    return replace(
        result,
        rig=result.rig.model_copy(update={"cameras": lens.rig.cameras}),
        reasons=(*result.reasons, *lens.reasons),
        residuals=(*result.residuals, *lens.residuals),
        facts={**its, **mine, "frame_labels": labels},
        not_observable=(*result.not_observable, *lens.not_observable),
    )


def _mapping(value: object) -> dict[str, object]:
    return dict(value) if isinstance(value, dict) else {}


def _told(options: Options, setup: str) -> dict[str, str | float | int | bool | None]:
    return {
        "setup": setup,
        "method": options.method,
        "poses": None if options.poses is None else options.poses.name,
        "pose_format": options.pose_format,
        "pose_unit": options.pose_unit,
        "angle_unit": options.angle_unit,
        "inverse_poses": options.inverse_poses,
        "inverse_second": options.inverse_second,
        "motions": options.motions,
        "target": None if options.target is None else options.target.name,
        "predict": options.predict,
        "robot_noise": options.robot_noise,
        "free_intrinsics": options.free_intrinsics,
    }
