"""Data frames as logs: how they are split, and how their cleaning reaches a prediction."""

import numpy as np
import pandas as pd
import pytest
import torch

import pinn_dyn
from pinn_dyn.data import LogSource
from pinn_dyn.data.logs import Deduplicate, InputDelay, InputRates, Resample, SubtractStart
from pinn_dyn.run.predict_frame import predict_frame
from tests.support.linear import unit_masses


def motion(runs, rate=50, seconds=4.0, start=0.0):
    """Runs of one coordinate in mm under a force in N; the lengths may differ."""
    tables = []
    for k in range(runs):
        t = np.arange(round(rate * seconds) + 1) / rate
        q = 1000 * np.sin((1 + 0.1 * k) * t + k)
        tables.append(
            pd.DataFrame({"run": f"r{k}", "t": t + start, "x": q, "f": np.cos(t * (k + 1))})
        )
    return pd.concat(tables, ignore_index=True)


def log(**changes):
    arguments = dict(
        name="log",
        root=".",
        files="*.csv",
        trajectory="run",
        time={"columns": "t", "unit": "s"},
        q={"columns": "x", "unit": "mm", "sign": -1, "offset": 3.0},
        u={"columns": "f", "unit": "N"},
        validation={"runs": 1, "piece": 1.0},
        test={"runs": 1, "piece": 1.0},
    )
    return LogSource(**{**arguments, **changes})


def predicted(frame, **changes):
    model = unit_masses(1)
    with torch.no_grad():
        return predict_frame(model, log(**changes), frame)


def test_units_signs_and_offsets_come_back():
    frame = motion(2, start=7.0)
    found = predicted(frame)
    firsts = frame.groupby("run").head(1).index
    np.testing.assert_allclose(found.x[firsts], frame.x[firsts])
    slope = np.gradient(found.x.to_numpy()[:200], 0.02)
    np.testing.assert_allclose(found["dx/dt"][2:198], slope[2:198], rtol=1e-2, atol=2.0)


def test_a_measured_velocity_keeps_its_name_and_unit():
    frame = motion(1).assign(rate=5.0)
    found = predicted(frame, v={"columns": "rate", "unit": "mm/s"})
    assert list(found.columns) == ["x", "rate"]
    assert found.rate[0] == pytest.approx(5.0)


def test_an_input_delay_leaves_its_first_rows_open_and_shifts_the_input():
    frame = motion(1)
    found = predicted(frame, steps={"delay": InputDelay(delay=0.1)})
    assert found.isna().all(axis=1).sum() == 5
    moved = frame[5:].assign(f=frame.f[:-5].to_numpy())
    # One velocity of a start from the whole run, the other from its later part.
    np.testing.assert_allclose(found.x[5:], predicted(moved).x, atol=2.0)


def test_rows_that_the_cleaning_drops_or_moves_are_predicted_all_the_same():
    frame = motion(1)
    doubled = pd.concat([frame, frame[10:12]]).sort_values("t", ignore_index=True)
    found = predicted(doubled, steps={"once": Deduplicate()})
    np.testing.assert_allclose(found.drop_duplicates().x, predicted(frame).x)
    finer = predicted(frame, steps={"finer": Resample(rate=100, max_gap=0.1)})
    np.testing.assert_allclose(finer.x, predicted(frame).x, atol=5.0)
    assert finer.notna().all(axis=None)


def test_steps_that_change_the_signals_are_applied():
    frame = motion(1)
    ((_, raw, clean),) = log(steps={"rates": InputRates(), "zero": SubtractStart(1)}).recordings(
        frame
    )
    assert clean.u.shape == (201, 2)
    np.testing.assert_allclose(clean.q, raw.q - raw.q[0])
    assert raw.v is None
    assert clean.v.shape == (201, 1)


def test_a_model_of_fixed_steps_is_drawn_on_lines_between_them():
    class Still(torch.nn.Module):
        fixed_step = 0.04

        def predict(self, start, t, input):
            return start.unsqueeze(-2) + t[:, None] * torch.tensor([1.0, 0.0])

    frame = motion(1)
    found = predict_frame(Still(), log(), frame)
    np.testing.assert_allclose(found.x, frame.x[0] - 1000 * frame.t, atol=1e-9)
    with pytest.raises(ValueError, match=r"in steps of 0.04 s, no multiple of .* 0.03 s"):
        predict_frame(Still(), log(), motion(1).assign(t=np.arange(201) * 0.03))


def test_oscillators_fit_a_short_log_by_default(tmp_path):
    """Up to 0.5 Hz for 4 s: steps far longer than 20 ms, and windows of at most half a run."""
    columns = dict(q=["x"], u=["f"], run="run", folder=tmp_path / "run")
    run = pinn_dyn.fit(motion(3), **columns, model="oscillators", steps=1)
    step = run.statistics.step
    assert step > 0.05
    assert 1 < len(run.statistics.qv_increment_std) * step <= 2
