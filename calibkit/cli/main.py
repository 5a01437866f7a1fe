"""The `calibkit` command: the table of subcommands and the one boundary where errors become a line and an exit code."""

import os
import sys
import traceback
from importlib import import_module
from io import TextIOWrapper
from typing import Annotated

import typer

from calibkit.cli.once import refuse_repeated
from calibkit.errors import BadInputError, CalibkitError, one_line
from calibkit.version import __version__

# One module `calibkit.cli.NAME` a command, with `register(app)`; --help lists them in this order.
COMMANDS: tuple[str, ...] = (
    "target",
    "info",
    "intrinsics",
    "allan",
    "imu",
    "timeoffset",
    "handeye",
    "joint",
    "calibrate",
    "observability",
    "diagnose",
    "validate",
    "report",
    "diff",
    "budget",
    "import_",
    "export",
    "simulate",
)

_ANYWHERE = ("--version", "--debug")
_INTERRUPTED = 130
_STATE = {"debug": False}

app = typer.Typer(
    help="Find the hidden unknowns of a sensor rig and say how far each may be trusted.",
    epilog="--version and --debug may stand anywhere on the line.",
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help: importing rich would double the time of --help
)


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"calibkit {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    _STATE["debug"] = debug


# All are imported because --help needs their signatures; what they call is imported when they run.
for _name in COMMANDS:
    import_module(f"calibkit.cli.{_name}").register(app)
refuse_repeated(app)


def main() -> None:
    """Run the command line; each kind of error is one line on stderr and the exit code of SPEC section 6."""
    # Our matrices are small and many: BLAS's own threads only get in each other's way. Read when numpy is first imported.
    for variable in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal or a log that has no sign for sigma is no error
    arguments = sys.argv[1:]
    try:
        if "" in arguments:
            raise BadInputError("an argument is empty: is a variable of the shell unset?")
        code = app(_anywhere_first(arguments) or ["--help"], prog_name="calibkit", standalone_mode=False)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        _fail(error, 2, f"{one_line(error.format_message())} (see {context.command_path if context else 'calibkit'} --help)")
    except CalibkitError as error:
        _fail(error, error.exit_code, one_line(error, 1000))
    except BrokenPipeError:  # the reader of our output has gone, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        what = f"{one_line(error.filename, 120)}: {error.strerror}" if error.filename and error.strerror else one_line(error)
        _fail(error, 2, f"{what}; check the path, its permissions and the room on the disk")
    except Exception as error:
        cause = error.__cause__ if isinstance(error, typer.Abort) and error.__cause__ else error  # Typer's Abort hides an EOFError
        _fail(cause, 4, f"internal error: {type(cause).__name__}: {one_line(cause)} (please report it with --debug's output)")
    if code == _INTERRUPTED:  # what Typer makes of Ctrl-C
        typer.echo("calibkit: interrupted", err=True)
    sys.exit(code if arguments else 2)


def _anywhere_first(arguments: list[str]) -> list[str]:
    """Move the options that hold for every command before the command's name, where Typer looks for them."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return sorted(arguments[:end], key=lambda word: word not in _ANYWHERE) + arguments[end:]


def _fail(error: BaseException, code: int, line: str) -> None:
    if _STATE["debug"]:
        traceback.print_exception(error)
    typer.echo(f"calibkit: {line}", err=True)
    sys.exit(code)
