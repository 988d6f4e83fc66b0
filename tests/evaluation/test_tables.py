import json
import math
from dataclasses import replace

import pandas as pd
import pytest

from pinn_dyn.evaluation import (
    RunResult,
    beaten_by_floors,
    best_floor,
    format_table,
    grouped_table,
    summary_table,
    write_table,
)


def result(model, seed, error, *, diverged=0, valid=1.0):
    metrics = {
        "error_mean": error,
        "error_std": error / 2,
        "diverged": diverged,
        "valid_time_near": valid,
    }
    return RunResult(f"{model}-{seed}", model, seed, metrics, {"training_pairs": 8000})


@pytest.fixture
def results():
    return [
        result("lagrangian", 0, 0.25, valid=3.0),
        result("lagrangian", 1, 0.75, valid=2.0),
        # The mean of what is left is small, but trajectories are missing from it.
        result("black_box", 0, 0.125, diverged=4),
        result("black_box", 1, math.inf, diverged=9, valid=0.0),
    ]


def row_of(text, name):
    return next(line for line in text.splitlines() if line.startswith(name))


def test_one_row_per_run(results):
    frame = summary_table(results)
    assert list(frame.columns[:5]) == ["run", "model", "seed", "floor", "training_pairs"]
    assert list(frame.run) == ["lagrangian-0", "lagrangian-1", "black_box-0", "black_box-1"]
    assert list(frame.error_mean) == [0.25, 0.75, 0.125, math.inf]


def test_the_best_is_marked_among_those_that_did_not_diverge(results):
    text = format_table(summary_table(results))
    assert "0.25 ± 0.125*" in row_of(text, "lagrangian-0")
    assert "3*" in row_of(text, "lagrangian-0")
    assert "0*" in row_of(text, "lagrangian-1")  # no trajectory diverged
    assert "*" not in row_of(text, "black_box-0")
    assert "8000*" not in text
    assert "nan" not in text.lower()


def test_columns_are_aligned(results):
    lines = format_table(summary_table(results)).splitlines()
    ends = lines[0].index("seed") + len("seed")
    assert [line[ends - 1] for line in lines[2:]] == ["0", "1", "0", "1"]


def test_a_column_without_a_difference_has_no_best():
    text = format_table(summary_table([result("a", 0, 0.5), result("a", 1, 0.5)]))
    assert "*" not in text


def test_mean_and_worst_over_seeds(results):
    frame = grouped_table(summary_table(results)).set_index("model")
    assert list(frame.index) == ["lagrangian", "black_box"]
    assert list(frame.seeds) == [2, 2]
    assert frame.loc["lagrangian", "mean_error_mean"] == pytest.approx(0.5)
    assert frame.loc["lagrangian", "worst_error_mean"] == pytest.approx(0.75)
    assert frame.loc["lagrangian", "worst_valid_time_near"] == pytest.approx(2.0)
    assert frame.loc["lagrangian", "mean_training_pairs"] == 8000
    assert frame.loc["black_box", "mean_error_mean"] == math.inf
    assert frame.loc["black_box", "worst_diverged"] == 9
    assert "worst_training_pairs" not in frame.columns


def test_files_round_trip(results, tmp_path):
    frame = summary_table(results)
    csv, records = write_table(frame, tmp_path / "new", "runs")
    assert (csv.name, records.name) == ("runs.csv", "runs.json")
    pd.testing.assert_frame_equal(pd.read_csv(csv), frame.astype({"seed": "int64"}))

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    rows = json.loads(records.read_text(), parse_constant=refuse)
    assert rows[0]["error_mean"] == 0.25
    assert rows[0]["seed"] == 0
    assert float(rows[3]["error_mean"]) == math.inf


def test_a_run_without_a_metric_has_a_gap(tmp_path):
    runs = [result("a", 0, 0.5), RunResult("b-0", "b", 0, {"error_mean": 0.25})]
    frame = summary_table(runs)
    row = row_of(format_table(frame), "b-0")
    assert row.split()[-1] == "-"
    _, records = write_table(frame, tmp_path, "runs")
    assert json.loads(records.read_text())[1]["training_pairs"] is None


