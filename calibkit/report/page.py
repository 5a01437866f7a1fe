"""The report's files: one self-contained HTML page, its pictures, report.md and report.json; the same input gives the same bytes."""

import base64
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from calibkit.data.rig import CONVENTIONS
from calibkit.errors import one_line
from calibkit.report.figures import PICTURES, Chapter, Drawn, Plate, draw, plates
from calibkit.report.markdown import MEANING, markdown
from calibkit.report.parameters import sigma_note
from calibkit.report.summary import Summary, as_json
from calibkit.report.summary_text import about, camera_lines, limit_cells, stage_lines, stage_tables
from calibkit.version import __version__

_EARLIER = "A later stage has found this anew: the numbers above are that one's."
_LONG = 30  # letters of a cell: a column of words, not of numbers
_SAFE = " !$'*+,-./:;=?@[\\]^_`{|}~"  # quote adds letters and digits


@dataclass(frozen=True)
class _Section:
    """Pictures under one heading."""

    name: str
    note: str
    pictures: list[tuple[Plate, Markup]]


def build(summary: Summary, formats: Sequence[str] = ("png",), chapters: Sequence[Chapter] = ()) -> dict[str, bytes]:
    """Return the report's files by name: report.html, report.md, report.json and the pictures in these formats (FORMATS).

    Chapters come before the pictures of the views.
    """
    sections: dict[str, _Section] = {}  # a sensor's sets under one heading
    order = {picture.key: i for i, picture in enumerate(PICTURES)}
    images, pictures = {}, []

    def add(heading: str, note: str, parts: tuple[str, ...], drawn: Sequence[Drawn]) -> None:
        for one in drawn:
            what = {"sensor": parts[0], "stage": parts[-1], "key": one.plate.key, "caption": one.plate.caption}
            for form, content in one.files.items():
                name = f"pictures/{_slug(*parts, one.plate.key)}.{form}"
                images[name] = content
                pictures.append({"file": name, **what})
        section = sections.setdefault(heading, _Section(heading, note, []))
        section.pictures.extend((one.plate, _svg_uri(one.svg)) for one in drawn)

    for chapter in chapters:
        add(chapter.name, chapter.note, (chapter.name,), draw(chapter.plates, formats))
    for view in (*summary.views, *summary.earlier):
        add(view.name, _EARLIER if view in summary.earlier else "", (view.sensor, view.stage), draw(plates(view), formats))
    for section in sections.values():
        section.pictures.sort(key=lambda pair: order.get(pair[0].key, -1))  # of a sensor's several sets
    thumbnails = [(result.stage, one.label, _data_uri("image/jpeg", one.jpeg)) for result in summary.results for one in result.thumbnails]
    page = _template().render(
        summary=summary,
        told=[*camera_lines(summary), *stage_lines(summary)],
        tables=[
            (table, [i == 0 or max(len(row[i]) for row in table) > _LONG for i in range(len(table[0]))]) for table in stage_tables(summary)
        ],
        limits=limit_cells(summary),
        meaning=MEANING[summary.verdict],
        sections=list(sections.values()),
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
