"""Python API: train, fit, load, predictions and terms."""

import itertools
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial

import lightning as L
import numpy as np
import pandas as pd
import pytest
import torch
from scipy.signal import savgol_filter

import pinn_dyn
from pinn_dyn.data import DynamicsData
from pinn_dyn.data.logs import InputDelay
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.models import AccelerationMLP, LagrangianNetwork
from tests.app.entry import ROOT, TINY_DATA, run_script

Q = {"columns": ["bend_x", "bend_y", "stretch"], "unit": ["deg", "deg", "mm"]}
U = {"columns": ["torque_x", "torque_y", "force"], "unit": ["Nm", "Nm", "N"]}


def log():
    """Six runs of 1 s of the example log; its index is that of the whole file."""
    frame = pd.read_csv(ROOT / "examples" / "example_log.csv")
    return frame[(frame.t <= 1.0) & (frame.run < "run_06")]


def fit(frame=None, **changes):
    arguments = dict(q=Q, u=U, run="run", steps=2, validator=partial(RolloutValidator, horizon=0.2))
    return pinn_dyn.fit(log() if frame is None else frame, **{**arguments, **changes})


@pytest.fixture(scope="module")
def model():
    return fit()


@pytest.fixture(scope="module")
def black_box(mlp_run):
    return pinn_dyn.load(mlp_run)


class Still(pinn_dyn.DataSource):
    """One motion of constant acceleration."""

    name, labels, input_labels = "still", ["q [m]"], ["u [N]"]

    def __init__(self, speed=1.0):
        self.speed = speed

    def load(self):
        t = torch.arange(21, dtype=torch.float64) * 0.01
        q, u = (t**2 / 2).unsqueeze(1), torch.ones(21, 1).double()
        v = self.speed * t.unsqueeze(1)
        motion = pinn_dyn.Trajectory(q, v, pinn_dyn.Signal(t, u))
        return pinn_dyn.Splits([motion], [motion], [motion])


SHORT = dict(
    steps=1,
    data=partial(DynamicsData, pairs=8, batch_size=8, stride=1),
    validator=partial(RolloutValidator, horizon=0.1),
)


def test_the_package_imports_nothing_until_it_is_asked():
    code = "import sys, pinn_dyn; sys.exit('torch' in sys.modules or 'hydra' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
    for name in pinn_dyn.__all__:
        assert getattr(pinn_dyn, name).__name__ == name
    with pytest.raises(AttributeError, match=r"no attribute 'Fit'"):
        pinn_dyn.Fit  # noqa: B018


