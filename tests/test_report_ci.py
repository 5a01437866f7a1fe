"""What a CI server reads: JUnit XML that its schema takes, Markdown that stays tables, the same bytes twice, exit codes."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
import xmlschema
from markdown_it import MarkdownIt
from report_samples import residual_set, result
from test_report_limits import a_rig, lost

from calibkit.data.result import Result
from calibkit.data.rig import Camera, Estimate, Rig
from calibkit.data.verdict import Reason, Verdict
from calibkit.io.residual_file import save_residuals
from calibkit.io.rig_file import save_rig
from calibkit.report.junit import junit
from calibkit.report.limits import read
from calibkit.report.markdown import escape, markdown
from calibkit.report.summary import Demands, summarise
from calibkit.report.summary_text import limit_cells, parameter_cells, signal_cells

SCHEMA = xmlschema.XMLSchema(Path(__file__).with_name("junit.xsd"))
EVIL = (
    "a|b `c` <script>alert(1)</script> ]]> & \"q\" 'q' \x00\x1b[2J\u202e\ufffe\ud800 "
    "[x](http://e.vil) *b* _i_ ~s~ $m$ @you #1 \\| \\\n# h\r\n- i"
)
LIMITS = ("reprojection_rms=0.2px", "fx.sigma=1px", "image_coverage=50%")


def summary_of(made, *asked, observable=False):
    limits = tuple(read(*one.split("="), one) for one in asked)
    return summarise(made.rig, [made], demands=Demands(limits, observable))


@pytest.fixture(scope="module")
def good():
    return result(residuals=residual_set(frames=12, outliers=3), thumbnails=0)


def evil():
    made = result(
        topic=EVIL[:100].replace("\ud800", ""), residuals=residual_set(frames=6), reasons=(Reason(Verdict.CHECK, EVIL),), thumbnails=0
    )
    runs = [made.rig.provenance[0].model_copy(update={"inputs": [made.rig.provenance[0].inputs[0].model_copy(update={"name": EVIL})]})]
    facts = {"frame_labels": {"cam0": [EVIL] * 6}, "lines": [EVIL, f"1. {EVIL}", f"  {EVIL}"]}
    return replace(made, rig=made.rig.model_copy(update={"provenance": runs}), facts=facts)


def cases_of(xml):
    SCHEMA.validate(xml.decode())
    (suite,) = ElementTree.fromstring(xml)
    cases = suite.findall("testcase")
    assert (int(suite.get("tests")), int(suite.get("failures"))) == (len(cases), len(suite.findall("testcase/failure")))
    names = [(case.get("classname"), case.get("name")) for case in cases]
    assert len(set(names)) == len(names)
    return {f"{group}: {name}": case for (group, name), case in zip(names, cases, strict=True)}


def failed(cases):
    return {name for name, case in cases.items() if case.find("failure") is not None}


def test_junit_has_a_case_for_each_reason_limit_signal_and_parameter(good):
    summary = summary_of(good, *LIMITS)
    cases = cases_of(junit(summary))
    assert len(cases) == len(summary.reasons) + len(summary.limits) + len(summary.signals) + len(summary.parameters)
    broken = "cam0: reprojection rms 0.282 px, beyond the limit ≤ 0.2 px (reprojection_rms)"
    assert failed(cases) == {f"calibkit.verdict: {broken}", "calibkit.limits.cam0: reprojection_rms: reprojection rms (intrinsics)"}
    failure = cases[f"calibkit.verdict: {broken}"].find("failure")
    assert (failure.get("type"), failure.get("message"), failure.text) == ("FAIL", broken, broken)
    assert "calibkit.signals.cam0: reprojection rms (intrinsics)" in cases
    assert cases["calibkit.parameters.cam0: fx"].find("system-out").text == "PASS cam0 fx 460.000 +- 0.045 px, determined"


def test_junit_fails_where_the_exit_code_is_1(good):
    """Whatever is CHECK fails with --strict only; what is not observable always does."""
    check = result(residuals=residual_set(frames=12, noise=0.35), thumbnails=0)
    weak = Result(stage="joint", rig=a_rig(), reasons=())
    gone = Result(stage="joint", rig=a_rig(lost("s")), reasons=())
    said = Result(stage="joint", rig=a_rig(lost("s")), reasons=(Reason(Verdict.CHECK, "dt_imu0_cam0: not observable: still"),))
    for made, verdict in ((good, Verdict.PASS), (check, Verdict.CHECK), (weak, Verdict.PASS), (gone, Verdict.FAIL), (said, Verdict.FAIL)):
        summary = summary_of(made)
        assert summary.verdict is verdict
        assert bool(failed(cases_of(junit(summary)))) is (verdict is Verdict.FAIL)
    assert failed(cases_of(junit(summary_of(check), strict=True))) >= {"calibkit.signals.cam0: reprojection rms (intrinsics)"}
    assert "calibkit.parameters.dt_imu0_cam0: offset" in failed(cases_of(junit(summary_of(gone))))
    observable = failed(cases_of(junit(summary_of(weak, observable=True))))
    assert "calibkit.limits.rig: require_observable: parameters that are well observable" in observable


def test_junit_takes_any_text():
    cases = cases_of(junit(summary_of(evil())))
    assert any(
        "<script>alert(1)</script> ]]> &" in case.find("system-out").text for case in cases.values() if case.find("system-out") is not None
    )


def test_the_schema_refuses_what_is_no_junit(good):
    xml = junit(summary_of(good)).decode()
    for old, new in ((' classname="', ' class="'), ("<testcase ", "<test "), (' failures="0"', ""), (' time="0"', ' time=""')):
        with pytest.raises(xmlschema.XMLSchemaException):
            SCHEMA.validate(xml.replace(old, new).replace("</testcase>", "</test>" if "test " in new else "</testcase>"))


# Markdown


def tables_of(text):
    """The cells' texts of every table, and the kinds of all tokens, as GitHub's Markdown has them."""
    parser = MarkdownIt("commonmark").enable(["table", "strikethrough"])
    tables, kinds, cell = [], set(), False
    for token in parser.parse(text):
        kinds |= {token.type, *(child.type for child in token.children or ())}
        if token.type == "table_open":
            tables.append([])
        elif token.type == "tr_open":
            tables[-1].append(())
        elif token.type in ("th_open", "td_open"):
            cell = True
        elif token.type == "inline" and cell:
            tables[-1][-1] += ("".join(child.content for child in token.children),)
            cell = False
        elif token.type in ("th_close", "td_close"):
            cell = False
    return tables, kinds


PLAIN = {
    "heading_open", "heading_close", "inline", "text", "text_special", "bullet_list_open", "bullet_list_close", "list_item_open",
    "list_item_close", "paragraph_open", "paragraph_close", "strong_open", "strong_close", "table_open", "table_close", "thead_open",
    "thead_close", "tbody_open", "tbody_close", "tr_open", "tr_close", "th_open", "th_close", "td_open", "td_close",
}  # fmt: skip


def test_the_markdown_holds_the_tables_of_the_report(good):
    summary = summary_of(good, *LIMITS)
    text = markdown(summary).decode()
    tables, kinds = tables_of(text)
    assert tables == [limit_cells(summary), parameter_cells(summary), signal_cells(summary)]
    assert kinds <= PLAIN
    assert text.startswith("## calibkit: FAIL, do not use it\n\n- **FAIL** cam0: reprojection rms 0.282 px, beyond the limit ≤ 0.2 px (")


def test_text_from_files_stays_text_in_markdown():
    made = evil()
    summary = summary_of(made)
    text = markdown(summary).decode()
    tables, kinds = tables_of(text)
    assert kinds <= PLAIN
    assert [len(set(map(len, table))) for table in tables] == [1, 1]
    clean = " ".join(
        EVIL.replace("\x00", " ").replace("\x1b", " ").replace("\u202e", " ").replace("\ufffe", " ").replace("\ud800", " ").split()
    )
    assert tables[1][4][-1].startswith(clean[:40])
    shown = "".join(child.content for token in MarkdownIt().parse(text) for child in token.children or ())
    assert shown.count(clean) >= 3
    assert "<script" not in MarkdownIt("commonmark").enable("table").render(text)


@pytest.mark.parametrize(
    "text",
    [
        "- a",
        "+ a",
        "1. a",
        "12) a",
        "# a",
        "> a",
        "=",
        "---",
        "a\n\nb",
        "http://a.b",
        "www.a.b",
        "a@b.c",
        "    a",
        "**a**",
        "&lt;",
        "\\",
        "a\\|b",
        "![x](y)",
        "<https://a>",
        "~~a~~",
        "[a]: b",
        "|a|b|",
    ],
)
def test_escaped_text_reads_as_itself(text):
    for wrapped in (f"{escape(text)}\n", f"- {escape(text)}\n"):
        tokens = MarkdownIt("gfm-like", {"linkify": False}).parse(wrapped)
        inline = [token for token in tokens if token.type == "inline"]
        assert len(inline) == 1
        assert {child.type for child in inline[0].children} <= {"text", "text_special"}
        assert "".join(child.content for child in inline[0].children) == " ".join(text.split())
        assert {token.type for token in tokens} <= PLAIN
    assert not re.search(r"(?<!\\)://|www\.|(?<!\\)@", escape(text))  # what GitHub makes links of


# The command


def saved(made, path):
    name, digest = save_residuals(made, path)
    run = made.rig.provenance[-1].model_copy(update={"residual_file": name, "residual_sha256": digest})
    save_rig(made.rig.model_copy(update={"provenance": [run]}), path)
    return path


def test_two_runs_in_two_processes_give_the_same_bytes(tmp_path, good):
    """With two pictures; test_report_page.py has all of them."""
    only = replace(good.residuals[0], context={key: good.residuals[0].context[key] for key in ("uv", "kept")})
    rig = saved(replace(good, residuals=(only,)), tmp_path / "rig.yaml")
    found = []
    for k, seed in enumerate("12"):
        folder = tmp_path / f"run{k}"
        folder.mkdir()
        options = "-o out --json r.json --markdown r.md --junit r.xml --pictures png --pictures pdf --pictures svg"
        command = [
            sys.executable,
            "-c",
            "from calibkit.cli.main import main; main()",
            "report",
            str(rig),
            *options.split(),
            "--limit",
            "reprojection_rms=0.3px",
        ]
        environment = {**os.environ, "PYTHONHASHSEED": seed, "TZ": f"Etc/GMT+{k}"}
        subprocess.run(command, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
        found.append({str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.*")})
    assert found[0] == found[1]
    assert {path.rpartition(".")[2] for path in found[0]} == {"html", "json", "md", "xml", "png", "pdf", "svg"}
    assert len(found[0]) == 6 + 2 * 3
    assert found[0]["r.md"] == found[0]["out/report.md"]
    assert all(data.startswith(b"%PDF") for path, data in found[0].items() if path.endswith("pdf"))


def test_done_when_5(run, tmp_path, good):
    """Unobservable: 1 and why. A missing file, a misspelt limit: 2, one line, nothing written."""
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    values = {name: Estimate(value=0.5) for name in names} | {"k2": lost()}
    reasons = ["k2: not observable: the boards never reached the corners of the image; bring them there"]
    camera = Camera(resolution=(640, 480), model="pinhole-radtan", parameters=values, verdict=Verdict.FAIL, reasons=reasons)
    save_rig(Rig(cameras={"cam0": camera}), tmp_path / "rig.yaml")
    said = run("report", tmp_path / "rig.yaml", "--junit", tmp_path / "r.xml", "--markdown", tmp_path / "r.md")
    assert said.code == 1
    assert f"FAIL  cam0: {reasons[0]}" in said.out
    assert "calibkit.parameters.cam0: k2" in failed(cases_of((tmp_path / "r.xml").read_bytes()))
    assert "**FAIL** cam0: k2: not observable: the boards never reached" in (tmp_path / "r.md").read_text()
    before = sorted(tmp_path.iterdir())
    outputs = ["-o", tmp_path / "out", "--junit", tmp_path / "no.xml", "--markdown", tmp_path / "no.md", "--json", tmp_path / "no.json"]
    assert run("report", tmp_path / "gone.yaml", *outputs).mistake.startswith(f"{tmp_path}/gone.yaml: cannot be read")
    assert "did you mean k1.sigma?" in run("report", tmp_path / "rig.yaml", "--limit", "kk1.sigma=1", *outputs).mistake
    rig = saved(good, tmp_path / "full.yaml")
    (tmp_path / "full.intrinsics.residuals.npz").unlink()
    assert "full.intrinsics.residuals.npz" in run("report", rig, *outputs).mistake
    rig.unlink()
    assert sorted(tmp_path.iterdir()) == before


def test_outputs_that_exist_are_kept_unless_forced(run, tmp_path):
    save_rig(a_rig(), tmp_path / "rig.yaml")
    for option, name in (("--junit", "r.xml"), ("--markdown", "r.md")):
        (tmp_path / name).write_text("mine")
        assert "exists already" in run("report", tmp_path / "rig.yaml", option, tmp_path / name).mistake
        assert (tmp_path / name).read_text() == "mine"
        assert run("report", tmp_path / "rig.yaml", option, tmp_path / name, "--force").code == 0
        assert (tmp_path / name).read_text() != "mine"
