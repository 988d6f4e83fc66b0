"""Data frames as logs: how they are split, and how their cleaning reaches a prediction."""

import numpy as np
import pandas as pd
import pytest
import torch
import yaml

from examples.cleaning_steps import PolynomialFit, SubtractStart
from pinn_dyn.app.frame import frame_dataset
from pinn_dyn.app.predict_frame import predict_frame
from pinn_dyn.data import LogSource
from pinn_dyn.data.logs import Deduplicate, InputDelay, InputRates, Resample, SplitGaps
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


def dataset(folder, frame, run="run", seed=0):
    """The data set that fit writes for a frame, and the settings that go with it."""
    signals = {"time": "t", "q": {"columns": "x", "unit": "mm"}, "u": "f"}
    words = frame_dataset(frame, signals, run, seed, folder)
    settings = {key: float(value) for key, value in (w.split("=") for w in words[3:])}
    values = yaml.safe_load((folder / "dataset" / "frame.yaml").read_text())
    assert values.pop("defaults") == ["csv_log", "_self_"]
    return LogSource(**values), settings


@pytest.mark.parametrize("runs", [1, 3, 5, 12])
def test_a_split_leaves_training_and_keeps_tests_apart(tmp_path, runs):
    source, settings = dataset(tmp_path, motion(runs))
    splits = source.load()
    assert min(map(len, (splits.train, splits.validation, splits.test))) >= 1
    parts = source.fingerprint()["splits"]
    if runs >= 5:  # whole runs
        names = {key: {place.split()[0] for place in places} for key, places in parts.items()}
        assert not names["train"] & (names["test"] | names["validation"])
        assert sum(map(len, names.values())) == runs
        assert splits.test[0].duration == pytest.approx(4.0)
    else:
        assert splits.test[0].duration == pytest.approx(0.6)
        assert sum(item.duration for item in splits.train) < runs * (4 - 1.2)
    horizon = settings["validator.horizon"]
    assert horizon <= splits.validation[0].duration + 1e-9
    span = settings["data.steps"] * settings["data.stride"]
    starts = sum(max(len(item.t) - span, 0) for item in splits.train)
    assert 0.9 * starts <= settings["data.pairs"] <= starts
    assert settings["data.batch_size"] <= settings["data.pairs"]


def test_windows_last_as_long_at_any_rate(tmp_path):
    for rate, stride in ((50, 1), (25, 1), (1000, 20)):
        _, settings = dataset(tmp_path / str(rate), motion(5, rate=rate, seconds=2.0))
        assert settings["data.stride"] == stride
    assert settings["data.batch_size"] == 128


def test_a_long_log_is_cut_into_pieces_and_short_runs_are_trained_on(tmp_path):
    frame = pd.concat([motion(5, seconds=12.0), motion(2, seconds=1.0).assign(run="short")])
    frame = frame[~((frame.run == "short") & frame.duplicated(["run", "t"]))]
    source, _ = dataset(tmp_path, frame)
    splits = source.load()
    assert {item.duration for item in splits.test} == {5.0}
    assert "short" not in source.test.names + source.validation.names


def test_another_seed_draws_other_runs(tmp_path):
    drawn = {tuple(dataset(tmp_path / str(k), motion(12), seed=k)[0].test.names) for k in range(4)}
    assert len(drawn) > 1


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


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        (PolynomialFit(degree=3, segment=1.0), "steps.own leaves 3 stretches"),
        (SplitGaps(longest=0.01), "steps.own leaves 0 stretches"),
    ],
)
def test_a_step_that_no_frame_can_take_is_named(step, expected):
    with pytest.raises(ValueError, match=expected):
        predicted(motion(1), steps={"own": step})


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
