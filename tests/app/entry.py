"""Calls of the entry scripts, in this process or another one, on a data set that takes no time."""

import contextlib
import json
import logging
import os
import runpy
import sys
from pathlib import Path

import hydra
import pytest

from pinn_dyn.app.config import CONF
from tests.support.processes import fork

ROOT = Path(__file__).parents[2]

# Set points of control.py in the middle of the tiny data.
LOW, HIGH = "[-0.2,-0.2,0.15]", "[0.2,0.2,0.3]"
BOX = f"{{_target_: pinn_dyn.data.InitialStates, q_low: {LOW}, q_high: {HIGH}, v_max: [0, 0, 0]}}"
SET_POINTS = [
    "experiment=soft_arm_1/regulation",
    f"reference.q_low={LOW}",
    f"reference.q_high={HIGH}",
    f"initial_states={BOX}",
    "runs=3",
    "duration=0.05",
    "settled_after=0.03",
    "gains.position=5",
    "gains.velocity=0.5",
    "animate=false",
]

TINY_DATA = [
    "dataset.duration=0.2",
    "dataset.step=0.002",
    "dataset.train_initial_states=2",
    "dataset.train_inputs=2",
    "dataset.validation=2",
    "dataset.test=2",
]
STRIDE = "data.stride=5"
TINY_TRAINING = [
    "data.pairs=64",
    "data.batch_size=32",
    "validator.horizon=0.1",
    "validator.window=null",
    "validator.step=null",
    "trainer.steps=2",
    "trainer.validations=1",
    "trainer.enable_progress_bar=false",
]
TINY = [*TINY_DATA, STRIDE, *TINY_TRAINING]
# Drawing takes longer than the training itself.
NO_FIGURES = "callbacks.figures=null"
RUNS = {
    "hnn": ["model=hnn", "trainer.steps=4", "trainer.validations=2"],
    "lnn": ["model=lnn"],
    "mlp": ["model=mlp"],
    "other seed": ["model=lnn", "seed=1"],
    "oscillators": ["model=oscillators", "data.steps=5", "data.history=0"],
}
"""Arguments of the runs that all tests share; a test that changes a run takes a copy."""


@contextlib.contextmanager
def own_logging():
    """Take away the log handlers that Hydra adds: they would outlive the captured output."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        yield
    finally:
        for handler in root.handlers:
            if handler not in handlers:
                with contextlib.suppress(OSError):  # of a full disk, as logging itself does at exit
                    handler.close()
        root.handlers[:] = handlers
        root.setLevel(level)


def run_script(script, *arguments, checked=False):
    """Run an entry script in this process, as ``python <script> <arguments>`` would.

    A configuration is composed three times: to be checked, for a mode that ours leave to -m, and to
    be used. Unless checked, only the last is done: a composition takes as long as a tiny training.
    """
    with pytest.MonkeyPatch.context() as patch, own_logging():
        patch.setattr(sys, "argv", [script, *arguments])
        if not checked:
            patch.setattr("pinn_dyn.app.command.composed", lambda *_: None)
            patch.setattr("hydra._internal.hydra.Hydra.get_mode", lambda *_, **__: None)
        runpy.run_path(str(ROOT / script), run_name="__main__")


def train(folder, *arguments):
    """Train on the tiny data set and return the run folder."""
    run_script("train.py", *TINY, f"hydra.run.dir={folder}", *arguments)
    return Path(folder)


def fails(script, *arguments):
    """Run an entry script that has to end with an error; returns what was raised."""
    with pytest.raises(SystemExit) as caught:
        run_script(script, *arguments, checked=True)
    assert caught.value.code not in (0, None)
    return caught.value


def refused_text(capsys, script, *arguments):
    """What an entry script says, without a traceback, when it has to end with an error."""
    error = fails(script, *arguments)
    captured = capsys.readouterr()
    text = f"{captured.out}\n{captured.err}\n{error.code}"
    assert "Traceback" not in text
    return text


def fork_script(script, *arguments, folder, output, own_session=False):
    """Run an entry script in a copy of this process, with its output going to a file.

    The copy has imported PyTorch, which takes a program of its own six seconds.
    """

    def work():
        if own_session:
            os.setsid()
        os.chdir(folder)
        run_script(script, *arguments, checked=True)

    return fork(work, output)


def compose(*overrides):
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        return hydra.compose("train", overrides=list(overrides))


def assert_trained(folder, steps=2):
    """Weights have been written, and a finite validation error."""
    assert (folder / "checkpoints" / "best.ckpt").is_file()
    assert (folder / "checkpoints" / "last.ckpt").is_file()
    record = json.loads((folder / "metrics.json").read_text())
    assert record["steps"] == steps
    assert 0 < record["validation"]["val/error_mean"] < 10
