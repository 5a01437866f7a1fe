"""A summary in words: lines and tables for a terminal, which the page and the Markdown share."""

from collections.abc import Mapping, Sequence

from calibkit.data.plural import counted
from calibkit.errors import one_line
from calibkit.report.limits import Check
from calibkit.report.parameters import Row, sigma_note
from calibkit.report.probe import Signal
from calibkit.report.summary import Summary


def text(summary: Summary) -> str:
    """Return verdict, reasons and tables for a terminal; what came from files is stripped of control characters."""
    told = [*camera_lines(summary), *stage_lines(summary)]
    lines = [*told, ""] if told else []
    lines += [_table(cells) for cells in stage_tables(summary)]
    lines += [_table(parameter_cells(summary))]
    if any(row.factor for row in summary.parameters):
        lines.append(f"{sigma_note(summary.rig)}\n")
    if summary.signals:
        lines.append(_table(signal_cells(summary)))
    if summary.limits:
        lines.append(_table(limit_cells(summary)))
    lines.append(f"{summary.verdict.value}")
    lines += [f"  {reason.verdict.value:5} {one_line(reason.text, 1000)}" for reason in summary.reasons]
    return "\n".join(lines)


def stage_lines(summary: Summary) -> list[str]:
    """Return what the stages say of their recordings in lines of their own."""
    found = [result.facts.get("lines") for result in summary.results]
    return [
        ("  " if line[:1] == " " else "") + one_line(line, 1000).strip()
        for lines in found
        if isinstance(lines, list)
        for line in map(str, lines)
    ]


def stage_tables(summary: Summary) -> list[list[list[str]]]:
    """Return the stages' own tables of texts, heads first, rows of equal length."""
    found = [result.facts.get("tables") for result in summary.results]
    tables = [table for tables in found if isinstance(tables, list) for table in tables if isinstance(table, list) and table]
    return [
        [[str(cell) for cell in row] for row in table]
        for table in tables
        if all(isinstance(row, list) and len(row) == len(table[0]) > 0 for row in table)
    ]


def camera_lines(summary: Summary) -> list[str]:
    """Return what each camera's numbers rest on: model, frames, corners, rms, and how other models did."""
    lines = []
    for name, camera in summary.rig.cameras.items():
        width, height = camera.resolution
        text = f"{name}: {camera.model}, {width}x{height}"
        r = camera.reprojection
        if r is not None:
            held_out = "" if r.held_out_rms_px is None else f", held-out {r.held_out_rms_px:.3g} px"
            text += _seen(summary, name)
            text += f"; {counted(r.frames, 'frame')} used, {r.frames_dropped} given up"
            text += f"; {counted(r.corners, 'corner')} kept, {r.corners_dropped} dropped"
            text += f"; rms {r.rms_px:.3g} px ({r.rms_all_px:.3g} px with the dropped){held_out}"
        lines.append(one_line(text))
        lines += [f"  {text}" for text in _pixel_sigma(summary, name)]
        lines += [f"  held-out error by model, outliers included: {one_line(scores)}" for scores in _model_scores(summary, name)]
    return lines


def _seen(summary: Summary, camera: str) -> str:
    """Return how many of the camera's images show the board, where a stage has counted them."""
    for result in summary.results:
        views = result.facts.get("views")
        counts = views.get(camera) if isinstance(views, Mapping) else None
        if isinstance(counts, Mapping) and counts.get("images"):
            return f"; the board is in {counts.get('with_board')} of {counted(counts['images'], 'image')}"
    return ""


def _pixel_sigma(summary: Summary, camera: str) -> list[str]:
    """Return how well a point's pixel is known, where boards were seen and at the worst place of the image."""
    for result in summary.results:
        maps = result.facts.get("projection_sigma")
        found = maps.get(camera) if isinstance(maps, Mapping) else None
        if isinstance(found, Mapping) and isinstance(found.get("sigma_px"), list) and isinstance(found.get("seen"), list):
            pairs = [(s, seen) for s, seen in zip(found["sigma_px"], found["seen"], strict=False) if isinstance(s, float)]
            inside = [s for s, seen in pairs if seen]
            if inside:
                worst = max(s for s, _ in pairs)
                return [
                    f"a far point's pixel is known to {max(inside):.2g} px where boards were seen, to {worst:.2g} px at the worst place"
                ]
    return []


def _model_scores(summary: Summary, camera: str) -> list[str]:
    """Return the comparison of lens models that a stage has made for this camera."""
    found = []
    for result in summary.results:
        models = result.facts.get("models")
        scores = models.get(camera) if isinstance(models, Mapping) else None
        if isinstance(scores, Mapping):
            errors = {model: s.get("held_out_px") for model, s in scores.items() if isinstance(s, Mapping)}
            texts = [f"{model} {error:.3g} px" for model, error in errors.items() if isinstance(error, float)]
            asked = any(isinstance(s, Mapping) and s.get("asked") for s in scores.values())
            chosen = (
                ""
                if asked
                else f"; chosen: {summary.rig.cameras[camera].model}, the simplest of those that chance cannot tell from the best"
            )
            found.append(", ".join(texts) + chosen if texts else "")
    return [text for text in found if text]


def about(summary: Summary) -> str:
    """Return which stages of which inputs the report tells of."""
    runs = summary.rig.provenance
    stages = ", ".join(dict.fromkeys(run.stage for run in runs)) or "rig"
    names = ", ".join(dict.fromkeys(file.name for run in runs for file in run.inputs))
    return f"{stages} of {names}" if names else stages


def parameter_cells(summary: Summary) -> list[tuple[str, ...]]:
    """Return the table of parameters, its head first; the columns plain and factor only where they hold anything."""
    cells = [("parameter", "value", "sigma", "plain", "factor", "unit", "status"), *map(_parameter, summary.parameters)]
    return cells if summary.has_plain else [(*row[:3], *row[5:]) for row in cells]


def _parameter(row: Row) -> tuple[str, ...]:
    status = row.status.value + (f" ({row.note})" if row.note else "")
    return (f"{row.part} {row.name}", row.value_text, row.sigma_text, row.sigma_plain_text, row.factor_text, row.unit, status)


def signal_cells(summary: Summary) -> list[tuple[str, ...]]:
    """Return the table of signals, its head first."""
    return [("sensor", "signal", "measured", "good", "", "seen"), *map(_signal, summary.signals)]


def _signal(signal: Signal) -> tuple[str, ...]:
    unit = f" {signal.probe.unit}" if signal.probe.unit else ""
    return (signal.sensor, signal.probe.title, f"{signal.value:.3g}{unit}", signal.probe.limit, signal.mark, signal.note)


def limit_cells(summary: Summary) -> list[tuple[str, ...]]:
    """Return the table of limits, its head first."""
    return [("limit", "on", "measured", "asked for", ""), *map(_limit, summary.limits)]


def _limit(one: Check) -> tuple[str, ...]:
    stage = f" ({one.stage})" if one.stage else ""
    return (one.name, f"{one.part} {one.what}{stage}", one.measured, one.limit, one.reason.verdict.value)


def _table(cells: Sequence[Sequence[str]]) -> str:
    clean = [[one_line(cell, 80) for cell in row] for row in cells]
    widths = [max(len(cell) for cell in column) for column in zip(*clean, strict=True)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in clean) + "\n"
