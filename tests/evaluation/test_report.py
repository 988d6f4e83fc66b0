"""Reports without a browser: numbers, names, nothing from the network, honest curves."""

import base64
import dataclasses
import re
from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from pinn_dyn.evaluation import write_table
from pinn_dyn.evaluation.drawing import Line, Panel, error_panel, units
from pinn_dyn.evaluation.identification import COLUMNS
from pinn_dyn.evaluation.report import measured_model_report
from pinn_dyn.evaluation.report.error_curves import error_figure
from pinn_dyn.evaluation.report.motion import motion_figure, shown_motions
from pinn_dyn.evaluation.report.page import table
from pinn_dyn.evaluation.report.style import POINTS, simplify
from tests.evaluation.report_pages import (
    ODD,
    Page,
    comparisons_of,
    control_page,
    origin,
    prediction_page,
    records,
)


@pytest.fixture(scope="module")
def prediction():
    text, summary = prediction_page(comparisons=comparisons_of(["hnn"]))
    return text, Page(text), summary


@pytest.fixture(scope="module")
def control():
    text, summary = control_page()
    return text, Page(text), summary


@pytest.fixture(params=["prediction", "control"])
def either(request):
    return request.getfixturevalue(request.param)


def test_nothing_is_loaded_from_anywhere(either):
    _, page, _ = either
    for tag, attributes in page.tags:
        assert tag not in ("link", "iframe", "object", "embed", "base")
        assert not (tag == "script" and "src" in attributes)
        for name in ("src", "href", "srcset", "action"):
            assert attributes.get(name, "#").startswith(("#", "data:"))
    styles = re.findall(r"<style>.*?</style>", either[0], re.DOTALL)
    assert styles
    assert not any("url(" in style or "@import" in style for style in styles)


def test_plotly_is_there_once_and_sends_nothing(either):
    text = either[0]
    assert text.count("plotly.js v") == 1
    figures = text.count("Plotly.newPlot(")
    assert figures >= 2
    assert len(re.findall(r'"modeBarButtonsToRemove": \["sendChartToCloud"', text)) == figures
    assert len(text.encode()) < 8e6


@pytest.mark.parametrize(("kind", "key"), [("prediction", "run"), ("control", "controller")])
def test_every_number_of_the_csv_is_on_the_page(kind, key, request, tmp_path):
    _, page, summary = request.getfixturevalue(kind)
    csv, _ = write_table(summary, tmp_path, "summary")
    rows = page.table("figure")
    compared = 0
    for _, run in pd.read_csv(csv).iterrows():
        for row in rows:
            (name, _), (text, digits) = row["figure"], row[run[key]]
            value = run[name]
            if isinstance(value, (str, bool, np.bool_)):
                assert text == str(value)
            elif digits is not None:
                assert float(digits) == value
            else:
                assert float(text) == value
            compared += 1
    assert compared == len(summary) * (summary.shape[1] - 1)


def test_the_first_table_has_all_runs_and_marks_the_best(prediction):
    text, page, summary = prediction
    rows = page.table("mean error ± std")
    assert [row["run"][0] for row in rows] == ["hnn", "lnn"]
    value = summary["error_mean"][0]
    assert rows[0]["mean error ± std"][1] == repr(float(value))
    assert rows[0]["mean error ± std"][0].startswith(f"{value:.3g} ± ")
    assert re.search(rf'class=" best" title="{re.escape(repr(float(value)))}"', text)


def test_the_laws_are_listed_with_what_stopped_them(control):
    _, page, _ = control
    assert [row["law"][0] for row in page.table("RMS error")] == ["learned", "pd"]
    (stop,) = page.table("stopped")[1:2] or page.table("run")
    assert "1.20 s: A is singular" in page.text
    assert stop["law"][0] == "pd"
    assert "learned" in page.text


def test_a_lost_trajectory_is_named(prediction, control):
    assert "Diverged: lnn on 1." in prediction[1].text
    assert "(1 of 5 diverged)" in prediction[0]
    assert "(1 of 4 stopped)" in control[0]
    assert "2 stopped" in control[0]


def test_the_configuration_and_the_origin_are_there(either):
    page = either[1]
    for text in ("python evaluate.py", "abc1234", "a: 1", "runs/x"):
        assert text in page.text


