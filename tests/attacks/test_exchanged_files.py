"""Run folders of which one file is that of another run, or was edited after the training."""

import shutil

import pytest
import yaml

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.evaluate import find_runs
from pinn_dyn.app.run_folder import load_run
from tests.app.entry import NO_FIGURES, refused_text, train


@pytest.fixture
def run(tmp_path, lnn_run):
    shutil.copytree(lnn_run, tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture(scope="module")
def other_seed(tmp_path_factory):
    return train(tmp_path_factory.mktemp("runs") / "other", "model=lnn", "seed=1", NO_FIGURES)


def edit(run, part, **values):
    config = yaml.safe_load((run / "config.yaml").read_text())
    (config[part] if part else config).update(values)
    (run / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))


def exchange(run, other, name):
    shutil.copy(other / name, run / name)


@pytest.mark.parametrize(
    ("part", "values", "said"),
    [
        ("optimizer", {"lr": 0.5}, "optimizer.lr is 0.5, the checkpoint has "),
        ("data", {"pairs": 1000}, "data.pairs is 1000, the checkpoint has 64"),
        ("trainer", {"steps": 8}, "trainer.steps is 8, the checkpoint has 2"),
        (None, {"seed": 7}, "seed is 7, the checkpoint has 0"),
    ],
)
def test_a_configuration_edited_after_the_training(run, capsys, part, values, said):
    edit(run, part, **values)
    with pytest.raises(ConfigError, match=r"best.ckpt is of another training than .*config.yaml"):
        load_run(run, "best")
    (run / "metrics.json").unlink()
    assert said in refused_text(capsys, "train.py", f"resume={run}")


def test_a_checkpoint_of_another_seed(run, other_seed, capsys):
    for name in ("best", "last"):
        exchange(run, other_seed, f"checkpoints/{name}.ckpt")
    with pytest.raises(ConfigError, match=r"seed is 0, the checkpoint has 1"):
        load_run(run, "best")
    (run / "metrics.json").unlink()
    assert "bring back the file" in refused_text(capsys, "train.py", f"resume={run}")


def test_a_record_of_another_seed(run, other_seed):
    exchange(run, other_seed, "metrics.json")
    with pytest.raises(ConfigError, match=r"metrics.json is of another run: its seed is 1"):
        load_run(run, "best")


def test_a_run_that_is_linked_or_named_twice_counts_once(run, tmp_path):
    (tmp_path / "again").symlink_to(run)
    assert find_runs([str(run), str(tmp_path / "*"), f"{run}/../run"]) == [run]
