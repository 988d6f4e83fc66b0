"""The numbers of a log's check against what the log was made of."""

import numpy as np
import pandas as pd
import pytest

from pinn_dyn.data.logs import LogSource
from pinn_dyn.evaluation.log_check import check_log
from tests.support.delayed_robots import log


def source(folder, table, **changes):
    pd.DataFrame(table).to_csv(folder / "run.csv", index=False)
    arguments = dict(
        name="arm",
        root=str(folder),
        files="*.csv",
        time=dict(columns="t", unit="s"),
        q=dict(columns=["q1", "q2"], unit="rad"),
        u=dict(columns=["u1", "u2"], unit="Nm"),
        validation=dict(seconds=1.0, piece=1.0),
        test=dict(seconds=2.0, piece=1.0),
    )
    return LogSource(**{**arguments, **changes})


def columns(item):
    q, u = item.q, item.u
    return {"t": item.t, "q1": q[:, 0], "q2": q[:, 1], "u1": u[:, 0], "u2": u[:, 1]}


@pytest.fixture(scope="module")
def item():
    return log("arm", 0, 0.03, noise=2e-3)


def test_noise_delay_and_coverage_are_those_of_the_log(tmp_path, item):
    found = check_log(source(tmp_path, columns(item)))
    np.testing.assert_allclose(found.coordinates["noise / range"], 2e-3, rtol=0.4)
    assert found.inputs["delay [ms]"].tolist() == pytest.approx([30, 30], abs=10)
    assert not found.problems
    assert "delay: " in found.suggestion
    assert found.runs["sample time [ms]"].tolist() == pytest.approx([10.0] * 3)
    assert (found.coordinates["own share of a"] > 0.05).all()


def test_a_joint_that_follows_another_cannot_be_identified(tmp_path, item):
    table = columns(item)
    table["q2"] = 0.5 * log("arm", 0, 0.03, noise=0.0).q[:, 0]
    table["q1"] = 2 * table["q2"]
    found = check_log(source(tmp_path, table))
    assert (found.coordinates["own share of a"] < 1e-6).all()
    assert sum("inertia cannot be told" in text for text in found.warnings) == 2


def test_a_test_outside_the_training_is_told(tmp_path, item):
    table = columns(item)
    table["q1"] = table["q1"] + 3.0 * (item.t > item.t[-1] - 2.0)
    found = check_log(source(tmp_path, table))
    assert found.coordinates["test outside"][0] > 0.8
    assert np.median(found.distance) > 3
    assert any("outside the range" in text for text in found.warnings)


def test_a_robot_that_rests_is_not_worth_a_training(tmp_path, item):
    table = columns(item)
    moving = item.t < 0.1
    for name in ("q1", "q2"):
        table[name] = np.where(moving, table[name], 0.0)
    found = check_log(source(tmp_path, table))
    assert any("rests" in text for text in found.problems)
