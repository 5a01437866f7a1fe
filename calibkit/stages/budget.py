"""What a rig's uncertainties cost whoever uses it: the rig file in, a table and JSON out."""

from pathlib import Path

from calibkit.errors import BadInputError, one_line
from calibkit.estimation.error_budget import Cost, Use, budget
from calibkit.io.atomic import refuse_unwritable, write_json
from calibkit.io.rig_file import load_rig
from calibkit.report.columns import columns, range_text, sized

SCHEMA = "calibkit-budget/1"


def cost_of(rig_path: Path, use: Use, json_path: Path | None = None, force: bool = False) -> list[Cost]:
    """Return all costs, the largest first, and write them as JSON where that is asked for; BadInputError where there are none."""
    if json_path is not None:
        refuse_unwritable(json_path, force)
    costs = budget(load_rig(rig_path), use)
    if not costs:
        raise BadInputError(f"{one_line(rig_path)}: holds no camera, transform or time offset: nothing has a cost here")
    if json_path is not None:
        write_json(json_path, _as_json(costs, use), force)
    return costs


def text(costs: list[Cost], use: Use) -> str:
    """Return the table, and in words what costs most and what is not known."""
    head = ("entry", "term", "sigma", "pixels", f"at {range_text(use.range_m)}", "velocity", "acceleration")
    table = columns([head, *(_cells(cost) for cost in costs)])
    how = f"at {use.rate:.3g} rad/s, {range_text(use.range_m)} and {use.speed:g} m/s"
    about = f"One sigma of each, {how}; pixels and lengths of lenses and transforms are rms over the image."
    return "\n".join([table, "", about, "", *_said(costs, use)])


def _cells(cost: Cost) -> tuple[str, ...]:
    if cost.known != "known":
        word = {"unknown": "unknown: given without a sigma", "unbounded": "unbounded: not observable"}[cost.known]
        return cost.entry, cost.term, word, "", "", "", ""
    sizes = ((cost.px, "px"), (cost.metres, "m"), (cost.velocity, "m/s"), (cost.acceleration, "m/s^2"))
    return cost.entry, cost.term, "" if cost.sigma is None else sized(cost.sigma, cost.unit), *(sized(value, unit) for value, unit in sizes)


def _said(costs: list[Cost], use: Use) -> list[str]:
    lines = [f"{cost.entry}: the cost of its {cost.term} is unbounded, it is not observable: {cost.remedy}" for cost in unbounded(costs)]
    unknown = [f"{cost.entry} ({cost.term})" for cost in costs if cost.known == "unknown"]
    if unknown:
        lines.append(f"unknown is what these cost, they were given without a sigma: {', '.join(unknown)}")
    known = [cost for cost in costs if cost.known == "known"]
    if known:
        most = known[0]
        px = "" if most.px is None else f" ({sized(most.px, 'px')})"
        cost = f"{sized(most.metres, 'm')}{px} at {range_text(use.range_m)}"
        lines.append(f"most of what is known: {most.entry}'s {most.term} costs {cost}; less with {most.remedy}")
    return lines


def unbounded(costs: list[Cost]) -> list[Cost]:
    """Return what is not observable: for exit code 1."""
    return [cost for cost in costs if cost.known == "unbounded"]


def _as_json(costs: list[Cost], use: Use) -> dict[str, object]:
    return {
        "schema": SCHEMA,
        "use": {"rate_rad_s": use.rate, "range_m": use.range_m, "speed_m_s": use.speed},
        "costs": [
            {
                "entry": cost.entry,
                "term": cost.term,
                "known": cost.known,
                "sigma": cost.sigma,
                "unit": cost.unit,
                "px": cost.px,
                "at_range_m": cost.metres,
                "velocity_m_s": cost.velocity,
                "acceleration_m_s2": cost.acceleration,
                "remedy": cost.remedy,
            }
            for cost in costs
        ],
    }
