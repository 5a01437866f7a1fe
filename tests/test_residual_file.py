"""The residual file: what is written comes back bit by bit, and nothing that a stranger's file holds does harm."""

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from report_samples import residual_set, result

from calibkit.data.rig import StageRun
from calibkit.errors import BadInputError
from calibkit.io import residual_file
from calibkit.io.residual_file import load_result, save_residuals


@pytest.fixture
def saved(tmp_path):
    """A small result saved beside rig.yaml: (result, rig path, the run that names the file)."""
    made = result(residuals=residual_set(frames=4, outliers=2), thumbnails=2)
    rig_path = tmp_path / "rig.yaml"
    name, digest = save_residuals(made, rig_path)
    return made, rig_path, StageRun(stage="intrinsics", command="c", calibkit="0", residual_file=name, residual_sha256=digest)


def test_round_trip(saved):
    made, rig_path, run = saved
    back = load_result(rig_path, made.rig, run)
    assert run.residual_file == "rig.intrinsics.residuals.npz"
    assert (back.stage, back.reasons, back.facts, back.thumbnails) == (made.stage, made.reasons, made.facts, made.thumbnails)
    for old, new in zip(made.residuals, back.residuals, strict=True):
        assert (old.sensor, old.unit, list(old.context)) == (new.sensor, new.unit, list(new.context))
        for key, array in residual_file._arrays(old).items():
            other = residual_file._arrays(new)[key]
            assert array.dtype == other.dtype
            np.testing.assert_array_equal(array, other)


def test_numpy_reads_it_without_pickle(saved):
    made, rig_path, run = saved
    with np.load(rig_path.parent / run.residual_file, allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["0.raw"], made.residuals[0].raw)


def test_equal_results_give_equal_bytes(saved, tmp_path):
    made, _, run = saved
    (tmp_path / "other").mkdir()
    assert save_residuals(made, tmp_path / "other" / "rig.yaml") == (run.residual_file, run.residual_sha256)


def test_rows_without_a_prediction_survive(tmp_path):
    residuals = residual_set(frames=4, outliers=2)
    residuals.raw[3] = np.nan
    made = result(residuals=residuals, thumbnails=0)
    name, _ = save_residuals(made, tmp_path / "rig.yaml")
    back = load_result(tmp_path / "rig.yaml", made.rig, StageRun(stage="intrinsics", command="c", calibkit="0", residual_file=name))
    np.testing.assert_array_equal(np.isnan(back.residuals[0].raw[:, 0]).nonzero()[0], [3])


@pytest.mark.parametrize("name", ["../rig.npz", "/etc/passwd", "a/b.npz", "a\\b.npz", "..", "", "C:x.npz", "x\0.npz"])
def test_a_name_that_leaves_the_folder_is_refused(saved, name):
    made, rig_path, run = saved
    with pytest.raises(BadInputError, match="plain file name"):
        load_result(rig_path, made.rig, run.model_copy(update={"residual_file": name}))


def test_missing_and_changed_are_named_with_the_remedy(saved):
    made, rig_path, run = saved
    path = rig_path.parent / run.residual_file
    path.write_bytes(path.read_bytes() + b" ")
    with pytest.raises(
        BadInputError, match=r"rig\.intrinsics\.residuals\.npz: was changed since rig\.yaml was written; run calibkit intrinsics"
    ):
        load_result(rig_path, made.rig, run)
    path.unlink()
    with pytest.raises(BadInputError, match=r"rig\.intrinsics\.residuals\.npz: missing beside rig\.yaml; run calibkit intrinsics again"):
        load_result(rig_path, made.rig, run)


