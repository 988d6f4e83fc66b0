"""Sweeps gathered into a table: what varied, what it reached, and what was lost on the way."""

import json
import math
import os
import statistics

import pandas as pd
import pytest
import yaml

from tests.app.entry import fails, run_script

HEADS = {
    "mlp": {"_target_": "pinn_dyn.models.BlackBox", "hidden": [128, 128]},
    "lnn": {
        "_target_": "pinn_dyn.models.LagrangianNetwork",
        "mass": {"_target_": "pinn_dyn.models.NetworkCholesky", "hidden": [32]},
    },
}


def configuration(model, pairs, seed, lr=0.01, epochs=5):
    return {
        "dataset": {"name": "arm", "cache": f"/tmp/{seed}", "system": {"damping": None}},
        "data": {"pairs": pairs, "seed": seed},
        "model": HEADS[model],
        "optimizer": {"lr": lr},
        "scheduler": {"max_lr": lr},
        "trainer": {"steps": epochs},
        "name": f"arm/{model}",
        "model_name": model,
        "seed": seed,
    }


def write_job(folder, config, error=None, seconds=1.0):
    """What train.py leaves behind: with a validation error a record, else none."""
    raw = {
        **config,
        "dataset": {**config["dataset"], "cache": "${oc.env:CACHE}"},
        "data": {**config["data"], "seed": "${seed}"},
        "scheduler": {"max_lr": "${optimizer.lr}"},
        "name": "${dataset.name}/${model_name}",
        "model_name": "${hydra:runtime.choices.model}",
    }
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(raw))
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / "train.log").write_text(
        "[2026-01-01 10:00:00,000][train][INFO] - arm: loading data\n"
    )
    if error is not None:
        record = {
            "seed": config["seed"],
            "training_seconds": seconds,
            "steps": 100,
            "pairs": config["data"]["pairs"],
            "parameters": 10,
            "validation": {"val/error_mean": error, "val/diverged": 0.0},
        }
        (folder / "metrics.json").write_text(json.dumps(record))
        os.utime(folder / "metrics.json", (seconds, seconds))
    return folder


ERRORS = {
    ("lnn", 16): [0.5, 0.25, 0.75],
    ("lnn", 128): [0.02, 0.04, 0.03],
    ("mlp", 16): [0.9, 0.7, 0.8],
    ("mlp", 128): [0.4, 0.1, 0.1],
}


@pytest.fixture
def sweep(tmp_path, monkeypatch):
    """Two models, two numbers of pairs, three seeds; job 3 takes 3.125 s."""
    monkeypatch.chdir(tmp_path)
    number = 0
    for (model, pairs), errors in ERRORS.items():
        for seed, error in enumerate(errors):
            folder = tmp_path / "sweep" / f"{number}_{model}-seed{seed}"
            write_job(folder, configuration(model, pairs, seed), error, seconds=number + 0.125)
            number += 1
    return tmp_path / "sweep"


@pytest.fixture
def gather(tmp_path, capsys):
    """Run gather.py; returns its table, read back, and what it printed."""

    def run(*arguments):
        out = tmp_path / "gathered"
        run_script("gather.py", f"hydra.run.dir={out}", *arguments)
        table = pd.read_csv(out / "sweep.csv") if (out / "sweep.csv").is_file() else None
        return table, capsys.readouterr().out

    return run


def refused(*arguments):
    return str(fails("gather.py", "hydra.run.dir=gathered", *arguments).code)


def test_a_sweep_becomes_one_row_per_choice_with_mean_and_spread_over_its_seeds(sweep, gather):
    table, text = gather(f"runs=[{sweep}]")
    parameters = list(table.columns[: list(table.columns).index("seeds")])
    assert parameters == ["model_name", "data.pairs"]
    assert len(table) == 4
    for _, row in table.iterrows():
        errors = ERRORS[row["model_name"], row["data.pairs"]]
        assert row["seeds"] == 3
        assert row["val/error_mean"] == pytest.approx(statistics.mean(errors), rel=1e-12)
        assert row["val/error_mean_std"] == pytest.approx(statistics.stdev(errors), rel=1e-12)
        assert row["steps"] == 100
    assert list(table["val/error_mean"]) == sorted(table["val/error_mean"])
    assert "0.03 ± 0.01*" in text
    assert "no result" not in text


def test_globs_and_folders_of_sweeps_find_the_same_runs(sweep, gather):
    first, _ = gather(f"runs=[{sweep}/*]")
    second, _ = gather(f"runs=[{sweep.parent}]")
    pd.testing.assert_frame_equal(first, second)


