"""The `calibkit` command: the table of subcommands and the one boundary where errors become a line and an exit code."""

import sys
import traceback
from importlib import import_module
from typing import Annotated

import typer

from calibkit.errors import CalibkitError, one_line
from calibkit.version import __version__

app = typer.Typer(
    name="calibkit",
    help="Find the hidden unknowns of a sensor rig and say how far each may be trusted.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
_STATE = {"debug": False}


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"calibkit {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an internal error.")] = False,
) -> None:
    _STATE["debug"] = debug


# One module a command, imported here because a signature is what --help needs; what they call is imported when they run.
for _name in ():
    import_module(f"calibkit.cli.{_name}").register(app)


def main() -> None:
    """Run the command line; each kind of error is one line on stderr and the exit code of SPEC section 6."""
    try:
        app()
    except CalibkitError as error:
        _fail(error, error.exit_code, f"calibkit: {one_line(error, 1000)}")
    except KeyboardInterrupt:
        typer.echo("calibkit: interrupted, nothing was written", err=True)
        sys.exit(130)
    except Exception as error:
        _fail(error, 4, f"calibkit: internal error: {type(error).__name__}: {one_line(error)} (please report it with --debug's output)")


def _fail(error: Exception, code: int, line: str) -> None:
    if _STATE["debug"]:
        traceback.print_exception(error)
    typer.echo(line, err=True)
    sys.exit(code)
