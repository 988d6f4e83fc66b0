"""Tables of the pages: made of results/, each in its place; no result is kept that none reads."""

import re

import pandas as pd
import pytest

from docs.tables import results
from docs.tables.floors import SETS
from docs.tables.pages import PAGES, filled
from docs.tables.text import number
from tests.docs.blocks import ROOT


@pytest.fixture(scope="module")
def made():
    """The tables of each page, and the files that were read for them."""
    opened = set()
    read = pd.read_csv
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pd, "read_csv", lambda path, *a: opened.add(str(path)) or read(path, *a))
        return {page: tables() for page, tables in PAGES.items()}, opened


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_is_made_of_the_results(made, page):
    text = page.read_text()
    assert filled(text, made[0][page]) == text, "run: python -m docs.tables"


def test_a_place_without_a_table_and_a_table_without_a_place_are_refused():
    page = "<!-- table: one -->\n<!-- end -->\n"
    assert filled(page, {"one": "1"}) == "<!-- table: one -->\n1\n<!-- end -->\n"
    for tables in ({}, {"one": "1", "two": "2"}):
        with pytest.raises(ValueError, match=r"a place without a table.*: (one|two)"):
            filled(page, tables)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.00181, "0.0018"), (0.0996, "0.100"), (0.797, "0.80"), (2.8, "2.8"), (44.7, "45")],
)
def test_numbers_have_two_digits(value, text):
    assert number(value) == text


def test_the_best_of_a_log_is_bold_unless_the_floor_is_better():
    rows = [line.split(" | ") for line in results.logs().strip().splitlines()[2:]]
    log = ""
    for cells in rows:
        log = next(iter(re.findall(r"`(\w+)`", cells[0])), log)
        bold = [index for index, cell in enumerate(cells[2:]) if "**" in cell]
        if "velocity" in cells[1]:
            wins = results.floors().loc[log, results.WINDOWS].to_numpy()
            models = results.read_log(log).groupby("model")[results.WINDOWS].mean().min().to_numpy()
            assert bold == [k for k in range(3) if wins[k] < models[k]], log


def test_every_test_set_of_the_tables_has_its_floor():
    assert set(results.floors().index) == set(SETS)


def test_every_result_is_read_by_a_page(made):
    """What nothing reads goes: each file is opened by a table, or linked from a page."""
    _, opened = made
    linked = "".join(page.read_text() for page in (ROOT / "docs").glob("*.md"))
    for path in (ROOT / "results").rglob("*.*"):
        name = path.relative_to(ROOT).as_posix()
        assert str(path) in opened or name in linked, f"no page reads {name}"
