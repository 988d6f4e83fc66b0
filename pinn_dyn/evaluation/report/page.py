"""The frame of a report: sections of text, tables and figures, in one HTML file."""

from __future__ import annotations

import base64
import datetime
import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import markdown
import pandas as pd
from jinja2 import Environment, PackageLoader
from markupsafe import Markup
from matplotlib import figure as figures
from plotly.graph_objects import Figure
from plotly.offline import get_plotlyjs

from pinn_dyn.evaluation.tables import number

# Whatever is put into a template is escaped, unless it is Markup that was made here.
_TEMPLATES = Environment(
    loader=PackageLoader("pinn_dyn.evaluation.report"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
)
_FIGURE_OPTIONS = {
    "displaylogo": False,
    "responsive": True,
    # Nothing on the page may send it anywhere.
    "modeBarButtonsToRemove": ["sendChartToCloud", "lasso2d", "select2d"],
}
# Patterns of Markdown that make links and load pictures.
_LINKS = (
    *("link", "reference", "short_reference", "autolink", "automail"),
    *("image_link", "image_reference", "short_image_ref"),
)


@dataclass(frozen=True)
class Origin:
    """Where the numbers of a page come from.

    Attributes:
        provenance: what was run, on which commit, data and hardware: names and values.
        runs: one row per trained model: its name, seed, folder and so on.
        configurations: names and resolved configurations as text.
    """

    provenance: Mapping[str, str]
    runs: pd.DataFrame
    configurations: Mapping[str, str]

    def section(self) -> Section:
        """The last section of a page."""
        facts = pd.DataFrame({"what": self.provenance.keys(), "value": self.provenance.values()})
        parts = [table(facts, headers={"what": "", "value": ""})]
        parts.append(table(self.runs))
        parts += [details(name, preformatted(text)) for name, text in self.configurations.items()]
        return Section("Configuration and provenance", parts)


@dataclass(frozen=True)
class Section:
    """A part of a page under its own heading; the parts are what the functions below return."""

    title: str
    parts: Sequence[Markup]


def page(title: str, subtitle: str, sections: Sequence[Section]) -> str:
    """The whole page; plotly.js is inside, nothing is loaded from anywhere."""
    return _TEMPLATES.get_template("page.html").render(
        title=title,
        subtitle=subtitle,
        date=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        sections=sections,
        plotly=Markup(get_plotlyjs()),
    )


def paragraph(text: str) -> Markup:
    """A paragraph of plain text."""
    return Markup("<p>{}</p>").format(text)


def preformatted(text: str) -> Markup:
    """Text as it is, in a monospaced font."""
    return Markup("<pre>{}</pre>").format(text)


def details(summary: str, content: Markup) -> Markup:
    """Content that a click unfolds."""
    return Markup("<details><summary>{}</summary>{}</details>").format(summary, content)


def from_markdown(text: str) -> Markup:
    """A Markdown report with its tables; its headings become the third level and below.

    HTML and links stay the text that they are: names in it come from files of others.
    """
    reader = markdown.Markdown(
        extensions=["tables", "toc"], extension_configs={"toc": {"baselevel": 3}}
    )
    for pattern in _LINKS:
        reader.inlinePatterns.deregister(pattern)
    reader.parser.blockprocessors.deregister("reference")
    return Markup('<div class="document">{}</div>').format(
        Markup(reader.convert(html.escape(text, quote=False)))
    )


def picture(content: bytes, kind: str, text: str) -> Markup:
    """A ``gif`` or ``png``, embedded."""
    data = base64.b64encode(content).decode()
    return Markup('<img src="data:image/{};base64,{}" alt="{}">').format(kind, data, text)


def drawing(drawn: figures.Figure, text: str) -> Markup:
    """A figure of matplotlib, embedded."""
    file = io.BytesIO()
    drawn.savefig(file, format="png", dpi=110)
    return picture(file.getvalue(), "png", text)


def table(
    frame: pd.DataFrame,
    *,
    headers: Mapping[str, str] | None = None,
    best: pd.DataFrame | None = None,
    spread: Mapping[str, str] | None = None,
) -> Markup:
    """A table; a number has three digits, and all of them in its tooltip.

    Args:
        frame: what to show.
        headers: columns to show and their headings; None takes all by their names.
        best: which cells to mark, with columns of ``frame``.
        spread: columns whose cells get ``± x``, and the columns of ``frame`` that hold it.
    """
    headers = {name: str(name) for name in frame} if headers is None else headers
    rows = []
    for index in range(len(frame)):
        cells = []
        for name in headers:
            value = frame[name].iloc[index]
            text = _cell(value)
            if spread and spread.get(name) in frame and text != "-":
                text += f" ± {_cell(frame[spread[name]].iloc[index])}"
            marked = best is not None and name in best and bool(best[name].iloc[index])
            exact = repr(float(value)) if isinstance(value, float) else ""  # as of numpy too
            cells.append((text, exact, marked, isinstance(value, str)))
        rows.append(cells)
    return Markup(
        _TEMPLATES.get_template("table.html").render(
            headers=[(text, _is_text(frame[name])) for name, text in headers.items()], rows=rows
        )
    )


def turned(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """Rows and columns exchanged, under headings from the column ``name``."""
    return frame.set_index(name).T.rename_axis(None, axis=1).reset_index(names="figure")


def figure(drawn: Figure, name: str) -> Markup:
    """An interactive figure; the name is its id on the page."""
    return Markup(
        drawn.to_html(
            full_html=False,
            include_plotlyjs=False,
            auto_play=False,
            div_id=name,
            config=_FIGURE_OPTIONS,
            default_height=f"{drawn.layout.height}px",
        )
    )


def _is_text(column: pd.Series) -> bool:
    return len(column) > 0 and all(isinstance(value, str) for value in column)


def _cell(value: object) -> str:
    if value is pd.NA:
        return "-"
    return number(float(value)) if isinstance(value, float) else str(value)