@pytest.mark.parametrize(
    "make", [partial(prediction_page, comparisons=comparisons_of([ODD])), control_page]
)
def test_odd_names_are_text(make):
    text, _ = make(names=(ODD, "lnn"), title=ODD)
    page = Page(text)
    assert not [attributes for tag, attributes in page.tags if "onerror" in attributes]
    assert page.text.count(ODD) >= 3
    assert "<img src=x" not in text


def test_odd_text_in_a_stability_report_is_text():
    page = Page(
        measured_model_report(
            title="m", report=f"# Of {ODD}\n\n| a | b |\n|---|---|\n| 1 | 2 |\n", origin=origin()
        )
    )
    assert not any("onerror" in attributes for _, attributes in page.tags)
    assert ODD in page.text
    assert page.table("b") == [{"a": ["1", None], "b": ["2", None]}]


def test_without_the_truth_the_page_says_so():
    text, _ = prediction_page()
    assert "of measured data nobody knows the true ones" in Page(text).text
    assert 'id="figure-terms"' not in text


def test_steady_states_are_counted_against_their_bounds(control):
    assert "holds at 3 of 4 set points" in control[1].text
    assert "2 of 3 measured steady-state errors" in control[1].text


def test_an_animation_is_embedded_unless_it_is_too_large(tmp_path, monkeypatch):
    path = tmp_path / "a.gif"
    Image.new("RGB", (4, 4), "red").save(path)
    pictures = [a for tag, a in Page(control_page(animation=path)[0]).tags if tag == "img"]
    (attributes,) = (a for a in pictures if "image/gif" in a["src"])
    head, data = attributes["src"].split(",")
    assert head == "data:image/gif;base64"
    assert base64.b64decode(data) == path.read_bytes()
    monkeypatch.setattr("pinn_dyn.evaluation.report.control_page._ANIMATION", 10)
    page = Page(control_page(animation=path)[0])
    assert not [a for tag, a in page.tags if tag == "img" and "gif" in a["src"]]
    assert "a.gif is too large" in page.text


def test_a_simplified_curve_is_nowhere_off_by_more_than_the_tolerance():
    t = torch.linspace(0, 5, 20001, dtype=torch.float64)
    y = torch.sin(3 * t) + torch.exp(-(((t - 2) / 0.002) ** 2))
    x, values = simplify(t, y, tolerance=1e-3)
    assert len(x) < 300
    assert np.abs(np.interp(t, x, values) - y.numpy()).max() < 1.1e-3
    assert values.max() == pytest.approx(float(y.max()), abs=1e-3)
    assert set(values) <= set(y.numpy().astype(np.float32))
    logarithmic = torch.exp(-8 * t)
    x, values = simplify(t, logarithmic, tolerance=1e-2, log=True)
    assert len(x) < 20
    np.testing.assert_allclose(
        np.interp(t, x, np.log10(values)), np.log10(logarithmic), atol=1.1e-2
    )


def test_a_simplified_curve_keeps_its_gaps_and_stops_at_its_points():
    t = torch.linspace(0, 1, 1001, dtype=torch.float64)
    y = t.square()
    y[300:400], y[700:850], y[850:], y[500] = torch.nan, torch.nan, 1e39, torch.inf
    x, values = simplify(t, y, tolerance=1e-4)
    for low, high in ((0.2995, 0.3995), (0.4995, 0.5005), (0.6995, 1.0)):
        inside = (x > low) & (x < high)
        assert inside.any()
        assert np.isnan(values[inside]).all()
    assert not np.isnan(values[(x < 0.2995) | ((x > 0.4) & (x < 0.4995))]).any()
    constant, _ = simplify(t, torch.ones_like(t), tolerance=1e-4)
    np.testing.assert_allclose(constant, [0, 1])
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=1001))
    assert 100 <= len(simplify(t, noise, tolerance=1e-6, points=100)[0]) < 200


def test_a_motion_has_its_own_curves_and_range():
    t = torch.linspace(0, 1, 51, dtype=torch.float64)
    y = torch.stack([t, 10 * t.square()])
    real = Line("truth", t, y, "#999999", always=True)
    guess = Line("guess", t, 1e6 * y, "#0072b2")
    drawn = motion_figure(
        [Panel("q [rad]", [real, guess], leading=real)],
        {0: "0", 1: "1"},
        first=1,
        what="trajectory",
        everyone="all",
    )
    for index, frame in enumerate(drawn.frames):
        truth, runaway = frame.data
        np.testing.assert_allclose(np.interp(truth.x, t, y[index]), truth.y, atol=1e-6)
        low, high = frame.layout.yaxis.range
        assert low < 0
        assert high == pytest.approx(1.3 * float(y[index].max()))
        assert np.nanmax(runaway.y) < 110 * (high - low)
    np.testing.assert_array_equal(drawn.data[0].y, drawn.frames[1].data[0].y)
    assert drawn.layout.sliders[0].active == 1


