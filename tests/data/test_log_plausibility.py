"""Logs that can be read and are wrong: each is refused or warned of, by file, column and row."""

import gzip

import numpy as np
import pytest
from scipy.io import savemat

from pinn_dyn.data.logs import Deduplicate, LogError, MovingAverage, RemoveJumps
from tests.data.logs_files import motion, source, write


def warnings_of(log):
    return log.report.split("## Warnings\n")[1].split("\n## ")[0].strip()


def warned(folder, table, **changes):
    write(folder, table)
    return warnings_of(source(folder, **changes))


def refused(folder, table, message, **changes):
    write(folder, table)
    with pytest.raises(LogError, match=message):
        source(folder, **changes).load()


def put(row, column, value):
    table = motion()
    table.loc[row, column] = value
    return table


# Velocities.


def test_a_velocity_of_zero(tmp_path):
    text = warned(tmp_path, motion().assign(v2=0.0))
    assert text == (
        "- columns 'q2' and 'v2': v is not the derivative of q, their correlation is 0.00, "
        "expected nearly 1: v is zero throughout"
    )


def test_exchanged_velocities(tmp_path):
    table = motion()
    text = warned(tmp_path, table.assign(v1=table["v2"], v2=table["v1"]))
    assert "columns 'q1' and 'v1': v is not the derivative of q" in text
    assert "'v2' fits it: are columns of v exchanged?" in text
    assert "'v1' fits it: are columns of v exchanged?" in text


def test_a_velocity_of_noise(tmp_path):
    noise = np.random.default_rng(0).normal(size=1001)
    text = warned(tmp_path, motion().assign(v1=noise))
    assert text.count("\n") == 0
    assert text.startswith("- columns 'q1' and 'v1': v is not the derivative of q")
    assert text.endswith("is this the right column?")


def test_a_noisy_velocity_that_fits_is_let_through(tmp_path):
    table = motion()
    table["v1"] += 0.5 * table["v1"].std() * np.random.default_rng(0).normal(size=len(table))
    assert warned(tmp_path, table) == "- none"


# Angles.


@pytest.mark.parametrize(("unit", "turn"), [("rad", 2 * np.pi), ("deg", 360.0)])
@pytest.mark.parametrize("low", [0.5, 0.0], ids=["half", "full"])
def test_an_angle_that_wraps(tmp_path, unit, turn, low):
    table = motion()
    angle = turn * 0.15 * table["t"] + 0.01 * turn
    table["q2"], table["v2"] = (angle + low * turn) % turn - low * turn, turn * 0.15
    line = int(np.abs(table["q2"].diff()).gt(turn / 2).idxmax()) + 2
    refused(
        tmp_path,
        table,
        rf"run.csv, line {line}, column 'q2' \(q\): the angle wraps from .*numpy.unwrap",
        q=dict(columns=["q1", "q2"], unit=["rad", unit]),
        v=dict(columns=["v1", "v2"], unit=["rad/s", f"{unit}/s"]),
    )


# Jumps, spikes, numbers for no value.


def test_a_jump_that_stays(tmp_path):
    table = motion()
    table.loc[300:, "q1"] += 0.4
    text = warned(tmp_path, table)
    assert "run.csv, line 302, column 'q1' (q): a jump to " in text
    assert "add a RemoveJumps step" in text


def test_a_spike_of_each_signal(tmp_path):
    assert "line 302, column 'q1' (q): a jump to 1 rad" in warned(tmp_path, put(300, "q1", 1.0))
    assert "line 302, column 'v1' (v): a spike to 50 rad/s" in warned(
        tmp_path, put(300, "v1", 50.0)
    )
    assert "line 302, column 'u1' (u): a spike to -400 Nm" in warned(
        tmp_path, put(300, "u1", -400.0)
    )


def test_jumps_that_a_step_removes_need_no_warning(tmp_path):
    steps = dict(jumps=RemoveJumps(threshold=0.2, window=7))
    assert warned(tmp_path, put(300, "q1", 3.0), steps=steps) == "- none"