def test_a_typo_is_answered_without_slow_imports():
    code = (
        "import sys, pinn_dyn.app.command as c\n"
        "sys.argv[1:] = ['dataset=example_log', 'dataset.test.peice=3']\n"
        "try: c.main('train')\n"
        "except SystemExit as e: sys.exit('torch' in sys.modules or 'Error' not in str(e))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# Predictions.


def by_hand(model, run):
    """The prediction of a frame of one run, read, differentiated and integrated by NumPy alone."""
    factors = np.array([np.pi / 180, np.pi / 180, 1e-3])
    q = run[Q["columns"]].to_numpy() * factors
    u = run[U["columns"]].to_numpy()
    h = 0.02
    v = savgol_filter(q, 11, 3, deriv=1, delta=h, axis=0)

    def slope(x, u):
        return np.concatenate([x[3:], model.forward_dynamics(x[:3], x[3:], u)])

    x = np.concatenate([q[0], v[0]])
    states = [x]
    for before, after in itertools.pairwise(u):
        third, two_thirds = before + (after - before) / 3, before + 2 * (after - before) / 3
        k1 = slope(x, before)
        k2 = slope(x + h * k1 / 3, third)
        k3 = slope(x + h * (k2 - k1 / 3), two_thirds)
        k4 = slope(x + h * (k1 - k2 + k3), after)
        x = x + h * (k1 + 3 * k2 + 3 * k3 + k4) / 8
        states.append(x)
    return np.array(states) / np.tile(factors, 2)


def test_a_frame_is_predicted_in_its_own_columns_and_units(model):
    frame = log()
    predicted = model.predict(frame)
    assert predicted.index.equals(frame.index)
    rates = ["dbend_x/dt", "dbend_y/dt", "dstretch/dt"]
    assert list(predicted.columns) == [*Q["columns"], *rates]
    for name in ("run_00", "run_04"):  # each from its own start
        run = frame[frame.run == name]
        expected = by_hand(model, run)
        np.testing.assert_allclose(predicted.loc[run.index], expected, rtol=1e-8, atol=1e-8)


def test_a_start_and_an_input_are_predicted_as_the_model_does(model):
    t = np.arange(6) * 0.03
    u = np.random.default_rng(0).normal(size=(6, 3)) * 0.1
    start = [0.1, -0.2, 0.3, 0.0, 0.1, 0.0]
    signal = pinn_dyn.Signal(torch.tensor(t), torch.tensor(u))
    x0 = torch.tensor(start, dtype=torch.float64)
    expected = model.model.predict(x0, signal.t, signal).numpy()
    for predicted in (
        model.predict(start, u, t),
        model.predict(x0, torch.tensor(u), torch.tensor(t)),
        model.predict(np.tile(start, (2, 1)), u, t)[1],
    ):
        np.testing.assert_allclose(predicted, expected, rtol=1e-9, atol=1e-12)


def test_a_prediction_follows_the_present_weights(lnn_run):
    run = pinn_dyn.load(lnn_run)
    start, u, t = np.full(6, 0.1), 0.1 * np.ones((4, 3)), 0.01 * np.arange(4)
    before = run.predict(start, u, t)
    with torch.no_grad():
        for parameter in run.model.parameters():
            parameter.mul_(1.1)
    times = torch.from_numpy(t)
    signal = pinn_dyn.Signal(times, torch.from_numpy(u))
    expected = run.model.predict(torch.from_numpy(start), times, signal).detach()
    np.testing.assert_allclose(run.predict(start, u, t), expected, rtol=1e-9, atol=1e-12)
    assert np.abs(before - expected.numpy()).max() > 1e-6


# Terms.


def test_terms_are_those_of_the_equation_of_motion(model):
    q, v, u = np.array([0.3, -0.2, 0.35]), np.array([0.5, 0.1, -0.2]), np.array([0.2, 0.1, -1.0])
    M, D, G, A = model.terms(q)
    energy, step = model.system.potential_energy, 1e-5
    slopes = [
        float(energy(torch.tensor(q + d)) - energy(torch.tensor(q - d))) / (2 * step)
        for d in step * np.eye(3)
    ]
    np.testing.assert_allclose(G, slopes, rtol=1e-6, atol=1e-8)
    assert (np.linalg.eigvalsh(M) > 0).all()
    rest = model.forward_dynamics(q, np.zeros(3), u)
    np.testing.assert_allclose(M @ rest + G, A @ u, rtol=1e-9)
    a = model.forward_dynamics(q, v, u)
    np.testing.assert_allclose(model.inverse_dynamics(q, v, a), A @ u, rtol=1e-8)
    assert (v @ D @ v) >= 0
    assert model.terms(np.tile(q, (2, 1))).M.shape == (2, 3, 3)


def test_accelerations_of_rows_are_those_of_single_states(model):
    q, v, u = np.random.default_rng(0).uniform(-0.3, 0.3, (3, 4, 3))
    expected = np.stack([model.forward_dynamics(q[k], v[0], u[k]) for k in range(4)])
    np.testing.assert_allclose(model.forward_dynamics(q, v[0], u), expected, rtol=1e-9)
    bad = u.copy()
    bad[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"u has 1 non-finite .* index \(2, 1\)"):
        model.forward_dynamics(q, v, bad)
    with pytest.raises(ValueError, match="v has 1 non-finite"):
        model.forward_dynamics(q[0], [0.0, np.inf, 0.0], u[0])
    with pytest.raises(ValueError, match=r"v has shape \(2,\), expected \(\*batch, 3\)"):
        model.forward_dynamics(q[0], v[0, :2], u[0])
    with pytest.raises(ValueError, match="q holds dates"):
        model.forward_dynamics(np.zeros(3, "M8[s]"), v[0], u[0])


def test_a_black_box_has_no_terms(black_box):
    with pytest.raises(TypeError, match=r"is a black box and has no terms"):
        black_box.terms([0.0, 0.0, 0.3])
    with pytest.raises(ValueError, match=r"no columns of a log"):
        black_box.predict(log())
    with pytest.raises(ValueError, match=r"first.ckpt does not exist: .* has best, last"):
        pinn_dyn.load(black_box.folder, "first")


# Training.


def test_train_gives_the_weights_of_the_command_line(tmp_path, lnn_run):
    source = pinn_dyn.dataset("soft_arm_1", **dict(word[8:].split("=") for word in TINY_DATA))
    run = pinn_dyn.train(
        source,
        LagrangianNetwork,
        data=partial(DynamicsData, pairs=64, batch_size=32, stride=5),
        validator=partial(RolloutValidator, horizon=0.1),
        steps=2,
        validations=1,
    )
    expected = pinn_dyn.load(lnn_run)
    for name, value in run.model.state_dict().items():
        assert torch.equal(value, expected.model.state_dict()[name]), name
    assert run.metrics["validation"]["val/error_mean"] == pytest.approx(
        expected.metrics["validation"]["val/error_mean"]
    )


@pytest.mark.usefixtures("undrawn")
def test_a_fitted_run_can_be_saved_loaded_and_evaluated(model, tmp_path):
    folder = tmp_path / "run"
    model.save(folder)
    loaded = pinn_dyn.load(folder)
    assert repr(loaded) == repr(model)
    assert "lnn of frame" in repr(model)
    assert "stretch [m]" in repr(model)
    start = log()[:51]
    pd.testing.assert_frame_equal(loaded.predict(start), model.predict(start))
    out = tmp_path / "evaluation"
    run_script("evaluate.py", f"runs=[{folder}]", "horizon=0.2", f"hydra.run.dir={out}")
    assert "lnn" in (out / "summary.csv").read_text()


def test_a_delay_of_the_data_reaches_predictions_files_and_environments(tmp_path):
    delays = [0.015, 0.0, 0.03]
    run = fit(cleaning={"late": InputDelay(delays)})
    run.save(tmp_path / "run")
    loaded = pinn_dyn.load(tmp_path / "run")
    np.testing.assert_array_equal(loaded.input_delay, delays)
    t = np.arange(11) * 0.01
    u = np.random.default_rng(0).normal(size=(11, 3)) * 0.1
    fine = np.arange(21) * 0.005
    acting = np.stack([np.interp(fine - d, t, x) for d, x in zip(delays, u.T, strict=True)], 1)
    signal = pinn_dyn.Signal(torch.tensor(fine), torch.tensor(acting))
    start = torch.zeros(6).double()
    expected = run.model.predict(start, torch.tensor(t), signal).numpy()
    np.testing.assert_allclose(loaded.predict(start, u, t), expected, rtol=1e-6, atol=1e-9)


def test_a_training_leaves_the_random_numbers_and_the_threads_alone():
    torch.manual_seed(5)
    expected = torch.rand(2)
    torch.manual_seed(5)
    before = torch.get_num_threads()
    run = pinn_dyn.train(Still(), "acceleration", threads=2, **SHORT)
    assert torch.equal(torch.rand(2), expected)
    assert torch.get_num_threads() == before
    assert run.labels == ["q [m]"]
    assert run.predict([0.0, 0.0], np.ones((3, 1)), [0, 0.01, 0.02]).shape == (3, 2)


@pytest.mark.usefixtures("undrawn")
def test_a_source_made_in_python_can_be_evaluated_from_its_folder(tmp_path):
    run = tmp_path / "run"
    pinn_dyn.train(Still(), "lnn", folder=run, **SHORT)
    moved = run.rename(tmp_path / "moved")
    run_script("evaluate.py", f"runs=[{moved}]", f"hydra.run.dir={tmp_path / 'evaluation'}")
    rows = pd.read_csv(tmp_path / "evaluation" / "summary.csv")
    assert "lnn" in set(rows["model"])


class OwnModel(AccelerationMLP):
    """A model class of a user."""


def test_a_model_of_an_own_class_is_loaded_by_trust_or_by_its_builder(tmp_path):
    builder = partial(OwnModel, hidden=[4])
    run = pinn_dyn.train(Still(), builder, folder=tmp_path / "run", **SHORT)
    with pytest.raises(ValueError, match=r"OwnModel.*trust="):
        pinn_dyn.load(tmp_path / "run")
    for loaded in (
        pinn_dyn.load(tmp_path / "run", trust="tests"),
        pinn_dyn.load(tmp_path / "run", model=builder),
    ):
        assert isinstance(loaded.model, OwnModel)
        for name, value in run.model.state_dict().items():
            assert torch.equal(value, loaded.model.state_dict()[name])


def test_a_built_model_is_trained_and_loaded_by_a_builder(tmp_path):
    statistics = DynamicsData(
        Still(), pairs=8, batch_size=8, stride=1, batches_per_epoch=1, seed=0
    ).statistics
    built = AccelerationMLP(statistics, hidden=[4])
    start = built.network.linears[0].weight.detach().clone()
    pinn_dyn.train(Still(), built, folder=tmp_path / "run", **SHORT)
    assert not torch.equal(built.network.linears[0].weight, start)
    with pytest.raises(ValueError, match=r"built in Python: use pinn_dyn.load"):
        pinn_dyn.load(tmp_path / "run")
    loaded = pinn_dyn.load(tmp_path / "run", model=partial(AccelerationMLP, hidden=[4]))
    x0, u, t = [0.0, 0.0], np.ones((3, 1)), [0, 0.01, 0.02]
    assert loaded.predict(x0, u, t).shape == (3, 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q": ["bend_x", "bendy"]}, "frame: no column 'bendy', which q .*bend_y"),
        ({"validator": partial(RolloutValidator, horizon=5.0)}, "validator: horizon is 5.0 s"),
        (
            {"trainer": {"precision": "64-true"}},
            "trainer.precision is .64-true., expected .32-true",
        ),
        ({"model": "known"}, "model is .known., expected lnn, .* or a builder"),
    ],
)
def test_what_cannot_be_fitted_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        fit(**changes)


