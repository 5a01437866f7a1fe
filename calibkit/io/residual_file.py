"""The residual file: what a report is drawn from, beside the rig file, so that no later command needs the recording.

`NAME.STAGE.residuals.npz` is a zip of `header.json` (version, reasons, facts, what the arrays belong to), one `.npy` an array and
one `.jpg` a thumbnail. It is read as untrusted: every size, type and shape is checked before memory is taken, nothing is unpickled.
"""

import hashlib
import io
import json
import re
import zipfile
import zlib
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, ValidationError

from calibkit.data.result import ResidualSet, Result, Thumbnail
from calibkit.data.rig import Rig, StageRun
from calibkit.data.verdict import Reason, Verdict
from calibkit.errors import BadInputError, one_line
from calibkit.io.atomic import write_atomic

MAX_FILE_BYTES = 256 << 20
MAX_TOTAL_BYTES = 1 << 30  # unpacked: a thousand frames of 144 corners are 11 MB
MAX_HEADER_BYTES = 16 << 20  # as objects, JSON takes many times its size
MAX_ENTRIES = 1000
HEADER = "header.json"
_SOME, _SHRUNK = 1 << 16, 0.75
_FAST = 1  # of zlib's levels: the usual one takes twice the time for 2 % less
Dtype = Literal["bool", "int32", "int64", "float64"]

# What calibkit reads by name, and how it must look: the shape behind the n rows. Other context is carried along.
COLUMNS: dict[str, tuple[Dtype, tuple[int, ...]]] = {
    "t_ns": ("int64", ()),
    "sigma": ("float64", ()),
    "uv": ("float64", (2,)),
    "corner": ("int32", ()),
    "frame": ("int32", ()),
    "kept": ("bool", ()),
    "distance": ("float64", ()),
    "tilt": ("float64", ()),
    "axis": ("int32", ()),
    **dict.fromkeys(("tau", "deviation", "fitted", "low", "high"), ("float64", ())),
    "attitude": ("float64", (3,)),
    **dict.fromkeys(("rate", "rate_before", "of_rate", "delay", "window_offset", "window_sigma", "clock"), ("float64", ())),
    **dict.fromkeys(("before", "turn", "place", "motion"), ("float64", (3,))),
    "rotation": ("float64", (4,)),
    "px": ("float64", ()),
    "measured": ("float64", (3,)),
    **dict.fromkeys(("bias", "bias_sigma"), ("float64", (6,))),
}

ArrayName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,39}$")]


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid")

    sensor: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=100)]  # cam0, dt_imu0_cam0
    unit: Annotated[str, Field(max_length=40)]
    context: Annotated[list[ArrayName], Field(max_length=40)]


def _finite(facts: dict[str, JsonValue]) -> dict[str, JsonValue]:
    json.dumps(facts, allow_nan=False)  # they go into report.json, which holds no NaN: a ValueError
    return facts


class _Header(BaseModel):
    model_config = ConfigDict(extra="forbid")

    format: Literal["calibkit-residuals"] = "calibkit-residuals"
    version: Literal[1] = 1
    stage: Annotated[str, Field(max_length=40)]
    sets: Annotated[list[_Entry], Field(max_length=100)]
    thumbnails: Annotated[list[str], Field(max_length=40)]
    reasons: list[tuple[Verdict, str]]
    not_observable: list[str]
    facts: Annotated[dict[str, JsonValue], AfterValidator(_finite)]
    made: dict[str, str] = {}  # what the residuals belong to: see `entry_hashes`


def entry_hashes(rig: Rig) -> dict[str, str]:
    """Return the sha256 of every entry of the rig by key (`cameras.cam0`), without what may be renamed by hand: topic and equation.

    An IMU is two entries: its noise and its intrinsics come from different stages.
    """
    renamed = {"topic", "equation"}
    entries = {
        f"{section}.{name}": entry.model_dump(mode="json", exclude=renamed)
        for section in ("cameras", "transforms", "time_offsets")
        for name, entry in getattr(rig, section).items()
    }
    for name, imu in rig.imus.items():
        entries[f"imus.{name}.noise"] = imu.model_dump(mode="json", exclude={*renamed, "intrinsics"})
        if imu.intrinsics is not None:
            entries[f"imus.{name}.intrinsics"] = imu.intrinsics.model_dump(mode="json", exclude=renamed)
    texts = {key: json.dumps(entry, sort_keys=True) for key, entry in entries.items()}
    return {key: hashlib.sha256(text.encode()).hexdigest() for key, text in texts.items()}


