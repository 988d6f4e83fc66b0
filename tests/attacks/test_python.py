"""Arguments of load, predict and fit that cannot be: each named, with what was expected."""

import numpy as np
import pandas as pd
import pytest

import pinn_dyn
from tests.data.logs_files import motion

LOADS = {
    "nowhere": (("nowhere",), "nowhere is not a run folder"),
    "a file": (("config.yaml",), "is not a run folder"),
    "NUL": (("a\0b",), "is not a run folder"),
    "a way out": (("run", "../../x"), "does not exist"),
    "no checkpoint": (("run", None), "does not exist"),
}


@pytest.mark.parametrize(("arguments", "message"), LOADS.values(), ids=LOADS)
def test_load(tmp_path, lnn_run, arguments, message):
    (tmp_path / "run").symlink_to(lnn_run)
    (tmp_path / "config.yaml").write_text("")
    with pytest.raises(ValueError, match=message):
        pinn_dyn.load(*arguments)


@pytest.fixture(scope="module")
def model(lnn_run):
    return pinn_dyn.load(lnn_run)


T, X0, U = np.linspace(0, 0.1, 11), np.zeros(6), np.zeros((11, 3))
PREDICTIONS = {
    "NaN": ((X0 * np.nan, U, T), "start"),
    "infinite inputs": ((X0, U + np.inf, T), "u"),
    "inputs of NaN": ((X0, U * np.nan, T), "u"),
    "times of NaN": ((X0, U, T * np.nan), "t has 11 non-finite entries"),
    "times backwards": ((X0, U, T[::-1].copy()), "t must increase"),
    "one time": ((X0, U[:1], T[:1]), "at least 2 times"),
    "no time": ((X0, U[:0], T[:0]), "t|u"),
    "rows of times": ((X0, U, T[None]), r"t \(1, 11\)"),
    "few inputs": ((X0, U[:5], T), r"u has shape \(5, 3\)"),
    "wide inputs": ((X0, np.zeros((11, 4)), T), r"u has shape \(11, 4\)"),
    "a word": (("x", U, T), "start is 'x', expected real numbers"),
    "a mapping": (({}, U, T), "start is {}, expected real numbers"),
    "complex": ((X0 + 1j, U, T), "start is .*they are complex"),
    "objects": ((np.array([object()] * 6), U, T), "start is .*expected real numbers"),
    "ragged": (([[1], [1, 2]], U, T), "start is .*expected real numbers"),
    "one number": ((1.0, U, T), r"start has shape \(\)"),
    "a frame": ((pd.DataFrame({"a": [1]}),), "no log with columns"),
}


@pytest.mark.parametrize(("arguments", "message"), PREDICTIONS.values(), ids=PREDICTIONS)
def test_predict(model, arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        model.predict(*arguments)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: m.terms([np.nan] * 3), "q"),
        (lambda m: m.terms([0, 0]), r"q has shape \(2,\)"),
        (lambda m: m.terms(None), "q"),
        (lambda m: m.inverse_dynamics([0] * 3, [0] * 2, [0] * 3), "v has shape"),
        (lambda m: m.inverse_dynamics(np.zeros((4, 3)), np.zeros((5, 3)), [0] * 3), "batches"),
        (lambda m: m.forward_dynamics(np.zeros((4, 3)), [0] * 3, np.zeros((5, 3))), "batches"),
        (lambda m: m.forward_dynamics([0] * 3, [0] * 3, [np.nan] * 3), "u"),
    ],
)
def test_terms_and_dynamics(model, call, message):
    with pytest.raises(ValueError, match=message):
        call(model)


TABLE = motion(6.0)
NAMES = dict(q=["q1", "q2"], u=["u1", "u2"])
FITS = {
    "no columns": (TABLE, dict(q=[], u=["u1"]), "columns is empty"),
    "an unknown column": (TABLE, dict(q=["zz"], u=["u1"]), "no column 'zz'"),
    "an unknown time": (TABLE, NAMES | dict(time="zz"), "no column 'zz'"),
    "an unknown run": (TABLE, NAMES | dict(run="zz"), "no column 'zz'"),
    "an unknown model": (TABLE, NAMES | dict(model="x"), "x"),
    "a model with a seed": (
        TABLE,
        NAMES | dict(model="lnn seed=3"),
        "model is 'lnn seed=3', expected",
    ),
    "two models": (TABLE, NAMES | dict(model="lnn,mlp"), "model is 'lnn,mlp'"),
    "a way out": (TABLE, NAMES | dict(model="../../etc/passwd"), "model is .*etc/passwd"),
    "no steps": (TABLE, NAMES | dict(steps=0), "steps is 0, expected"),
    "steps backwards": (TABLE, NAMES | dict(steps=-1), "steps is -1, expected"),
    "half a step": (TABLE, NAMES | dict(steps=2.5), "steps is 2.5, expected"),
    "a seed below": (TABLE, NAMES | dict(seed=-1), "seed is -1"),
    "a seed in words": (TABLE, NAMES | dict(seed="x"), "seed is 'x', expected"),
    "foreign code": (TABLE, NAMES | dict(overrides=["model._target_=os.nothing"]), "os.nothing"),
    "half an override": (TABLE, NAMES | dict(overrides=["optimizer.lr"]), "optimizer.lr"),
    "a folder that is a file": (TABLE, NAMES | dict(folder="/etc/passwd"), "cannot be written to"),
    "a folder that cannot be": (TABLE, NAMES | dict(folder="/proc/x"), "cannot be written to"),
    "an unknown data set": ("nothing", {}, "nothing"),
    "two data sets": ("soft_arm_1,panda", {}, "soft_arm_1"),
    "no rows": (TABLE[:0], NAMES, "has no rows"),
    "two rows": (TABLE[:2], NAMES, "train|short|rows|long"),
    "a column twice": (pd.concat([TABLE, TABLE[["q1"]]], axis=1), NAMES, "2 columns have the name"),
    "an unknown unit": (TABLE, dict(q=dict(columns=["q1"], unit="x"), u=["u1"]), "unit is 'x'"),
    "an unknown key": (TABLE, dict(q=dict(column=["q1"]), u=["u1"]), "q has the key 'column'"),
    "times of NaN": (TABLE.assign(t=np.nan), NAMES, "column 't'"),
    "the input for q": (TABLE, dict(q=["q1"], u=["q1"]), "'q1' is given for q and for u"),
}


@pytest.mark.parametrize(("data", "arguments", "message"), FITS.values(), ids=FITS)
def test_fit(data, arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        pinn_dyn.fit(data, **arguments)
    assert len(str(caught.value)) < 1500


@pytest.mark.parametrize("data", [None, {}, np.zeros((5, 5)), 3])
def test_fit_on_no_data(data):
    with pytest.raises(TypeError, match=r"data is a .*expected a data frame"):
        pinn_dyn.fit(data)