def test_a_figure_that_a_row_does_not_have_is_one_dash():
    rows = [
        RunResult("one", "lnn", 0, {"member_error_mean": 0.5, "member_error_std": 0.25}),
        RunResult("other", "hnn", 0, {}),
    ]
    text = format_table(summary_table(rows))
    assert "0.5 ± 0.25" in row_of(text, "one")
    assert "±" not in row_of(text, "other")


def test_errors_name_the_run():
    with pytest.raises(ValueError, match="results is empty"):
        summary_table([])
    with pytest.raises(ValueError, match=r"run 'r' names \['seed', 'x'\] twice"):
        summary_table([RunResult("r", "m", 0, {"x": 1.0, "seed": 2}, {"x": 2.0})])


# Floors.


def table(models, floors, *, lost=()):
    """Errors by name, of models and of floors; those named in lost have a trajectory diverged."""
    rows = [
        RunResult(
            name,
            name,
            None if floor else 0,
            {"error_mean": error, "error_std": 0.0, "diverged": int(name in lost)},
            floor=floor,
        )
        for part, floor in ((models, False), (floors, True))
        for name, error in part.items()
    ]
    return summary_table(rows)


def stars(frame):
    return [line.split()[0] for line in format_table(frame).splitlines() if "*" in line]


FLOORS = {"stands still": 0.9, "ARX": 0.3}


@pytest.mark.parametrize(
    ("models", "lost", "starred", "sentence"),
    [
        ({"lnn": 0.2, "mlp": 0.25}, (), ["lnn"], None),
        # Better than one floor of two is not enough, and a tie is not better.
        ({"lnn": 0.35, "mlp": 0.5}, (), [], "'ARX' has 0.3"),
        ({"lnn": 0.3, "mlp": 0.5}, (), [], "'ARX' has 0.3"),
        # The mean of a model leaves out what it lost: it does not beat a floor that lost nothing.
        ({"lnn": 0.2, "mlp": 0.5}, ("lnn",), [], "'ARX' has 0.3"),
        # A floor that lost trajectories of its own is no bar.
        ({"lnn": 0.35, "mlp": 0.5}, ("ARX",), ["lnn"], None),
        # A model that lost all has an infinite error and no star.
        ({"lnn": math.inf, "mlp": 0.25}, ("lnn",), ["mlp"], None),
    ],
)
def test_a_star_goes_to_a_model_that_beats_every_floor(models, lost, starred, sentence):
    frame = table(models, FLOORS, lost=lost)
    assert stars(frame) == starred
    said = beaten_by_floors(frame)
    assert len(said) == (sentence is not None)
    assert all("No model beats every floor in error_mean" in text for text in said)
    assert all(sentence in text for text in said)


def test_a_floor_is_marked_in_the_file_and_bracketed_on_the_terminal(tmp_path):
    frame = table({"lnn": 0.2}, FLOORS)
    csv, records = write_table(frame, tmp_path, "summary")
    read = pd.read_csv(csv)
    assert read["floor"].tolist() == [False, True, True]
    assert read["seed"].isna().tolist() == [False, True, True]
    assert json.loads(records.read_text())[1]["seed"] is None
    assert row_of(format_table(frame), "[ARX]").split()[2] == "-"
    assert "floor" not in format_table(frame).splitlines()[0]
    by_model = grouped_table(frame)
    assert by_model["floor"].tolist() == [False, True, True]
    assert "[stands still]" in format_table(by_model)


def test_columns_of_what_went_wrong_appear_where_something_did():
    assert "diverged" not in format_table(table({"lnn": 0.2}, FLOORS))
    assert "diverged" in format_table(table({"lnn": 0.2}, FLOORS, lost=("lnn",)))


def test_no_floor_needs_no_sentence(results):
    assert beaten_by_floors(summary_table(results)) == []


def test_the_best_floor_is_the_lowest_of_those_that_lost_fewest():
    floors = [
        replace(result("still", None, 0.5), floor=True),
        replace(result("arx", None, 0.25), floor=True),
        replace(result("edmdc", None, 0.1, diverged=3), floor=True),
    ]
    models = [result("lnn", 0, 0.01)]
    assert best_floor(summary_table([*models, *floors])) == "arx-None"
    assert best_floor(summary_table(models)) is None
