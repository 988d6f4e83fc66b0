"""Tables of the pages: made of results/, each in its place; no result is kept that none reads."""

import itertools
import re

import pandas as pd
import pytest

from docs.tables import paper, results
from docs.tables.floors import FILE, GROUND, SETS
from docs.tables.pages import PAGES, filled
from docs.tables.text import number
from tests.docs.blocks import ROOT

FLOORS = {"stands still", "keeps its velocity", "ARX", "EDMDc degree 2"}


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


def cells_of(text):
    """The cells of a table below its head."""
    rows = [line for line in text.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


def value(cell):
    """The first number of a cell."""
    found = re.match(r"[\d.e+-]+", cell.strip("*"))
    return float(found.group()) if found else float("inf")


def test_of_a_log_the_smallest_is_bold_be_it_a_floor():
    logs, log = {}, ""
    for name, *cells in cells_of(results.logs()):
        log = name or log
        logs.setdefault(log, []).append(cells)
    assert len(logs) == len(results.LOGS)
    for log, rows in logs.items():
        assert {"stands still", "keeps its velocity"} <= {model for model, *_ in rows}, log
        for column in zip(*(figures for _, *figures in rows), strict=True):
            smallest = min(map(value, column))
            assert {value(cell) for cell in column if "**" in cell} == {smallest}, (log, column)


@pytest.mark.parametrize("group", ["soft_arm_1_wide", "soft_arm_1", "soft_arm_2", "panda"])
def test_bold_is_ahead_of_the_paper_and_of_every_floor(group):
    rows = cells_of(paper.prediction_table(group))
    floors = [row for row in rows if row[0] in FLOORS]
    assert len(floors) == len(FLOORS)
    lowest = min(value(row[2]) for row in floors if "diverged" not in row[2])
    for model, theirs, ours, *_ in rows:
        ahead = value(ours) < min(lowest, value(theirs)) and "diverged" not in ours
        assert ("**" in ours) == (ahead and model not in FLOORS), model


@pytest.mark.parametrize("make", [paper.generalization_table, paper.beyond_table])
def test_bold_elsewhere_is_the_smallest_of_those_that_lose_no_roll_out(make):
    """Of mean and median each, wherever models were tested; a floor that is ahead is not bold."""
    text, tasks, task = make(), {}, ""
    head = [name.strip() for name in text.strip().splitlines()[0].strip("|").split("|")]
    for row in cells_of(text):
        task = row[0] or task if head[0] == "task" else task
        if row[head.index("model")] != GROUND:
            tasks.setdefault(task, []).append(row)
    compared = [k for k, name in enumerate(head) if name.endswith("mean, median")]
    for rows in tasks.values():
        for k, figure in itertools.product(compared, (0, 1)):
            cells = {row[head.index("model")]: row[k] for row in rows if row[k] != "–"}
            figures = {model: cell.split(", ")[figure] for model, cell in cells.items()}
            whole = [value(figures[m]) for m, cell in cells.items() if "diverged" not in cell]
            expected = {
                model
                for model, found in figures.items()
                if value(found) == min(whole)
                and model not in FLOORS
                and "diverged" not in cells[model]
            }
            assert {m for m, found in figures.items() if "**" in found} == expected, head[k]


def test_every_test_set_of_the_tables_has_its_floor():
    data = pd.read_csv(FILE)
    for name in SETS:
        there = set(data["model"][data["dataset"] == name])
        assert there >= ({GROUND} if name.endswith("_beyond") else FLOORS), name


def test_every_result_is_read_by_a_page(made):
    """What nothing reads goes: each file is opened by a table, or linked from a page."""
    _, opened = made
    linked = "".join(page.read_text() for page in (ROOT / "docs").glob("*.md"))
    for path in (ROOT / "results").rglob("*.*"):
        name = path.relative_to(ROOT).as_posix()
        assert str(path) in opened or name in linked, f"no page reads {name}"
