"""gather.py: one table of many runs, with errors over seeds and the jobs that failed."""

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
    "lnn": {"_target_": "pinn_dyn.models.LagrangianNetwork", "mass": {"hidden": [32]}},
}
ERRORS = {
    ("lnn", 16): [0.5, 0.25, 0.75],
    ("lnn", 128): [0.02, 0.04, 0.03],
    ("mlp", 16): [0.9, 0.7, 0.8],
    ("mlp", 128): [0.4, 0.1, 0.1],
}


def write_run(folder, model="lnn", pairs=16, seed=0, error=None, trainer=True):
    """Write what train.py leaves behind; without an error no record."""
    config = {
        "dataset": {"name": "arm", "cache": f"/tmp/{seed}"},
        "data": {"pairs": pairs, "seed": seed},
        "model": HEADS[model],
        "scheduler": {"max_lr": pairs / 10},
        "trainer": {"steps": 5 if model == "lnn" else 9},
        "name": f"arm/{model}",
        "model_name": model,
        "seed": seed,
    }
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    if error is not None:
        validation = {"val/error_mean": error, "val/diverged": 0.0, "train/loss": 1.0}
        record = {"training_seconds": 1.5, "steps": 100, "pairs": pairs, "validation": validation}
        (folder / "metrics.json").write_text(json.dumps(record))
    return folder


@pytest.fixture
def sweep(tmp_path, monkeypatch):
    """Two models, two numbers of pairs, three seeds."""
    monkeypatch.chdir(tmp_path)
    for (model, pairs), errors in ERRORS.items():
        for seed, error in enumerate(errors):
            write_run(tmp_path / f"sweep/{model}-{pairs}-{seed}", model, pairs, seed, error)
    return tmp_path / "sweep"


@pytest.fixture
def gather(tmp_path, capsys):
    """Run gather.py; return its table and its output."""

    def run(*arguments):
        run_script("gather.py", f"hydra.run.dir={tmp_path}/gathered", *arguments)
        path = tmp_path / "gathered" / "sweep.csv"
        return (pd.read_csv(path) if path.is_file() else None), capsys.readouterr().out

    return run


def refused(*arguments):
    return str(fails("gather.py", "hydra.run.dir=gathered", *arguments).code)


def test_a_sweep_has_one_row_per_choice_with_mean_and_deviation_over_seeds(sweep, gather):
    table, text = gather(f"runs=[{sweep}]", "plot=data.pairs")
    settings = list(table.columns[: list(table.columns).index("seeds")])
    assert settings == ["model_name", "data.pairs"]
    assert len(table) == 4
    for _, row in table.iterrows():
        errors = ERRORS[row["model_name"], row["data.pairs"]]
        assert row["seeds"] == 3
        assert row["val/error_mean"] == pytest.approx(statistics.mean(errors), rel=1e-12)
        assert row["val/error_mean_std"] == pytest.approx(statistics.stdev(errors), rel=1e-12)
    assert list(table["val/error_mean"]) == sorted(table["val/error_mean"])
    assert "0.03 ± 0.01*" in text
    assert "no result" not in text
    assert (sweep.parent / "gathered" / "sweep.png").stat().st_size > 10_000
    runs = pd.read_csv(sweep.parent / "gathered" / "runs.csv")
    assert len(runs) == 12
    again, _ = gather(f"runs=[{sweep}/lnn*,{sweep}/mlp*]")
    pd.testing.assert_frame_equal(again, table)


def test_the_last_of_repeated_runs_counts(sweep, gather):
    write_run(sweep / "lnn-16-0-again", seed=0, error=0.35)
    table, text = gather(f"runs=[{sweep}]")
    row = table[(table["model_name"] == "lnn") & (table["data.pairs"] == 16)].iloc[0]
    assert row["val/error_mean"] == pytest.approx((0.35 + 0.25 + 0.75) / 3)
    assert "left out: 1 runs" in text


def test_failed_jobs_are_listed_with_their_errors(sweep, gather):
    failed = write_run(sweep / "failed")
    (failed / "error.txt").write_text("ConfigError: data: too many pairs\n\nTraceback ...\n")
    early = sweep / "early"
    early.mkdir()
    (early / "error.txt").write_text("ConfigError: no such model\n")
    write_run(sweep / "running")
    for name, file in (("cut", "metrics.json"), ("damaged", "config.yaml")):
        (write_run(sweep / name, error=1.0) / file).write_text('{"seed": [')

    table, text = gather(f"runs=[{sweep}]")
    assert len(table) == 4
    assert "jobs without a result: 5" in text
    lines = text.splitlines()
    messages = {
        name: lines[next(i for i, line in enumerate(lines) if line.endswith(f"/{name}")) + 1]
        for name in ("failed", "early", "running", "cut", "damaged")
    }
    assert "data: too many pairs" in messages["failed"]
    assert "no such model" in messages["early"]
    assert "no result: [Errno 2] No such file" in messages["running"]
    assert "no result: Expecting value" in messages["cut"]
    assert "no result: while parsing" in messages["damaged"]


def write_evaluation(folder, runs, errors, horizon=5.0):
    folder.mkdir(parents=True)
    table = pd.DataFrame({"folder": map(str, runs), "error_mean": errors, "diverged": 0})
    table.assign(horizon=horizon).to_csv(folder / "summary.csv", index=False)
    return folder / "summary.csv"


def test_test_errors_come_from_evaluations(sweep, gather):
    runs = [sweep / f"lnn-16-{k}" for k in (0, 1)]
    write_evaluation(sweep.parent / "seen", runs, [3.0, 5.0])
    os.utime(write_evaluation(sweep.parent / "older", runs, [8.0, 9.0]), (1, 1))
    table, text = gather(f"runs=[{sweep}]", "evaluations=[older,seen]", "sort=test/error_mean")
    assert table["test/error_mean"][0] == 4.0
    assert table["test/error_mean_std"][0] == pytest.approx(math.sqrt(2))
    assert (table["model_name"][0], table["data.pairs"][0]) == ("lnn", 16)
    assert table["test/error_mean"][1:].isna().all()
    assert "nan" not in text.lower()


def test_evaluations_over_other_horizons_are_not_mixed(sweep):
    write_evaluation(sweep.parent / "a", [sweep / "lnn-16-0"], [1.0], horizon=5.0)
    write_evaluation(sweep.parent / "b", [sweep / "lnn-16-1"], [1.0], horizon=1.0)
    assert "horizons differ" in refused(f"runs=[{sweep}]", "evaluations=[a,b]")
