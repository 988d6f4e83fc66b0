"""The front door in Python: fit on a data frame, load, predict, terms."""

import itertools
import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
import torch
from filelock import FileLock
from scipy.signal import savgol_filter

import pinn_dyn
from pinn_dyn.app.run_folder import load_run
from tests.app.entry import NO_FIGURES, ROOT, TINY, run_script, train

Q = {"columns": ["bend_x", "bend_y", "stretch"], "unit": ["deg", "deg", "mm"]}
U = {"columns": ["torque_x", "torque_y", "force"], "unit": ["Nm", "Nm", "N"]}
SHORT = [
    *("data.pairs=64", "data.batch_size=32", "data.steps=2", "validator.horizon=0.2"),
    *("trainer.enable_progress_bar=false", NO_FIGURES),
]


def log():
    """Six runs of 1 s of the example log; its index is that of the whole file."""
    frame = pd.read_csv(ROOT / "examples" / "example_log.csv")
    return frame[(frame.t <= 1.0) & (frame.run < "run_06")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("frame") / "run"


@pytest.fixture(scope="module")
def model(folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pinn_dyn.app.train._write_report", lambda source, folder: None)
        return pinn_dyn.fit(log(), q=Q, u=U, run="run", steps=2, folder=folder, overrides=SHORT)


@pytest.fixture(scope="module")
def black_box(mlp_run):
    return pinn_dyn.load(mlp_run)


def test_the_package_imports_nothing_until_it_is_asked():
    code = "import sys, pinn_dyn; sys.exit('torch' in sys.modules or 'hydra' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
    for name in pinn_dyn.__all__:
        assert getattr(pinn_dyn, name).__name__ == name
    assert set(pinn_dyn.__all__) <= set(dir(pinn_dyn))
    with pytest.raises(AttributeError, match=r"no attribute 'Fit'"):
        pinn_dyn.Fit  # noqa: B018


# --- predictions ----------------------------------------------------------------------------------


def by_hand(model, run):
    """The prediction of a frame of one run, read, derived and integrated by NumPy alone."""
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
    alone = frame[frame.run == "run_04"].drop(columns="run")
    np.testing.assert_allclose(model.predict(alone), predicted.loc[alone.index], rtol=1e-12)


def test_a_start_and_an_input_are_predicted_as_the_model_does(model):
    t = np.arange(6) * 0.03
    u = np.random.default_rng(0).normal(size=(6, 3)) * 0.1
    start = [0.1, -0.2, 0.3, 0.0, 0.1, 0.0]
    signal = pinn_dyn.Signal(torch.tensor(t), torch.tensor(u))
    x0 = torch.tensor(start, dtype=torch.float64)
    expected = model.model.predict(x0, signal.t, signal).numpy()
    for found in (
        model.predict(start, u, t),
        model.predict(x0, torch.tensor(u), torch.tensor(t)),
        model.predict(np.tile(start, (2, 1)), u, t)[1],
        model.predict(start, signal),
    ):
        assert isinstance(found, np.ndarray)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    half = model.predict(start, signal, t[:4])
    np.testing.assert_allclose(half, expected[:4], rtol=1e-9, atol=1e-12)


START, T = np.zeros(6) + 0.1, np.arange(4) * 0.02


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((START[:5], np.zeros((4, 3)), T), r"start has shape \(5,\), expected .* 2N = 6, q and v"),
        ((START, np.zeros((4, 2)), T), r"u has shape \(4, 2\), expected .* M = 3, torque_x"),
        ((START, np.zeros((5, 3)), T), r"u has shape \(5, 3\) and t \(4,\)"),
        ((START, np.zeros((2, 4, 3)), T[::-1]), "t must increase"),
        ((START * np.nan, np.zeros((4, 3)), T), "start has 6 non-finite entries"),
        ((["a"] * 6, np.zeros((4, 3)), T), "start is .*expected real numbers"),
        ((np.zeros((3, 6)), np.zeros((2, 4, 3)), T), r"start has the batch \(3,\) and u \(2,\)"),
        (
            (START, pinn_dyn.Signal(torch.tensor(T), torch.zeros(4, 3)), T + 0.02),
            r"t has the time 0.08 s, outside the input, which is known from 0 to 0.06 s",
        ),
    ],
)
def test_what_cannot_be_predicted_is_refused_by_name(model, arguments, expected):
    with pytest.raises(ValueError, match=expected):
        model.predict(*arguments)


