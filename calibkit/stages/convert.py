"""Foreign calibration files into a rig file, and a rig file into them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calibkit.data.rig import Camera, InputFile, Rig, StageRun
from calibkit.errors import BadInputError, one_line
from calibkit.estimation.model_conversion import nearest
from calibkit.io.atomic import make_folder, refuse_existing, write_atomic
from calibkit.io.foreign import Exporter, camera_values, given_camera
from calibkit.io.formats import EXPORTERS, IMPORTERS
from calibkit.io.rig_file import load_rig, merge_rigs, save_rig
from calibkit.io.yaml_file import Document, load_yaml
from calibkit.models.cameras import CAMERAS
from calibkit.version import __version__

LOSSLESS_PX = 0.1


@dataclass(frozen=True)
class Outcome:
    """The files written, and what a person should know about them."""

    files: tuple[Path, ...]
    notes: tuple[str, ...]
    rig: Rig


def import_files(paths: Sequence[Path], out: Path, force: bool = False, command: str = "calibkit import") -> Outcome:
    """Read foreign files, each in the format it is recognised by, and write them as one rig."""
    refuse_existing(out, force)
    merged, notes, inputs = Rig(), list[str](), list[InputFile]()
    read: list[tuple[Path, Rig]] = []
    for path in paths:
        document = load_yaml(path, opencv=True)
        name = _recognised(document)
        imported = IMPORTERS[name].read(document, merged)
        read.append((path, imported.rig))
        merged = merge_rigs(read)
        notes += [f"{one_line(path.name)}: {one_line(warning)}" for warning in imported.warnings]
        inputs.append(InputFile(name=one_line(path.name), sha256=document.sha256))
    run = StageRun(stage="import", command=one_line(command, 2000), calibkit=__version__, inputs=inputs)
    rig = merged.model_copy(update={"provenance": [run]})
    if not (rig.cameras or rig.imus or rig.transforms):
        raise BadInputError(f"{one_line(paths[0])}: holds no camera, no IMU and no transform; nothing to import")
    save_rig(rig, out, force)
    return Outcome((out,), tuple(notes), rig)


def _recognised(document: Document) -> str:
    data = document.data
    if isinstance(data, dict) and data.get("format") == "calibkit-rig":
        raise document.error(("format",), "is a rig file already; give it as --rig to the next command")
    for name, importer in IMPORTERS.items():
        if isinstance(data, dict) and importer.recognises(data):
            return name
    raise document.error((), f"is in no known format ({', '.join(IMPORTERS)}); a Kalibr chain has cam0, OpenCV and ROS files camera_matrix")


def export_rig(path: Path, to: str, folder: Path, lossy: bool = False, force: bool = False) -> Outcome:
    """Write a rig in a foreign format; a camera that the format cannot hold becomes the nearest one that it can."""
    if to not in EXPORTERS:
        raise BadInputError(f"--to {one_line(to, 40)}: no such format; choose one of {', '.join(EXPORTERS)}")
    rig = load_rig(path)
    exporter = EXPORTERS[to]
    converted = {name: _held(name, camera, exporter, lossy) for name, camera in rig.cameras.items()}
    exported = exporter.write(rig.model_copy(update={"cameras": {name: camera for name, (camera, _) in converted.items()}}))
    if not exported.files:
        raise BadInputError(f"{one_line(path)}: holds nothing that {to} has a place for; calibrate or import a camera first")
    files = {folder / name: text for name, text in exported.files.items()}
    make_folder(folder)
    for file in files:
        if file.exists() and file.samefile(path):
            raise BadInputError(f"{one_line(file)}: is the rig file that is exported; choose another folder")
        refuse_existing(file, force)
    for file, text in files.items():
        write_atomic(file, text, force)
    notes = [note for _, note in converted.values() if note]
    return Outcome(tuple(files), (*notes, *exported.notes), rig)


def _held(name: str, camera: Camera, exporter: Exporter, lossy: bool) -> tuple[Camera, str]:
    """Return the camera as the format can hold it, and what that costs."""
    params = camera_values(name, camera)
    if camera.model in exporter.holds:
        return camera, ""
    targets = [CAMERAS[model] for model in exporter.holds if model in CAMERAS]
    best = nearest(CAMERAS[camera.model], params, camera.resolution, targets)
    lost = f" and {best.lost:.0%} of the image lost" if best.lost else ""
    cost = f"{best.model.name} instead of {camera.model}, off by at most {best.worst_px:.3g} px (rms {best.rms_px:.3g} px){lost}"
    if (best.worst_px > LOSSLESS_PX or best.lost) and not lossy:
        held = ", ".join(target.name for target in targets)
        raise BadInputError(f"{name}: {exporter.name} would hold {cost}; calibrate again with --model {held}, or pass --lossy")
    values = dict(zip(best.model.parameter_names, best.params.tolist(), strict=True))
    return given_camera(best.model.name, values, camera.resolution, camera.topic), f"{name}: written as {cost}"
