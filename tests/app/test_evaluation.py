"""evaluate.py: what it writes, and runs that cannot be evaluated."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.image import imread

from pinn_dyn.app.build import build_source
from pinn_dyn.app.run_folder import read_config
from tests.app.entry import NO_FIGURES, TINY_DATA, refused_text, run_script, train
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
    """A structured model beside a black box, and what was printed."""
    folder = tmp_path_factory.mktemp("evaluation")
    printed = folder / "printed.txt"
    with pytest.MonkeyPatch.context() as patch, printed.open("w") as file:
        patch.setattr("sys.stdout", file)
        evaluate(folder, hnn_run, mlp_run)
    return folder


def test_tables_are_written_as_csv_and_json(evaluation):
    every = pd.read_csv(evaluation / "summary.csv")
    assert every["model"].tolist()[:4] == ["hnn", "mlp", "stands still", "keeps its velocity"]
    assert every["floor"].tolist() == [False, False] + [True] * (len(every) - 2)
    summary = every[~every["floor"]]
    assert np.isfinite(summary["error_mean"]).all()
    assert (summary["error_mean"] > 0).all()
    assert {"window_0.02s_error_mean", "window_0.05s_error_mean"} <= set(summary)
    assert (summary["pairs"] == 64).all()
    rows = json.loads((evaluation / "summary.json").read_text())
    assert [row["error_mean"] for row in rows] == pytest.approx(every["error_mean"].tolist())
    by_model = pd.read_csv(evaluation / "by_model.csv")
    assert by_model["model"].tolist() == every["model"].tolist()


def test_the_floors_are_those_of_the_test_motions(evaluation, hnn_run):
    """Computed again from the data, without the code that predicts."""
    test = build_source(read_config(hnn_run)).load().test
    still = [torch.linalg.vector_norm(x.q - x.q[:1], dim=-1)[:51:5] for x in test]
    moving = [
        torch.linalg.vector_norm(x.q - x.q[:1] - x.v[:1] * x.t[:, None], dim=-1)[:51:5]
        for x in test
    ]
    rows = pd.read_csv(evaluation / "summary.csv").set_index("run")
    for name, errors in (("stands still", still), ("keeps its velocity", moving)):
        expected = float(torch.stack(errors).mean())
        assert rows.loc[name, "error_mean"] == pytest.approx(expected, rel=1e-6)


def test_mechanical_models_have_a_torque_error_joint_by_joint(evaluation):
    rows = pd.read_csv(evaluation / "summary.csv").set_index("run")
    assert rows["torque_share"].notna().tolist()[:2] == [True, False]
    joints = pd.read_csv(evaluation / "torque.csv")
    assert len(joints) == 3
    assert set(joints["run"]) == {"hnn"}


def test_a_windowed_error_is_smaller_than_the_open_loop_one(evaluation):
    """Re-set every 0.02 s of 0.1 s, an untrained model has less time to drift."""
    summary = pd.read_csv(evaluation / "summary.csv")[:2]
    assert (summary["window_0.02s_error_mean"] < summary["error_mean"]).all()


def test_the_table_is_printed(evaluation):
    text = (evaluation / "printed.txt").read_text()
    assert "2 unseen test trajectories, 0.1 s open loop" in text
    for model in ("hnn", "mlp"):
        assert any(line.startswith(model) for line in text.splitlines())
    assert "error_mean" in text
    assert str(evaluation) in text


def test_figures_are_drawn(evaluation):
    for name in ("trajectory.png", "error.png", "terms_hnn_bent.png"):
        picture = imread(evaluation / name)
        assert min(picture.shape[:2]) > 200
        assert picture[..., :3].std() > 0.01


def test_terms_are_compared_for_the_structured_model_alone(evaluation):
    terms = pd.read_csv(evaluation / "terms_hnn.csv")
    assert len(terms) > 0
    assert "hnn" in (evaluation / "terms.txt").read_text()
    assert not list(evaluation.glob("terms_mlp*"))


def test_the_page_has_the_numbers_of_its_files(evaluation, hnn_run):
    page, summary = page_of(evaluation), pd.read_csv(evaluation / "summary.csv")
    rows = page.table("mean error ± std")
    assert [row["run"][0] for row in rows][:3] == ["hnn", "mlp", "[stands still]"]
    for row, value in zip(rows, summary["error_mean"], strict=True):
        assert float(row["mean error ± std"][1]) == value
    terms = pd.read_csv(evaluation / "terms_hnn.csv")
    shown = page.table("|X_L − X| / |X|")
    assert [row["term X"][0] for row in shown] == terms["term"].tolist()
    for row, value in zip(shown, terms["relative_error_best_P"], strict=True):
        assert float(row["|X_L − P X| / |X_L|"][1]) == value
    assert_says_how_it_came_about(evaluation, "evaluate.py", hnn_run)


def test_the_records_say_what_was_evaluated(evaluation):
    record = json.loads((evaluation / "provenance.json").read_text())
    assert record["config"]["horizon"] == 0.1
    assert record["dataset"]["name"] == "soft_arm_1"
    assert {"commit", "torch"} <= record.keys()


def test_the_validation_trajectories_are_evaluated_on_request(tmp_path, mlp_run, capsys):
    """By the same figures that the training logged of them."""
    evaluate(tmp_path / "out", mlp_run, arguments=["split=validation", "step=0.01"])
    assert "2 validation trajectories, 0.1 s open loop" in capsys.readouterr().out
    assert "unseen test" not in (tmp_path / "out" / "report.html").read_text()
    found = pd.read_csv(tmp_path / "out" / "summary.csv")["error_mean"][0]
    recorded = json.loads((mlp_run / "metrics.json").read_text())["validation"]
    assert found == pytest.approx(recorded["val/error_mean"], rel=1e-5)


def test_an_unknown_split_is_refused(capsys, mlp_run):
    text = refused(capsys, mlp_run, arguments=["split=train"])
    assert "split is 'train', expected test or validation" in text


@pytest.mark.usefixtures("undrawn")
def test_seeds_of_a_model_are_grouped_and_globs_find_them(tmp_path, hnn_run, mlp_run, capsys):
    runs = tmp_path / "runs"
    shutil.copytree(hnn_run, runs / "a")
    other = train(runs / "b", "model=hnn", "seed=1", NO_FIGURES)
    shutil.copytree(mlp_run, runs / "c")
    (runs / "not a run").mkdir()
    assert (other / "metrics.json").is_file()
    capsys.readouterr()
    evaluate(tmp_path / "out", f"{runs}/*")
    summary = pd.read_csv(tmp_path / "out" / "summary.csv")
    assert summary["model"].tolist()[:3] == ["hnn", "hnn", "mlp"]
    assert summary["run"].is_unique
    by_model = pd.read_csv(tmp_path / "out" / "by_model.csv").set_index("model")
    assert by_model.loc["hnn", "mean_error_mean"] == pytest.approx(summary["error_mean"][:2].mean())
    assert by_model.loc["hnn", "worst_error_mean"] == pytest.approx(summary["error_mean"][:2].max())
    assert "over seeds" in capsys.readouterr().out


def copy(run, folder):
    shutil.copytree(run, folder)
    return folder


def swap(first, second):
    """Exchange the checkpoints of two runs."""
    one, other = (run / "checkpoints" / "best.ckpt" for run in (first, second))
    contents = one.read_bytes(), other.read_bytes()
    other.write_bytes(contents[0])
    one.write_bytes(contents[1])


def test_a_checkpoint_of_another_model_is_refused_with_both_named(
    tmp_path, hnn_run, mlp_run, capsys
):
    hnn, mlp = copy(hnn_run, tmp_path / "hnn"), copy(mlp_run, tmp_path / "mlp")
    swap(hnn, mlp)
    for run in (hnn, mlp):
        text = refused(capsys, run)
        assert "another model" in text
        assert str(run / "checkpoints" / "best.ckpt") in text
        assert "config.yaml describes" in text


def test_a_checkpoint_of_a_model_that_differs_in_its_activation_is_refused(
    tmp_path, mlp_run, capsys
):
    tanh = train(tmp_path / "tanh", "model=mlp", "model.activation=tanh", NO_FIGURES)
    mlp = copy(mlp_run, tmp_path / "mlp")
    swap(tanh, mlp)
    assert "another model" in refused(capsys, mlp)


@pytest.mark.parametrize("left", [0, 3, 100, 20000, -100])
def test_a_truncated_checkpoint_is_refused(tmp_path, mlp_run, capsys, left):
    run = copy(mlp_run, tmp_path / "mlp")
    path = run / "checkpoints" / "best.ckpt"
    path.write_bytes(path.read_bytes()[:left])
    text = refused(capsys, run)
    assert str(path) in text
    assert "cut short" in text


def test_a_file_that_is_no_checkpoint_is_refused(tmp_path, mlp_run, capsys):
    run = copy(mlp_run, tmp_path / "mlp")
    (run / "checkpoints" / "best.ckpt").write_text("something else altogether")
    assert str(run / "checkpoints" / "best.ckpt") in refused(capsys, run)


@pytest.mark.usefixtures("undrawn")
def test_a_missing_checkpoint_is_refused_with_those_there_are(tmp_path, mlp_run, capsys):
    run = copy(mlp_run, tmp_path / "mlp")
    (run / "checkpoints" / "best.ckpt").unlink()
    text = refused(capsys, run)
    assert "best.ckpt does not exist" in text
    assert "has last" in text
    evaluate(tmp_path / "out", run, arguments=["checkpoint=last"])
    assert (tmp_path / "out" / "summary.csv").is_file()


def test_a_pattern_that_matches_nothing_is_refused(tmp_path, capsys):
    text = refused(capsys, tmp_path / "nowhere" / "*")
    assert "nowhere/*' matches nothing" in text


def test_a_folder_that_is_no_run_is_refused(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert "matches no run folder" in refused(capsys, tmp_path / "empty")


def test_runs_of_different_data_sets_are_refused(tmp_path, hnn_run, capsys):
    other = train(tmp_path / "other", "model=mlp", "dataset.seed=1", NO_FIGURES)
    text = refused(capsys, hnn_run, other)
    assert "another data set" in text
    assert str(other) in text
    assert str(hnn_run) in text


def test_a_horizon_beyond_the_data_is_refused(hnn_run, capsys):
    text = refused(capsys, hnn_run, arguments=["horizon=3"])
    assert "horizon is 3" in text
    assert "lasts only 0.2 s" in text


@pytest.mark.usefixtures("undrawn")
def test_horizon_and_windows_fit_the_data_by_themselves(tmp_path, mlp_run):
    run_script("evaluate.py", f"runs=[{mlp_run}]", f"hydra.run.dir={tmp_path / 'out'}")
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert record["config"]["horizon"] == pytest.approx(0.2)  # as long as the motions are
    assert record["config"]["windows"] == [0.1]


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("horizon=nan", "horizon is nan, expected a number above 0 or null"),
        ("horizon=long", "horizon is 'long', expected a number above 0 or null"),
        ("step=-1", "step is -1, expected a number above 0 or null"),
        ("windows=text", "windows is 'text', expected null or a list"),
        ("windows=[0.1,nan]", "windows is [0.1, nan], expected null or a list"),
        ("trajectory=9", "trajectory is 9, expected 0 to 1"),
    ],
)
def test_settings_that_no_data_fit_are_refused_by_name(capsys, mlp_run, argument, words):
    text = refused_text(capsys, "evaluate.py", f"runs=[{mlp_run}]", "hydra.run.dir=out", argument)
    assert words in text


def test_no_runs_are_refused_by_name(capsys):
    text = refused_text(capsys, "evaluate.py", "runs=[]", "hydra.run.dir=out")
    assert "runs is empty, expected run folders" in text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("damage", ["config.yaml", "metrics.json", "checkpoints/best.ckpt"])
def test_a_damaged_run_is_named_and_the_others_are_evaluated(tmp_path, mlp_run, capsys, damage):
    whole, cut = copy(mlp_run, tmp_path / "a"), copy(mlp_run, tmp_path / "b")
    content = (cut / damage).read_bytes()
    (cut / damage).write_bytes(content[: len(content) // 2])
    text = refused(capsys, cut, whole)
    assert "1 of 2 runs could not be evaluated" in text
    assert f"{cut}" in text
    summary = pd.read_csv("out/summary.csv")
    assert summary["run"].tolist()[0] == "mlp"
    assert (~summary["floor"]).sum() == 1
    assert "open report.html" in text


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_step_too_long_for_the_fastest_motion_is_named_with_its_coordinate(tmp_path, lnn_run):
    run_script(
        "evaluate.py",
        f"runs=[{lnn_run}]",
        "dataset=soft_arm_1",
        *TINY_DATA,
        "horizon=0.2",
        "windows=[0.1]",
        "step=0.1",
        f"hydra.run.dir={tmp_path / 'out'}",
    )
    said = (tmp_path / "out" / "evaluate.log").read_text()
    assert "a step of 0.1 s is too long for the fastest motion in the data, that of" in said
