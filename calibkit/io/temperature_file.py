"""A temperature beside a recording: a text table with columns `t, temperature [C or K]`, times on the IMU's clock."""

from pathlib import Path

import numpy as np

from calibkit.errors import BadInputError, one_line
from calibkit.io.text_table import Array, TextTable, Times

_WANTED = "wanted are columns t, temperature [C]"


def load_temperature(path: Path) -> tuple[Times, Array]:
    """Return times in ns (n,), increasing, and temperatures (n,) in C or K; BadInputError where the file is none."""
    name = one_line(path.name, 120)
    if not path.is_file():
        raise BadInputError(f"{one_line(path)}: is not a file; give the temperature as CSV ({_WANTED})")
    table = TextTable(path, name, lambda _: None)
    if not table.holds("t", "temperature"):
        raise BadInputError(f"{name} is no table of temperatures: {_WANTED}")
    t_ns, values = table.read("temperature")
    if len(t_ns) < 2 or np.any(np.diff(t_ns) <= 0) or not np.isfinite(values).all():
        raise BadInputError(f"{name}: it needs two rows or more of finite numbers, in the order of time")
    return t_ns, values[:, 0]