def test_a_copy_without_hydras_folder_has_the_same_replicates(sweep, gather):
    for path in sweep.glob("*/.hydra/config.yaml"):
        path.unlink()
    table, _ = gather(f"runs=[{sweep}]", "filter={model_name:lnn,data.pairs:16,dataset.name:arm}")
    assert "data.seed" not in table


@pytest.mark.parametrize(
    ("condition", "kept"),
    [
        ("{model_name:lnn}", {("lnn", 16), ("lnn", 128)}),
        ("{data.pairs:128}", {("lnn", 128), ("mlp", 128)}),
        ("{data.pairs:[16,128],model_name:mlp}", {("mlp", 16), ("mlp", 128)}),
        ("{dataset.system.damping:null,data.pairs:16}", {("lnn", 16), ("mlp", 16)}),
    ],
)
def test_a_filter_keeps_what_meets_all_its_conditions(sweep, gather, condition, kept):
    table, _ = gather(f"runs=[{sweep}]", f"filter={condition}")
    found = {round(error, 9) for error in table["val/error_mean"]}
    assert found == {round(statistics.mean(ERRORS[choice]), 9) for choice in kept}


def test_sorting_takes_numbers_as_numbers(sweep, gather):
    table, _ = gather(f"runs=[{sweep}]", "sort=data.pairs")
    assert list(table["data.pairs"]) == [16, 16, 128, 128]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["filter={data.pair:16}"], ["no key 'data.pair'", "data.pairs"]),
        (["filter={data.pairs:17}"], ["data.pairs=17", "16", "128"]),
        (["sort=error"], ["sort is 'error'", "val/error_mean"]),
        (["plot=data.pair"], ["plot", "'data.pair'", "data.pairs"]),
        (["evaluations=[nowhere]"], ["evaluations: 'nowhere'", "evaluate.py"]),
    ],
)
def test_a_wrong_word_is_answered_with_the_right_ones(sweep, arguments, words):
    text = refused(f"runs=[{sweep}]", *arguments)
    for word in words:
        assert word in text


@pytest.mark.parametrize("pattern", ["nowhere", "."])
def test_a_place_without_runs_is_named(tmp_path, monkeypatch, pattern):
    monkeypatch.chdir(tmp_path)
    assert f"'{pattern}'" in refused(f"runs=[{pattern}]")


def test_lost_jobs_are_listed_with_their_last_words_and_break_nothing(sweep, gather):
    config = configuration("lnn", 10**6, 0)
    failed = write_job(sweep / "12_lnn-seed0", config)
    (failed / "error.txt").write_text("ConfigError: data: ask for fewer pairs\n\nTraceback ...\n")
    write_job(sweep / "13_lnn-seed0", config)
    early = write_job(sweep / "14_lnn-seed0", config)
    (early / "config.yaml").unlink()
    (early / "train.log").unlink()
    cut_short = write_job(sweep / "15_lnn-seed0", config, error=1.0)
    (cut_short / "metrics.json").write_text('{"seed": 0, "val')
    damaged = write_job(sweep / "16_lnn-seed0", config, error=1.0)
    (damaged / "config.yaml").write_text("model: [")
    other = sweep / "evaluation" / ".hydra"
    other.mkdir(parents=True)
    (other / "config.yaml").write_text("horizon: 5.0\n")

    table, text = gather(f"runs=[{sweep}]")
    assert len(table) == 4
    assert "5 of 17 jobs have no result" in text
    lines = text.splitlines()

    def said_of(number):
        at = next(i for i, line in enumerate(lines) if f"/{number}_lnn" in line)
        assert "data.pairs=1000000" in lines[at]
        return lines[at + 1].strip()

    assert said_of(12) == "failed: ConfigError: data: ask for fewer pairs"
    assert said_of(13) == "running or stopped, its log ends with: arm: loading data"
    assert said_of(14) == "running or stopped, without a log"
    assert "metrics.json" in said_of(15)
    assert "config.yaml" in said_of(16)
    assert "evaluation" not in text


def test_a_failure_too_early_to_know_its_model_is_not_hidden_by_a_filter(sweep, gather):
    early = write_job(sweep / "12_lnn-seed0", configuration("lnn", 16, 0))
    (early / "config.yaml").unlink()
    write_job(sweep / "13_mlp-seed0", configuration("mlp", 16, 0))
    _, text = gather(f"runs=[{sweep}]", "filter={model_name:lnn}")
    assert "12_lnn-seed0" in text
    assert "13_mlp-seed0" not in text


def test_a_sweep_of_failures_only_is_told_as_such(tmp_path, gather):
    write_job(tmp_path / "sweep" / "0_lnn", configuration("lnn", 16, 0))
    table, text = gather(f"runs=[{tmp_path / 'sweep'}]")
    assert table is None
    assert "no run has finished" in text
    assert "loading data" in text


