"""Sweeps that lose jobs, are interrupted, and go on."""

import json
import math
import os
import signal
import time

import pytest
import torch
import yaml
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import RunMode
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pinn_dyn.app.sweep import SweepCallback
from tests.app.entry import (
    NO_FIGURES,
    STRIDE,
    TINY,
    fails,
    fork_script,
    run_script,
)

DDP = ["trainer.devices=2", "trainer.strategy=ddp_spawn_find_unused_parameters_true"]


@pytest.fixture
def sweep(tmp_path, monkeypatch, capsys):
    """Run a sweep of tiny jobs in this process; returns how it ended and the logs of the jobs."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        words = ["-m", *TINY, NO_FIGURES, "hydra.sweep.dir=sweep", *arguments]
        try:
            run_script("train.py", *words)
        except SystemExit as end:
            return str(end.code)
        return None

    return run


@pytest.mark.parametrize(("mode", "returned"), [("MULTIRUN", math.inf), ("RUN", math.nan)])
def test_a_search_takes_nan_for_the_worst_result(mode, returned):
    config = OmegaConf.create({"hydra": {"mode": RunMode[mode]}})
    result = JobReturn(status=JobStatus.COMPLETED, _return_value=math.nan)
    SweepCallback().on_job_end(config, result)
    assert result.return_value == pytest.approx(returned, nan_ok=True)


def job(tmp_path, name):
    return tmp_path / "sweep" / name


def record(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_a_failed_job_does_not_end_the_sweep_and_is_listed_with_its_error(sweep, tmp_path):
    said = sweep("model=lnn", "data.steps=1,1000,2")
    assert "1 job failed:\n  sweep/1_lnn-seed0\n    ConfigError: data: 64 windows" in said
    assert "hydra.sweep.dir=sweep" in said
    error = (job(tmp_path, "1_lnn-seed0") / "error.txt").read_text()
    assert "Traceback" in error
    assert not (job(tmp_path, "1_lnn-seed0") / "metrics.json").exists()
    for name in ("0_lnn-seed0", "2_lnn-seed0"):
        assert record(job(tmp_path, name))["steps"] == 2
        assert not (job(tmp_path, name) / "error.txt").exists()


def test_a_single_run_that_failed_leaves_its_error_too(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="data: 64 windows of 5000 samples"):
        run_script("train.py", *TINY, NO_FIGURES, "data.steps=1000", "hydra.run.dir=one")
    assert "Traceback" in (tmp_path / "one" / "error.txt").read_text()
    run_script("gather.py", "runs=[one]", "plot=null", "hydra.run.dir=gathered")
    assert "ConfigError: data: 64 windows" in capsys.readouterr().out


def test_the_same_sweep_again_skips_what_is_done_and_runs_the_rest(sweep, tmp_path, monkeypatch):
    choices = ["model=lnn", "seed=0,1", "trainer.steps=4"]
    assert sweep(*choices) is None
    first, second = job(tmp_path, "0_lnn-seed0"), job(tmp_path, "1_lnn-seed1")
    checkpoint = first / "checkpoints" / "last.ckpt"
    before, expected = checkpoint.stat().st_mtime_ns, record(second)
    # As if it had been killed between its last checkpoint and its record.
    (second / "metrics.json").unlink()
    (first / "error.txt").write_text("of an earlier try\n")
    # The place of the cache does not make another training.
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path / "elsewhere"))
    assert sweep(*choices) is None
    assert checkpoint.stat().st_mtime_ns == before
    assert not (first / "error.txt").exists()
    again = record(second)
    assert again["steps"] == expected["steps"] == 4
    assert again["validation"]["val/error_mean"] == expected["validation"]["val/error_mean"]


def test_another_configuration_in_the_folder_is_refused_with_the_keys_that_differ(sweep, tmp_path):
    assert sweep("model=lnn", "data.pairs=64") is None
    folder = job(tmp_path, "0_lnn-seed0")
    before = (folder / "config.yaml").read_text()
    said = sweep("model=lnn", "data.pairs=96", "optimizer.lr=0.001")
    assert "sweep/0_lnn-seed0 holds a training of another configuration" in said
    assert "data.pairs=96 (there 64)" in said
    assert "optimizer.lr=0.001 (there 0.005)" in said
    assert (folder / "config.yaml").read_text() == before


def test_a_folder_in_which_another_process_trains_is_refused(tmp_path, monkeypatch):
    filelock = pytest.importorskip("filelock")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    with filelock.FileLock(tmp_path / "run" / ".lock"):
        error = fails("train.py", *TINY, NO_FIGURES, "model=lnn", "hydra.run.dir=run")
    assert "run is in use: another process trains there" in str(error.code)
    assert not (tmp_path / "run" / "config.yaml").exists()


def test_a_search_goes_past_diverged_trials_and_asks_for_the_same_ones_again(sweep, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    words = [
        "hydra/sweeper=tpe",
        "hydra.sweeper.n_trials=4",
        "hydra.sweeper.sampler.n_startup_trials=2",
        "optimizer.lr=choice(0.005,1e9)",
        "trainer.steps=2",
    ]
    said = sweep(*words)
    folders = sorted(path.parent for path in (tmp_path / "sweep").glob("*/.hydra"))
    assert len(folders) == 4
    errors = {
        path: record(path)["validation"] for path in folders if (path / "metrics.json").exists()
    }
    assert f"{4 - len(errors)} jobs failed" in said.replace("1 job ", "1 jobs ")
    assert "NonFiniteLossError" in said
    found = yaml.safe_load((tmp_path / "sweep" / "optimization_results.yaml").read_text())
    best = min(value["val/error_mean"] for value in errors.values())
    assert found["best_value"] == pytest.approx(best, rel=1e-12)
    before = [yaml.safe_load((path / "config.yaml").read_text()) for path in folders]
    sweep(*words)
    assert [yaml.safe_load((path / "config.yaml").read_text()) for path in folders] == before
    assert len(list((tmp_path / "sweep").glob("*/.hydra"))) == 4


def ended(process, log, seconds=300):
    process.join(seconds)
    process.kill()  # if it has not ended
    return process.exitcode, log.read_text()


@pytest.mark.slow
def test_jobs_side_by_side_simulate_once_lose_one_and_the_others_are_done(
    sweep, tmp_path, monkeypatch
):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    loky = pytest.importorskip("joblib.externals.loky")
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path / "cold"))
    two = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    try:
        said = sweep(*two, "model=lnn", "optimizer.lr=0.005,0.01,1e9")
    finally:
        loky.get_reusable_executor().shutdown()
    assert "1 job failed:\n  sweep/2_lnn-seed0\n    NonFiniteLossError" in said
    assert len(list((tmp_path / "sweep").glob("*/metrics.json"))) == 2
    assert len(list((tmp_path / "cold").glob("*.npz"))) == 1


def wait_for(process, condition):
    while not condition() and process.is_alive():
        time.sleep(0.05)


def test_ctrl_c_ends_the_whole_sweep_which_then_goes_on(tmp_path):
    words = [
        *("-m", *TINY, NO_FIGURES, "model=lnn", "seed=0,1", "hydra.sweep.dir=sweep"),
        *("trainer.steps=50", "trainer.validations=5"),
    ]
    first = tmp_path / "sweep" / "0_lnn-seed0"
    log = tmp_path / "log.txt"
    with log.open("w") as output:
        at = dict(folder=tmp_path, output=output)
        process = fork_script("train.py", *words, **at, own_session=True)
        wait_for(process, (first / "checkpoints" / "last.ckpt").exists)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        code, said = ended(process, log)
        assert code not in (0, None), said
        assert "go on with the same command and hydra.sweep.dir=sweep" in said
        assert not (first / "metrics.json").exists()
        code, said = ended(fork_script("train.py", *words, **at), log)
    assert code == 0, said
    assert f"resuming in {first}" in (first / "train.log").read_text()
    for seed in (0, 1):
        folder = tmp_path / "sweep" / f"{seed}_lnn-seed{seed}"
        assert record(folder)["steps"] == 50


def scalars(folder, name):
    """Values of a scalar in the TensorBoard log of a run, in order."""
    events = EventAccumulator(str(folder / "tensorboard")).Reload()
    return [item.value for item in events.Scalars(name)]


@pytest.mark.slow
def test_two_processes_train_as_one_does_also_in_a_sweep(tmp_path):
    """Each job of a sweep starts two processes, which import PyTorch."""
    words = ["-m", *TINY, NO_FIGURES, "model=lnn", "seed=3", STRIDE, "trainer.steps=5"]
    log = tmp_path / "log.txt"
    with log.open("w") as output:
        at = dict(folder=tmp_path, output=output)
        process = fork_script("train.py", *words, *DDP, "hydra.sweep.dir=ddp", **at)
        try:
            run_script("train.py", *words, f"hydra.sweep.dir={tmp_path / 'cpu'}")
        finally:
            code, said = ended(process, log)
    assert code == 0, said
    alone, together = (tmp_path / trainer / "0_lnn-seed3" for trainer in ("cpu", "ddp"))
    one, two = (
        torch.load(path / "checkpoints" / "last.ckpt", weights_only=True)
        for path in (alone, together)
    )
    assert record(together)["steps"] == two["global_step"] == one["global_step"] == 5
    for key, value in one["state_dict"].items():
        assert torch.allclose(two["state_dict"][key], value, rtol=1e-4, atol=1e-6), key
    losses = [scalars(path, "train/loss") for path in (alone, together)]
    assert len(losses[0]) == 5
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    errors = [record(path)["validation"]["val/error_mean"] for path in (alone, together)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-4)
    assert len(list((together / "tensorboard").glob("events*"))) == len(
        list((alone / "tensorboard").glob("events*"))
    )


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["trainer.devices=2"], [DDP[1]]),
        ([*DDP, "data.batch_size=31"], ["batch_size 31", "2 devices"]),
    ],
)
def test_what_goes_wrong_on_several_devices_is_refused(tmp_path, monkeypatch, overrides, words):
    monkeypatch.chdir(tmp_path)
    error = fails("train.py", *TINY, NO_FIGURES, "model=lnn", *overrides)
    for word in words:
        assert word in str(error.code)
