"""One table for runs whose inputs were prepared in different ways."""

import json

import numpy as np
import pandas as pd
import pytest

from tests.app.entry import NO_FIGURES, TINY_TRAINING, fails, run_script
from tests.data.logs_files import motion, write

LOG = [
    "dataset=csv_log",
    "dataset.files='*.csv'",
    "dataset.q={columns:[q1,q2],unit:rad}",
    "dataset.v={columns:[v1,v2],unit:rad/s}",
    "dataset.u={columns:[u1,u2],unit:Nm}",
    "dataset.validation={runs:[run_2],piece:1.0}",
    "dataset.test={runs:[run_3],piece:1.0}",
]
DELAY = "dataset.steps={delay:{_target_:pinn_dyn.data.logs.InputDelay,delay:%s}}"
SLOW = "dataset.steps={slow:{_target_:pinn_dyn.data.logs.Resample,rate:50.0,max_gap:0.1}}"

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A model on the log as it is, and with delayed, hardly delayed and slowly sampled inputs."""
    place = tmp_path_factory.mktemp("log")
    for k in range(4):
        write(place, motion(3.0, phase=k), f"run_{k}.csv")
    preparations = {
        "plain": [],
        "late": [DELAY % 0.05],
        "zero": [DELAY % 0.0],
        "slow": [SLOW],
        "one": ["dataset.q={columns:[q1],unit:rad}", "dataset.v={columns:[v1],unit:rad/s}"],
    }
    for name, words in preparations.items():
        overrides = {word.split("=")[0]: word for word in [*LOG, *words]}
        run_script(
            "train.py",
            "model=mlp",
            f"dataset.root='{place}'",
            *overrides.values(),
            *TINY_TRAINING,
            NO_FIGURES,
            "data.stride=2" if name != "slow" else "data.stride=1",
            f"hydra.run.dir={place / name}",
        )
    return place


def evaluate(runs, names, folder, *words):
    paths = ",".join(str(runs / name) for name in names)
    run_script("evaluate.py", f"runs=[{paths}]", f"hydra.run.dir={folder}", *words)
    return pd.read_csv(folder / "summary.csv").set_index("run")


def test_runs_with_and_without_a_delay_are_one_table(runs, tmp_path, capsys):
    table = evaluate(runs, ["plain", "late"], tmp_path)
    assert table.index.tolist()[:3] == ["mlp", "mlp with delay", "hold position"]
    assert table["model"].tolist()[:2] == ["mlp", "mlp with delay"]  # no seeds of one model
    # The first piece of 1 s lost its first 0.05 s, and steps are 0.02 s.
    np.testing.assert_allclose(table["horizon"], 0.94)
    assert (table["trajectories"] == 3).all()
    assert table["error_mean"].iloc[0] != table["error_mean"].iloc[1]
    note = "with delay: trained and tested on inputs as prepared in its own data set"
    assert note in capsys.readouterr().out
    record = json.loads((tmp_path / "provenance.json").read_text())
    assert not record["dataset"]["steps"]


def test_a_preparation_that_changes_nothing_changes_no_figure(runs, tmp_path):
    """A delay of nothing trains the same weights, which are compared with those trained alone."""
    table = evaluate(runs, ["plain", "zero"], tmp_path / "both")
    alone = evaluate(runs, ["plain"], tmp_path / "alone")
    figures = [name for name in table if name.startswith(("error", "window", "valid"))]
    for row in (0, 1):
        np.testing.assert_array_equal(table[figures].iloc[row], alone[figures].iloc[0])


def test_a_run_at_a_lower_rate_is_compared_at_the_times_of_the_higher_one(runs, tmp_path):
    table = evaluate(runs, ["slow", "plain"], tmp_path / "both")
    assert table.index.tolist()[:2] == ["mlp with slow", "mlp"]
    assert (table["step"].iloc[:2] == 0.02).all()
    # On inputs that are straight between samples of 50 Hz it predicts as it does alone.
    alone = evaluate(runs, ["slow"], tmp_path / "alone", "horizon=1.0")
    expected = alone.loc["mlp", "error_mean"]
    assert table.loc["mlp with slow", "error_mean"] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("plain", "one"), "was trained on another data set than"),
        (("plain", "late", "dataset=example_log"), "inputs of the runs were prepared in different"),
    ],
)
def test_what_cannot_be_made_common_is_refused_by_name(runs, tmp_path, capsys, words, said):
    names = [word for word in words if "=" not in word]
    paths = ",".join(str(runs / name) for name in names)
    more = [word for word in words if "=" in word]
    error = fails("evaluate.py", f"runs=[{paths}]", f"hydra.run.dir={tmp_path}", *more)
    text = f"{capsys.readouterr()}\n{error.code}"
    assert said in text
    assert "evaluate them separately" in text
