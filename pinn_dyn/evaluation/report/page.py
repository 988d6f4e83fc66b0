"""The frame of a report: sections of text, tables and figures in one self-contained HTML file."""

from __future__ import annotations

import base64
import datetime
import html
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import pandas as pd
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from pinn_dyn.evaluation.tables import best, formatted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TEMPLATES = Environment(
    loader=PackageLoader("pinn_dyn.evaluation.report"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
)
_SIZE = 600_000  # of the figures of a slider, bytes
# Patterns of Markdown that make links and load pictures.
_LINKS = (
    *("link", "reference", "short_reference", "autolink", "automail"),
    *("image_link", "image_reference", "short_image_ref"),
)


class Section(NamedTuple):
    """A part of a page under its own heading. The functions below make its parts."""

    title: str
    parts: Sequence[Markup]


@dataclass(frozen=True)
class Origin:
    """The origin of the numbers of a page: facts, one row per trained model, configurations."""

    provenance: Mapping[str, str]
    runs: pd.DataFrame
    configurations: Mapping[str, str]

    def section(self) -> Section:
        """Return the last section of a page."""
        facts = pd.DataFrame({"fact": self.provenance.keys(), "value": self.provenance.values()})
        parts = [table(facts, headers={"fact": "", "value": " "}), table(self.runs)]
        parts += [details(name, preformatted(text)) for name, text in self.configurations.items()]
        return Section("Configuration and provenance", parts)


def page(title: str, subtitle: str, sections: Sequence[Section]) -> str:
    """Return the page, which loads nothing."""
    return _TEMPLATES.get_template("page.html").render(
        title=title,
        subtitle=subtitle,
        date=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        sections=sections,
    )


def paragraph(text: str) -> Markup:
    """Return a paragraph of plain text."""
    return Markup("<p>{}</p>").format(text)


def preformatted(text: str) -> Markup:
    """Return text in a monospaced font, with its line breaks."""
    return Markup("<pre>{}</pre>").format(text)


def details(summary: str, *content: Markup) -> Markup:
    """Return content that a click unfolds."""
    parts = Markup("").join(content)
    return Markup("<details><summary>{}</summary>{}</details>").format(summary, parts)


def from_markdown(text: str) -> Markup:
    """Convert a Markdown report: headings from the third level on, HTML and links as text."""
    import markdown  # takes a tenth of a second

    reader = markdown.Markdown(
        extensions=["tables", "toc"], extension_configs={"toc": {"baselevel": 3}}
    )
    for pattern in _LINKS:
        reader.inlinePatterns.deregister(pattern)
    reader.parser.blockprocessors.deregister("reference")
    content = reader.convert(html.escape(text, quote=False))
    return Markup('<div class="document">{}</div>').format(Markup(content))


def picture(content: bytes, kind: str, text: str, width: float | None = None) -> Markup:
    """Return an embedded image of the kind ``gif`` or ``webp`` with its description."""
    data = base64.b64encode(content).decode()
    style = "" if width is None else f"width: {width:.0f}px"
    image = Markup('<img src="data:image/{};base64,{}" alt="{}" style="{}">')
    return Markup('<div class="figure">{}</div>').format(image.format(kind, data, text, style))


def drawing(figure: Figure, text: str, dpi: int = 140) -> Markup:
    """Return a matplotlib figure, embedded as WebP."""
    file = io.BytesIO()
    figure.savefig(file, format="webp", dpi=dpi, pil_kwargs={"quality": 60})
    return picture(file.getvalue(), "webp", text, width=96 * figure.get_figwidth())


def slider(figures: Iterable[tuple[int, Figure]], name: str) -> Markup:
    """Return a slider over numbered figures of equal panels, which first shows the first one.

    Figures are drawn until they reach the size that a page affords. ``name`` is the word before
    their numbers. Without scripts, a browser shows all.
    """
    drawings: dict[int, Markup] = {}
    places = None
    for number, figure in figures:
        if places is not None:  # of the same panels; computing them takes longer than drawing
            figure.set_layout_engine(None)  # with "none" each figure would be drawn twice
            for ax, place in zip(figure.axes, places, strict=True):
                ax.set_position(place)
        drawings[number] = drawing(figure, f"{name} {number}", dpi=80)
        places = [ax.get_position() for ax in figure.axes]
        if sum(map(len, drawings.values())) > _SIZE:
            break
    numbers = sorted(drawings)
    text = '<input type="range" max="{}" value="{}" aria-label="{}"><output></output>'
    control = Markup(text).format(len(numbers) - 1, numbers.index(next(iter(drawings))), name)
    content = Markup("").join([control, *(drawings[number] for number in numbers)])
    return Markup('<div class="slider">{}</div>').format(content)


def table(frame: pd.DataFrame, *, headers: Mapping[str, str] | None = None) -> Markup:
    """Return a table, numbers with three significant digits and the best entries in bold.

    ``headers`` are the columns to show and their headings; None shows all under their names.
    """
    headers = headers or {name: str(name) for name in frame}
    frame = frame.reset_index(drop=True)
    marks = {header: best(frame, name).map({True: "best"}) for name, header in headers.items()}
    styler = formatted(frame, headers).style.hide(axis="index").format(escape="html")
    styler.format_index(escape="html", axis=1).set_td_classes(pd.DataFrame(marks).fillna(""))
    left = [{"selector": "", "props": "text-align: left; white-space: normal"}]
    styler.set_table_styles(
        {
            header: left
            for name, header in headers.items()
            if frame[name].map(lambda value: isinstance(value, str)).all()
        }
    )
    return Markup('<div class="table">{}</div>').format(Markup(styler.to_html()))