def save_residuals(result: Result, rig_path: Path) -> tuple[str, str]:
    """Write the result's residuals beside the rig file, to be called before the rig is written; return the file's name and sha256.

    Equal results give equal bytes.
    """
    name = f"{rig_path.stem}.{result.stage}.residuals.npz"
    data = _pack(result)
    if len(data) > MAX_FILE_BYTES:
        raise BadInputError(f"{name} would hold {len(data) >> 20} MB, the limit is {MAX_FILE_BYTES >> 20}: use fewer frames")
    write_atomic(rig_path.parent / name, data, overwrite=True)
    return name, hashlib.sha256(data).hexdigest()


def load_result(rig_path: Path, rig: Rig, run: StageRun) -> Result:
    """Return one stage's result as its residual file holds it, for the given rig; BadInputError when it is missing, changed or damaged."""
    name = run.residual_file
    if name is None:
        raise BadInputError(f"{rig_path.name}: stage {one_line(run.stage, 40)} has no residual file")
    if name != Path(name).name or name in ("", ".", "..") or re.search(r"[\\/:\0]", name):
        raise BadInputError(f"{rig_path.name}: residual_file '{one_line(name, 80)}' must be a plain file name beside the rig file")
    shown = one_line(name, 120)
    again = f"run calibkit {one_line(run.stage, 40)} again, or copy the file from where the rig file came from"
    path = rig_path.parent / name
    try:
        if not path.is_file():
            raise BadInputError(f"{shown}: missing beside {rig_path.name}; {again}")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise BadInputError(f"{shown}: larger than {MAX_FILE_BYTES >> 20} MB, not a residual file of calibkit; {again}")
        data = path.read_bytes()
    except OSError as error:
        raise BadInputError(f"{shown}: cannot be read ({one_line(error.strerror or error, 80)})") from error
    if run.residual_sha256 is not None and hashlib.sha256(data).hexdigest() != run.residual_sha256:
        raise BadInputError(f"{shown}: was changed since {rig_path.name} was written; {again}")
    try:
        return _unpack(data, rig)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise BadInputError(f"{shown}: {HEADER}: {one_line(where, 80)}: {one_line(first['msg'], 120)}; {again}") from error
    except _DAMAGE as error:
        raise BadInputError(f"{shown}: damaged ({one_line(error, 120)}); {again}") from error


# What zipfile, zlib, numpy's header parser and json raise on damaged bytes.
_DAMAGE = (zipfile.BadZipFile, zlib.error, ValueError, KeyError, EOFError, OSError, NotImplementedError, RuntimeError, SyntaxError)


def _arrays(residuals: ResidualSet) -> dict[str, NDArray[np.generic]]:
    return {"t_ns": residuals.t_ns, "raw": residuals.raw, "sigma": residuals.sigma, **residuals.context}


def _pack(result: Result) -> bytes:
    header = _Header.model_validate(
        {
            "stage": result.stage,
            "sets": [{"sensor": r.sensor, "unit": r.unit, "context": list(r.context)} for r in result.residuals],
            "thumbnails": [thumbnail.label for thumbnail in result.thumbnails],
            "reasons": [(reason.verdict, reason.text) for reason in result.reasons],
            "not_observable": list(result.not_observable),
            "facts": result.facts,
            "made": entry_hashes(result.rig),
        }
    )
    entries = {HEADER: json.dumps(header.model_dump(mode="json"), ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()}
    for i, residuals in enumerate(result.residuals):
        for key, array in _arrays(residuals).items():
            dtype = COLUMNS[key][0] if key in COLUMNS else _portable(array.dtype)
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.ascontiguousarray(array, np.dtype(dtype).newbyteorder("<")), allow_pickle=False)
            entries[f"{i}.{key}.npy"] = stream.getvalue()
    entries |= {f"{i}.jpg": thumbnail.jpeg for i, thumbnail in enumerate(result.thumbnails)}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in entries.items():
            info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            info.create_system, info.external_attr = 3, 0o644 << 16  # the same bytes on every system
            info.compress_type = zipfile.ZIP_DEFLATED if _shrinks(data) else zipfile.ZIP_STORED
            archive.writestr(info, data, compresslevel=_FAST)
    return out.getvalue()


