"""evaluate.py and pinn_dyn.app.evaluate: results, baselines, and runs that cannot be evaluated."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.image import imread

import pinn_dyn
from tests.app.entry import NO_FIGURES, refused_text, run_script, train
from tests.app.pages import assert_says_how_it_came_about, page_of

SHORT = ["horizon=0.1", "windows=[0.02,0.05]"]


def evaluate(folder, *runs, arguments=()):
    paths = ",".join(str(run) for run in runs)
    run_script("evaluate.py", f"runs=[{paths}]", *SHORT, f"hydra.run.dir={folder}", *arguments)
    return folder


def refused(capsys, *runs, arguments=()):
    """What evaluate.py says about runs that it cannot evaluate."""
    paths = ",".join(str(run) for run in runs)
    return refused_text(
        capsys, "evaluate.py", f"runs=[{paths}]", *SHORT, "hydra.run.dir=out", *arguments
    )


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Relative folders are made here."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory, hnn_run, mlp_run):
    """A structured model beside a black box, and the printed text."""
    folder = tmp_path_factory.mktemp("evaluation")
    with pytest.MonkeyPatch.context() as patch, (folder / "printed.txt").open("w") as file:
        patch.setattr("sys.stdout", file)
        evaluate(folder, hnn_run, mlp_run)
    return folder


def test_the_tables_have_runs_and_baselines(evaluation):
    table = pd.read_csv(evaluation / "summary.csv")
    assert table["model"].tolist()[:4] == ["hnn", "mlp", "hold position", "constant velocity"]
    assert table["baseline"].tolist() == [False, False] + [True] * (len(table) - 2)
    summary = table[~table["baseline"]].set_index("run")
    assert np.isfinite(summary["error_mean"]).all()
    assert (summary["pairs"] == 64).all()
    # Reset every 0.02 s of 0.1 s, a model has less time to drift.
    assert (summary["window_0.02s_error_mean"] < summary["error_mean"]).all()
    assert summary["torque_share"].notna().tolist() == [True, False]
    assert pd.read_csv(evaluation / "torque.csv")["run"].tolist() == ["hnn"] * 3
    assert pd.read_csv(evaluation / "by_model.csv")["model"].tolist() == table["model"].tolist()
    text = (evaluation / "printed.txt").read_text()
    assert "2 unseen test trajectories, 0.1 s open loop" in text
    assert {"hnn", "mlp", "[hold"} <= {line.split()[0] for line in text.splitlines() if line}


@pytest.mark.usefixtures("undrawn")
def test_python_gives_the_numbers_of_the_command(evaluation, hnn_run, tmp_path):
    result = pinn_dyn.evaluate(pinn_dyn.load(hnn_run), horizon=0.1, windows=[0.02])
    table = pd.read_csv(evaluation / "summary.csv").set_index("run")
    errors = result.summary.set_index("run")["error_mean"]
    assert errors["hnn"] == pytest.approx(table.loc["hnn", "error_mean"], rel=1e-9)
    result.save(tmp_path / "results")
    assert (tmp_path / "results" / "summary.csv").is_file()


def test_figures_and_the_page_are_written(evaluation, hnn_run):
    for name in ("trajectory.png", "error.png", "terms_hnn_bent.png"):
        picture = imread(evaluation / name)
        assert min(picture.shape[:2]) > 200
        assert picture[..., :3].std() > 0.01
    assert not list(evaluation.glob("terms_mlp*"))  # a black box
    page = page_of(evaluation)
    names = [row["run"] for row in page.table("mean error ± std")]
    assert names[:3] == ["hnn", "mlp", "[hold position]"]
    terms = pd.read_csv(evaluation / "terms_hnn.csv")
    assert set(terms["term"]) == {"M", "M_inverse", "D", "G", "A"}
    assert_says_how_it_came_about(evaluation, "evaluate.py", hnn_run)
    record = json.loads((evaluation / "provenance.json").read_text())
    assert record["config"]["horizon"] == 0.1
    assert record["dataset"]["name"] == "soft_arm_1"


@pytest.mark.usefixtures("undrawn")
def test_a_model_of_finer_steps_is_compared_at_the_times_of_the_step(mlp_run):
    """The mean over more times would not compare with models of the longer step."""
    run = pinn_dyn.load(mlp_run)
    fine, coarse = (
        pinn_dyn.evaluate(run, horizon=0.08, windows=[0.04], step=x).predictions["mlp"]
        for x in (None, 0.02)
    )
    assert run.model.fixed_step == pytest.approx(0.01)
    assert torch.equal(coarse.q_hat, fine.q_hat[:, ::2])
    assert torch.equal(coarse.t, fine.t[::2])


@pytest.mark.usefixtures("undrawn")
def test_validation_errors_are_those_that_the_training_logged(tmp_path, mlp_run, capsys):
    evaluate(tmp_path / "out", mlp_run, arguments=["split=validation", "step=0.01"])
    assert "2 validation trajectories, 0.1 s open loop" in capsys.readouterr().out
    error = pd.read_csv(tmp_path / "out" / "summary.csv")["error_mean"][0]
    recorded = json.loads((mlp_run / "metrics.json").read_text())["validation"]
    assert error == pytest.approx(recorded["val/error_mean"], rel=1e-5)


@pytest.mark.usefixtures("undrawn")
def test_runs_are_grouped_by_their_configuration_without_the_seed(
    tmp_path, hnn_run, mlp_run, capsys
):
    runs = tmp_path / "runs"
    shutil.copytree(mlp_run, runs / "a")
    train(runs / "b", "model=mlp", "seed=1", NO_FIGURES)
    train(runs / "c", "model=mlp", "data.pairs=32", NO_FIGURES)
    shutil.copytree(hnn_run, runs / "d")
    (runs / "not a run").mkdir()
    capsys.readouterr()
    evaluate(tmp_path / "out", f"{runs}/*")
    summary = pd.read_csv(tmp_path / "out" / "summary.csv")
    names = ["mlp data.pairs=64", "mlp data.pairs=64", "mlp data.pairs=32", "hnn"]
    assert summary["model"].tolist()[:4] == names
    assert summary["run"].is_unique
    by_model = pd.read_csv(tmp_path / "out" / "by_model.csv").set_index("model")
    row = by_model.loc["mlp data.pairs=64"]
    assert row["seeds"] == 2
    assert row["error_mean"] == pytest.approx(summary["error_mean"][:2].mean())
    assert row["error_mean_std"] == pytest.approx(summary["error_mean"][:2].std())
    assert "over seeds" in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn")
def test_a_damaged_run_is_named_and_the_others_are_evaluated(tmp_path, mlp_run, capsys):
    shutil.copytree(mlp_run, tmp_path / "a")
    shutil.copytree(mlp_run, tmp_path / "b")
    path = tmp_path / "b" / "checkpoints" / "best.ckpt"
    path.write_bytes(path.read_bytes()[:20000])
    text = refused(capsys, tmp_path / "b", tmp_path / "a")
    assert "1 runs cannot be loaded" in text
    assert str(path) in text
    summary = pd.read_csv("out/summary.csv")
    assert summary["run"].tolist()[0] == "mlp"
    assert (~summary["baseline"]).sum() == 1
