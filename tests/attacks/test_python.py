"""Arguments of load, predict and fit that cannot be used are named."""

import numpy as np
import pandas as pd
import pytest

import pinn_dyn


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
