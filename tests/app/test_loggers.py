"""Figures, settings and errors of a run, read back from its TensorBoard log."""

import json
from types import SimpleNamespace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from pinn_dyn.run.training.trainer import _MovableCheckpoint
from tests.app.entry import train

FIGURES = {"rollout/trajectory", "rollout/error", "terms/bent", "terms/strongly_bent"}


def test_figures_are_logged_at_the_step_of_the_errors_that_they_explain(tmp_path):
    run = train(tmp_path / "run", "model=lnn")
    log = EventAccumulator(str(run / "tensorboard")).Reload()
    assert set(log.Tags()["images"]) == FIGURES
    (last,) = {log.Images(tag)[-1].step for tag in FIGURES}
    assert last == log.Scalars("val/error_mean")[-1].step == 1


def test_settings_are_logged_beside_the_validation_error(hnn_run):
    log = EventAccumulator(str(hnn_run / "tensorboard")).Reload()
    content = log.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    start = HParamsPluginData.FromString(content).session_start_info
    assert start.hparams["model_name"].string_value == "hnn"
    assert start.hparams["data.pairs"].number_value == 64
    (error,) = (item.value for item in log.Scalars("hp/validation_error"))
    record = json.loads((hnn_run / "metrics.json").read_text())
    assert error == pytest.approx(record["validation"]["val/error_mean"], rel=1e-6)


def test_of_equal_scores_the_smaller_loss_is_kept(tmp_path):
    """All rollouts of a training may diverge."""
    checkpoint = _MovableCheckpoint(tmp_path, monitor="score")
    checkpoint.best_model_score = score = torch.tensor(10.0)
    checkpoint.best_k_models, checkpoint.kth_best_model_path = {"best": score}, "best"
    kept = [
        checkpoint.check_monitor_top_k(
            SimpleNamespace(
                lightning_module=SimpleNamespace(latest_loss=loss),
                strategy=SimpleNamespace(reduce_boolean_decision=lambda x: x),
            ),
            score,
        )
        for loss in (0.5, 0.7, 0.2)
    ]
    assert kept == [True, False, True]
