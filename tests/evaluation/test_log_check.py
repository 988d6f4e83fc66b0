"""The numbers of a log's check against what the log was made of."""

import numpy as np
import pandas as pd
import pytest

from pinn_dyn.data.logs import LogSource, Recording
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
    assert "delay: 0.03}" in found.suggestion
    assert "inertia not identified: none" in str(found)
    assert found.runs["sample time [ms]"].tolist() == pytest.approx([10.0] * 3)
    assert (found.coordinates["own share of a"] > 0.05).all()


def test_a_joint_that_follows_another_cannot_be_identified(tmp_path, item):
    table = columns(item)
    table["q2"] = 0.5 * log("arm", 0, 0.03, noise=0.0).q[:, 0]
    table["q1"] = 2 * table["q2"]
    found = check_log(source(tmp_path, table))
    assert (found.coordinates["own share of a"] < 1e-6).all()
    assert sum("inertia cannot be told" in text for text in found.warnings) == 2
    assert found.unidentified == ["q1 [rad]", "q2 [rad]"]


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


def test_the_noise_of_a_measured_velocity_is_its_own(tmp_path, item):
    table = columns(item)
    v = np.gradient(log("arm", 0, 0.03, noise=0.0).q, item.t, axis=0)
    noise = np.random.default_rng(1).normal(size=v.shape) * [0.01, 0.03]
    table |= {f"v{k + 1}": (v + noise)[:, k] for k in range(2)}
    measured = source(tmp_path, table, v=dict(columns=["v1", "v2"], unit="rad/s"))
    assert check_log(measured).coordinates["noise of v"].tolist() == pytest.approx(
        [0.01, 0.03], rel=0.15
    )


def test_motions_that_come_twice_give_the_floor(tmp_path, item):
    """Two runs of one motion: they differ by the noise of both, and by a shift of 0.4 samples."""
    clean, rng = log("arm", 0, 0.03, noise=0.0), np.random.default_rng(2)
    spread = 1e-3 * np.ptp(clean.q, axis=0)
    late = np.column_stack([np.interp(item.t - 0.004, item.t, x) for x in clean.q.T])
    for k, q in enumerate((clean.q, late, item.q[::-1])):
        table = columns(
            Recording("run", item.t, q + spread * rng.normal(size=q.shape), None, item.u)
        )
        pd.DataFrame(table).to_csv(tmp_path / f"{k}.csv", index=False)
    splits = {"test": dict(runs=["1"], piece=4.0), "validation": dict(runs=["2"], piece=4.0)}
    found = check_log(source(tmp_path, columns(item), **splits, files="[0-2].csv"))
    assert found.figures["motions that repeat one of the training"] == 3
    np.testing.assert_allclose(found.coordinates["floor of q"], spread, rtol=0.15)
    assert (found.coordinates["floor of v"] > 0).all()