def _rewrite(path, **changes):
    """Replace entries of the zip: None leaves one out."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    entries |= changes
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            if data is not None:
                archive.writestr(name, data)


def _npy(array, **kwargs):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, **kwargs)
    return stream.getvalue()


def _lying_npy(shape):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue() + b"\0" * 16


def _header(**changes):
    base = {"stage": "s", "sets": [], "thumbnails": [], "reasons": [], "not_observable": [], "facts": {}}
    return json.dumps(base | changes).encode()


@pytest.mark.parametrize(
    ("entry", "data", "message"),
    [
        ("0.raw.npy", _npy(np.array([[{}]]), allow_pickle=True), "type object"),
        ("0.raw.npy", _npy(np.zeros((3, 2), [("a", "<f8")])), "type"),
        ("0.raw.npy", _npy(np.zeros((3, 2))), "has shape"),
        ("0.raw.npy", _npy(np.zeros(3)), "expected"),
        ("0.raw.npy", _lying_npy((10**12, 2)), "bytes for shape"),
        ("0.raw.npy", _lying_npy((-1, -2)), "expected"),
        ("0.raw.npy", b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535, "damaged"),
        ("0.raw.npy", None, "damaged"),
        ("0.frame.npy", _npy(np.zeros(3, np.int32)), "has shape"),
        ("0.kept.npy", _npy(np.zeros(3)), "expected bool"),
        ("0.jpg", b"<svg onload=alert(1)>", "not a JPEG"),
        ("header.json", None, "damaged"),
        ("header.json", b"[" * 100_000, "header.json"),
        ("header.json", _header(facts={"a": [float("nan")]}), "facts: .*not JSON compliant"),
        ("header.json", b'{"facts": {"a": 1e999}}', "header.json"),
        ("header.json", _header() + b" " * (17 << 20), "header.json is larger than 16 MB"),
        ("header.json", _header(version=2), "version"),
        ("header.json", _header(surprise=1), "surprise"),
        ("header.json", _header(sets=[{"sensor": "../cam", "unit": "px", "context": []}]), "sensor"),
        ("header.json", _header(sets=[{"sensor": "cam", "unit": "px", "context": ["../x"]}]), "context"),
    ],
)
def test_a_hostile_entry_is_one_line(saved, entry, data, message):
    made, rig_path, run = saved
    _rewrite(rig_path.parent / run.residual_file, **{entry: data})
    with pytest.raises(BadInputError, match=message) as caught:
        load_result(rig_path, made.rig, run.model_copy(update={"residual_sha256": None}))
    assert "\n" not in str(caught.value)


def test_a_zip_that_unpacks_to_too_much_is_refused_before_unpacking(saved, monkeypatch):
    made, rig_path, run = saved
    _rewrite(rig_path.parent / run.residual_file, bomb=b"\0" * (4 << 20))
    monkeypatch.setattr(residual_file, "MAX_TOTAL_BYTES", 2 << 20)
    with pytest.raises(BadInputError, match="unpacks to more than 2 MB"):
        load_result(rig_path, made.rig, run.model_copy(update={"residual_sha256": None}))


def test_damaged_bytes_never_raise_anything_else(saved):
    """Cuts and random bytes anywhere: a result or one BadInputError."""
    made, rig_path, run = saved
    path = rig_path.parent / run.residual_file
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    run = run.model_copy(update={"residual_sha256": None})
    refused = 0
    for i in range(200):
        data = bytearray(good[: rng.integers(len(good))] if i % 4 == 0 else good)
        for at in rng.integers(0, max(len(data), 1), 3) if data else ():
            data[at] = rng.integers(256)
        if i % 4 == 1:  # the directory at the end, where zip keeps names and sizes
            data[-rng.integers(1, 400)] = rng.integers(256)
        path.write_bytes(bytes(data))
        try:
            load_result(rig_path, made.rig, run)
        except BadInputError:
            refused += 1
    assert refused > 100


def test_context_that_is_no_number_cannot_be_saved(tmp_path):
    residuals = residual_set(frames=4, outliers=2)
    labelled = replace(residuals, context={**residuals.context, "name": np.array(["x"] * len(residuals.raw))})
    with pytest.raises(ValueError, match="cannot be saved"):
        save_residuals(result(residuals=labelled, thumbnails=0), tmp_path / "rig.yaml")
