"""Arguments of load, predict and fit that cannot be: each named, with what was expected."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

import pinn_dyn
from pinn_dyn.app.frame import frame_dataset
from pinn_dyn.control import load_law
from tests.data.logs_files import motion

LOADS = {
    "nowhere": (("nowhere",), "nowhere is not a run folder"),
    "a file": (("config.yaml",), "is not a run folder"),
    "NUL": (("a\0b",), "is not a run folder"),
    "a way out": (("run", "../../x"), "does not exist"),
    "no checkpoint": (("run", None), "does not exist"),
    "a long name": (("z" * 5000,), "run_folder is 'zzz"),
}


@pytest.mark.parametrize(("arguments", "message"), LOADS.values(), ids=LOADS)
def test_load(tmp_path, lnn_run, arguments, message):
    (tmp_path / "run").symlink_to(lnn_run)
    (tmp_path / "config.yaml").write_text("")
    with pytest.raises(ValueError, match=message):
        pinn_dyn.load(*arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *[((one,), "run_folder is .*, expected the path") for one in (None, 3, b"x", ["x"])],
        *[(("x", "best", one), "trust is .*, expected names") for one in (None, 3, [3])],
    ],
)
def test_load_of_something_else(arguments, message):
    with pytest.raises(TypeError, match=message):
        pinn_dyn.load(*arguments)


LAWS = {
    "None": ((None,), TypeError, "path is None, expected that of a file"),
    "a list": ((["x"],), TypeError, "path is"),
    "nowhere": (("nowhere.pt2",), FileNotFoundError, "nowhere.pt2 is no file"),
    "a folder": ((".",), FileNotFoundError, "is no file"),
    "NUL": (("a\0b",), FileNotFoundError, "is no file"),
    "a text": (("x.pt2",), ValueError, "x.pt2 is no exported law"),
    "half a checksum": (("x.pt2", "abc"), ValueError, "sha256 is 'abc', expected the 64 hexa"),
    "no checksum": (("x.pt2", 3), ValueError, "sha256 is 3, expected"),
}


@pytest.mark.parametrize(("arguments", "kind", "message"), LAWS.values(), ids=LAWS)
def test_load_law(tmp_path, arguments, kind, message):
    (tmp_path / "x.pt2").write_text("x")
    with pytest.raises(kind, match=message):
        load_law(*arguments)


@pytest.fixture(scope="module")
def model(lnn_run):
    return pinn_dyn.load(lnn_run)


T, X0, U = np.linspace(0, 0.1, 11), np.zeros(6), np.zeros((11, 3))
PREDICTIONS = {
    "NaN": ((X0 * np.nan, U, T), "start"),
    "infinite inputs": ((X0, U + np.inf, T), "u"),
    "inputs of NaN": ((X0, U * np.nan, T), "u"),
    "times of NaN": ((X0, U, T * np.nan), "t has 11 non-finite entries"),
    "an infinite time": ((X0, U, np.append(T[:-1], np.inf)), "t has 1 non-finite"),
    "durations": ((X0, U, pd.to_timedelta(T, unit="s")), "t is .*dates or durations, not sec"),
    "dates": ((np.array(["2026"] * 6, "M8[s]"), U, T), "start is .*dates or durations"),
    "masked": ((np.ma.masked_all(6), U, T), "start is .*some are masked"),
    "a generator": ((X0, (row for row in U), T), "u is <generator .*expected real numbers"),
    "a function": ((X0, lambda t: t, T), "u is <function .*expected real numbers"),
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
    "a set of columns": (TABLE, NAMES | dict(q={"q1", "q2"}), "q is .*expected names of columns"),
    "a number of columns": (TABLE, NAMES | dict(q=3), "q is 3, expected names of columns"),
    "columns by number": (TABLE, NAMES | dict(q=[1, 4]), "q names the column 1, expected a text"),
    "no name": (TABLE, NAMES | dict(q=[None]), "q names the column None"),
    "an interpolation": (
        TABLE.rename(columns={"q1": "${seed}"}),
        NAMES | dict(q=["${seed}", "q2"]),
        r"q names the column '\$\{seed\}'",
    ),
    "two levels of columns": (
        TABLE.set_axis(pd.MultiIndex.from_product([TABLE.columns, ["x"]]), axis=1),
        NAMES,
        "no column 't'",
    ),
    "a list for a run": (TABLE, NAMES | dict(run=["t"]), r"run is \['t'\], expected the name"),
    "runs of NaN": (TABLE.assign(r=np.nan), NAMES | dict(run="r"), "some rows belong to no run"),
    "lists in cells": (TABLE.assign(q1=[[0]] * len(TABLE)), NAMES, r"the value is '\[0\]'"),
    "a folder of no name": (TABLE, NAMES | dict(folder=""), "folder is '', expected the name"),
    "a folder of bytes": (TABLE, NAMES | dict(folder=b"x"), "folder is b'x', expected the name"),
    "a folder with NUL": (TABLE, NAMES | dict(folder="a\0b"), "cannot be written to"),
    "a folder with $": (TABLE, NAMES | dict(folder="${seed}"), "folder is .*expected the name"),
    "overrides in one": (TABLE, NAMES | dict(overrides="data.pairs=3"), "overrides is 'data.pairs"),
    "overrides as a dict": (TABLE, NAMES | dict(overrides={"a": 1}), "overrides is {'a': 1}, exp"),
    "a number": (TABLE, NAMES | dict(overrides=[3]), "overrides has 3, expected words"),
    "a flag": (TABLE, NAMES | dict(overrides=["-m"]), "overrides has '-m', expected words"),
    "other data": (TABLE, NAMES | dict(overrides=["dataset=panda"]), "which is for train.py"),
    "another place": (TABLE, NAMES | dict(overrides=["hydra.run.dir=x"]), "which is for train.py"),
    "the input for q": (TABLE, dict(q=["q1"], u=["q1"]), "'q1' is given for q and for u"),
}


@pytest.mark.parametrize(("data", "arguments", "message"), FITS.values(), ids=FITS)
def test_fit(data, arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        pinn_dyn.fit(data, **arguments)
    assert len(str(caught.value)) < 1500


@pytest.mark.parametrize("data", [None, {}, np.zeros((5, 5)), 3, TABLE["q1"], Path("one.csv")])
@pytest.mark.parametrize("columns", [{}, NAMES])
def test_fit_on_no_data(data, columns):
    with pytest.raises(TypeError, match=r"data is a .*expected a data frame"):
        pinn_dyn.fit(data, **columns)


def test_what_numpy_and_pandas_hold_is_written(tmp_path):
    """Up to the configuration: what it takes to train on it is tested elsewhere."""
    q = {"columns": np.array(["q1", "q2"]), "unit": "rad", "scale": np.float64(2)}
    given = {"time": "t", "q": {**q, "offset": np.array([0.1, 0.2])}, "u": TABLE.columns[[3, 6]]}
    frame_dataset(TABLE, given, None, 0, tmp_path)
    written = yaml.safe_load((tmp_path / "dataset" / "frame.yaml").read_text())
    assert written["q"] == {
        "columns": ["q1", "q2"],
        "unit": "rad",
        "scale": 2,
        "offset": [0.1, 0.2],
    }
    assert written["u"]["columns"] == ["u1", "u2"]
