"""The command line's boundary: fast help without heavy imports, one line and one exit code for each kind of error."""

import json
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest
import typer
from commands import Run

from calibkit.cli import main as cli
from calibkit.errors import BadInputError, NotConvergedError
from calibkit.version import __version__

CHECK = "; check the path, its permissions and the room on the disk"
HEAVY = ("cv2", "jinja2", "matplotlib", "numba", "numpy", "pydantic", "rich", "rosbags", "scipy", "yaml")
LIST_MODULES = """
import json, sys
from calibkit.cli.main import main
sys.argv = ["calibkit", *sys.argv[1:]]
try:
    main()
except SystemExit as end:
    assert end.code == 0, end.code
print()
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def command_lines() -> list[list[str]]:
    """Return the words of every command, also those in groups."""
    found = [[str(command.name)] for command in cli.app.registered_commands]
    for group in cli.app.registered_groups:
        inner = group.typer_instance
        assert inner is not None
        name = str(inner.info.name)
        found += [[name], *([name, str(command.name)] for command in inner.registered_commands)]
    return found


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], *([*words, "--help"] for words in command_lines())], ids=" ".join)
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    result = subprocess.run([sys.executable, "-c", LIST_MODULES, *arguments], capture_output=True, text=True, check=True)
    modules = json.loads(result.stdout.splitlines()[-1])
    assert "typer" in modules
    typers_own = {"pydantic"} if len(arguments) > 1 else set()  # typer 0.29 builds a command's parameters with it
    assert [name for name in HEAVY if name in modules and name not in typers_own] == []


def test_help_takes_less_than_300_ms() -> None:
    # CPU time of the whole process, the least of five: wall time would measure what else the machine does.
    command = [sys.executable, "-c", "from calibkit.cli.main import main; main()", "--help"]
    seconds = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(seconds) < 0.3


Raise = Callable[[BaseException], None]


@pytest.fixture
def boom() -> Iterator[Raise]:
    """A command `boom` that raises what it is given, taken out of the table again after the test."""
    kept = list(cli.app.registered_commands)
    raised: list[BaseException] = []

    def boom(limit: int = 0) -> None:
        raise raised[0]

    cli.app.command()(boom)
    yield raised.append
    cli.app.registered_commands[:] = kept


@pytest.mark.parametrize("arguments", [["--version"], ["boom", "--version"], ["boom", "--limit", "3", "--version"]])
def test_version_stands_anywhere(run: Run, boom: Raise, arguments: list[str]) -> None:
    assert run(*arguments) == (0, f"calibkit {__version__}\n", "")


def test_bare_command_shows_help_and_is_a_usage_error(run: Run) -> None:
    code, out, err = run()
    assert (code, err) == (2, "")
    usage, _, commands = out.partition("\nCommands:\n")
    assert usage.startswith("Usage: calibkit ")
    assert len(commands.splitlines()) > len(cli.COMMANDS)
    assert "..." not in commands  # no command's line is cut


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nonsense"], "No such command 'nonsense'. (see calibkit --help)"),
        (["--nonsense"], "No such option: --nonsense (see calibkit --help)"),
        (["boom", "--nonsense"], "No such option: --nonsense (see calibkit boom --help)"),
        (["boom", "extra"], "Got unexpected extra argument(s) (extra) (see calibkit boom --help)"),
        (["boom", "--limit", "many\n\x1b[31m"], "Invalid value for '--limit'"),
    ],
)
def test_usage_errors_are_one_line(run: Run, boom: Raise, arguments: list[str], said: str) -> None:
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert said in err
    assert err.startswith("calibkit: ")
    assert err.count("\n") == 1
    assert "\x1b" not in err


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["intrinsics", "a.bag", "--target", "a.yaml", "--target=b.yaml"], "--target is given twice"),
        (["report", "rig.yaml", "--markdown", "a", "--markdown", "a", "--markdown", "b"], "--markdown is given 3 times"),
        (["joint", "a.bag", "-o", "a.yaml", "--out", "b.yaml"], "--out is given twice"),
        (["diagnose", "rig.yaml", "a.bag", "--imu", "/imu0", "--imu", "/imu0"], "--imu is given twice"),
        (["target", "aprilgrid", "--columns", "6", "--columns", "7"], "--columns is given twice"),
    ],
)
def test_an_option_of_one_value_is_given_once(run: Run, arguments: list[str], option: str) -> None:
    command = " ".join(arguments[: 1 + (arguments[0] == "target")])
    assert run(*arguments).mistake == f"{option} and holds one value: keep one of them (see calibkit {command} --help)"


def test_flags_and_options_of_several_values_may_be_repeated(run: Run) -> None:
    said = run("report", "no.yaml", "--strict", "--strict", "--limit", "fx.sigma=1px", "--limit", "fy.sigma=1px")
    assert said.mistake.startswith("no.yaml: cannot be read")


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (BadInputError("a.bag: no topic\n\x1b[31m/cam0; give --camera"), 2, "calibkit: a.bag: no topic [31m/cam0; give --camera"),
        (NotConvergedError("no answer"), 4, "calibkit: no answer"),
        (FileNotFoundError(2, "No such file or directory", "a.bag"), 2, f"calibkit: a.bag: No such file or directory{CHECK}"),
        (PermissionError(13, "Permission denied", "out"), 2, f"calibkit: out: Permission denied{CHECK}"),
        (OSError(28, "No space left on device"), 2, f"calibkit: [Errno 28] No space left on device{CHECK}"),
        (ValueError("odd"), 4, "calibkit: internal error: ValueError: odd (please report it with --debug's output)"),
        (EOFError("cut"), 4, "calibkit: internal error: EOFError: cut (please report it with --debug's output)"),
        (KeyboardInterrupt(), 130, "calibkit: interrupted"),
        (typer.BadParameter("too many"), 2, "calibkit: Invalid value: too many (see calibkit boom --help)"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_each_kind_of_error_has_its_line_and_code(run: Run, boom: Raise, error: BaseException, code: int, line: str) -> None:
    boom(error)
    found, out, err = run("boom")
    assert (found, out, err.strip().splitlines()) == (code, "", [line])


@pytest.mark.parametrize("code", [0, 1, 3])
def test_a_command_chooses_its_exit_code(run: Run, boom: Raise, code: int) -> None:
    boom(typer.Exit(code))
    assert run("boom") == (code, "", "")


@pytest.mark.parametrize("arguments", [["--debug", "boom"], ["boom", "--debug"]])
def test_debug_shows_the_traceback(run: Run, boom: Raise, arguments: list[str]) -> None:
    boom(ValueError("odd"))
    code, _, err = run(*arguments)
    assert code == 4
    assert "Traceback" in err
    assert err.splitlines()[-1].startswith("calibkit: internal error: ValueError: odd")
    assert "Traceback" not in run("boom")[2]