def test_a_finished_run_is_loaded_only_for_the_same_data_and_arguments(tmp_path):
    """Otherwise the message names the difference, and its advice trains anew."""

    def trained(speed=1.0, **changes):
        return pinn_dyn.train(Still(speed), "acceleration", folder=tmp_path, **SHORT | changes)

    first = trained()
    (tmp_path / "constants.csv").touch()
    (tmp_path / "note.txt").touch()
    assert trained().metrics == first.metrics
    with pytest.raises(ValueError, match=r"seed=1 \(there 0\): train into another folder") as error:
        trained(seed=1)
    with pytest.raises(ValueError, match=r"start_from=\S+ \(there None\)"):
        trained(start_from=first)
    with pytest.raises(ValueError, match=r"(?s)still has changed .*train has other") as error:
        trained(2.0)
    assert pinn_dyn.load(tmp_path).source.load().train[0].v[1] == pytest.approx(0.01)
    advice = re.search(r"by (\w+)=True", str(error.value))[1]
    second = trained(2.0, **{advice: True})
    assert second.statistics.v_std > 1.5 * first.statistics.v_std
    assert not (tmp_path / "constants.csv").exists()
    assert (tmp_path / "note.txt").exists()  # of the user
    assert trained(2.0).metrics == second.metrics


