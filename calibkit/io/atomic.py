"""Files written whole or not at all."""

import json
import os
import secrets
import shutil
import stat
import tempfile
from pathlib import Path

from calibkit.errors import BadInputError, one_line


def write_atomic(path: Path, content: bytes | str, overwrite: bool = False) -> None:
    """Write a file by way of a temporary one in the same folder; an existing file is refused unless `overwrite`."""
    target = path
    try:
        target = Path(os.path.realpath(path))  # through links, so that the link stays one
        temporary = target.with_name(f".{target.name[:40]}.{secrets.token_hex(8)}.tmp")
        refuse_existing(target, overwrite)
        _refuse_no_folder(path)
        try:
            _write_synced(temporary, content.encode() if isinstance(content, str) else content)
            if target.exists():
                shutil.copymode(target, temporary)
            _move(temporary, target, overwrite)
        finally:
            temporary.unlink(missing_ok=True)
        _sync_folder(target.parent)
    except (OSError, ValueError) as error:
        raise BadInputError(f"{one_line(path)}: cannot be written ({reason_of(error)}); choose another place") from None


def write_json(path: Path, data: object, overwrite: bool = False) -> None:
    """Write what `--json` asks for: indented, and never NaN or Infinity, which are no JSON (ValueError)."""
    write_atomic(path, json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n", overwrite)


def reason_of(error: OSError | ValueError) -> str:
    """Return what the system says about a path, without the path."""
    return one_line(getattr(error, "strerror", None) or error)


def make_folder(folder: Path) -> None:
    """Make a folder for outputs where it is missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise BadInputError(f"{one_line(folder)}: is a file; give the name of a folder") from None
    except (OSError, ValueError) as error:
        raise BadInputError(f"{one_line(folder)}: cannot be made ({reason_of(error)}); choose another") from None


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise BadInputError where writing `path` would destroy something: to be asked before long work, too."""
    if path.is_dir():
        raise BadInputError(f"{one_line(path)}: is a folder; give the name of a file")
    if not path.exists():
        return
    if not stat.S_ISREG(path.stat().st_mode):
        raise BadInputError(f"{one_line(path)}: is not a regular file; give another name")
    if not overwrite:
        raise BadInputError(f"{one_line(path)}: exists already; give another name, or --force to overwrite it")


def refuse_unwritable(path: Path, overwrite: bool) -> None:
    """Raise BadInputError where `path` could not be written: to be asked before long work."""
    if str(path) == "-":
        raise BadInputError("-: output goes to files only; give the name of a file")
    if any("\ud800" <= character <= "\udfff" for character in path.name):  # bytes that are no UTF-8: YAML and JSON cannot name the file
        raise BadInputError(f"{one_line(path)}: the name is not UTF-8; give another name")
    refuse_existing(path, overwrite)
    _refuse_no_folder(path)
    try:
        with tempfile.TemporaryFile(dir=os.path.dirname(os.path.realpath(path))):
            pass
    except (OSError, ValueError) as error:
        raise BadInputError(f"{one_line(path)}: cannot be written ({reason_of(error)}); choose another place") from None


def _refuse_no_folder(path: Path) -> None:
    folder = os.path.dirname(os.path.realpath(path))
    if not os.path.exists(folder):
        raise BadInputError(f"{one_line(path)}: there is no folder {one_line(folder)}; make it first")


def _write_synced(path: Path, content: bytes) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as file:  # 0o666: the umask decides
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _move(temporary: Path, target: Path, overwrite: bool) -> None:
    if not overwrite:
        try:
            os.link(temporary, target)  # unlike a rename, fails where another process was quicker
        except FileExistsError:
            refuse_existing(target, overwrite)
            raise
        except OSError:  # a file system without hard links
            refuse_existing(target, overwrite)
        else:
            return
    os.replace(temporary, target)


def _sync_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:  # some network file systems refuse it; the file itself is synced
        pass
    finally:
        os.close(handle)
