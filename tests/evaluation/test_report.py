"""Reports without a browser: self-contained, with the numbers of their tables, names as text."""

import math
import re

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from pinn_dyn.evaluation.report.page import slider
from pinn_dyn.identification.constants import COLUMNS
from tests.evaluation.report_pages import (
    ODD,
    Page,
    control_page,
    evaluation,
    prediction_page,
)


@pytest.fixture(scope="module")
def prediction():
    text, item = prediction_page()
    return text, Page(text), item


@pytest.fixture
def empty_pictures(monkeypatch):
    """Pages with empty pictures of the trajectories, which take longer than all else."""
    page = "pinn_dyn.evaluation.results"
    monkeypatch.setattr(f"{page}.trajectory_figure", lambda *_, **__: Figure())


@pytest.fixture(scope="module")
def control():
    text, summary = control_page()
    return text, Page(text), summary


def test_a_page_loads_nothing(prediction, control):
    for text, page, _ in (prediction, control):
        for tag, attributes in page.tags:
            assert tag not in ("link", "iframe", "object", "embed", "base")
            assert not (tag == "script" and "src" in attributes)
            for name in ("src", "href", "srcset", "action"):
                assert attributes.get(name, "#").startswith(("#", "data:"))
        styles = re.findall(r"<style.*?</style>", text, re.DOTALL)
        assert not any("url(" in style or "@import" in style for style in styles)
        for fact in ("python evaluate.py", "abc1234", "a: 1", "runs/x"):
            assert fact in page.text
    assert len(prediction[0]) < 1e6
    assert len(control[0]) < 1e6


def test_the_summary_has_known_errors_and_marks_the_best(prediction):
    text, page, item = prediction
    rows = page.table("mean error ± std")
    assert [row["run"] for row in rows] == ["hnn", "lnn", "[hold position]"]
    # Three coordinates are off by 0.01 t for t up to 2 s.
    assert rows[0]["mean error ± std"].startswith(f"{0.01 * math.sqrt(3):.3g} ± ")
    assert item.summary["diverged"].tolist() == [0, 1, 0]
    assert item.summary["valid_time_large"][0] == 2.0
    assert re.search(r'class="data row0 col1 best"', text)
    assert rows[1]["worst trajectory"] == "diverged: 1 of 5"
    assert re.search(r"Worst trajectory of each run: hnn: \d; lnn: 1\.", page.text)


def test_control_laws_are_listed_with_the_reason_of_a_stop(control):
    _, page, _ = control
    assert [row["law"] for row in page.table("RMS error")] == ["learned", "pd"]
    (stop,) = page.table("reason")
    assert stop == {"law": "pd", "run": "2", "reason": "1.20 s: A is singular"}


def test_sections_of_constants_torques_and_parts_appear_with_their_data(prediction, empty_pictures):
    rows = [
        ["mass of link", 91.0548, 79.3, 102.8, "kg", 50.0, 0.999],
        ["armature of screw", 4.0, 0.0, 15.7, "kg", 4.0, 0.0004],
        [ODD, 1.0, 0.5, 1.5, "Nm/A", np.nan, np.nan],
    ]
    values = {"joint": ["elbow"], "torque_rms": [0.5], "torque_spread": [2.0]}
    page = Page(
        prediction_page(
            constants={"known": pd.DataFrame(rows, columns=COLUMNS)},
            torque=pd.DataFrame({"run": ["lnn"], **values, "torque_share": [0.25]}),
            parts=pd.DataFrame(
                {"run": ["a"], "part": ["net"], "term": ["G"], "rms": [2.5], "share": [0.048]}
            ),
        )[0]
    )
    mass, armature, odd = page.table("low")
    assert (mass["value"], mass["unit"], mass["note"]) == ("91.1", "kg", "")
    assert armature["note"] == "not determined"
    assert (odd["name"], odd["start"]) == (ODD, "-")
    assert page.table("torque share")[0]["torque share"] == "0.25"
    assert page.table("part")[0]["part"] == "net"
    titles = [attributes.get("href") for tag, attributes in prediction[1].tags if tag == "a"]
    assert len(titles) == 4  # of the sections without data none is there


def test_the_slider_offers_the_median_and_the_worst_trajectories(prediction, monkeypatch):
    """In the order of their numbers, starting at the chosen one; pictures replace plotly's data."""
    drawn = []

    def figure(*_, trajectory, **__):
        drawn.append(trajectory)
        return Figure()

    _, page, item = prediction
    figures = dict(item.figures(2))
    monkeypatch.setattr("pinn_dyn.evaluation.results.trajectory_figure", figure)
    monkeypatch.setattr("pinn_dyn.evaluation.results.MAX_TRAJECTORIES", 3)
    pictures = [x["alt"] for tag, x in page.tags if tag == "img" and "alt" in x]
    assert [x for x in pictures if x.startswith("trajectory")] == [
        f"trajectory {k}" for k in range(5)
    ]
    page = Page(item.page(figures, 2))
    lnn = item.models["lnn"].error().mean(dim=1)
    order = sorted(range(5), key=lambda k: (math.isnan(lnn[k]), float(lnn[k])))
    assert f"lnn: {order[2]}." in page.text.partition("Median")[2]
    assert drawn[0] == 2
    assert {1, drawn[0]} <= set(drawn)  # lnn diverges on 1
    assert len(drawn) == 3
    (control,) = [x for tag, x in page.tags if tag == "input"]
    assert sorted(drawn)[int(control["value"])] == 2


def test_an_added_section_stands_behind_the_results(empty_pictures):
    item = evaluation()
    item.add_section("Load", ODD, pd.DataFrame({"mass [kg]": [2.5]}), Figure())
    figures = dict(item.figures())
    titles = [section.title for section in item.sections(figures)]
    assert titles[-2:] == ["Load", "Configuration and provenance"]
    page = Page(item.page(figures))
    assert ODD in page.text
    assert page.table("mass [kg]") == [{"mass [kg]": "2.5"}]


@pytest.mark.slow
def test_a_slider_of_large_figures_stays_small():
    def figures():
        for number in range(20):
            figure = Figure(figsize=(12, 16))
            noise = np.random.default_rng(number).normal(size=(300, 400))
            figure.subplots().imshow(noise, cmap="gray")
            yield number, figure

    text = slider(figures(), "run")
    assert 6e5 < len(text) < 1e6
    assert text.count("<img") < 20


def test_a_saved_evaluation_has_tables_figures_and_a_page(tmp_path, empty_pictures):
    item = evaluation()
    item.save(tmp_path / "out")
    summary = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert summary["error_mean"].tolist() == item.summary["error_mean"].tolist()
    for name in ("trajectory.png", "error.png", "report.html", "by_model.csv"):
        assert (tmp_path / "out" / name).is_file()
    text = str(item)
    assert "5 unseen test trajectories, 2 s open loop" in text
    assert "nan" not in text.lower()