def test_a_built_model_is_loaded_only_with_the_same_constants(tmp_path):
    """Its learned parameters may differ: a training changes them."""
    windows = DynamicsData(Still(), pairs=8, batch_size=8, stride=1, batches_per_epoch=1, seed=0)
    built = AccelerationMLP(windows.statistics, hidden=[4])
    first = pinn_dyn.train(Still(), built, folder=tmp_path, **SHORT)
    assert pinn_dyn.train(Still(), built, folder=tmp_path, **SHORT).metrics == first.metrics
    other = AccelerationMLP(replace(windows.statistics, v_std=torch.ones(1)), hidden=[4])
    with pytest.raises(ValueError, match=r"another configuration: built="):
        pinn_dyn.train(Still(), other, folder=tmp_path, **SHORT)


def test_train_and_fit_have_one_set_of_defaults():
    """Also on a log whose pieces are shorter than the usual horizon."""
    frame = log()
    fitted = pinn_dyn.fit(frame, q=Q, u=U, run="run", steps=1)
    source = pinn_dyn.LogSource(files=frame, time="t", q=Q, u=U, trajectory="run")
    trained = pinn_dyn.train(source, "lnn", steps=1)
    assert trained.metrics["validation"] == fitted.metrics["validation"]
    for key in ("data", "validator", "optimizer", "loss", "trainer", "log"):
        assert trained.config[key] == fitted.config[key]


