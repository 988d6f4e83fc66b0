"""The example log, from the script that writes it to its evaluation, and logs with a mistake."""

import runpy
import shutil

import pandas as pd
import pytest

from tests.app.entry import (
    NO_FIGURES,
    ROOT,
    TINY_TRAINING,
    assert_trained,
    refused_text,
    run_script,
)

EXAMPLES = ROOT / "examples"
TINY = ["experiment=example_log", "compile=false", *TINY_TRAINING, NO_FIGURES]


@pytest.fixture
def at_root(monkeypatch):
    """The folder of the example is given as seen from the root of the repository."""
    monkeypatch.chdir(ROOT)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run on a copy of the example log, which a test may take away."""
    place = tmp_path_factory.mktemp("example")
    shutil.copy(EXAMPLES / "example_log.csv", place)
    run_script("train.py", *TINY, f"dataset.root='{place}'", f"hydra.run.dir={place / 'run'}")
    return place / "run"


def evaluation_of(run, folder):
    return [f"runs=[{run}]", f"hydra.run.dir={folder}"]


@pytest.mark.slow
def test_the_script_writes_the_example_log_again(tmp_path):
    script = runpy.run_path(str(EXAMPLES / "write_example_log.py"))
    script["main"](tmp_path / "again.csv")
    again = pd.read_csv(tmp_path / "again.csv").set_index("run")
    kept = pd.read_csv(EXAMPLES / "example_log.csv").set_index("run")
    # Two units of the last digit: solvers of other machines may round the other way.
    pd.testing.assert_frame_equal(again, kept, rtol=0, atol=0.02)
    assert (EXAMPLES / "example_log.csv").stat().st_size < 250_000


def test_a_run_on_a_log_keeps_the_report_of_the_cleaning(run):
    assert_trained(run)
    report = (run / "log_report.md").read_text()
    assert "from example_log.csv" in report
    assert "9 trajectories of 5 to 5 s" in report
    assert "## Warnings\n\n- none" in report


@pytest.mark.slow
def test_evaluate_takes_a_run_on_a_log_with_its_own_settings(run, tmp_path, capsys):
    run_script("evaluate.py", *evaluation_of(run, tmp_path / "out"))
    assert "example_log: 2 unseen test trajectories, 5 s open loop" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert table["baseline"].tolist() == [False] + [True] * (len(table) - 1)
    row = table.iloc[0]
    assert row["model"] == "lnn"
    # q wanders by some tenths of a rad; an untrained model is no better than that.
    assert 0 < row["error_mean"] < 2
    for name in ("trajectory.png", "error.png"):
        assert (tmp_path / "out" / name).is_file()
    assert not list((tmp_path / "out").glob("terms_*"))


@pytest.mark.usefixtures("undrawn")
def test_runs_whose_inputs_were_prepared_differently_are_refused(run, tmp_path, capsys):
    words = [f"dataset.root='{run.parent}'", f"hydra.run.dir={tmp_path / 'late'}"]
    words += ["+dataset.steps.delay={_target_: pinn_dyn.data.logs.InputDelay, delay: 0.04}"]
    words += ["dataset.validation.piece=4.9", "dataset.test.piece=4.9"]
    run_script("train.py", *TINY, *words)
    runs = [f"runs=[{run},{tmp_path / 'late'}]", f"hydra.run.dir={tmp_path / 'out'}"]
    text = refused_text(capsys, "evaluate.py", *runs)
    assert "late has another data set in test than" in text
    assert "'steps.delay.delay': 0.04" in text
    data = ["dataset=example_log", f"dataset.root='{run.parent}'", "horizon=1", "windows=[]"]
    run_script("evaluate.py", *runs, *data)
    log = (tmp_path / "out" / "evaluate.log").read_text()
    assert log.count("was trained with other steps than those of example_log") == 1


@pytest.mark.usefixtures("undrawn")
def test_a_horizon_takes_the_test_motions_that_are_long_enough(run, tmp_path, capsys):
    """Whole runs of 5 s, one of which is cut to 1 s."""
    log = pd.read_csv(EXAMPLES / "example_log.csv")
    runs = list(log["run"].unique()[-3:])
    log[(log["run"] != runs[0]) | (log["t"] <= 1.0)].to_csv(tmp_path / "example_log.csv")
    words = ["dataset=example_log", f"dataset.root='{tmp_path}'", "horizon=1.5", "windows=[]"]
    words += [f"dataset.test={{runs: {runs}, piece: whole}}"]
    run_script("evaluate.py", *words, *evaluation_of(run, tmp_path / "out"))
    assert "2 unseen test trajectories, 1.5 s" in capsys.readouterr().out
    said = (tmp_path / "out" / "evaluate.log").read_text()
    assert "1 of 3 trajectories of example_log are shorter than horizon=1.5" in said


def test_evaluate_names_the_log_that_is_gone(run, tmp_path, capsys):
    log = run.parent / "example_log.csv"
    log.rename(tmp_path / "elsewhere.csv")
    try:
        text = refused_text(capsys, "evaluate.py", *evaluation_of(run, tmp_path / "out"))
    finally:
        (tmp_path / "elsewhere.csv").rename(log)
    assert "nothing matches 'example_log.csv'" in text
    assert str(run.parent) in text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (
            "dataset.q.columns=[bend_x,bend_y,strech]",
            ["example_log.csv: no column 'strech'", "did you mean stretch", "torque_y"],
        ),
        ("dataset.root=nowhere", [f"root is '{ROOT / 'nowhere'}'", "no folder"]),
        ("dataset.test.piece=7.0", ["test: ", "no stretch lasts 7 s"]),
    ],
)
def test_a_mistake_about_a_log_ends_with_its_name_and_place(
    at_root, tmp_path, capsys, mistake, words
):
    arguments = [*TINY, *mistake.split(), f"hydra.run.dir={tmp_path / 'run'}"]
    text = refused_text(capsys, "train.py", *arguments)
    for word in words:
        assert word in text
    assert not list(tmp_path.rglob("*.ckpt"))