def test_a_lacking_argument_is_named(model):
    with pytest.raises(TypeError, match=r"lacks the input"):
        model.predict(START)
    with pytest.raises(TypeError, match=r"lacks the times t"):
        model.predict(START, np.zeros((4, 3)))
    with pytest.raises(TypeError, match=r"leave out u and t"):
        model.predict(log(), np.zeros((4, 3)))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda x: x.rename(columns={"bend_x": "bendx"}), "no column 'bend_x'.*mean bendx"),
        (lambda x: x.assign(force=np.nan), "the frame, row 251, column 'force' .*empty or NaN"),
        (lambda x: x.assign(t=x.t * 1000), "unit of the time wrong"),
        (lambda x: x[:0], "the frame has no rows"),
        (lambda x: x[:5], "5 samples are too few for SavitzkyGolayVelocity"),
    ],
)
def test_a_frame_is_checked_as_a_log(model, change, expected):
    frame = log()
    with pytest.raises(ValueError, match=expected):
        model.predict(change(frame[frame.run == "run_01"]))


# --- terms ----------------------------------------------------------------------------------------


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
    # At rest M a + G = A u, and what drives a given acceleration gives it.
    rest = model.forward_dynamics(q, np.zeros(3), u)
    np.testing.assert_allclose(M @ rest + G, A @ u, rtol=1e-9)
    a = model.forward_dynamics(q, v, u)
    np.testing.assert_allclose(model.inverse_dynamics(q, v, a), A @ u, rtol=1e-8)
    assert (v @ D @ v) >= 0
    assert model.terms(np.tile(q, (2, 1))).M.shape == (2, 3, 3)
    assert not any(weight.requires_grad for weight in model.model.parameters())


def test_a_black_box_has_no_terms_and_says_so(black_box):
    for call in (
        lambda: black_box.terms([0.0, 0.0, 0.3]),
        lambda: black_box.inverse_dynamics(*np.zeros((3, 3))),
        lambda: black_box.forward_dynamics(*np.zeros((3, 3))),
    ):
        with pytest.raises(TypeError, match=r"model=mlp is a black box and has no terms"):
            call()
    with pytest.raises(ValueError, match=r"trained on soft_arm_1, which is no log with columns"):
        black_box.predict(log())


# --- fit ------------------------------------------------------------------------------------------


def test_fit_gives_the_weights_of_train(tmp_path, lnn_run):
    options = [word for word in TINY if not word.startswith(("trainer.steps", "trainer.valid"))]
    fitted = pinn_dyn.fit(
        "soft_arm_1",
        model="lnn",
        steps=2,
        folder=tmp_path / "run",
        overrides=[*options, "trainer.validations=1", NO_FIGURES],
    )
    trained = load_run(lnn_run, "best")
    assert fitted.config == trained.config
    expected = trained.model.state_dict()
    for name, value in fitted.model.state_dict().items():
        assert torch.equal(value.float(), expected[name].float()), name


def test_a_run_of_fit_is_a_run_folder(model, folder, tmp_path):
    again = pinn_dyn.load(folder)
    assert repr(again) == repr(model)
    assert "lnn of frame" in repr(model)
    assert "stretch [m]" in repr(model)
    start = log()[:51]
    pd.testing.assert_frame_equal(again.predict(start), model.predict(start))
    run_script(
        "evaluate.py",
        f"runs=[{folder}]",
        "horizon=0.2",
        "windows=[0.1]",
        f"hydra.run.dir={tmp_path}",
    )
    assert "lnn" in (tmp_path / "report.html").read_text()


def test_the_same_training_by_train_has_the_same_weights(model, folder, tmp_path):
    """The data set that fit writes is one for the command line too."""
    words = [f"--config-dir={folder}", "dataset=frame", "data=multi_step", "model=lnn"]
    lengths = ["trainer.steps=2", "trainer.validations=2", f"hydra.run.dir={tmp_path}"]
    run_script("train.py", *words, *SHORT, *lengths, checked=True)
    expected = load_run(tmp_path, "best").model.state_dict()
    for name, value in model.model.state_dict().items():
        assert torch.equal(value.float(), expected[name].float()), name


class Still(pinn_dyn.DataSource):
    name, labels, input_labels = "still", ["q [m]"], ["u [N]"]

    def load(self):
        t = torch.arange(21, dtype=torch.float64) * 0.01
        q, u = (t**2 / 2).unsqueeze(1), torch.ones(21, 1).double()
        one = pinn_dyn.Trajectory(q, t.unsqueeze(1), pinn_dyn.Signal(t, u))
        return pinn_dyn.Splits([one], [one], [one])


def test_fit_leaves_the_random_numbers_and_the_threads_alone(black_box, folder):
    torch.manual_seed(5)
    expected = torch.rand(2)
    torch.manual_seed(5)
    short = ["data.pairs=8", "data.batch_size=8", "data.stride=1", "validator.horizon=0.1"]
    quiet = ["trainer.enable_progress_bar=false", "threads=2"]
    fitted = pinn_dyn.fit(Still(), model="acceleration", steps=1, overrides=[*short, *quiet])
    assert torch.equal(torch.rand(2), expected)
    assert torch.get_num_threads() == 1
    assert not fitted.folder.exists()
    assert fitted.labels == ["q [m]"]
    assert fitted.predict([0.0, 0.0], np.ones((3, 1)), [0, 0.01, 0.02]).shape == (3, 2)