@pytest.mark.parametrize("kind", ["dict", "list", "columns", "path"])
def test_a_log_is_fitted_in_every_form(monkeypatch, tmp_path, kind):
    frame, sources = log().reset_index(drop=True), []
    runs = {name: rows for name, rows in frame.groupby("run")}
    frame.to_csv(tmp_path / "my arm.csv", index=False)
    forms = {"dict": runs, "list": list(runs.values()), "path": tmp_path / "my arm.csv"}
    forms["columns"] = {name: frame[name].to_numpy() for name in frame}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "pinn_dyn.run.training.fit.train", lambda source, *_, **__: sources.append(source)
    )
    column = "run" if kind in ("columns", "path") else None
    path = "my arm.csv" if kind == "path" else forms[kind]
    for form, run in ((frame, "run"), (path, column)):
        pinn_dyn.fit(form, q=Q, u=U, run=run)
    first, second = (source.load() for source in sources)
    assert sources[1].name == ("myarm" if kind == "path" else "frame")
    assert len(first.train) == len(second.train)
    for a, b in zip(first.train, second.train, strict=True):
        torch.testing.assert_close(a.q, b.q, atol=1e-9, rtol=0)


def test_an_interrupted_training_ends_with_one_line(tmp_path):
    """The innermost frame is that of train: none of Lightning."""

    class Interrupt(L.Callback):
        def on_train_batch_start(self, *_):
            raise KeyboardInterrupt

    for folder, text in ((tmp_path, "starts again"), (None, "folder=.* resume")):
        with pytest.raises(KeyboardInterrupt, match=text) as error:
            pinn_dyn.train(Still(), "lnn", folder=folder, **SHORT | {"callbacks": [Interrupt()]})
        assert error.traceback[-1].name == "train"
        assert error.value.__suppress_context__


def test_a_model_with_a_memory_trains_on_windows_with_a_past(caplog):
    run = fit(model="subnet", steps=2)
    assert run.model.history_steps > 1
    assert run.config["model_name"] == "subnet"
    assert "the model sees" not in caplog.text
    short = partial(DynamicsData, pairs=8, batch_size=8, steps=1, stride=1, history=0.5)
    fit(model="subnet", data=short)
    assert "sees 25 steps of 0.02 s before windows of 1 steps: increase data.str" in caplog.text
