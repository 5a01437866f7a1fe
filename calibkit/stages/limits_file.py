"""What a person asks of a rig, from the command line and a YAML file of limits: `td.sigma: 0.1ms` and `require_observable: true`."""

from collections.abc import Iterable
from pathlib import Path

from calibkit.errors import BadInputError, one_line
from calibkit.io.yaml_file import load_yaml
from calibkit.report.limits import Limit, read
from calibkit.report.summary import Demands

_REQUIRE = "require_observable"


def demands(asked: Iterable[str] = (), path: Path | None = None, require_observable: bool = False) -> Demands:
    """Return the limits NAME=VALUE as `asked`, and those of the file that were not asked for by name."""
    limits: dict[str, Limit] = {}
    for text in asked:
        source = f"--limit {one_line(text, 120)}"
        name, equals, value = text.partition("=")
        limit = read(name if equals else "", value, source)
        if limit.name in limits:
            raise BadInputError(f"{source}: {one_line(limit.name, 80)} is limited twice; keep one")
        limits[limit.name] = limit
    if path is None:
        return Demands(tuple(limits.values()), require_observable)
    from_file, required = _of_file(path)
    return Demands(tuple({**from_file, **limits}.values()), require_observable or required)


def _of_file(path: Path) -> tuple[dict[str, Limit], bool]:
    document = load_yaml(path)
    if not isinstance(document.data, dict):
        raise document.error([], "holds no limits; write one a line, such as reprojection_rms: 0.3px")
    required = document.data.get(_REQUIRE, False)
    if not isinstance(required, bool):
        raise document.error([_REQUIRE], "is neither true nor false")
    limits = {}
    for name, value in ((name, value) for name, value in document.data.items() if name != _REQUIRE):
        source = f"{one_line(path)}, line {document.line_of([name])}: {one_line(name, 80)}: {one_line(value, 80)}"
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise BadInputError(f"{source}: is no limit; write a number with its unit, such as 0.3px")
        limits[name] = read(name, str(value), source)
    return limits, required
