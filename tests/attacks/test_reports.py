"""Names in a report that would be code in a browser: all of them stay text."""

import re

import pandas as pd
import pytest
from matplotlib.figure import Figure

from pinn_dyn.evaluation.report.page import (
    Section,
    details,
    from_markdown,
    page,
    paragraph,
    preformatted,
    slider,
    table,
)
from tests.evaluation.report_pages import Page

SCRIPTS = [
    "</script><script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "' onmouseover='alert(1)",
    '" onmouseover="alert(1)',
    "<!--",
]
LINKS = [
    "[x](javascript:alert(1))",
    "[x](java&#115;cript:alert(1))",
    "[x](<javascript:alert(1)>)",
    "[x](https://localhost/x)",
    "![x](https://localhost/x.png)",
    "[x][1]\n\n[1]: javascript:alert(1)",
    "[x]\n\n[x]: javascript:alert(1)",
    "<javascript:alert(1)>",
    "| a |\n|---|\n| [x](javascript:alert(1)) |",
]


def assert_harmless(text, said):
    """No tag but ours, no attribute that runs or loads; and the words are still there."""
    harmless = {"html", "head", "meta", "title", "style", "script", "body", "header", "h1", "h2"}
    harmless |= {"h3", "div", "nav", "a", "main", "section", "p", "pre", "details", "summary"}
    harmless |= {"table", "thead", "tbody", "tr", "th", "td", "ul", "li", "em", "input", "output"}
    shown = Page(text)
    for tag, attributes in shown.tags:
        assert tag in harmless or attributes.pop("src", "").startswith("data:image/webp;base64,")
        assert not [name for name in attributes if name.startswith("on") or name == "http-equiv"]
        assert attributes.get("href", "#").startswith("#")
        assert "src" not in attributes
    assert sum(tag == "script" for tag, _ in shown.tags) == 1
    assert " ".join(said.split()) in shown.text


@pytest.mark.parametrize("name", SCRIPTS + LINKS[:3])
def test_a_name_is_text_wherever_it_stands(name):
    frame = pd.DataFrame({name: [name], "x": [1.5]})
    parts = [paragraph(name), preformatted(name), details(name, paragraph(name)), table(frame)]
    sections = [Section(name, [*parts, slider([(0, Figure())], name)])]
    text = page(name, name, sections)
    assert_harmless(text, name)
    # Nothing ends the script but its end.
    assert len(re.findall(r"</script", text, re.IGNORECASE)) == text.count("<script")


@pytest.mark.parametrize("text", SCRIPTS + LINKS)
def test_markdown_has_no_links_and_no_html(text):
    html = str(from_markdown(text))
    tags = {tag for tag, _ in Page(html).tags}
    assert not tags & {"a", "img", "script", "svg", "iframe", "base", "meta"}
    for _, attributes in Page(html).tags:
        assert not attributes.keys() & {"href", "src", "onerror", "onmouseover", "onload"}
