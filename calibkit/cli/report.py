"""`calibkit report`: the verdict on a rig file, and its report as pages and for CI."""

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from calibkit.cli import options


class Format(str, Enum):
    """Of the files of pictures."""

    PNG = "png"
    PDF = "pdf"
    SVG = "svg"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(name="report")(report)


def report(
    rig: Annotated[Path, typer.Argument(metavar="RIG.yaml", help="The rig file; its residual files lie beside it.")],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--report", metavar="DIR", help="Write report.html, report.md, report.json and the pictures here."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the verdict, parameters, signals and limits as JSON.")
    ] = None,
    markdown: Annotated[
        Path | None, typer.Option("--markdown", metavar="FILE.md", help="Write a summary for the page of a CI job; also DIR/report.md.")
    ] = None,
    junit: Annotated[
        Path | None, typer.Option("--junit", metavar="FILE.xml", help="Write JUnit XML, for a CI server's list of tests.")
    ] = None,
    pictures: Annotated[
        list[Format] | None,
        typer.Option("--pictures", help="Format of the files in DIR/pictures; repeatable. [default: png]"),
    ] = None,
    limit: Annotated[
        list[str] | None,
        typer.Option(
            "--limit", metavar="NAME=VALUE", help="FAIL beyond it: reprojection_rms=0.3px, td.sigma=0.1ms, T.p.sigma=2mm; repeatable."
        ),
    ] = None,
    limits: Annotated[
        Path | None, typer.Option("--limits", metavar="FILE.yaml", help="Limits, one NAME: VALUE a line; --limit goes before them.")
    ] = None,
    require_observable: Annotated[
        bool, typer.Option("--require-observable", help="FAIL where a parameter is weak, too; not observable ones FAIL anyway.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an earlier report.")] = False,
    strict: options.Strict = False,
) -> None:
    """Judge a rig file: verdict, sigmas, signals, limits.

    The verdict with its reasons, every parameter with its sigma, the signals in its residuals. A limit's NAME is a signal's key (as in
    report.json) or a parameter with .sigma or .value, of one part of the rig (cam0.fx.sigma) or of all (fx.sigma); td stands for all
    time offsets, T.p and T.r for all translations and rotations. docs/ci.md has them all, and a workflow.

    Exit code 1 on FAIL, which includes broken limits and parameters that are not observable; 2 when a file is missing or was changed, or a
    limit names nothing in this rig.
    """
    from calibkit.cli.paths import refuse_clashes
    from calibkit.data.verdict import Verdict
    from calibkit.errors import BadInputError, one_line
    from calibkit.report.summary_text import text
    from calibkit.stages import report as stage
    from calibkit.stages.limits_file import demands

    refuse_clashes([rig, *([limits] if limits else [])], [out, json_file, markdown, junit])
    formats = tuple(form.value for form in pictures) if pictures else stage.Files.pictures
    if pictures and out is None:
        raise BadInputError("--pictures: goes with --report DIR, where they are written")
    files = stage.Files(out, json_file, markdown, junit, formats, force)
    summary = stage.report(rig, files, demands(limit or (), limits, require_observable), strict)
    typer.echo(text(summary))
    for what, path in (("report", out and out / stage.FILES[0]), ("markdown", markdown), ("junit", junit), ("json", json_file)):
        if path is not None:
            typer.echo(f"{what}: {one_line(path)}")
    if summary.verdict is Verdict.FAIL or (strict and summary.verdict is Verdict.CHECK):
        raise typer.Exit(1)