def _shrinks(data: bytes) -> bool:
    """Whether packing is worth its time, by the beginning: of measured numbers it takes a tenth off for two thirds of the time."""
    some = data[:_SOME]
    return len(zlib.compress(some, _FAST)) < _SHRUNK * len(some)


def _portable(dtype: np.dtype[np.generic]) -> Dtype:
    kinds: dict[str, Dtype] = {"b": "bool", "i": "int64", "u": "int64", "f": "float64"}
    if dtype.kind not in kinds:
        raise ValueError(f"residual context of type {dtype} cannot be saved")
    return kinds[dtype.kind]


def _unpack(data: bytes, rig: Rig) -> Result:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        infos = archive.infolist()
        by_name = {info.filename: info for info in infos}
        if len(infos) > MAX_ENTRIES or len(by_name) != len(infos):
            raise ValueError("too many entries, or the same name twice")
        if sum(info.file_size for info in infos) > MAX_TOTAL_BYTES:
            raise ValueError(f"unpacks to more than {MAX_TOTAL_BYTES >> 20} MB")

        if by_name[HEADER].file_size > MAX_HEADER_BYTES:
            raise ValueError(f"{HEADER} is larger than {MAX_HEADER_BYTES >> 20} MB")

        def read(name: str) -> bytes:
            info = by_name[name]
            with archive.open(info) as stream:  # the declared sizes were capped above; a stream that holds more is cut and fails its CRC
                return stream.read(info.file_size)

        header = _Header.model_validate_json(read(HEADER))
        sets = []
        for i, entry in enumerate(header.sets):
            raw = _array(read(f"{i}.raw.npy"), "raw", None)
            if raw.ndim != 2:
                raise ValueError(f"raw has shape {raw.shape}, expected (n, d)")
            names = ["t_ns", "sigma", *entry.context]
            columns = {name: _array(read(f"{i}.{name}.npy"), name, len(raw)) for name in names}
            sets.append(
                ResidualSet(
                    sensor=entry.sensor,
                    unit=entry.unit,
                    t_ns=columns["t_ns"].astype(np.int64, copy=False),
                    raw=raw.astype(np.float64, copy=False),
                    sigma=columns["sigma"].astype(np.float64, copy=False),
                    context={name: columns[name] for name in entry.context},
                )
            )
        thumbnails = [Thumbnail(label, read(f"{i}.jpg")) for i, label in enumerate(header.thumbnails)]
    if not all(thumbnail.jpeg.startswith(b"\xff\xd8\xff") for thumbnail in thumbnails):
        raise ValueError("a thumbnail is not a JPEG")
    return Result(
        stage=header.stage,
        rig=rig,
        reasons=tuple(Reason(verdict, text) for verdict, text in header.reasons),
        residuals=tuple(sets),
        facts=dict(header.facts),
        thumbnails=tuple(thumbnails),
        not_observable=tuple(header.not_observable),
        made=dict(header.made),
    )


def _array(data: bytes, name: str, rows: int | None) -> NDArray[np.generic]:
    """Return one .npy as a view of its bytes, so that a header that lies about its shape costs nothing."""
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{name} is not a version 1.0 npy array")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    expected = (COLUMNS[name][0],) if name in COLUMNS else ("float64",) if name == "raw" else ("bool", "int64", "float64")
    if fortran or dtype.name not in expected or dtype.names is not None:
        raise ValueError(f"{name} has type {dtype}, expected {' or '.join(expected)}")
    wanted = shape if rows is None else (rows, *(COLUMNS[name][1] if name in COLUMNS else shape[1:]))
    if shape != wanted or any(n < 0 for n in shape):
        raise ValueError(f"{name} has shape {shape}, expected {wanted}")
    count = 1
    for n in shape:
        count *= n
    if len(data) - stream.tell() != count * dtype.itemsize:
        raise ValueError(f"{name} has {len(data) - stream.tell()} bytes for shape {shape}")
    return np.frombuffer(data, dtype, count, stream.tell()).reshape(shape)
