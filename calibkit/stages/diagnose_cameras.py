"""`calibkit diagnose` of a recording without an IMU: whether lenses and places of cameras still fit it, and what is wrong with them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from calibkit.data.progress import Progress
from calibkit.data.rig import Camera, Rig
from calibkit.data.transforms import frames_of
from calibkit.errors import NotConvergedError
from calibkit.estimation.camera_rig_seed import components, match_instants
from calibkit.estimation.diagnosis import diagnose
from calibkit.estimation.diagnosis_words import About, in_words, named
from calibkit.estimation.lens_fit import LensFit, fit_lenses
from calibkit.estimation.lens_suspects import KnownCamera, corners_rms, lens_evidence, together, with_poses
from calibkit.estimation.rig_values import chained, of_estimates
from calibkit.estimation.view_choice import choose_views
from calibkit.models.cameras import CAMERAS
from calibkit.solver.trust import WEAK
from calibkit.stages.camera_imu import CamerasRead, Sensors, read_cameras
from calibkit.stages.diagnose import Diagnosed, Rms, noisier_corners

_MAX_VIEWS = 1500


@dataclass(frozen=True)
class CamerasExamined:
    """A recording's own calibration of cameras beside the one under test."""

    read: CamerasRead
    rig: Rig
    held: tuple[LensFit, ...]  # the calibration under test with the board's poses that suit it best, of cameras that see it at once
    about: About
    diagnosed: Diagnosed


def diagnose_cameras(sources: Sequence[Path], target: Path, rig: Rig, sensors: Sensors, progress: Progress) -> CamerasExamined:
    """Test a rig file's cameras against a recording before a board.

    BadInputError names the file, topic or option that is wrong, or what the rig file lacks; NotConvergedError: no lens fits the recording.
    """
    read = read_cameras(sources, target, rig, sensors, progress)
    models = [lens.model for lens in read.lenses]
    instants = match_instants(read.views)
    groups = components(instants)
    parts, fits, rms, lenses, corners = [], [], {}, {}, {}
    with threadpool_limits(1, user_api="blas"):
        for group in progress(groups, "cameras", len(groups)):
            own = [models[c] for c in group]
            views, shared = choose_views([read.views[c] for c in group], own, tuple(instants[c] for c in group), _MAX_VIEWS)
            fit = fit_lenses(views, own, shared)
            _refuse_unsettled(fit, read)
            known = [_known(rig, read.names[c], read.lenses[c], read.names[group[0]]) for c in group]
            parts.append(lens_evidence(fit, known, group))
            fits.append(with_poses(fit, known))
            held, best = corners_rms(fits[-1]), corners_rms(fit)
            for i, c in enumerate(group):
                rms[c] = Rms(f"{read.names[c]}'s corners", "px", held[i], best[i])
                lenses[c], corners[c] = fit.state.lenses[i], fit.problem.cameras[i].uv[fit.kept[i]]
        found, suspects = together(parts)
        diagnosis = diagnose(found, suspects)
    order = range(len(models))
    about = About(
        read.names,
        read.names[0],
        tuple(CAMERAS[model] for model in models),
        tuple(lenses[c] for c in order),
        tuple(corners[c] for c in order),
        "intrinsics",
    )
    told = tuple(in_words(cause, about) for cause in diagnosis.causes)
    of_rms = tuple(rms[c] for c in order)
    diagnosed = Diagnosed(
        f"{', '.join(read.names)}, without an IMU: {sum(len(each) for each in corners.values())} corners",
        diagnosis,
        told,
        noisier_corners(read.names, read.lenses, of_rms),
        tuple(named(each.key, about) for each in suspects if diagnosis.sigmas[each.key] > WEAK),
        of_rms,
        tuple(read.warnings),
        "intrinsics",
        tuple(name for name in (*rig.transforms, *rig.time_offsets) if not set(frames_of(name)) <= set(read.names)),
    )
    return CamerasExamined(read, rig, tuple(fits), about, diagnosed)


def _refuse_unsettled(fit: LensFit, read: CamerasRead) -> None:
    if not fit.converged:
        names = ", ".join(views.camera for views in fit.views)
        raise NotConvergedError(f"{read.recording.name}: no lens fits the corners of {names}: run calibkit intrinsics, which says why")


def _known(rig: Rig, name: str, camera: Camera, first: str) -> KnownCamera:
    """Return a camera as the rig file has it; a place that is not observable is none."""
    order = CAMERAS[camera.model].parameter_names
    lens = of_estimates(camera.parameters, camera.covariance).of(order)
    T, cov = (None, None) if name == first else chained(rig, name, first) or (None, None)
    return KnownCamera(lens.x, lens.cov, T, cov)
