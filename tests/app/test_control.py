"""control.py: what it writes, and what it refuses."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

import pinn_dyn
from pinn_dyn.app.config import CONF
from pinn_dyn.app.control import _guarded
from pinn_dyn.control import Tracking, export_law
from pinn_dyn.exports.escaping import c_text
from pinn_dyn.systems import RigidChain
from tests.app.entry import (
    NO_FIGURES,
    SET_POINTS,
    STRIDE,
    TINY_TRAINING,
    refused_text,
    run_script,
)
from tests.app.pages import assert_says_how_it_came_about, page_of
from tests.support.c_code import function_of


def control(folder, run, *arguments):
    run_script("control.py", f"run={run}", f"hydra.run.dir={folder}", *SET_POINTS, *arguments)
    return folder


def refused(capsys, run, *arguments):
    """What control.py says about what it cannot do."""
    return refused_text(
        capsys, "control.py", f"run={run}", "hydra.run.dir=out", *SET_POINTS, *arguments
    )


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def results(tmp_path_factory, lnn_run):
    """Three runs at 200 Hz."""
    folder = tmp_path_factory.mktemp("control")
    return control(folder, lnn_run, "rate=200", "guard.threshold=1.0")


def test_the_table_has_a_row_for_each_controller(results):
    summary = pd.read_csv(results / "summary.csv")
    assert summary["controller"].tolist() == ["learned", "truth", "pd"]
    assert (summary["runs"] == 3).all()
    assert np.isfinite(summary["rms_error"]).all()
    assert "step_error_after_0.03_s_mean_percent" in summary
    coordinates = pd.read_csv(results / "coordinates.csv")
    assert coordinates.groupby("controller").size().to_dict() == {"learned": 3, "truth": 3, "pd": 3}


@pytest.mark.slow
def test_an_animation_is_written(tmp_path, lnn_run):
    control(tmp_path, lnn_run, "rate=200", "animate=true", "~controllers.truth", "~controllers.pd")
    with Image.open(tmp_path / "animation_learned.gif") as animation:
        assert animation.is_animated


def test_figures_record_page_and_provenance_are_written(results, lnn_run):
    for name in ("closed_loop", "comparison"):
        assert (results / f"{name}.png").stat().st_size > 10_000
    summary = pd.read_csv(results / "summary.csv")
    with np.load(results / "record_learned.npz") as record:
        assert {"input_condition", "distance", "outside"} <= set(record)
        rms = np.sqrt(np.mean((record["q"] - record["q_ref"]) ** 2))
    assert summary["rms_error"][0] == pytest.approx(rms)
    record = json.loads((results / "provenance.json").read_text())
    assert {"config", "run", "commit", "hardware"} <= set(record)
    assert record["config"]["gains"]["position"] == 5
    assert_says_how_it_came_about(results, "control.py", lnn_run)
    errors = [row["RMS error"] for row in page_of(results).table("RMS error")]
    assert [float(x) for x in errors] == pytest.approx(summary["rms_error"], rel=5e-3)


def test_limits_noise_delay_and_another_mass_reach_the_loop(tmp_path, results, lnn_run, undrawn):
    effects = ["actuator.low=-1.2", "actuator.high=0.1", "dead_time=0.01", "sensor.q_noise=0.01"]
    effects += ["+robot.mass=0.36"]
    folder = control(tmp_path, lnn_run, "rate=200", *effects)
    with np.load(folder / "record_learned.npz") as record:
        assert record["u"].min() >= -1.2
        assert record["u"].max() <= 0.1
        assert not record["u"][:, :2].any()
    with np.load(folder / "record_pd.npz") as a, np.load(results / "record_pd.npz") as b:
        assert (a["q"][:, -1] != b["q"][:, -1]).all()  # the robot is heavier
    assert pd.read_csv(folder / "summary.csv")["saturated_samples"].sum() > 0


def test_predictive_control_keeps_the_limits_and_reports_its_solver(tmp_path, lnn_run, undrawn):
    pytest.importorskip("casadi")
    words = ["controllers=mpc", "controllers.learned.law.horizon=0.06", "~controllers.truth"]
    limits = ["actuator.low=-1.2", "actuator.high=0.1", "guard.threshold=1.0"]
    folder = control(tmp_path, lnn_run, "rate=50", "duration=0.1", *words, *limits)
    summary = pd.read_csv(folder / "summary.csv").set_index("controller")
    assert summary.loc["learned", "solver_failures"] == 0
    assert summary.loc["learned", "solve_time_median_ms"] > 0
    assert np.isnan(summary.loc["clipped", "solve_time_median_ms"])
    with np.load(folder / "record_learned.npz") as record:
        assert record["u_wanted"].min() >= -1.2
        assert record["u_wanted"].max() <= 0.1
        assert {"solve_time", "distance"} <= set(record)


@pytest.mark.slow
def test_a_run_that_was_stopped_at_once_has_its_curves_and_its_report(tmp_path, lnn_run):
    words = ["gains.position=1e5", "gains.velocity=1e3", "rate=100", "duration=0.4", "runs=1"]
    words += ["settled_after=0.2", "~controllers.truth", "~controllers.pd"]
    folder = tmp_path / "out"
    with pytest.raises(SystemExit, match=r"learned: 1 of 1 runs were stopped.*the plant diverged"):
        control(folder, lnn_run, *words)
    assert pd.read_csv(folder / "summary.csv").set_index("controller").loc["learned", "stopped"]
    assert (folder / "closed_loop.png").is_file()
    assert "the plant diverged" in (folder / "report.html").read_text()


def test_the_learned_law_is_exported_with_its_limits_and_guard(
    tmp_path, lnn_run, undrawn, few_states
):
    """By what tests/exports tests."""
    path = tmp_path / "law.c"
    words = ["rate=200", f"export={path}", "~controllers.pd", "~controllers.truth"]
    words += ["actuator.high=0.5", "actuator.rate=20", "guard.threshold=2", "guard.fallback=hold"]
    control(tmp_path / "out", lnn_run, *words)
    control_law = function_of(path, "law_control")
    size = pinn_dyn.load(lnn_run).model.num_coordinates
    far = np.full(size, 50.0)
    u, memory, status = control_law(far, far, far, far, far, [1.0, *[0.2] * size])
    np.testing.assert_allclose(u, 0.2)
    np.testing.assert_allclose(memory, [1.0, *[0.2] * size])
    assert status == 2
    header = path.with_suffix(".h").read_text()
    for part in (
        f"#define law_MEMORY_SIZE {1 + size}",
        c_text('"period": 0.005'),
        c_text('"fallback": "hold"'),
    ):
        assert part in header


def test_the_guard_of_a_known_robot_counts_whole_turns_as_the_same_angle():
    """A known robot has no network, so the data alone say which coordinates are angles."""
    arm = RigidChain(str(CONF.parent / "examples" / "double_pendulum.urdf"))
    q = torch.rand(2, 50, 2, generator=torch.Generator().manual_seed(0)).double()
    train = [SimpleNamespace(q=x, v=torch.zeros_like(x)) for x in q]
    source = SimpleNamespace(angles=(0, 1), load=lambda: SimpleNamespace(train=train))
    region = _guarded(Tracking(arm, 1.0, 1.0), {"guard": {"threshold": 2.0}}, source).region
    assert region.distance(q[0, 0] + 2 * torch.pi, train[0].v[0]) < 1e-6


def test_a_law_on_the_model_of_a_run_has_the_names_of_its_joints(tmp_path, monkeypatch, lnn_run):
    written = []
    monkeypatch.setattr("pinn_dyn.control.export.write", lambda *given: written.append(given))
    run = pinn_dyn.load(lnn_run)
    export_law(Tracking(run.system, 1.0, 1.0), tmp_path / "law.c")
    assert written[0][2]["q"] == run.labels
    assert written[0][2]["u"] == run.input_labels


def test_the_law_of_an_experiment_goes_to_the_kind_of_its_file(
    tmp_path, monkeypatch, lnn_run, undrawn
):
    written = []
    monkeypatch.setattr("pinn_dyn.control.export.write", lambda *given: written.append(given))
    words = ["rate=200", "~controllers.pd", "~controllers.truth", "duration=0.01"]
    words += ["settled_after=0", "controllers=tracking", "exported_law=learned_observer"]
    words += ["export_real=float"]
    control(tmp_path / "c", lnn_run, f"export={tmp_path}/law.c", *words)
    (((law,), path, info, real),) = written
    assert (law.name, path.name, real) == ("control", "law.c", "float")
    assert info["observer"] == {"bandwidth": 200.0}


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["gains.position=[1,2]"], ["controllers.learned", "position_gain"]),
        (["controllers.learned.terms=guess"], ["controllers.learned.terms", "guess", "truth"]),
        (["rate=null"], ["rate", "20000"]),
        (["trajectory=3"], ["trajectory is 3", "0 to 2"]),
        (["checkpoint=first"], ["first", "'best' or 'last'"]),
    ],
    ids=lambda value: value[0] if isinstance(value[0], str) else None,
)
def test_what_does_not_fit_is_refused_by_name(capsys, lnn_run, arguments, parts):
    text = refused(capsys, lnn_run, *arguments)
    for part in parts:
        assert part in text


def test_a_black_box_has_no_terms_to_control_by(capsys, mlp_run):
    text = refused(capsys, mlp_run)
    assert "black box" in text
    assert "model=lnn" in text


@pytest.fixture(scope="module")
def oscillators_run(run_of):
    return run_of("oscillators")


def test_oscillators_control_beside_pid_and_the_true_terms(
    tmp_path, oscillators_run, undrawn, few_states
):
    words = "controllers=latent", "rate=100", f"export={tmp_path / 'law.c'}"
    folder = control(tmp_path / "out", oscillators_run, *words)
    assert "LatentLaw" in (tmp_path / "law.h").read_text()
    summary = pd.read_csv(folder / "summary.csv").set_index("controller")
    assert list(summary.index) == ["learned", "pid", "truth"]
    assert np.isfinite(summary["rms_error"]).all()
    record = np.load(folder / "record_learned.npz")
    assert np.isfinite(record["static_residual"]).all()


@pytest.mark.slow
def test_the_law_on_a_model_of_measured_data_is_exported(tmp_path, capsys):
    """Hold the first measured pose where no reference is set, as in docs/your_log.md."""
    (tmp_path / "examples").symlink_to(CONF.parent / "examples")
    run = tmp_path / "arm" / "lnn"
    words = [*TINY_TRAINING, NO_FIGURES, "compile=false", f"hydra.run.dir={run}"]
    run_script("train.py", "experiment=example_log", *words)
    command = ["control.py", "run=arm/lnn", "export=law.onnx"]
    run_script(*command, "gains.position=10", "gains.velocity=1", checked=True)
    assert (tmp_path / "law.onnx").is_file()
    (folder,) = (tmp_path / "runs" / "control" / "arm" / "lnn").iterdir()
    table = pd.read_csv(folder / "conditions.csv")
    model = pinn_dyn.load(run)
    terms = model.terms(table[["q1", "q2", "q3"]].to_numpy())
    np.testing.assert_allclose(np.linalg.eigvalsh(terms.M)[:, 0], table["mass_min"], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.cond(terms.A), table["input_condition"], rtol=1e-6)
    for words, problem in (
        (["~controllers.learned", "~controllers.truth"], "export: exported_law is 'learned'"),
        (["guard.threshold=1", "export=null"], "guard: example_log has no simulated robot"),
    ):
        assert problem in refused_text(capsys, *command, *words)


@pytest.mark.parametrize(
    "experiment", ["panda/tracking", pytest.param("panda/helix", marks=pytest.mark.slow)]
)
def test_the_panda_is_controlled_without_pybullet(request, tmp_path, experiment, panda_run):
    if experiment != "panda/helix":  # which has a picture of its own
        request.getfixturevalue("undrawn")
    folder = tmp_path / "out"
    run_script(
        "control.py",
        f"experiment={experiment}",
        f"run={panda_run}",
        "duration=0.05",
        "animate=false",
        f"hydra.run.dir={folder}",
    )
    summary = pd.read_csv(folder / "summary.csv").set_index("controller")
    assert (summary["stopped"] == 0).all()
    assert summary.loc["truth", "rms_error"] < 1e-4
    assert (folder / "tip_path.png").is_file() == (experiment == "panda/helix")


@pytest.mark.slow
def test_the_panda_is_planned_within_its_limits(tmp_path, panda_run, undrawn):
    pytest.importorskip("casadi")
    words = ["duration=0.1", "runs=2", "controllers.learned.terms=truth", "~controllers.truth"]
    folder = f"hydra.run.dir={tmp_path}"
    run_script("control.py", "experiment=panda/mpc", f"run={panda_run}", *words, folder)
    summary = pd.read_csv(tmp_path / "summary.csv").set_index("controller")
    assert summary.loc["learned", "solver_failures"] == 0
    limits = np.repeat([87.0, 12.0], [4, 3])
    with np.load(tmp_path / "record_learned.npz") as planned:
        shares = np.abs(planned["u_wanted"][:, :-1]) / limits
        assert 0.9 < shares.max() <= 1
        assert np.abs(planned["v"] / np.repeat([2.175, 2.61], [4, 3])).max() < 1.02
    with np.load(tmp_path / "record_clipped.npz") as clipped:
        assert np.abs(clipped["u_wanted"][:, 0] / limits).max() > 2


@pytest.fixture(scope="module")
def panda_run(tmp_path_factory):
    """A run of a process that cannot import PyBullet, until the last test of this module."""
    pytest.importorskip("mujoco", reason="the mujoco extra is not installed")
    folder = tmp_path_factory.mktemp("runs") / "panda"
    counts = ["dataset.train=2", "dataset.validation=1", "dataset.test=1"]
    with pytest.MonkeyPatch.context() as patch:
        for name in ("pybullet", "pybullet_data"):
            patch.setitem(sys.modules, name, None)
        run_script(
            "train.py",
            "experiment=panda",
            "dataset=panda_mujoco",
            *TINY_TRAINING,
            "dataset.duration=0.2",
            *counts,
            STRIDE,
            NO_FIGURES,
            "compile=false",
            f"hydra.run.dir={folder}",
        )
        yield folder
