"""A turntable's known rates: a text table with columns `t, rate [rad/s or deg/s], run, nx, ny, nz`.

`run` numbers the mountings (one where it is missing); n, the table's axis in the IMU's frame, is the same throughout a run and may be
missing. Times are on the IMU's clock.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibkit.data.observations import TableRates
from calibkit.errors import BadInputError, one_line
from calibkit.io.text_table import TextTable

_WANTED = "wanted are columns t, rate [rad/s] and, for several mountings, run; nx,ny,nz where the table's axis is known"


def load_turntable(path: Path) -> list[TableRates]:
    """Return the runs of a turntable's file; BadInputError where it is none."""
    name = one_line(path.name, 120)
    if not path.is_file():
        raise BadInputError(f"{one_line(path)}: is not a file; give the turntable's rates as CSV ({_WANTED})")
    table = TextTable(path, name, lambda _: None)
    if not table.holds("t", "rate"):
        raise BadInputError(f"{name} is no table of rates: {_WANTED}")
    axes = ("nx", "ny", "nz") if table.holds("nx", "ny", "nz") else ()
    numbered = ("run",) if table.holds("run") else ()
    t_ns, values = table.read("rate", *axes, *numbered)
    if not (len(t_ns) and np.isfinite(values).all() and np.all(np.abs(values) < 1e6)):
        raise BadInputError(f"{name}: its rates, axes and runs must be finite numbers")
    run = values[:, -1] if numbered else np.zeros(len(t_ns))
    return [_run(name, number, t_ns[run == number], values[run == number], bool(axes)) for number in np.unique(run)]


def _run(name: str, number: float, t_ns: NDArray[np.int64], values: NDArray[np.float64], known: bool) -> TableRates:
    if len(t_ns) < 2 or np.any(np.diff(t_ns) <= 0):
        raise BadInputError(f"{name}: run {number:g} needs two rows or more, in the order of time")
    axis = values[0, 1:4] if known else None
    if axis is not None and (np.ptp(values[:, 1:4], axis=0).any() or not np.linalg.norm(axis) > 0):
        raise BadInputError(f"{name}: run {number:g} must have one axis nx,ny,nz, other than 0, throughout")
    return TableRates(t_ns, values[:, 0], axis)
