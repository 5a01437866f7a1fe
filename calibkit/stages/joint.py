"""`calibkit joint`: cameras and an IMU on one continuous-time trajectory."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Literal

import numpy as np

from calibkit.data.observations import BoardViews
from calibkit.data.progress import Progress, silent
from calibkit.data.rig import Camera
from calibkit.errors import one_line
from calibkit.estimation.added_motion import missing_motions
from calibkit.estimation.joint import CameraInput
from calibkit.estimation.joint_checks import check_joint
from calibkit.estimation.joint_imu import NamedImu
from calibkit.estimation.joint_result import joint_result
from calibkit.estimation.joint_state import A_G, LINE, M_A, M_G, PHI
from calibkit.estimation.joint_trust import joint_trust
from calibkit.stages.camera_imu import Sensors, read_camera_imu
from calibkit.stages.outputs import Outputs, Saved, save

ImuModelChoice = Literal["known", "scale-misalignment"]
_IMU_EXTRAS: dict[str, tuple[str, ...]] = {"known": (), "scale-misalignment": (M_A, M_G, PHI)}


@dataclass(frozen=True)
class Options(Sensors):
    """Which sensors, and how to fit."""

    knots_s: float | None = None
    hold_lens: bool = False  # as the rig file has it, with its covariance
    imu_model: ImuModelChoice = "known"
    g_sensitivity: bool = False  # of the gyroscope, free
    line_delay: bool = False  # of rolling shutters, free
    halves: bool = True


def joint(
    sources: Sequence[Path], target: Path, outputs: Outputs | None = None, options: Options | None = None, progress: Progress = silent
) -> Saved:
    """Estimate T_cam_imu, dt_imu_cam and the lenses of a recording of cameras and IMUs before a board, and how the IMUs lie to each other.

    BadInputError names the file, topic or option that is wrong.
    """
    outputs, options = outputs or Outputs(), options or Options()
    base = outputs.open()
    free = _IMU_EXTRAS[options.imu_model] + ((A_G,) if options.g_sensitivity else ())
    read = read_camera_imu(sources, target, base, options, progress, free)
    cameras = [_input(each, lens, options.hold_lens) for each, lens in zip(read.views, read.lenses, strict=True)]
    found = read.fitted(cameras, read.settings((LINE,) if options.line_delay else (), options.knots_s), progress)
    trust, checks = joint_trust(found.fit), check_joint(found.fit, options.halves)
    imus = []
    for each, measured in zip(read.imus, found.imus, strict=True):
        known = each.known if each.name in base.imus else each.known.model_copy(update={"rate_hz": round(measured.rate_hz, 3)})
        imus.append(NamedImu(each.name, each.input, known))
    result = joint_result(found, trust, checks, cameras, imus, read.stamps, missing_motions(found.fit, trust))
    result = replace(result, facts={**result.facts, "warnings": read.warnings})
    told: dict[str, str | float | int | bool | None] = {
        "target": read.board.key(),
        "imu": ", ".join(f"{each.name}={one_line(each.topic)}" for each in read.imus),
        "hold_lens": options.hold_lens,
        "imu_model": options.imu_model,
        "g_sensitivity": options.g_sensitivity,
        "line_delay": options.line_delay,
        "knots_s": options.knots_s,
    }
    rigs = [(path.name, sha256(path.read_bytes()).hexdigest()) for path in outputs.rigs]
    return save(result, base, outputs, [*read.inputs, *rigs], told)


def _input(views: BoardViews, camera: Camera, held: bool) -> CameraInput:
    """Return what enters the fit; a lens that is held without a covariance is taken as good as certain."""
    if not held:
        return CameraInput(views, camera)
    lens = np.array([value.value for value in camera.parameters.values()], float)
    if camera.covariance is None:
        return CameraInput(views, camera, (lens, np.diag(1 / (1e-6 * np.maximum(np.abs(lens), 1e-3)) ** 2)), lens_given=True)
    return CameraInput(views, camera, (lens, np.linalg.inv(np.array(camera.covariance.matrix))))
