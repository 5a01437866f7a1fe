"""OpenCV, checked once where it is first used: pip lets two distributions of it overwrite each other's files.

Only `detection`, `io.images` and `simulation.render` may import this.
"""

from importlib import metadata

from calibkit.errors import BadInputError

_WANTED = "opencv-contrib-python-headless"
_DISTRIBUTIONS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", _WANTED)
_NAMES = ("findChessboardCorners", "aruco", "remap", "imdecode")  # one of each part that calibkit uses


def _remedy(installed: list[str]) -> str:
    return f"run: pip uninstall -y {' '.join(installed)}; pip install {_WANTED}"


def _installed() -> list[str]:
    found = []
    for name in _DISTRIBUTIONS:
        try:
            metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
        found.append(name)
    return found


def check(installed: list[str], module: object) -> None:
    """Raise BadInputError with the exact pip commands when OpenCV is doubled, empty or the broken 4.12."""
    if len(installed) > 1:
        raise BadInputError(f"{len(installed)} OpenCV distributions overwrite each other ({', '.join(installed)}); {_remedy(installed)}")
    missing = [name for name in _NAMES if not hasattr(module, name)]
    if missing:
        raise BadInputError(f"OpenCV (cv2) is incomplete: {', '.join(missing)} missing; {_remedy(installed or [_WANTED])}")
    version = str(getattr(module, "__version__", "0"))
    if version.startswith("4.12."):
        raise BadInputError(f"OpenCV {version} is not supported; {_remedy(installed or [_WANTED])}")


try:
    import cv2
except ImportError as error:
    raise BadInputError(f"OpenCV cannot be imported ({error}); {_remedy(_installed() or [_WANTED])}") from error
check(_installed(), cv2)

__all__ = ["check", "cv2"]
