"""What TensorBoard and MLflow are told about a run, read back from what they store."""

import json

import pytest
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import api_pb2, metadata

from tests.app.entry import NO_FIGURES, train

FIGURES = {"rollout/trajectory", "rollout/error", "terms/bent", "terms/strongly_bent"}


def tensorboard(run):
    return EventAccumulator(str(run / "tensorboard")).Reload()


def session(log):
    """Settings at the start, and whether there is a successful end."""
    found = log.summary_metadata
    content = found[metadata.SESSION_START_INFO_TAG].plugin_data.content
    start = metadata.parse_session_start_info_plugin_data(content)
    settings = {
        key: getattr(value, value.WhichOneof("kind")) for key, value in start.hparams.items()
    }
    if metadata.SESSION_END_INFO_TAG not in found:
        return settings, False
    content = found[metadata.SESSION_END_INFO_TAG].plugin_data.content
    end = metadata.parse_session_end_info_plugin_data(content)
    return settings, end.status == api_pb2.STATUS_SUCCESS


def test_tensorboard_has_few_settings_and_all_that_were_given(hnn_run):
    log = tensorboard(hnn_run)
    settings, success = session(log)
    config = yaml.safe_load((hnn_run / "config.yaml").read_text())
    assert success
    assert len(settings) < 25
    assert settings["model"] == "hnn"
    assert settings["dataset"] == "soft_arm_1"
    assert settings["optimizer.lr"] == config["optimizer"]["lr"]
    assert settings["dataset.train_inputs"] == config["dataset"]["train_inputs"]
    assert settings["validator.step"] == "None"
    assert not [key for key in settings if "callbacks" in key or "_target_" in key]


def test_figures_are_logged_at_the_step_of_the_errors_that_they_explain(hnn_run):
    log = tensorboard(hnn_run)
    assert set(log.Tags()["images"]) == FIGURES
    (last,) = {log.Images(tag)[-1].step for tag in FIGURES}
    assert last == log.Scalars("val/error_mean")[-1].step == 3


def test_a_training_that_fails_is_among_the_others_without_success(tmp_path):
    run = tmp_path / "run"
    with pytest.raises(SystemExit):
        train(run, "model=mlp", "optimizer.lr=1e12", "trainer.steps=6", NO_FIGURES)
    settings, success = session(tensorboard(run))
    assert settings["optimizer.lr"] == 1e12
    assert not success


@pytest.mark.slow  # making the data base takes seconds
def test_mlflow_keeps_settings_errors_figures_and_the_configuration_offline(tmp_path, monkeypatch):
    pytest.importorskip("mlflow", reason="needs MLflow (the mlflow extra)")
    from mlflow import MlflowClient

    monkeypatch.chdir(tmp_path)
    run = train(
        "run", "logger=mlflow", "model=lnn", "trainer.steps=4", "trainer.validations=2"
    ).resolve()
    client = MlflowClient("sqlite:///runs/mlflow/mlflow.db")
    experiment = client.get_experiment_by_name("soft_arm_1")
    (found,) = client.search_runs([experiment.experiment_id])
    assert found.info.status == "FINISHED"
    assert found.info.run_name == "lnn-seed0"
    assert found.data.tags["folder"] == str(run)
    assert found.data.params["data.pairs"] == "64"
    record = json.loads((run / "metrics.json").read_text())
    error = record["validation"]["val/error_mean"]
    assert found.data.metrics["val/error_mean"] == pytest.approx(error)
    assert len(client.get_metric_history(found.info.run_id, "train/loss")) == 2
    files = tmp_path / "runs" / "mlflow" / "artifacts" / found.info.run_id / "artifacts"
    assert (files / "config.yaml").read_text() == (run / "config.yaml").read_text()
    for name in FIGURES:
        assert (files / name / "step_0000003.png").read_bytes().startswith(b"\x89PNG")
    # TensorBoard goes on beside it.
    assert set(tensorboard(run).Tags()["images"]) == FIGURES
