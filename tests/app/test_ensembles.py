"""Ensembles through the entry points: trained, resumed, evaluated, used by a controller."""

import json

import numpy as np
import pandas as pd
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import pinn_dyn
from pinn_dyn.ensembles import Ensemble
from pinn_dyn.models import LagrangianNetwork
from pinn_dyn.models.output_limits import free_weights
from pinn_dyn.run.run_folder import load_run
from tests.app.entry import SET_POINTS, run_script


@pytest.fixture(scope="module")
def ensemble_run(run_of):
    """Three members of the seeds 0, 1 and 2."""
    return run_of("ensemble")


def weights(run):
    return torch.load(run / "checkpoints" / "best.ckpt", weights_only=True)["state_dict"]


def test_the_first_member_is_what_a_training_of_that_seed_gives(ensemble_run, lnn_run):
    """The seed of the windows, their order and the initial weights are those of the run."""
    alone = load_run(lnn_run, "last").model
    run = load_run(ensemble_run, "last")
    assert isinstance(run.model, Ensemble)
    assert run.model.size == 3
    first, second = run.model.member(0), run.model.member(1)
    assert isinstance(first, LagrangianNetwork)
    for name, expected in free_weights(alone.state_dict()).items():  # limits hold for all
        torch.testing.assert_close(first.state_dict()[name], expected, rtol=1e-4, atol=1e-5)
    pairs = zip(first.parameters(), second.parameters(), strict=True)
    assert any((a - b).abs().max() > 0.1 for a, b in pairs)


def test_a_run_of_an_ensemble_loads_back_with_its_weights(ensemble_run):
    run = load_run(ensemble_run, "best")
    saved = weights(ensemble_run)
    found = run.model.state_dict()
    assert {f"model.{key}" for key in found} == {key for key in saved if key.startswith("model.")}
    assert all(torch.equal(value, saved[f"model.{key}"]) for key, value in found.items())
    record = json.loads((ensemble_run / "metrics.json").read_text())
    single = sum(p.numel() for p in run.model.member(0).parameters())
    assert record["parameters"] == 3 * single
    assert record["validation"]["val/member_error_mean"] > 0
    log = EventAccumulator(str(ensemble_run / "tensorboard")).Reload()
    assert {"train/loss_spread", "val/spread_mean"} <= set(log.Tags()["scalars"])


@pytest.mark.usefixtures("undrawn")
def test_an_ensemble_is_evaluated_beside_a_single_model(tmp_path, ensemble_run, lnn_run):
    run_script(
        "evaluate.py",
        f"runs=[{ensemble_run},{lnn_run}]",
        "horizon=0.1",
        "windows=[0.02]",
        f"hydra.run.dir={tmp_path}",
    )
    table = pd.read_csv(tmp_path / "summary.csv")
    both, single = table.iloc[0], table.iloc[1]
    (row,) = pd.read_csv(tmp_path / "ensembles.csv").to_dict("records")
    assert (row["run"], row["members"]) == (both["run"], 3)
    assert np.isfinite([row["spread_mean"], row["spread_over_error"]]).all()
    assert row["member_error_mean"] > 0
    assert not {"member_error_mean", "spread_over_error"} & set(table)
    # 0.02 s is shorter than the validation motions, so widths are corrected too.
    assert 0 <= both["window_0.02s_within"] <= 1
    assert both["window_0.02s_factor"] > 0
    assert np.isnan(single["window_0.02s_within"])


def test_an_interval_holds_the_predictions_of_the_members(ensemble_run, lnn_run):
    model = pinn_dyn.load(ensemble_run)
    t = np.linspace(0, 0.05, 6)
    start, u = np.zeros(6), np.ones((6, 3))
    each = np.stack([member.predict(start, u, t) for member in model.members])
    low, high = model.predict_interval(start, u, t)
    # Student's t with two degrees of freedom at 97.5 %.
    reach = 4.30265 * (4 / 3) ** 0.5 * each.std(axis=0, ddof=1)
    np.testing.assert_allclose(0.5 * (low + high), each.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(0.5 * (high - low), reach, rtol=1e-4, atol=1e-9)
    assert reach[-1].max() > 0
    twice = model.predict_interval(start, u, t, factor=2)
    np.testing.assert_allclose(twice[1] - twice[0], 2 * (high - low))
    narrow = model.predict_interval(start, u, t, level=0.5)
    assert (narrow[1] - narrow[0] <= high - low).all()
    with pytest.raises(TypeError, match="a single network has no spread"):
        pinn_dyn.load(lnn_run).predict_interval(start, u, t)


@pytest.mark.usefixtures("undrawn")
def test_a_controller_takes_one_member(tmp_path, monkeypatch, ensemble_run):
    monkeypatch.chdir(tmp_path)

    def errors(run, *arguments):
        folder = tmp_path / f"{run.name}-{len(arguments)}"
        words = [f"run={run}", f"hydra.run.dir={folder}", *SET_POINTS, "rate=200"]
        words += ["~controllers.truth"]
        run_script("control.py", *words, *arguments)
        return pd.read_csv(folder / "summary.csv")["rms_error"].tolist()

    first, second = errors(ensemble_run), errors(ensemble_run, "member=1")
    assert first[0] != second[0]
    assert first[1:] == second[1:]
