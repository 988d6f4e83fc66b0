"""The page of a command's results, and what every one says of its origin."""

import json
import shlex
from pathlib import Path

from tests.evaluation.report_pages import Page


def page_of(folder):
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def assert_says_how_it_came_about(folder, script, run):
    page, record = page_of(folder), json.loads((folder / "provenance.json").read_text())
    words = shlex.split(record["command"])
    assert [words[0], Path(words[1]).name] == ["python", script]
    assert f"hydra.run.dir={folder}" in words
    for key in ("command", "data_hash", "commit", "hardware", "torch"):
        assert record[key] in page.text
    (row,) = (row for row in page.table("folder") if row["folder"] == str(run))
    assert row["seed"] == "0"
    assert row["trained on commit"] == json.loads((run / "metrics.json").read_text())["commit"]
    assert "Configuration of this program" in page.text