def test_a_held_input_is_drawn_as_stairs():
    t = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    line = Line("input", t, torch.tensor([[1.0, 3.0, 2.0]]), "#999999", held=True)
    drawn = motion_figure(
        [Panel("u", [line])], {0: "0"}, first=0, what="trajectory", everyone="all"
    )
    np.testing.assert_allclose(drawn.data[0].x, [0, 1, 1, 2, 2], atol=1e-5)
    np.testing.assert_array_equal(drawn.data[0].y, [1, 1, 3, 3, 2])


def test_a_spike_does_not_flatten_a_panel():
    t = torch.linspace(0, 1, 1001, dtype=torch.float64)
    y = torch.cos(9 * t)[None].clone()
    y[0, :3] = 500.0
    low, high = Panel("u", [Line("learned", t, y, "#0072b2")]).limits(0)
    assert -3 < low < -1
    assert 1 < high < 3


def test_the_errors_are_the_mean_of_what_was_not_lost():
    t = torch.linspace(0, 1, 11, dtype=torch.float64)
    error = torch.tensor([1.0, 2.0, 900.0])[:, None] * (1 + t)
    lost = torch.tensor([False, False, True])
    panel = error_panel(
        {"a": (t, error, lost), "b": (t, error, torch.ones(3, dtype=torch.bool))},
        label="e",
        floors={"still": (t, 2 * error, lost)},
    )
    drawn = error_figure(panel, one="run", lost="diverged")
    low, high, mean, every, empty, floor = drawn.data
    np.testing.assert_allclose(np.interp(t[1:], floor.x, floor.y), 3 * (1 + t[1:]), rtol=0.01)
    assert floor.line.width < mean.line.width
    np.testing.assert_allclose(np.interp(t[1:], mean.x, mean.y), 1.5 * (1 + t[1:]), rtol=0.01)
    np.testing.assert_allclose(low.y / mean.y[0] * 1.5, 1.1 * low.y / low.y[0], rtol=1e-5)
    assert high.y[0] == pytest.approx(1.9 * 1.1)
    assert set(every.customdata) == {0, 1}
    assert [trace.name for trace in (mean, empty)] == [
        "a (1 of 3 diverged)",
        "b (3 of 3 diverged)",
    ]
    first, second = drawn.layout.updatemenus[0].buttons
    assert list(first.args[0]["visible"]) == [True, True, True, False, True, True]
    assert list(second.args[0]["visible"]) == [False, False, False, True, True, True]


def test_the_terms_are_pictures_of_every_model_and_configuration(prediction):
    _, page, _ = prediction
    pictures = [a["alt"] for tag, a in page.tags if tag == "img"]
    assert pictures == ["hnn, bent", "hnn, more"]


def test_floors_are_in_brackets_and_a_model_that_loses_to_one_has_no_bold_figure():
    names = {"names": ("hnn",), "floors": ("ARX",)}
    text, summary = prediction_page(**names, comparisons=comparisons_of(["hnn"]))
    page = Page(text)
    rows = page.table("mean error ± std")
    assert [row["run"][0] for row in rows] == ["hnn", "[ARX]"]
    assert "No model beats every floor" not in page.text
    assert "ARX" not in page.table("configuration")[0]["run"][0]
    # The second of the names errs twice as much: now the floor is the better one.
    swapped = summary.assign(floor=[True, False])
    page = Page(prediction_page(**names, summary=swapped)[0])
    assert "No model beats every floor in error_mean: 'hnn' has" in page.text


def test_a_value_that_is_not_there_is_a_dash():
    """Of whole numbers too, such as the seed of a floor."""
    frame = pd.DataFrame({"seed": pd.array([0, None], dtype="Int64"), "x": [0.5, float("nan")]})
    shown = re.findall(r"<td[^>]*>([^<]*)</td>", str(table(frame)))
    assert shown == ["0", "0.5", "-", "-"]


def test_notes_on_rows_stand_below_the_table(prediction):
    page = Page(prediction_page(notes=["with delay: <its own> inputs"])[0])
    assert "with delay: <its own> inputs" in page.text
    assert "with delay" not in prediction[1].text


