"""A full disk, here one that takes small files alone: it is named which file, and none is half."""

import contextlib
import errno
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from pinn_dyn.app.run_folder import write_config, write_json
from pinn_dyn.data.cache import load_or_make
from pinn_dyn.data.whole import write_whole
from pinn_dyn.evaluation import write_table
from pinn_dyn.training import WholeCheckpoints
from tests.app.entry import (
    NO_FIGURES,
    ROOT,
    SET_POINTS,
    TINY,
    assert_trained,
    refused_text,
    run_script,
)

resource = pytest.importorskip("resource", reason="limits of a process, which Windows has not")


@contextlib.contextmanager
def small_disk(size):
    """No file of this process becomes larger than so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def cached(folder, size):
    load_or_make(folder, "data", {"size": size}, lambda: {"q": np.zeros(size)})


WRITERS = {
    "config.yaml": lambda folder, size: write_config(folder, {"q": [0] * size}),
    "metrics.json": lambda folder, size: write_json(folder / "metrics.json", {"q": [0] * size}),
    "stability.md": lambda folder, size: write_whole(folder / "stability.md", "q" * size),
    "summary.csv": lambda folder, size: write_table(
        pd.DataFrame({"q": np.zeros(size)}), folder, "summary"
    ),
    "last.ckpt": lambda folder, size: WholeCheckpoints().save_checkpoint(
        {"q": torch.zeros(size)}, folder / "last.ckpt"
    ),
    "data-": cached,
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_file_is_named_and_that_of_before_is_whole(tmp_path, name):
    write = WRITERS[name]
    write(tmp_path, 10)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with small_disk(3000), pytest.raises(OSError, match=name) as caught:
        write(tmp_path, 5000)
    assert caught.value.errno == errno.EFBIG
    after = {path: path.read_bytes() for path in tmp_path.iterdir() if path.suffix != ".lock"}
    assert after == {path: before[path] for path in after}
    write(tmp_path, 5000)


def ends_in_a_line(capsys, size, name, *words):
    with small_disk(size):
        text = refused_text(capsys, *words)
    assert f"{name} cannot be written: File too large" in text
    assert "free space" in text


def test_a_training_says_so_and_is_trained_again(tmp_path, capsys, lnn_run):
    folder = tmp_path / "run"
    words = ["train.py", *TINY, NO_FIGURES, "model=lnn", f"hydra.run.dir={folder}"]
    ends_in_a_line(capsys, 20_000, ".ckpt", *words)
    assert not list(folder.rglob("*.partial"))
    assert not list(folder.rglob("*.ckpt"))
    run_script(*words)
    assert_trained(folder)


def test_a_sweep_lists_its_jobs_with_the_file(tmp_path, capsys, lnn_run):
    words = ["train.py", "-m", *TINY, NO_FIGURES, "model=lnn", "seed=0,1"]
    with small_disk(20_000):
        text = refused_text(capsys, *words, f"hydra.sweep.dir={tmp_path}")
    failed = text.partition("2 jobs failed:")[2]
    assert failed.count(".ckpt'") == 2


def test_an_evaluation_says_so(tmp_path, capsys, lnn_run):
    words = ["evaluate.py", f"runs=[{lnn_run}]", f"hydra.run.dir={tmp_path}"]
    ends_in_a_line(capsys, 20_000, ".png", *words)
    assert not (tmp_path / "report.html").exists()
    assert not list(tmp_path.rglob("*.partial"))


def test_a_control_experiment_says_so(tmp_path, capsys, lnn_run):
    words = ["control.py", f"run={lnn_run}", *SET_POINTS, f"hydra.run.dir={tmp_path}"]
    words += ["rate=200", "~controllers.truth", "~controllers.pd"]
    ends_in_a_line(capsys, 20_000, ".png", *words)
    assert not (tmp_path / "report.html").exists()


def test_a_check_says_so(tmp_path, capsys):
    root = f"dataset.root={ROOT / 'examples'}"
    words = ["check.py", "dataset=example_log", root, f"hydra.run.dir={tmp_path}"]
    ends_in_a_line(capsys, 20_000, "check.html", *words)
    assert not (tmp_path / "check.html").exists()


def commands(run):
    """Each of them, as it is called on a run."""
    data = ["dataset=example_log", f"dataset.root={ROOT / 'examples'}"]
    return {
        "train.py": [*TINY, NO_FIGURES, "model=lnn"],
        "evaluate.py": [f"runs=[{run}]"],
        "control.py": [f"run={run}", *SET_POINTS],
        "gather.py": [f"runs=[{run}]"],
        "check.py": data,
    }


@pytest.mark.parametrize("script", commands(""))
def test_files_of_hydra_end_in_a_line_too(tmp_path, capsys, lnn_run, script):
    folder = tmp_path / "out"
    words = [script, *commands(lnn_run)[script], f"hydra.run.dir={folder}"]
    ends_in_a_line(capsys, 100, folder / ".hydra" / "config.yaml", *words)


@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
def test_a_log_that_takes_no_line_ends_in_one(tmp_path, capsys, lnn_run, script):
    """Logging itself would print a traceback for each; the other commands say nothing by it."""
    folder = tmp_path / "out"
    folder.mkdir()
    name = f"{Path(script).stem}.log"
    (folder / name).write_text(" " * 20_000)
    words = [script, *commands(lnn_run)[script], f"hydra.run.dir={folder}"]
    ends_in_a_line(capsys, 20_000, name, *words)


def test_a_log_that_cannot_be_opened_is_named(tmp_path, capsys):
    (tmp_path / "train.log").mkdir()
    text = refused_text(capsys, "train.py", *TINY, "model=lnn", f"hydra.run.dir={tmp_path}")
    assert f"{tmp_path / 'train.log'}: Is a directory" in text


def test_a_sweep_says_so_of_hydras_files(tmp_path, capsys):
    words = ["train.py", "-m", *TINY, NO_FIGURES, "model=lnn", "seed=0,1"]
    ends_in_a_line(capsys, 100, tmp_path / "multirun.yaml", *words, f"hydra.sweep.dir={tmp_path}")