def test_a_source_made_in_python_can_be_evaluated_and_controlled_from_its_folder(tmp_path):
    short = ["data.pairs=8", "data.batch_size=8", "data.stride=1", "validator.horizon=0.1"]
    run = tmp_path / "run"
    pinn_dyn.fit(Still(), model="lnn", steps=1, overrides=short, folder=run)
    run_script("evaluate.py", f"runs=[{run}]", f"hydra.run.dir={tmp_path / 'evaluation'}")
    rows = pd.read_csv(tmp_path / "evaluation" / "summary.csv")
    assert {"lnn", "hold position", "constant velocity"} <= set(rows["model"])
    wanted = ["reference.q=[0.1]", f"hydra.run.dir={tmp_path / 'control'}"]
    run_script("control.py", f"run={run}", *wanted)
    assert (tmp_path / "control" / "report.html").is_file()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"q": ["bend_x", "bendy"]}, "the frame: no column 'bendy', which q asks for.*bend_y"),
        ({"q": {"columns": "bend_x", "unit": "degree"}}, "unit is 'degree'"),
        ({"q": {"columns": "bend_x", "unit": "Nm"}}, "q has the column 'bend_x' in Nm"),
        ({"run": None}, "time goes back.*'trajectory' .*run="),
        ({"run": "trial"}, "no column 'trial', which run asks for"),
        ({"time": {"columns": "t", "unit": "min"}}, "sample time would be 1.2 s"),
        ({"model": "lmm"}, "lmm"),
        ({"overrides": ["optimizer.lrr=1"]}, "no key 'optimizer.lrr'"),
    ],
)
def test_what_cannot_be_fitted_is_refused_by_name(changes, expected):
    arguments = {"q": Q, "u": U, "run": "run", "steps": 1, "overrides": SHORT, **changes}
    with pytest.raises(ValueError, match=expected):
        pinn_dyn.fit(log(), **arguments)


def test_a_row_of_a_frame_is_named_by_its_number_not_by_a_line_of_a_file_that_is_gone():
    frame = log()
    frame.loc[260, "t"] = 0.0
    with pytest.raises(ValueError, match=r"data: the frame, row 260, column 't': the time goes"):
        pinn_dyn.fit(frame, q=Q, u=U, run="run", steps=1, overrides=SHORT)
    frame.loc[260, "t"] = np.nan
    with pytest.raises(ValueError, match=r"the frame, row 260, column 't' .*empty or NaN"):
        pinn_dyn.fit(frame, q=Q, u=U, run="run", steps=1, overrides=SHORT)


def test_columns_belong_to_a_frame(folder, model):
    with pytest.raises(TypeError, match=r"lacks columns"):
        pinn_dyn.fit(log(), q=Q)
    with pytest.raises(TypeError, match=r"leave them out"):
        pinn_dyn.fit("soft_arm_1", q=Q, u=U)
    with pytest.raises(ValueError, match=r"holds a training: give another one"):
        pinn_dyn.fit(log(), q=Q, u=U, run="run", folder=folder)


# --- load -----------------------------------------------------------------------------------------


def test_what_is_no_finished_run_is_refused(tmp_path, lnn_run):
    with pytest.raises(ValueError, match=r"is not a run folder: it has no config.yaml"):
        pinn_dyn.load(tmp_path)
    (tmp_path / "config.yaml").write_text((lnn_run / "config.yaml").read_text())
    with pytest.raises(ValueError, match=r"was interrupted.*resume="):
        pinn_dyn.load(str(tmp_path))
    with (
        FileLock(tmp_path / ".lock"),
        pytest.raises(ValueError, match=r"a training in progress.*wait for it"),
    ):
        pinn_dyn.load(tmp_path)
    with pytest.raises(ValueError, match=r"first.ckpt does not exist.*best, last"):
        pinn_dyn.load(lnn_run, checkpoint="first")


@pytest.mark.parametrize(("made_by", "said"), [(None, "0.2 or before"), ("9.9", "9.9")])
def test_a_run_of_another_version_says_which(tmp_path, made_by, said):
    run = train(tmp_path / "run", "model=acceleration", NO_FIGURES)
    record = json.loads((run / "metrics.json").read_text())
    assert record.pop("pinn_dyn") == pinn_dyn.__version__
    if made_by:
        record["pinn_dyn"] = made_by
    (run / "metrics.json").write_text(json.dumps(record))
    assert pinn_dyn.load(run).metrics == record  # as long as it can be read
    config = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(config.replace("  hidden:", "  width:"))
    with pytest.raises(ValueError, match=f"The run was made by pinn_dyn {said}, and this is"):
        pinn_dyn.load(run)
