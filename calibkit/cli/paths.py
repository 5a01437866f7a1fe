"""Files given twice on one command line: with --force an output would destroy what it is made from."""

import os
from collections.abc import Iterable
from pathlib import Path

from calibkit.errors import BadInputError, one_line


def refuse_clashes(inputs: Iterable[Path], outputs: Iterable[Path | None]) -> None:
    """Refuse an output that is an input, or the same as another output."""
    known = {_identity(path): "an input" for path in inputs}
    for path in outputs:
        if path is None:
            continue
        if taken := known.get(_identity(path)):
            raise BadInputError(f"{one_line(path)}: is {taken} of this command, too; give another name")
        known[_identity(path)] = "an output"


def _identity(path: Path) -> object:
    try:
        status = path.stat()
    except (OSError, ValueError):
        return os.path.realpath(path)
    return status.st_dev, status.st_ino