def test_parts_of_sums_have_a_section_where_there_are_any(prediction):
    parts = pd.DataFrame(
        {
            "part": ["known", "network"],
            "term": ["G", "G"],
            "rms": [2.5, 0.125],
            "share": [0.952, 0.048],
            "run": ["learned", "learned"],
        }
    )
    rows = Page(prediction_page(parts=parts)[0]).table("share of all parts")
    assert [row["part"][0] for row in rows] == ["known", "network"]
    assert rows[1]["share of all parts"][0] == "0.048"
    assert "share of all parts" not in prediction[0]


def test_torque_errors_have_a_section_where_there_are_any():
    joints = pd.DataFrame(
        {
            "run": ["lnn"],
            "joint": ["elbow"],
            "torque_rms": [0.5],
            "torque_spread": [2.0],
            "torque_share": [0.25],
        }
    )
    (row,) = Page(prediction_page(joints=joints)[0]).table("RMS / spread")
    assert (row["joint"][0], row["RMS / spread"][0]) == ("elbow", "0.25")


def test_the_worst_motions_are_among_those_shown():
    assert shown_motions(5, [3]) == [0, 1, 2, 3, 4]
    shown = shown_motions(100, [70, 99, 70])
    assert len(shown) == 24
    assert shown == sorted(shown)
    assert {70, 99} <= set(shown)


def test_a_large_noisy_evaluation_stays_small():
    found = records(("a", "b"), runs=24)
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=(24, 801)))
    t = torch.linspace(0, 2, 801, dtype=torch.float64)
    panels = [Panel("q", [Line(name, t, noise, "#0072b2") for name in found])] * 7
    names = {k: f"{k}" for k in range(24)}
    drawn = motion_figure(panels, names, first=0, what="run", everyone="all")
    points = sum(len(trace.x) for frame in drawn.frames for trace in frame.data)
    assert points < 2 * POINTS


def test_units_are_read_from_the_labels():
    assert units(["Δx [rad]", "Δy [rad]", "δℓ [m]"]) == "rad, m"
    assert units(["q1 (deg)", "arm"]) == "deg"
    assert units(["q1", "q2"]) == ""


def test_a_table_of_text_and_numbers_shows_three_digits():
    page = Page(str(table(pd.DataFrame({"a": ["x"], "b": [0.123456], "c": [7]}))))
    assert page.tables == [
        [[["a", None], ["b", None], ["c", None]], [["x", None], ["0.123", "0.123456"], ["7", None]]]
    ]


def test_a_run_without_any_finite_sample_is_drawn_as_nothing():
    found = records()
    lost = found["pd"]
    q = torch.full_like(lost.q, torch.nan)
    q[:, 0] = 0.0
    found["pd"] = dataclasses.replace(lost, q=q, stopped=["0.02 s: too fast"] * 4)
    page = Page(control_page(records=found)[0])
    assert page.text.count("0.02 s: too fast") == 4


def test_one_run_of_one_trajectory_is_enough():
    text, _ = prediction_page(names=("hnn",))
    assert [row["run"][0] for row in Page(text).table("mean error ± std")] == ["hnn"]


def test_fitted_constants_have_a_section_that_says_what_is_not_determined(prediction):
    rows = [
        ["mass of link", 91.0548, 79.3, 102.8, "kg", 50.0, 0.999],
        ["armature of screw", 4.0, 0.0, 15.7, "kg", 4.0, 0.0004],
        ["mass of link + armature of screw", 95.0415, 93.7, 96.4, "kg", 54.0, 0.99999],
        [ODD, 1.0, 0.5, 1.5, "Nm/A", np.nan, np.nan],
    ]
    constants = {"known": pd.DataFrame(rows, columns=COLUMNS)}
    page = Page(prediction_page(constants=constants)[0])
    mass, armature, both, odd = page.table("95 % from")
    assert mass["value"] == ["91.1", "91.0548"]
    assert (mass["unit"][0], mass["start"][0], mass[""][0]) == ("kg", "50", "")
    assert armature[""][0] == "not determined"
    assert both["constant"][0] == "mass of link + armature of screw"
    assert both[""][0] == ""
    assert odd["constant"][0] == ODD
    assert odd["start"][0] == "-"
    assert "1 not determined" in page.text
    assert "95 % from" not in prediction[0]
