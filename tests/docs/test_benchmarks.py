"""benchmarks/training_loop.py measures a cell, keeps what it measured, and says what it lacks."""

import ast
import csv
import importlib.util
import os
import statistics
from importlib import metadata

import pytest
import torch

from pinn_dyn.app import build
from tests.docs.blocks import ROOT


@pytest.fixture
def script(monkeypatch):
    """The script as a module, which leaves this process its cores, threads and settings."""
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None)
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    monkeypatch.setattr(build, "LONGEST_EPOCH", build.LONGEST_EPOCH)
    path = ROOT / "benchmarks" / "training_loop.py"
    spec = importlib.util.spec_from_file_location("training_loop", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def without_jax(monkeypatch):
    def version(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", version)


def test_a_cell_of_soap_is_timed_without_jax(script, without_jax, capsys):
    script.main(["--quick", "--optimizers", "soap", "--members", "1", "2"])
    row = ast.literal_eval(capsys.readouterr().out.splitlines()[-1])
    assert min(row["loss_and_gradient_ms"], row["ms"]) > 0
    assert row["loop_and_optimizer"] == pytest.approx(
        1 - row["loss_and_gradient_ms"] / row["ms"], abs=0.01
    )
    assert row["rounds"] == 1
    assert row["jax_ms"] == ""


def test_adamw_without_jax_says_what_to_install(script, without_jax, capsys):
    with pytest.raises(SystemExit):
        script.main(["--quick"])
    assert "pip install -e '.[bench]'" in capsys.readouterr().err


def test_a_run_that_was_stopped_goes_on_where_it_was(script, monkeypatch, tmp_path, capsys):
    path, measured = tmp_path / "loop.csv", []

    def run_cell(*cell, **_):
        if len(measured) == 2:
            raise KeyboardInterrupt
        measured.append(cell)
        return {**dict(zip(script.CELL, cell, strict=True)), "jax_slower": len(measured)}

    monkeypatch.setattr(script, "run_cell", run_cell)
    monkeypatch.setattr(script, "versions", lambda: {"jax": "1", "optax": "1"})
    words = ["--sizes", "3", "--losses", "midpoint", "--optimizers", "adamw", "--output", str(path)]
    with pytest.raises(KeyboardInterrupt):
        script.main(words)
    with path.open() as file:
        assert [row["batch"] for row in csv.DictReader(file)] == ["256", "1024"]
    done, measured = measured, []
    script.main(words)
    assert done + measured == [(3, batch, "midpoint", "adamw", 1) for batch in (256, 1024, 8192)]
    # of 1, 2 and again 1
    assert "1.26 times as long in the geometric mean of 3 cells" in capsys.readouterr().out


def test_in_no_cell_of_one_or_two_cores_is_ours_slower_as_the_page_says():
    page = (ROOT / "benchmarks" / "README.md").read_text()
    for name, sentence in (
        ("1_core", "In no cell is ours slower than structured JAX by the median of the rounds"),
        ("2_cores", "Again ours is slower in no cell by the median"),
    ):
        cells = {}
        with (ROOT / f"benchmarks/results/training_step_{name}.csv").open() as file:
            for row in csv.DictReader(file):
                if row["method"] in ("jax autodiff", "jax explicit"):
                    cell = row["coordinates"], row["batch"]
                    ratio = float(row["slower_than_ours"])
                    cells[cell] = min(ratio, cells.get(cell, ratio))
        assert len(cells) == 9
        assert (sentence in page) == (min(cells.values()) >= 1)
        assert f"{statistics.geometric_mean(cells.values()):.2f} times as long" in page
