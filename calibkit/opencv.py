"""OpenCV, checked once where it is first used: pip lets two distributions of it overwrite each other's files.

Only `detection`, `io.images` and `simulation.render` may import this.
"""

import shlex
import sys
from collections.abc import Sequence
from importlib import metadata

from calibkit.errors import BadInputError, one_line

_WANTED = "opencv-contrib-python-headless"
_DISTRIBUTIONS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", _WANTED)
_NAMES = ("findChessboardCorners", "aruco", "remap", "imdecode")  # one of each part that calibkit uses
_OLDEST = (4, 10)
_BROKEN = (4, 12)


def installed_distributions() -> list[str]:
    """Return the names of the OpenCV distributions that pip knows in this environment."""
    found = []
    for name in _DISTRIBUTIONS:
        try:
            metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
        found.append(name)
    return found


def check(installed: Sequence[str], module: object) -> None:
    """Raise BadInputError with the pip commands to run when OpenCV is doubled, incomplete, too old or the broken 4.12."""
    if len(installed) > 1:
        raise BadInputError(f"{len(installed)} OpenCV distributions overwrite each other ({', '.join(installed)}); {_remedy(installed)}")
    missing = [name for name in _NAMES if not hasattr(module, name)]
    if missing:
        place = getattr(module, "__file__", None) or ", ".join(getattr(module, "__path__", ())) or "unknown place"
        raise BadInputError(f"OpenCV (cv2 in {one_line(place)}) is incomplete: no {', '.join(missing)}; {_remedy(installed)}")
    version = str(getattr(module, "__version__", "0.0"))
    number = tuple(int(part) if part.isdigit() else 0 for part in version.split(".")[:2])
    if number < _OLDEST or number == _BROKEN:
        raise BadInputError(f"OpenCV {one_line(version)} is not supported (4.10 and newer are, but 4.12); {_remedy(installed)}")


def _remedy(installed: Sequence[str]) -> str:
    pip = f"{shlex.quote(sys.executable)} -m pip"
    return f'run: {pip} uninstall -y {" ".join(installed or [_WANTED])} && {pip} install "{_WANTED}>=4.10,!=4.12.*"'


try:
    import cv2
except ImportError as error:
    raise BadInputError(f"OpenCV cannot be imported ({one_line(error)}); {_remedy(installed_distributions())}") from error
check(installed_distributions(), cv2)

__all__ = ["check", "cv2", "installed_distributions"]
