"""Tables of the pages equal results/results.csv, and every result has its entry."""

import re

import pandas as pd
import pytest

from docs import tables
from reproduce import COMMAND, RESULTS, read_entries
from tests.docs.blocks import ROOT

PAGES = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
PAGES = [path for path in PAGES if re.search("^<!-- table: ", path.read_text(), re.MULTILINE)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_has_the_tables_of_the_results(page):
    text = page.read_text()
    assert tables.filled(text) == text, "run: python -m docs.tables"


def test_every_result_comes_from_an_entry_and_every_entry_has_results():
    commands = set(pd.read_csv(RESULTS)["command"])
    entries = {command.removeprefix(COMMAND) for command in commands if COMMAND in command}
    assert entries == set(read_entries())


def test_bold_is_the_smallest_error_without_diverged_rollouts():
    index = pd.MultiIndex.from_product([["lnn", "mlp", "ARX"], [0, 1]], names=["model", "seed"])
    data = pd.DataFrame({"error_mean": [1.0, 3.0, 2.0, 2.5, 9.0, 9.0]}, index=index)
    data["trajectories"], data["diverged"] = 10, 0
    assert [row[1] for row in tables.grid(data, ["error_mean"])] == ["**2.0**", "2.2", "9.0"]
    data.loc[("lnn", 1), "diverged"] = 1
    rows = tables.grid(data, ["error_mean"])
    assert [row[1] for row in rows] == ["2.0 (1 of 20 diverged)", "**2.2**", "9.0"]
