"""`calibkit report`: from the rig file and its residual files to words, pages and exit codes, without the recording."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from report_samples import residual_set, result
from typer.testing import CliRunner

from calibkit.cli.main import app
from calibkit.data.rig import Camera, Estimate, Rig
from calibkit.data.verdict import Reason, Status, Verdict
from calibkit.errors import BadInputError
from calibkit.io.residual_file import save_residuals
from calibkit.io.rig_file import save_rig, updated
from calibkit.report.summary import summarise
from calibkit.stages.outputs import Outputs
from calibkit.stages.report import Files, report, write_pages


def save(made, path):
    """Write a result as a stage does: the residuals first, then the rig with their hash; return the result as the rig file has it."""
    name, digest = save_residuals(made, path)
    run = made.rig.provenance[-1].model_copy(update={"residual_file": name, "residual_sha256": digest})
    rig = made.rig.model_copy(update={"provenance": [run]})
    save_rig(rig, path)
    return rig


def run(*arguments):
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


@pytest.fixture
def small():
    return result(residuals=residual_set(frames=12, outliers=3), thumbnails=1)


def test_the_verdict_and_the_table_need_no_recording(tmp_path, small):
    save(small, tmp_path / "rig.yaml")
    got = run(tmp_path / "rig.yaml")
    assert got.exit_code == 0, got.output
    assert "cam0 fx    460.000   0.045    0.026    1.70    px    determined" in got.output
    assert "cam0    reprojection rms" in got.output
    assert "\nPASS\n  PASS  cam0: reprojection rms 0.28 px over 5000 corners" in got.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.intrinsics.residuals.npz", "rig.yaml"]


def test_the_stage_and_the_rig_file_give_the_same_pages(tmp_path, small):
    rig = save(small, tmp_path / "rig.yaml")
    got = run(tmp_path / "rig.yaml", "-o", tmp_path / "later", "--json", tmp_path / "verdict.json")
    assert got.exit_code == 0, got.output
    assert got.output.splitlines()[-2].startswith("report: ")
    write_pages(summarise(rig, [replace(small, rig=rig)]), tmp_path / "at_once")
    later, at_once = (
        {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.*")}
        for folder in (tmp_path / "later", tmp_path / "at_once")
    )
    assert later == at_once
    assert {"report.html", "report.json", "report.md", "pictures/cam0-intrinsics-field.png"} <= later.keys()
    asked, paged = (json.loads(path.read_text()) for path in (tmp_path / "verdict.json", tmp_path / "later" / "report.json"))
    assert {**paged, "pictures": []} == asked


def test_fail_is_exit_code_1_and_check_only_when_strict(tmp_path):
    save(result(residuals=residual_set(frames=12, noise=0.35), thumbnails=0), tmp_path / "check.yaml")
    save(result(residuals=residual_set(frames=12, noise=1.5), thumbnails=0), tmp_path / "fail.yaml")
    assert run(tmp_path / "check.yaml").exit_code == 0
    assert run(tmp_path / "check.yaml", "--strict").exit_code == 1
    assert run(tmp_path / "fail.yaml").exit_code == 1


def test_what_is_not_observable_fails_and_says_so(tmp_path, small):
    camera = small.rig.cameras["cam0"]
    k2 = Estimate(value=None, status=Status.NOT_OBSERVABLE)
    rig = small.rig.model_copy(update={"cameras": {"cam0": camera.model_copy(update={"parameters": {**camera.parameters, "k2": k2}})}})
    save(type(small)(**{**small.__dict__, "rig": rig, "not_observable": ("k2",)}), tmp_path / "rig.yaml")
    got = run(tmp_path / "rig.yaml", "--json", tmp_path / "r.json")
    assert got.exit_code == 1
    assert "FAIL  cam0: not observable in this recording: k2" in got.output
    data = json.loads((tmp_path / "r.json").read_text())
    assert data["not_observable"] == ["cam0.k2"]
    assert sum("not observable" in reason["text"] for reason in data["reasons"]) == 1


def test_the_rig_file_s_own_verdict_counts_without_residuals(tmp_path):
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    camera = Camera(resolution=(640, 480), model="pinhole-radtan", parameters={name: Estimate(value=0.5) for name in names})
    save_rig(Rig(cameras={"cam0": camera}), tmp_path / "given.yaml")
    assert report(tmp_path / "given.yaml").verdict is Verdict.CHECK
    bad = camera.model_copy(update={"verdict": Verdict.FAIL, "reasons": ["rms is 4 px"]})
    save_rig(Rig(cameras={"cam0": bad}), tmp_path / "bad.yaml")
    assert report(tmp_path / "bad.yaml").reasons == (Reason(Verdict.FAIL, "cam0: rms is 4 px"),)


def test_a_missing_file_is_exit_code_2_and_writes_nothing(tmp_path, small):
    save(small, tmp_path / "rig.yaml")
    (tmp_path / "rig.intrinsics.residuals.npz").unlink()
    for rig in ("rig.yaml", "other.yaml"):
        with pytest.raises(BadInputError, match="rig.intrinsics.residuals.npz" if rig == "rig.yaml" else "other.yaml"):
            report(tmp_path / rig, Files(tmp_path / "out", tmp_path / "out.json", tmp_path / "out.md", tmp_path / "out.xml"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.yaml"]


@pytest.mark.parametrize(("old", "new"), [("value: 370.0", "value: 1370.0"), ("rms_px: 0.283", "rms_px: 0.083"), ("752", "753")])
def test_an_entry_changed_by_hand_is_refused_by_name(tmp_path, small, old, new):
    path = tmp_path / "rig.yaml"
    save(small, path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(BadInputError, match=r"^rig.yaml: cameras.cam0 was changed since intrinsics made it: .*run intrinsics again$"):
        report(path)


def test_the_topic_may_be_renamed_by_hand(tmp_path, small):
    path = tmp_path / "rig.yaml"
    save(small, path)
    path.write_text(path.read_text().replace("topic: /cam0/image_raw", "topic: /camera"))
    assert report(path).rig.cameras["cam0"].topic == "/camera"


def test_residuals_of_an_entry_that_a_later_stage_made_anew_are_left_out(tmp_path, small):
    """The older stage's FAIL and residuals of cam0 are no longer those of the rig."""
    older = result(residuals=residual_set(frames=12, noise=1.5), thumbnails=0, reasons=(Reason(Verdict.FAIL, "cam0: bad"),))
    camera = older.rig.cameras["cam0"]
    worse = {**camera.parameters, "fx": camera.parameters["fx"].model_copy(update={"value": 500.0})}
    older = replace(older, rig=older.rig.model_copy(update={"cameras": {"cam0": camera.model_copy(update={"parameters": worse})}}))
    first = save(older, tmp_path / "old.yaml")
    last = save(replace(small, stage="joint"), tmp_path / "rig.yaml")
    save_rig(updated(first, last), tmp_path / "rig.yaml", force=True)
    summary = report(tmp_path / "rig.yaml")
    assert [view.stage for view in summary.views] == ["joint"]
    assert summary.verdict is Verdict.PASS


