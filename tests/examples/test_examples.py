"""Every example runs, on a training of two steps, and prints what its docstring promises."""

import contextlib
import io
import re
import runpy
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from pinn_dyn.data.simulation import has_cpp_compiler
from tests.app.entry import ROOT, compose, own_logging

EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory):
    """What the examples leave behind goes here, their caches included."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("HOME", str(folder))
        patch.setenv("PINN_DYN_CACHE", str(folder / "cache"))
        # One of the five seconds of each run: the examples predict whole runs.
        log = pd.read_csv(EXAMPLES / "example_log.csv")
        log[log.t <= 1.0].to_csv(folder / "example_log.csv", index=False)
        for script in EXAMPLES.glob("*.py"):
            shutil.copy(script, folder)
        yield folder


def run(name, *arguments):
    with pytest.MonkeyPatch.context() as patch, own_logging():
        patch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(name, run_name="__main__")


@pytest.fixture(scope="module")
def own_log(home):
    """What own_log.py prints; other examples load the run folder that it leaves."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        run("own_log.py", "--steps", "2")
    return out.getvalue()


RUN = "runs/own_log"


def test_own_log(own_log, home):
    errors = [line for line in own_log.splitlines() if "of constant velocity" in line]
    assert len(errors) == 2  # of two test runs
    assert all(re.search(r"'bend_x': \d+", line) for line in errors)
    assert (home / RUN / "metrics.json").is_file()


def test_load_and_predict(own_log, capsys):
    run("load_and_predict.py", RUN)
    text = capsys.readouterr().out
    assert "Run(lnn" in text
    assert "stretch [m]" in text


def test_torque_feedforward(own_log, capsys):
    """Even an untrained model follows its own inverse dynamics, for a while."""
    run("torque_feedforward.py", RUN)
    text = capsys.readouterr().out
    distances = re.search(r"from the path: \[(.*)\]", text)[1].split()
    assert max(map(float, distances)) < 0.1


def test_regulator_in_a_loop(own_log, capsys):
    run("regulator_in_a_loop.py", RUN, "--duration", "0.05")
    text = capsys.readouterr().out
    assert "t = 0.00 s   q = [0.  0.  0.3]" in text


@pytest.mark.slow
@pytest.mark.skipif(not has_cpp_compiler(), reason="an export needs a C++ compiler")
def test_export_and_call(own_log, home, capsys):
    run("export_and_call.py", RUN)
    assert "the same as before the export: True" in capsys.readouterr().out
    assert (home / "law.pt2").is_file()


def test_simulate_and_learn(capsys):
    run("simulate_and_learn.py", "--steps", "2", "--duration", "2.0")
    text = capsys.readouterr().out
    assert "mean error over 2 s: {'Δx [rad]'" in text
    assert "A^-1 M, true:" in text


def test_own_robot(capsys):
    run("own_robot.py", "--steps", "2")
    assert "M learned" in capsys.readouterr().out


@pytest.mark.slow
def test_ensemble_with_spread(capsys):
    run("ensemble_with_spread.py", "--members", "2", "--steps", "2")
    lines = capsys.readouterr().out.splitlines()
    head = next(k for k, line in enumerate(lines) if line.split() == ["t", "error", "spread"])
    first, last = lines[head + 1].split(), lines[-1].split()
    assert float(first[2]) < float(last[2])  # they start together


def test_write_example_bag(home):
    """The bag that examples/conf/dataset/example_bag.yaml reads, its joints by their names."""
    main = runpy.run_path("write_example_bag.py")["main"]
    main.__globals__["SECONDS"] = 12  # of a minute
    main(Path("example_bag"))
    short = [f"dataset.{split}.seconds=4" for split in ("validation", "test")]
    place = f"hydra.searchpath=[file://{ROOT / 'examples' / 'conf'}]"
    config = compose(place, "dataset=example_bag", f"dataset.root='{home}'", *short).dataset
    source = instantiate(OmegaConf.to_container(config, resolve=True), _convert_="all")
    (train,) = source.load().train
    assert len(train.t) == 298
    assert train.q[:, 0].std() > 1.2 * train.q[:, 1].std() > 0.1  # shoulder and elbow


def test_every_example_is_short_says_what_it_does_and_is_run_here():
    # Of the tests, of the documentation and of make demo.
    helpers = ("write_example_log.py", "write_example_bag.py", "demo_summary.py")
    helpers += ("cleaning_steps.py",)
    tests = (ROOT / "tests" / "examples" / "test_examples.py").read_text()
    names = [path for path in EXAMPLES.glob("*.py") if path.name not in helpers]
    assert len(names) == 8
    for path in names:
        text = path.read_text()
        assert text.startswith('"""')
        assert 20 <= len(text.splitlines()) <= 70, path.name
        assert f'run("{path.name}"' in tests
