"""How a run of the command line ended, for the fixture `run` of conftest.py."""

from collections.abc import Callable
from typing import NamedTuple


class Said(NamedTuple):
    """Exit code, stdout and stderr."""

    code: int
    out: str
    err: str

    @property
    def mistake(self) -> str:
        """The one line of an error that wrote nothing, without the program's name."""
        lines = self.err.splitlines()
        assert (self.code, self.out, len(lines)) == (2, "", 1), self
        assert lines[0].startswith("calibkit: "), self
        return lines[0].removeprefix("calibkit: ")


Run = Callable[..., Said]
