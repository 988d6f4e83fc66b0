"""Arguments of load, predict, fit and load_law that cannot be used are named."""

import numpy as np
import pandas as pd
import pytest

import pinn_dyn
from pinn_dyn.control import load_law


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere",), "nowhere/checkpoints/best.ckpt does not exist: this is no run folder"),
        (("run", "first"), "first.ckpt does not exist: .* has best, last"),
    ],
)
def test_load(tmp_path, lnn_run, arguments, message):
    (tmp_path / "run").symlink_to(lnn_run)
    with pytest.raises(ValueError, match=message):
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


T, X0, U = np.linspace(0, 0.1, 11), np.zeros(6), np.zeros((11, 3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((X0 * np.nan, U, T), "start has 6 non-finite"),
        ((X0, U + np.inf, T), "u has 33 non-finite"),
        ((X0, U, T * np.nan), "t has 11 non-finite entries"),
        ((X0, U, pd.to_timedelta(T, unit="s")), "t holds dates or durations"),
        ((X0, U[:5], T), r"u has shape \(5, 3\)"),
        ((pd.DataFrame({"a": [1]}),), "no columns of a log"),
    ],
)
def test_predict(lnn_run, arguments, message):
    with pytest.raises(ValueError, match=message):
        pinn_dyn.load(lnn_run).predict(*arguments)


def test_fit_takes_a_data_frame():
    with pytest.raises(TypeError, match=r"expected a data frame; for other data, see pinn_dyn.tr"):
        pinn_dyn.fit("soft_arm_1", q=["q"], u=["u"])