@pytest.mark.parametrize("column", ["q2", "v2", "u2"])
def test_a_number_for_no_value(tmp_path, column):
    refused(
        tmp_path,
        put(300, column, 1e300),
        rf"line 302, column '{column}' \(.\): the value is 1e\+300 .* stands for 'no value'",
    )


def test_steps_of_the_input_and_starts_from_rest_are_no_spikes(tmp_path):
    t = np.arange(1001) / 100
    q = np.where(t < 3, 0, 1 - np.exp(-5 * (t - 3).clip(0)))
    v = np.where(t < 3, 0, 5 * np.exp(-5 * (t - 3).clip(0)))
    table = motion().assign(q1=q, v1=v, u1=np.where(t < 3, 0.0, 5.0))
    assert "line" not in warned(tmp_path, table)


# Runs.


def test_two_runs_row_by_row(tmp_path):
    one, other = motion(), motion(phase=2.0)
    table = one.copy()
    table.iloc[1::2, 1:] = other.iloc[1::2, 1:]
    refused(tmp_path, table, r"run.csv, line 3, column 'q1' \(q\): rows go to and fro.*trajectory")


def test_two_runs_of_equal_times_are_not_deduplicated_away(tmp_path):
    table = np.repeat(motion().to_numpy(), 2, axis=0)
    table[1::2, 1:] = motion(phase=2.0).to_numpy()[:, 1:]
    table = (
        motion()
        .iloc[:0]
        .reindex(range(len(table)))
        .assign(**dict(zip(motion().columns, table.T, strict=True)))
    )
    steps = dict(once=Deduplicate())
    refused(tmp_path, table, r"line 3, column 'q1' \(q\): rows go to and fro", steps=steps)


def three_runs(folder, tables, **changes):
    for name, table in zip("abc", tables, strict=True):
        write(folder, table, f"{name}.csv")
    parts = dict(validation=dict(seconds=1.0, piece=1.0), test=dict(runs=["c"], piece=1.0))
    return source(folder, **{**parts, **changes})


def test_copies_of_runs(tmp_path):
    a, b = motion(), motion(phase=3.0)
    with pytest.raises(LogError, match=r"c, in test, is a copy of b, in validation"):
        three_runs(tmp_path, [a, b, b], validation=dict(runs=["b"], piece=1.0)).load()
    text = warnings_of(three_runs(tmp_path, [a, a, b]))
    assert "b is a copy of a, number by number (both train)" in text


def test_a_test_that_repeats_a_training_motion(tmp_path):
    a, b = motion(), motion(phase=3.0)
    again = a[200:601].reset_index(drop=True)
    rng = np.random.default_rng(0)
    for name in ("q1", "q2"):
        again[name] += 0.01 * again[name].std() * rng.normal(size=len(again))
    text = warnings_of(three_runs(tmp_path, [a, b, again]))
    assert "test: 4 of the motions of c repeat one of a, which is in the training" in text
    assert warnings_of(three_runs(tmp_path, [a, b, motion(4.0, phase=1.3)])) == "- none"


# Rest.


def test_a_robot_at_rest(tmp_path):
    refused(tmp_path, motion().assign(q1=0.3, q2=0.0, v1=0.0, v2=0.0), "no coordinate .* moves")
    text = warned(tmp_path, motion().assign(q1=0.3, v1=0.0))
    assert text == "- column 'q1' (q): never moves in the training runs"
    noise = 1e-3 * np.random.default_rng(0).normal(size=(2, 1001))
    text = warned(tmp_path, motion().assign(q1=noise[0], v1=noise[1]))
    assert (
        text == "- column 'q1' (q): moves no more than its noise in the training runs, 0.000997 rad"
    )
    table = motion(100.0)
    table.loc[500:, ["q1", "q2"]] = table.loc[500, ["q1", "q2"]].to_numpy()
    table.loc[500:, ["v1", "v2"]] = 0.0
    assert "the robot is at rest for 95 % of the training samples" in warned(tmp_path, table)