@pytest.mark.slow
def test_an_existing_report_is_kept_unless_forced(tmp_path, small):
    save(small, tmp_path / "rig.yaml")
    report(tmp_path / "rig.yaml", Files(tmp_path / "out"))
    page = tmp_path / "out" / "report.html"
    page.write_text("mine")
    with pytest.raises(BadInputError, match="--force"):
        report(tmp_path / "rig.yaml", Files(tmp_path / "out"))
    assert page.read_text() == "mine"
    report(tmp_path / "rig.yaml", Files(tmp_path / "out", force=True))
    assert page.read_text() != "mine"
    with pytest.raises(BadInputError, match="is a file"):
        report(tmp_path / "rig.yaml", Files(tmp_path / "rig.yaml"))


def test_where_nothing_can_be_written_is_told_by_the_name_that_was_given(tmp_path, monkeypatch):
    """Before any work: neither the rig file nor the residuals' name is looked at."""
    monkeypatch.chdir(tmp_path)
    for field in ("out", "json"):
        with pytest.raises(BadInputError, match=r"^no/a.yaml: there is no folder .*/no; make it first$"):
            Outputs(**{field: Path("no/a.yaml")}, rigs=(Path("gone.yaml"),)).open()
        with pytest.raises(BadInputError, match=r"^-: .*name of a file"):
            Outputs(**{field: Path("-")}).open()
    (tmp_path / "file").touch()
    with pytest.raises(BadInputError, match=r"^file/a.yaml: cannot be written \(Not a directory\)"):
        Outputs(out=Path("file/a.yaml")).open()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_text_from_files_cannot_drive_the_terminal(tmp_path):
    save(result(reasons=(Reason(Verdict.CHECK, "bad \x1b[2J\u202etopic [red]x"),), thumbnails=0), tmp_path / "rig.yaml")
    got = run(tmp_path / "rig.yaml")
    assert "CHECK bad [2J topic [red]x" in got.output
    assert "\x1b" not in got.output
    assert "\u202e" not in got.output
