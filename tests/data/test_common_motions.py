"""Motions that data sets of one log have in common, however each prepares its inputs."""

import numpy as np
import pytest

from examples.cleaning_steps import SubtractStart
from pinn_dyn.data.logs import Butterworth, InputDelay, LogError, Resample, common_motions
from tests.data.logs_files import RATE, motion, source, write

DELAY = 0.05


@pytest.fixture
def log(tmp_path):
    table = motion()
    write(tmp_path, table)
    return tmp_path, table


def whole(folder, **steps):
    return source(folder, steps=steps, test=dict(seconds=2.0, piece="whole"))


def test_inputs_are_those_of_each_source_at_the_times_of_the_first(log):
    folder, table = log
    delayed = whole(folder, delay=InputDelay(delay=DELAY))
    ((plain,), (late,)) = common_motions([whole(folder), delayed], "test")
    lag = round(DELAY * RATE)
    # The last 2 s of the file; the delay leaves its first samples without an input.
    rows = table.iloc[len(table) - plain.t.shape[0] :]
    assert plain.t.shape[0] == 2 * RATE + 1 - lag
    for one in (plain, late):
        np.testing.assert_allclose(one.q, rows[["q1", "q2"]], atol=1e-9)
        np.testing.assert_allclose(one.v, rows[["v1", "v2"]], atol=1e-9)
    before = table.shift(lag).loc[rows.index]
    np.testing.assert_allclose(plain.u, rows[["u1", "u2"]], atol=1e-9)
    np.testing.assert_allclose(late.u, before[["u1", "u2"]], atol=1e-9)
    assert np.abs(plain.u - late.u).max() > 0.05
    # What was cut away is the past of what is left.
    cut = table.iloc[rows.index[0] - lag : rows.index[0]]
    np.testing.assert_allclose(plain.past, cut[["u1", "u2"]], atol=1e-9)
    assert late.past.shape[0] == 0


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_inputs_of_a_lower_rate_are_taken_between_their_samples(log, interpolation):
    folder, table = log
    slow, fast = (
        source(
            folder,
            steps=dict(resample=Resample(rate=rate, max_gap=0.1)),
            interpolation=interpolation,
        )
        for rate in (RATE / 2, RATE)
    )
    fine, coarse = common_motions([fast, slow], "test")
    assert len(fine) == len(coarse) == 2
    for one, other in zip(fine, coarse, strict=True):
        np.testing.assert_array_equal(one.t, other.t)
        u = one.u.numpy()
        np.testing.assert_allclose(other.u[::2], u[::2], atol=1e-9)
        between = (u[:-2:2] + u[2::2]) / 2 if interpolation == "linear" else u[:-2:2]
        np.testing.assert_allclose(other.u[1::2], between, atol=1e-9)
        assert other.input.interpolation == interpolation
    first = table.iloc[len(table) - 2 * int(RATE) - 1]
    np.testing.assert_allclose(fine[0].q[0], first[["q1", "q2"]], atol=1e-6)


def test_a_motion_without_inputs_in_one_of_the_sources_is_left_out(tmp_path, caplog):
    for k in range(4):
        write(tmp_path, motion(3.0, phase=k), f"run_{k}.csv")
    parts = dict(validation=dict(runs=["run_2"], piece=1.0), test=dict(runs=["run_3"], piece=1.0))
    plain = source(tmp_path, **parts)
    late = source(tmp_path, **parts, steps=dict(delay=InputDelay(delay=1.5)))
    found = common_motions([plain, late], "test")
    # Of the three pieces the first has no input, and the second half of one.
    assert [[one.t.shape[0] for one in motions] for motions in found] == [[51, 101]] * 2
    assert "1 of 3 motions of oscillator have no inputs" in caplog.text


def test_no_motion_in_common_is_refused(tmp_path):
    for k in range(4):
        write(tmp_path, motion(3.0, phase=k), f"run_{k}.csv")
    first, second = (
        source(
            tmp_path,
            validation=dict(runs=["run_2"], piece=1.0),
            test=dict(runs=[run], piece=1.0),
        )
        for run in ("run_3", "run_0")
    )
    with pytest.raises(LogError, match="no motion has inputs in every preparation of oscillator"):
        common_motions([first, second], "test")


def test_a_step_that_makes_other_coordinates_is_refused(log):
    folder, _ = log
    shifted = whole(folder, start=SubtractStart(samples=1))
    with pytest.raises(LogError, match=r"make coordinate 1 differ by .*Evaluate the runs"):
        common_motions([whole(folder), shifted], "test")
    filtered = whole(folder, filter=Butterworth(cutoff=2.0))
    assert len(common_motions([whole(folder), filtered], "test")[1]) == 1
