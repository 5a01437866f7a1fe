"""The report's files: one self-contained HTML page, its pictures, report.md and report.json; the same input gives the same bytes."""

import base64
import json
import re
from collections.abc import Sequence
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from calibkit.data.rig import CONVENTIONS
from calibkit.errors import one_line
from calibkit.report.figures import PICTURES, Picture, draw
from calibkit.report.markdown import MEANING, markdown
from calibkit.report.parameters import sigma_note
from calibkit.report.summary import Summary, about, as_json, camera_lines, limit_cells, stage_lines, stage_tables
from calibkit.report.view import View
from calibkit.version import __version__

_SAFE = " !$'*+,-./:;=?@[\\]^_`{|}~"  # quote adds letters and digits


def build(summary: Summary, formats: Sequence[str] = ("png",)) -> dict[str, bytes]:
    """Return the report's files by name: report.html, report.md, report.json and the pictures in these formats (FORMATS)."""
    sections: dict[str, tuple[View, list[tuple[Picture, Markup]]]] = {}  # a sensor's sets under one heading
    images, pictures = {}, []
    for view in (*summary.views, *summary.earlier):
        drawn = draw(view, formats)
        for one in drawn:
            what = {"sensor": view.sensor, "stage": view.stage, "key": one.picture.key, "caption": one.picture.caption}
            for form, content in one.files.items():
                name = f"pictures/{_slug(view.sensor, view.stage, one.picture.key)}.{form}"
                images[name] = content
                pictures.append({"file": name, **what})
        sections.setdefault(view.name, (view, []))[1].extend((one.picture, _svg_uri(one.svg)) for one in drawn)
    thumbnails = [(result.stage, one.label, _data_uri("image/jpeg", one.jpeg)) for result in summary.results for one in result.thumbnails]
    page = _template().render(
        summary=summary,
        told=[*camera_lines(summary), *stage_lines(summary)],
        tables=stage_tables(summary),
        limits=limit_cells(summary),
        meaning=MEANING[summary.verdict],
        sections=[(view, sorted(drawn, key=lambda pair: PICTURES.index(pair[0]))) for view, drawn in sections.values()],
        thumbnails=thumbnails,
        conventions=CONVENTIONS,
        about=about(summary),
        sigma_note=sigma_note(summary.rig),
        version=__version__,
    )
    data = json.dumps(as_json(summary, pictures), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    texts = {"report.md": markdown(summary), "report.html": page.encode(), "report.json": data.encode()}
    return {**images, **texts}  # in the order of writing: what points to others last


def _template() -> Template:
    # Names of topics and files are a stranger's text: everything is escaped but what is marked safe here.
    loader = PackageLoader("calibkit.report")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["line"] = lambda value: one_line(value, 1000)
    return environment.get_template("report.html")


def _data_uri(mime: str, data: bytes) -> Markup:
    return Markup(f"data:{mime};base64,{base64.b64encode(data).decode()}")  # base64 has nothing to escape


def _svg_uri(svg: bytes) -> Markup:
    """Return an SVG as text, with all that HTML and addresses read otherwise as %XX: a quarter smaller than base64."""
    text = re.sub(r"\s*\n\s*", " ", svg.decode().replace("base64,\n", "base64,"))
    return Markup("data:image/svg+xml," + quote(text, safe=_SAFE))


def _slug(*parts: str) -> str:
    return "-".join(re.sub(r"[^A-Za-z0-9_]", "_", part)[:60] for part in parts)
