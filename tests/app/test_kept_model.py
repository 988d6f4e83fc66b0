"""The score of a run is that of the model that is kept, not of the last validation."""

import json

import pandas as pd
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import pinn_dyn
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.evaluation.metrics import score, validation_error
from pinn_dyn.mechanics import stack_until
from tests.app.entry import NO_FIGURES, TINY, run_script

# The learning rate rises until the last steps, which spoil the model.
SPOILED = ["model=acceleration", "optimizer.lr=3", "scheduler.warm_up=0.9", NO_FIGURES]
SPOILED += ["trainer.steps=12", "trainer.validations=4"]


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """A search of one trial, whose result is what train.py returned."""
    folder = tmp_path_factory.mktemp("spoiled") / "sweep"
    search = ["-m", "hydra/sweeper=tpe", "hydra.sweeper.n_trials=1", "hydra.sweeper.n_jobs=1"]
    run_script("train.py", *TINY, *SPOILED, *search, f"hydra.sweep.dir={folder}")
    return folder


def measured(run):
    """Errors of the model of a run on the validation motions, measured anew."""
    validator = RolloutValidator(horizon=0.1, training_step=run.statistics.step)
    splits = run.source.load()
    truth = stack_until(splits.validation)
    validator.check(truth, splits.train)
    with torch.no_grad():
        return validator(run.model, truth)


def test_all_scores_of_a_run_are_those_of_the_kept_model(sweep, tmp_path, capsys):
    (folder,) = [path.parent for path in sweep.rglob("metrics.json")]
    kept, last = (pinn_dyn.load(folder, name) for name in ("best", "last"))
    truth, spoiled = (measured(run)["error_mean"] for run in (kept, last))
    assert truth < 0.95 * spoiled
    record = json.loads((folder / "metrics.json").read_text())
    assert record["validation"]["val/error_mean"] == pytest.approx(truth, rel=1e-4)
    assert record["last_validation"]["val/error_mean"] == pytest.approx(spoiled, rel=1e-4)
    assert (record["kept_step"], record["steps"]) == (6, 12)
    assert f"validation error {truth:.3g} (kept: step 6 of 12; last: {spoiled:.3g})" in str(kept)
    assert f"validation error {spoiled:.3g})" in str(last)
    found = yaml.safe_load((sweep / "optimization_results.yaml").read_text())
    assert found["best_value"] == pytest.approx(truth, rel=1e-4)
    log = EventAccumulator(str(folder / "tensorboard")).Reload()
    (board,) = (item.value for item in log.Scalars("hp/validation_error"))
    assert board == pytest.approx(truth, rel=1e-4)
    run_script("gather.py", f"runs=[{sweep}]", f"hydra.run.dir={tmp_path}")
    (row,) = pd.read_csv(tmp_path / "runs.csv").to_dict("records")
    assert (row["val/error_mean"], row["last/error_mean"], row["kept_step"]) == (
        pytest.approx(truth, rel=1e-4),
        pytest.approx(spoiled, rel=1e-4),
        6,
    )
    assert f"{truth:.3g}" in capsys.readouterr().out


def test_a_search_never_prefers_a_model_whose_rollouts_diverge():
    diverged = {"val/error_mean": 0.001, "val/diverged": 1.0}
    assert validation_error(diverged) > validation_error({"val/error_mean": 5.0})
    record = {"validation": {"val/error_mean": 5.0}, "last_validation": diverged}
    text = score({**record, "kept_step": 400, "steps": 1600})
    assert text == "5 (kept: step 400 of 1600; last: 1 diverged)"
