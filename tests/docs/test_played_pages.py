"""Pages that run from start to end on small data."""

import re
import sys
import types
from pathlib import Path

import matplotlib
import pytest

from tests.app.entry import NO_FIGURES, ROOT, TINY_DATA, TINY_TRAINING, run_script
from tests.docs.blocks import PLAYED, blocks

# Overrides that make the commands of a page small.
SMALL_DATA = {
    "docs/tutorial.md": [*TINY_DATA, "data.stride=5"],
    "docs/your_log.md": [],
    "docs/from_log_to_controller.md": [],
    "docs/your_robot.md": [
        "dataset.duration=0.2",
        "dataset.train_initial_states=2",
        "dataset.train_inputs=2",
        "dataset.validation=1",
        "dataset.test=1",
    ],
}
LONG = {"dataset=urdf_arm", "dataset=panda_mujoco"}  # recorded in MuJoCo, for minutes
SMALL = {
    "train.py": [*TINY_TRAINING, NO_FIGURES],
    "evaluate.py": ["horizon=0.1", "windows=[0.1]"],
    "control.py": [
        *("runs=2", "rate=200", "duration=0.05", "settled_after=0.02", "animate=false"),
        *("gains.position=5", "gains.velocity=0.5"),  # soft gains for an untrained model
    ],
}


@pytest.mark.slow  # three short pages of commands, as whole runs
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", PLAYED)
def test_a_page_runs_from_start_to_end(name, tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path / "cache"))
    matplotlib.use("Agg")
    namespace = {"__name__": "docs"}
    played = 0
    for block in blocks(ROOT / name):
        if block.reason:
            continue
        if block.title:
            path = tmp_path / re.sub("^conf/", "my_conf/", block.title)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text)
        elif block.language == "python":
            exec(compile(block.text, str(block), "exec"), namespace)
        elif block.language == "bash":
            for program, *words in block.commands():
                if program == "python" and words[0] in SMALL and not LONG & set(words):
                    play(name, words)
                    played += 1
    assert played >= 2


def play(name, words):
    script, *overrides = words
    data = SMALL_DATA[name] if script == "train.py" else []
    if script == "evaluate.py" and any(word.startswith("dataset=") for word in overrides):
        data = [word for word in SMALL_DATA[name] if word.startswith("dataset.")]
    small = [*data, *SMALL[script]]
    if Path("my_conf").is_dir() and not any("--config-dir" in word for word in overrides):
        small.append("--config-dir=my_conf")
    run_script(script, *overrides, *small, checked=True)


def module_of_a_block(page, title):
    """A module made of the block that a page gives this file name."""
    (block,) = [b for b in blocks(ROOT / page) if b.title == title]
    module = types.ModuleType(title.removesuffix(".py"))
    sys.modules[module.__name__] = module  # the next block may import it
    exec(compile(block.text, str(block), "exec"), vars(module))
    return module


module_of_a_block("docs/your_robot.md", "planar_arm.py")
# The page's own test: pytest collects it from here.
TestPlanarArm = module_of_a_block("docs/your_robot.md", "test_planar_arm.py").TestPlanarArm