def test_of_a_run_that_was_repeated_the_latest_counts(sweep, gather):
    write_job(sweep / "again", configuration("lnn", 16, 0), error=0.05, seconds=1000.0)
    table, text = gather(f"runs=[{sweep}]", "filter={model_name:lnn,data.pairs:16}")
    assert table["val/error_mean"][0] == pytest.approx((0.05 + 0.25 + 0.75) / 3)
    assert table["seeds"][0] == 3
    assert "same configuration and seed: 1 of 4" in text


def write_evaluation(folder, seconds, errors, horizon=5.0):
    folder.mkdir(parents=True)
    rows = {
        "run": [f"lnn seed {k}" for k in range(len(errors))],
        "model": "lnn",
        "seed": range(len(errors)),
        "training_seconds": seconds,
        "horizon": horizon,
        "error_mean": errors,
        "diverged": 0,
    }
    pd.DataFrame(rows).to_csv(folder / "summary.csv", index=False)
    return folder


def test_test_errors_are_those_of_the_same_training(sweep, gather):
    # The seeds of lnn with 16 pairs, the last of which was trained once more since.
    write_evaluation(sweep.parent / "seen", [0.125, 1.125, 99.0], [3.0, 5.0, 100.0])
    table, text = gather(f"runs=[{sweep}]", "evaluations=[seen]", "sort=test/error_mean")
    assert "2 of 12 runs over 5 s" in text
    known = table["test/error_mean"].notna()
    assert list(known) == [True, False, False, False]
    assert table["test/error_mean"][0] == 4.0
    assert table["test/error_mean_std"][0] == pytest.approx(math.sqrt(2))
    assert (table["model_name"][0], table["data.pairs"][0]) == ("lnn", 16)
    assert "nan" not in text


def test_the_latest_evaluation_that_knows_a_run_is_found(sweep, gather):
    found = sweep.parent / "runs" / "evaluation"
    for age, (name, seconds, error) in enumerate(
        [("other", 77.0, 1.0), ("new", 0.125, 2.0), ("old", 0.125, 3.0)]
    ):
        path = write_evaluation(found / name, [seconds], [error]) / "summary.csv"
        os.utime(path, (1000 - age, 1000 - age))
    table, text = gather(f"runs=[{sweep}]")
    assert table["test/error_mean"].dropna().tolist() == [2.0]
    assert "runs/evaluation/new" in text


def test_evaluations_over_other_horizons_are_not_mixed(sweep):
    write_evaluation(sweep.parent / "a", [0.125], [1.0], horizon=5.0)
    write_evaluation(sweep.parent / "b", [3.125], [1.0], horizon=1.0)
    text = refused(f"runs=[{sweep}]", "evaluations=[a,b]")
    assert "a: 5 s" in text


def test_the_figure_is_written(sweep, gather):
    gather(f"runs=[{sweep}]", "plot=data.pairs")
    assert (sweep.parent / "gathered" / "sweep.png").stat().st_size > 10_000


@pytest.mark.usefixtures("undrawn")
def test_real_runs_are_gathered_with_their_evaluation(
    tmp_path, gather, monkeypatch, hnn_run, lnn_run, mlp_run
):
    monkeypatch.chdir(tmp_path)
    runs = f"runs=[{hnn_run},{lnn_run},{mlp_run}]"
    run_script("evaluate.py", runs, "horizon=0.1", "windows=[]", "hydra.run.dir=evaluation")
    table, text = gather(runs, "evaluations=[evaluation]")
    summary = pd.read_csv("evaluation/summary.csv").set_index("model")
    assert sorted(table["model_name"]) == ["hnn", "lnn", "mlp"]
    for _, row in table.iterrows():
        model = row["model_name"]
        folder = {"hnn": hnn_run, "lnn": lnn_run, "mlp": mlp_run}[model]
        record = json.loads((folder / "metrics.json").read_text())
        assert row["val/error_mean"] == pytest.approx(record["validation"]["val/error_mean"])
        assert row["test/error_mean"] == pytest.approx(summary.error_mean[model])
        assert row["parameters"] == record["parameters"]
    # Epochs differ between the runs, but the model says it.
    assert "trainer.steps" in table
    assert "trainer.steps" not in text.split("only in the files")[0]


def test_help_shows_examples(capsys):
    with pytest.raises(SystemExit) as caught:
        run_script("gather.py", "--help")
    assert caught.value.code in (0, None)
    text = capsys.readouterr().out
    assert "python gather.py 'runs=[" in text
    assert "filter={" in text


# --- the table itself ------------------------------------------------------------------------
