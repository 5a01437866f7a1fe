"""Which convention a pose file's columns follow: by their names, else by their count where only one fits; else it is asked for."""

from dataclasses import replace

import numpy as np

from calibkit.errors import BadInputError, one_line
from calibkit.io.pose_formats import FORMATS, fault
from calibkit.io.pose_names import ROTATIONS, ROTVEC, RPY, RXYZ, WPR, PoseRows
from calibkit.io.text_table import XYZ

_COUNTERS = 1e8  # whole numbers below are counters and no times, as in folders of images
_ALSO = {"ur-rotvec": ROTVEC, "rpy": RPY, "fanuc-wpr": WPR}  # what rx, ry, rz can be: a vector, or angles about x, y and z
Named = tuple[PoseRows, str, tuple[str, ...]]  # rows with named columns, the format, notes


def name_columns(rows: PoseRows, fmt: str | None) -> Named:
    """Return the rows with all columns named, their format, and notes; BadInputError where several conventions fit, or none."""
    return _by_count(rows, fmt) if rows.columns is None else _by_name(rows, fmt)


def without_lead(rows: PoseRows) -> PoseRows:
    """Return the rows without their first column, which becomes their counter or their times."""
    lead = _lead(rows)
    if lead is None:
        raise BadInputError(f"{one_line(rows.path)}: its first column is neither a counter nor a time: check the number of columns")
    numbers = rows.numbers[:, 1:]
    if lead == "time":
        return replace(rows, numbers=numbers, stamps=rows.firsts)
    return replace(rows, numbers=numbers, labels=rows.labels or tuple(f"{value:.0f}" for value in rows.numbers[:, 0]))


def _lead(rows: PoseRows) -> str | None:
    """Return what the first column can be beside the pose: "counter" or "time" where it grows from row to row."""
    first = rows.numbers[:, 0]
    if not np.all(np.diff(first) > 0):
        return None
    whole = np.all(first == np.rint(first)) and np.all((first >= 0) & (first < _COUNTERS))
    return "counter" if whole else "time"


def _by_name(rows: PoseRows, fmt: str | None) -> Named:
    """Return rows whose columns the file names, and the format that they have."""
    held = set(rows.columns or ())
    path = one_line(rows.path)
    turns = [names for names in ROTATIONS if held >= set(names)]
    if len(turns) != 1 or not held >= set(XYZ):
        names = one_line(" ".join(rows.columns or ()), 120)
        raise BadInputError(f"{path}: the columns named are {names}: wanted are x y z and one whole rotation, such as qx qy qz qw")
    if turns[0] == RXYZ and fmt is None:
        raise _ask(path, "columns rx, ry, rz fit", list(_ALSO))
    if turns[0] == RXYZ and fmt in _ALSO:
        other = dict(zip(RXYZ, _ALSO[fmt], strict=True))
        columns = tuple(other.get(name, name) for name in rows.columns or ())
        rows = replace(rows, columns=columns, units={other.get(name, name): unit for name, unit in rows.units.items()})
        turns = [_ALSO[fmt]]
    fitting = [name for name, form in FORMATS.items() if set(form.layouts[0]) >= set(turns[0])] or list(_ALSO)
    if fmt is not None and fmt not in fitting:
        raise BadInputError(f"{path}: its columns are named {' '.join(turns[0])}, which are {' or '.join(fitting)} and not {fmt}")
    if fmt == "tum" and rows.stamps is None:
        raise BadInputError(f"{path}: has no time column t, which tum has: add it, or --pose-format ros")
    return rows, fmt or fitting[0], ()


def _by_count(rows: PoseRows, fmt: str | None) -> Named:
    """Return rows with the columns of the only format that they fit."""
    width, lead, path = rows.numbers.shape[1], _lead(rows), one_line(rows.path)
    exact: list[tuple[str, PoseRows]] = []
    led: list[tuple[str, PoseRows]] = []  # where the first column is not the pose's
    for name, form in FORMATS.items():
        for layout in form.layouts if fmt in (None, name) else ():
            if len(layout) == width:
                exact.append((name, _with_columns(rows, layout)))
            elif len(layout) + 1 == width and lead is not None and name != "tum":
                led.append((name, _with_columns(without_lead(rows), layout)))
    if not exact + led:
        raise _wrong_count(path, width, fmt)
    good = [(name, named) for name, named in exact if fault(named) is None]
    if not good or lead == "counter":  # 1, 2, 3 in front can be times or numbers of images, times are times
        good += [(name, named) for name, named in led if fault(named) is None]
    if not good:
        found = [(named, fault(named) or (0, "")) for _, named in exact + led]
        named, first = max(found, key=lambda item: item[1][0])  # that which fits most rows
        raise named.error(*first)
    if len(good) > 1:
        raise _ask(path, f"{width} numbers a row fit", [name for name, _ in good])
    name, named = good[0]
    said = (f"{path}: {width} numbers a row are read as {name} ({FORMATS[name].says})",) if fmt is None and name != "matrix" else ()
    return named, name, said


def _with_columns(rows: PoseRows, layout: tuple[str, ...]) -> PoseRows:
    if layout[0] != "t":
        return replace(rows, columns=layout)
    return replace(rows, numbers=rows.numbers[:, 1:], columns=layout[1:], stamps=rows.firsts)


def _wrong_count(path: str, width: int, fmt: str | None) -> BadInputError:
    if fmt is not None:
        counts = " or ".join(str(len(layout)) for layout in FORMATS[fmt].layouts)
        return BadInputError(
            f"{path}: {width} numbers a row, where {fmt} has {counts} ({FORMATS[fmt].says}): check the file or --pose-format"
        )
    wanted = "16 or 12 (matrix), 7 (xyz + quaternion), 6 (xyz + angles) or 8 (time first)"
    return BadInputError(f"{path}: {width} numbers a row are no pose: wanted are {wanted}, or a header such as x,y,z,qx,qy,qz,qw")


def _ask(path: str, what: str, names: list[str]) -> BadInputError:
    choices = " and ".join(f"{name} ({FORMATS[name].says})" for name in dict.fromkeys(names))
    return BadInputError(f"{path}: {what} {choices}: add --pose-format {' or '.join(dict.fromkeys(names))}")