def test_an_input_that_only_moves_in_the_test(tmp_path):
    table = motion()
    table.loc[:799, "u2"] = 0.25
    text = warned(tmp_path, table, validation=dict(seconds=1.0, piece=1.0))
    assert "column 'u2' (u): is 0.25 Nm in all training runs and moves in run" in text


# Files.


def test_two_columns_of_one_name(tmp_path):
    text = motion().to_csv(index=False).replace("v2", "q1", 1)
    (tmp_path / "run.csv").write_text(text)
    both = dict(v=dict(columns=["v1"], unit="rad/s"), q=dict(columns=["q1"], unit="rad"))
    with pytest.raises(LogError, match=r"2 columns have the name 'q1', which q .*numbers 2, 6"):
        source(tmp_path, **both).load()
    other = dict(v=None, q=dict(columns=["q2"], unit="rad"), u=dict(columns=["u2"], unit="Nm"))
    assert source(tmp_path, **other).load().train


def test_decimal_commas(tmp_path):
    text = motion().to_csv(index=False, sep=";", decimal=",", float_format="%.6f")
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(
        LogError, match=r"line 2, column 't' \(time\): .*'0,000000'.* decimal comma"
    ):
        source(tmp_path).load()


def test_gzip(tmp_path):
    text = motion().to_csv(index=False, float_format="%.12g").encode()
    (tmp_path / "run.csv.gz").write_bytes(gzip.compress(text))
    log = source(tmp_path, files="*.gz")
    assert log.load().train[0].q.shape == (601, 2)
    assert log.cleaned[0].raw.run == "run"
    (tmp_path / "run.csv.gz").write_bytes(gzip.compress(text)[:2000])
    with pytest.raises(LogError, match=r"run.csv.gz: cannot be read as CSV"):
        source(tmp_path, files="*.gz").load()


@pytest.mark.parametrize(
    ("q", "message"),
    [
        (np.ones((1001, 2)) * 1j, r"variable 'q' \(q\): holds complex numbers"),
        (np.array([[np.ones(3), np.ones(4)]], dtype=object), r"variable 'q' \(q\): is a cell"),
        (np.ones((900, 2)), r"variable 'q' \(q\): is 900 by 2, and the time has 1001 samples"),
    ],
    ids=["complex", "ragged", "short"],
)
def test_matlab_fields_that_are_no_signals(tmp_path, q, message):
    table = motion()
    log = dict(t=table[["t"]].to_numpy(), q=q, u=table[["u1"]].to_numpy())
    savemat(tmp_path / "run.mat", log)
    columns = dict(q=dict(columns=["q"], unit="rad"), u=dict(columns=["u"], unit="Nm"), v=None)
    with pytest.raises(LogError, match=message):
        source(tmp_path, files="*.mat", **columns).load()


# Descriptions.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(q=dict(columns=["q1"], unit="Nm"), v=None), "q has the column 'q1' in Nm"),
        (dict(q=dict(columns=["q1"], unit="rad/s"), v=None), "q has the column 'q1' in rad/s"),
        (dict(u=dict(columns=["u1"], unit="ms")), "u has the column 'u1' in s"),
        (dict(angles=[2]), r"angles is \[2\], expected numbers of columns"),
    ],
    ids=["force", "speed", "time", "angles"],
)
def test_units_and_angles_that_cannot_be(tmp_path, changes, message):
    with pytest.raises(LogError, match=message):
        source(tmp_path, **changes)


# Steps that destroy the data.


def test_an_average_over_the_run(tmp_path):
    text = warned(tmp_path, motion(), steps=dict(smooth=MovingAverage(900)))
    assert "smooth: MovingAverage(window=900" in text
    assert "column 1 of q has " in text
    assert "% of its spread left" in text


def test_a_threshold_below_the_noise(tmp_path):
    table = motion()
    table["q1"] += 1e-3 * np.random.default_rng(0).normal(size=len(table))
    text = warned(tmp_path, table, steps=dict(jumps=RemoveJumps(threshold=1e-4, window=5)))
    assert "% of the rows are left as they were" in text
    assert "threshold is below the noise" in text
