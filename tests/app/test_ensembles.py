"""The mean of several runs: evaluated, with intervals, and refused where runs do not fit."""

import numpy as np
import pandas as pd
import pytest

import pinn_dyn
from tests.app.entry import run_script


@pytest.fixture(scope="module")
def folders(lnn_run, run_of):
    """Two runs that differ in the seed."""
    return [lnn_run, run_of("other seed")]


@pytest.mark.usefixtures("undrawn")
def test_the_mean_of_seeds_is_evaluated_beside_the_runs(tmp_path, folders, run_of):
    run_script(
        "evaluate.py",
        f"runs=[{folders[0]},{run_of('mlp')},{folders[1]}]",
        "ensemble=true",
        "horizon=0.1",
        "windows=[0.02]",
        f"hydra.run.dir={tmp_path}",
    )
    table = pd.read_csv(tmp_path / "summary.csv").set_index("run")
    mean = table.loc["mean of 2 lnn"]
    (row,) = pd.read_csv(tmp_path / "ensembles.csv").to_dict("records")
    assert (row["run"], row["members"]) == ("mean of 2 lnn", 2)
    of_seeds = [x for x in table.index if x.startswith("lnn")]
    assert row["member_error_mean"] == pytest.approx(table.loc[of_seeds, "error_mean"].mean())
    assert mean["error_mean"] <= row["member_error_mean"]
    assert mean["parameters"] == table.loc[of_seeds, "parameters"].sum()
    assert np.isfinite([row["spread_mean"], row["spread_over_error"]]).all()
    # 0.02 s is shorter than the validation motions, so widths are corrected too.
    assert 0 <= mean["window_0.02s_within"] <= 1
    assert mean["window_0.02s_factor"] > 0
    assert np.isnan(table.loc["mlp seed 0", "window_0.02s_within"])


def test_the_run_that_validation_prefers_is_named(folders, run_of):
    """Chosen by the test data, a run would look better than it is."""
    runs = [pinn_dyn.load(folder) for folder in (folders[0], run_of("mlp"))]
    test, validation = (
        pinn_dyn.evaluate(runs, split=x, horizon=0.1) for x in ("test", "validation")
    )
    errors = validation.summary.set_index("run")["error_mean"][["lnn", "mlp"]]
    chosen = test.summary.set_index("run")["validation_error_mean"]
    pd.testing.assert_series_equal(chosen[["lnn", "mlp"]], errors, check_names=False)
    assert chosen[2:].isna().all()
    assert f"The validation data prefer '{errors.idxmin()}'" in str(test)
    assert "prefer" not in str(validation)


def test_an_interval_holds_the_predictions_of_the_members(folders):
    run = pinn_dyn.ensemble([pinn_dyn.load(folder) for folder in folders])
    t = np.linspace(0, 0.05, 6)
    start, u = np.zeros(6), np.ones((6, 3))
    each = np.stack([member.predict(start, u, t) for member in run.members])
    assert (each[0] != each[1]).any()
    low, high = run.predict_interval(start, u, t, factor=1)
    # Student's t with one degree of freedom at 97.5 %.
    reach = 12.7062 * (3 / 2) ** 0.5 * each.std(axis=0, ddof=1)
    np.testing.assert_allclose(0.5 * (low + high), each.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(0.5 * (high - low), reach, rtol=1e-4, atol=1e-9)
    twice = run.predict_interval(start, u, t, factor=2)
    np.testing.assert_allclose(twice[1] - twice[0], 2 * (high - low))
    narrow = run.predict_interval(start, u, t, level=0.5, factor=1)
    assert (narrow[1] - narrow[0] <= high - low).all()
    np.testing.assert_allclose(run.predict(start, u, t), each.mean(axis=0), atol=1e-12)
    # By default, validation scales the spread, and adds a floor to each coordinate.
    wide = run.predict_interval(start, u, t)
    squares = [(0.5 * (b - a))[1:] ** 2 for a, b in (wide, (low, high))]
    change, expected = (x - x[:1] for x in squares)
    scale = change.sum() / expected.sum()
    np.testing.assert_allclose(change, scale * expected, atol=1e-6 * abs(change).max())
    assert (squares[0] > scale * squares[1]).all()
    np.testing.assert_array_equal(wide[0][0], wide[1][0])
