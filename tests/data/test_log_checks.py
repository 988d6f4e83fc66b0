"""Bad logs: each is refused or measured as a warning, by its place and with a cure."""

import re

import numpy as np
import pandas as pd
import pytest
import yaml
from hydra.utils import instantiate

import pinn_dyn
from pinn_dyn.data.logs import (
    Deduplicate,
    LogError,
    RemoveJumps,
    Resample,
    RowClock,
)
from pinn_dyn.data.logs.check.checks import _are_ticks
from pinn_dyn.data.logs.registers import rows_before_first_sample
from pinn_dyn.log_check.chain import SIGN
from pinn_dyn.log_check.check import check
from tests.data.logs_files import motion, source, write

RESAMPLE = {"resample": Resample(rate=100.0, max_gap=0.2)}
RUNS = dict(validation=dict(runs=["b"], piece=1.0), test=dict(runs=["c"], piece=1.0))


def refused(folder, table, message, **changes):
    write(folder, table)
    with pytest.raises(LogError, match=f"(?s){message}"):
        source(folder, **changes).load()


def warned(folder, table, **changes):
    write(folder, table)
    return "\n".join(source(folder, **changes).warnings)


def checked(folder, table):
    """Texts of the check of a log about units of angles and signs of forces."""
    write(folder, table)
    names = ("largest angle [rad]", SIGN)
    found = [x for x in check(source(folder)).measurements if x.verdict != "ok"]
    return "\n".join(x.text for x in found if x.name in names)


def warned_of_runs(folder, runs):
    """Warnings of a log of the runs a (training), b (validation), c (test) and others."""
    usual = {"a": motion(), "b": motion(phase=1.0), "c": motion(phase=2.5)}
    for name, table in {**usual, **runs}.items():
        write(folder, table, f"{name}.csv")
    return "\n".join(source(folder, **RUNS).warnings)


def put(row, column, value):
    table = motion().astype(object)
    table.loc[row, column] = value
    return table


def clock(change):
    table = motion()
    table["t"] = change(table["t"].to_numpy().copy())
    return table


def repeat(t):
    t[400] = t[399]
    return t


def alternating(first, second):
    table = first.copy()
    table.iloc[1::2, 1:] = second.iloc[1::2, 1:]
    return table


def wrapped(turn):
    angle = turn * 0.15 * motion()["t"] + 0.01 * turn
    return motion().assign(q2=angle % turn, v2=turn * 0.15)


def in_bursts(rows=8, apart=0.0):
    """The log of ``motion``, written by a logger that empties its buffer every so many rows."""
    table = motion()
    t, number = table["t"].to_numpy(), np.arange(len(table))
    # A burst is written after its last row.
    written = t[np.minimum(rows * (number // rows) + rows - 1, len(t) - 1)]
    return table.assign(t=written + 0.002 + apart * (number % rows))


BAD = {
    "name": (motion().rename(columns={"q2": "q_2"}), r"no column 'q2'.*mean q_2.*has t, q1"),
    "text": (put(41, "q2", "broken"), r"run.csv, line 43, column 'q2' \(q\): .*'broken'"),
    "1e300": (put(300, "v2", 1e300), r"line 302, column 'v2' \(v\): .*1e\+300 .*'no value'"),
    "back": (clock(lambda t: np.arange(1001) % 40 / 100), r"line 42.*from 0.39 to 0 s.*trajectory"),
    "repeat": (clock(repeat), r"line 402, column 't': the time repeats from 3.99.*Deduplicate"),
    "jump": (clock(lambda t: np.where(t > 3, t + 1, t)), r"line 303.*from 3 to 4.01.*SplitGaps"),
    "jitter": (clock(lambda t: t + 0.004 * np.sin(40 * t)), r"needs a uniform clock.*Resample"),
    "bursts": (in_bursts(), r"line 3, column 't': .* repeats .*RowClock.rate=.*, longest="),
    "empty": (motion()[:0], r"has no rows"),
    "short": (motion(2.0), r"too short for 2.0 s of test"),
    "wraps": (wrapped(2 * np.pi), r"run.csv, line \d+, column 'q2' \(q\): the angle wraps from"),
    "mixture": (alternating(motion(), motion(phase=2.0)), r"line 3, .*rows go to and fro"),
    "dates": (motion().assign(t="noon"), "line 2, column 't' .*expected a number, or a date"),
}  # fmt: skip


@pytest.mark.parametrize(("table", "message"), BAD.values(), ids=BAD)
def test_bad_files_are_refused_with_place_and_cure(tmp_path, table, message):
    refused(tmp_path, table, message)


def csv(**options):
    return motion().to_csv(index=False, float_format="%.6f", **options)


def test_a_time_in_seconds_that_is_read_as_milliseconds_is_named(tmp_path):
    write(tmp_path, motion())
    with pytest.raises(LogError, match=r"the sample time would be.*write the unit s, or"):
        source(tmp_path, time=dict(columns="t", unit="ms"), v=None).load()


def test_an_unsigned_register_is_named_with_the_number_to_subtract(tmp_path):
    table = motion()
    counts = (1000 * table["u1"]).round().astype(int)
    write(tmp_path, table.assign(u1=0.25 * (counts % 2**16)))
    first = int((counts < 0).to_numpy().argmax())
    with pytest.raises(LogError, match=rf"line {first + 2}, column 'u1'.*16 bits.*subtract 16384 "):
        source(tmp_path).load()
    for u in (0.25 * counts, 0.25 * (counts + 30000), 16383.75 * (counts > 0)):
        write(tmp_path, table.assign(u1=u))  # signed, an offset, on and off
        source(tmp_path).load()


@pytest.mark.parametrize(("count", "named"), [(0, False), (1, True), (3, True)])
def test_zeros_before_the_first_sample_are_left_out(tmp_path, count, named):
    table = motion()
    table[["q1", "q2"]] += 5.0
    table.loc[: count - 1, ["q1", "q2", "v1", "v2"]] = 0.0
    write(tmp_path, table)
    log = source(tmp_path)
    assert len(log.load().train[0].t) == 601 - count
    assert any(f"q jumps after the first {count} rows" in x for x in log.warnings) == named
    assert len(log.warnings) == named


@pytest.mark.parametrize(("count", "left_out"), [(5, 5), (20, 0)])
def test_a_long_rest_before_a_jump_is_a_motion(count, left_out):
    q = 5.0 + np.sin(0.1 * np.arange(100))[:, None]
    q[:count] = 0.0
    assert rows_before_first_sample(q) == left_out
    assert rows_before_first_sample(q[:1]) == 0  # of a run that ends at once


def gaps(rng, bursts):
    keep = rng.uniform(size=1001) > (0.0 if bursts else 0.02)
    for k in rng.integers(5, 990, 8 * bursts):
        keep[k : k + 5] = False
    return np.flatnonzero(keep)


CLOCKS = {
    "jitter": lambda rng: motion().assign(t=lambda x: x["t"] + rng.uniform(0, 1e-3, len(x))),
    "dropout": lambda rng: motion().iloc[gaps(rng, False)],
    "dropout of five rows": lambda rng: motion().iloc[gaps(rng, True)],
    "duplicates": lambda rng: motion().iloc[np.sort(np.r_[:1001, rng.integers(0, 1001, 20)])],
    "93.75 Hz": lambda rng: motion(rate=93.75).assign(
        t=lambda x: x["t"] + rng.uniform(0, 1e-3, len(x))
    ),
    "long gap": lambda rng: motion().drop(index=range(200, 290)),
}


def suggested(error, language):
    """The steps of the block at the end of a message."""
    _, block = str(error.value).split("\n\n")
    if language == "python":
        return eval(f"dict({block}\n)", {"pinn_dyn": pinn_dyn})["cleaning"]
    return instantiate(yaml.safe_load(block)["steps"], _convert_="all")


@pytest.mark.parametrize("clock", CLOCKS)
def test_the_suggested_steps_load_the_log_that_they_were_suggested_for(tmp_path, clock, language):
    write(tmp_path, CLOCKS[clock](np.random.default_rng(0)))
    with pytest.raises(LogError) as error:
        source(tmp_path).load()
    steps = suggested(error, language)
    splits = source(tmp_path, steps=steps).load()
    assert sum(len(x.t) for x in splits.train) > 450
    assert splits.train[0].t[1] == pytest.approx(0.01)


def test_two_runs_of_equal_times_are_not_deduplicated_away(tmp_path):
    rows = np.repeat(motion().to_numpy(), 2, axis=0)
    rows[1::2, 1:] = motion(phase=2.0).to_numpy()[:, 1:]
    table = pd.DataFrame(rows, columns=motion().columns)
    refused(tmp_path, table, r"line 3, .*rows go to and fro", steps=dict(once=Deduplicate()))


def test_a_run_of_another_sample_time_is_named(tmp_path):
    for name, table in zip("abc", (motion(), motion(), motion(rate=50)), strict=True):
        write(tmp_path, table, f"{name}.csv")
    message = r"c .*the sample time is 0.02 s, but that of other .* 0.01 s: .*Resample"
    with pytest.raises(LogError, match=message):
        source(tmp_path, validation=dict(seconds=1.0, piece=1.0)).load()


def test_files_that_are_not_there_and_runs_of_one_name(tmp_path):
    write(tmp_path, motion(), "b.csv")
    with pytest.raises(LogError, match=r"nothing matches .*b\.csv"):
        source(tmp_path, files="*.txt").load()
    with pytest.raises(LogError, match="absent', which is no folder"):
        source(tmp_path / "absent").load()
    write(tmp_path, motion(), "b.txt")
    with pytest.raises(LogError, match=r"both have the run name 'b'"):
        source(tmp_path, files=["*.csv", "*.txt"]).load()


def test_a_warning_is_logged_once(tmp_path, caplog):
    write(tmp_path, motion().assign(u2=0.0))
    log = source(tmp_path)
    log.load()
    assert "input 'u2' is constant" in log.report
    assert [record.getMessage() for record in caplog.records] == [
        "oscillator: input 'u2' is constant in the training runs: its effect cannot be learned"
    ]
    assert {x.name for x in log.measurements} >= {"dq/dt over v", "range of the input"}


def changed(**columns):
    return motion().assign(**columns)


def random_force(sign):
    """Two masses, and forces that their positions do not explain; the first has a sign."""
    columns = {}
    for k, factor in ((1, sign), (2, 1)):
        levels = np.random.default_rng(k).normal(size=44)
        force = np.interp(T, np.arange(0, 11, 0.25), levels)
        v = np.cumsum(force) * 0.01
        columns |= {f"v{k}": v, f"q{k}": np.cumsum(v) * 0.01, f"u{k}": factor * force}
    return changed(**columns)


def resting():
    table = motion(100.0)
    table.loc[500:, ["q1", "q2"]] = table.loc[500, ["q1", "q2"]].to_numpy()
    table.loc[500:, ["v1", "v2"]] = 0.0
    return table


def ticks(rate=500.0, resolution=2 * np.pi / 4096):
    """A slow motion, as an encoder of 12 bits measures it, with 1e-9 rad of rounding."""
    t = np.arange(0, 20, 1 / rate)
    q = np.round(0.1 * np.sin(0.9 * t) / resolution) * resolution
    q += 1e-9 * np.random.default_rng(0).normal(size=len(t))
    u = np.round(np.sin(0.9 * t) / 0.0269) * 0.0269
    table = {"t": t, "q1": q, "q2": q[::-1], "u1": u, "u2": -u}
    return pd.DataFrame(table | {f"v{k}": np.gradient(table[f"q{k}"], t) for k in (1, 2)})


def with_placeholders(table, rows, column, value):
    table.loc[rows, column] = value
    return table


NOISE = np.random.default_rng(0).normal(size=(2, 1001))
MANY = np.random.default_rng(0).choice(1001, 60, replace=False)  # jumps are not unusual any more
FEW = slice(300, 9000, 700)
T, Q1, Q2, V1, V2 = motion()[["t", "q1", "q2", "v1", "v2"]].to_numpy().T
# A start from rest, and a step of the input, are neither jumps nor spikes.
PUSHED = changed(
    q1=np.where(T < 3, 0, 1 - np.exp(-5 * (T - 3).clip(0))),
    v1=np.where(T < 3, 0, 5 * np.exp(-5 * (T - 3).clip(0))),
    u1=np.where(T < 3, 0.0, 5.0),
)
V = r"^columns 'q2' and 'v2': the derivative of q is "
AT = "run.csv, line 302, column "
AGAIN = [r"^validation: \d of the motions of run repeat", r"^test: \d of the motions of run repeat"]
WARNED = {
    # Fault: log, and a pattern of each warning in turn.
    "none": (motion(), []),
    "zero v": (changed(v2=0.0), [V + "0 times v.*right column"]),
    "v of noise": (changed(v1=NOISE[0]), ["^columns 'q1' and 'v1': .*correlation.*right column"]),
    "exchanged v": (changed(v1=V2, v2=V1), ["'v2' fits it", "'v1' fits it"]),
    "noisy v": (changed(v1=V1 + 0.5 * V1.std() * NOISE[0]), []),
    "v in degrees": (changed(v2=np.degrees(V2)), [V + "0.01745 times.*one of them is in degrees"]),
    "v reversed": (changed(v2=-V2), [V + "-1 times.*unit, scale and sign"]),
    "v halved": (changed(v2=V2 / 2), [V + "2 times.*unit, scale and sign"]),
    "still": (changed(q1=0.3, v1=0.0), [r"^column 'q1' \(q\): moves no more than its noise"]),
    "only noise": (changed(q1=1e-3 * NOISE[0], v1=NOISE[1]), ["than its noise, 0.000997"]),
    "degrees": (changed(q2=np.degrees(Q2), v2=np.degrees(V2)), []),
    "inputs": (changed(u1=1.0, u2=0.0), ["'u1' is constant", "'u2' is constant"]),
    "pushed": (PUSHED, []),
    "rest": (resting(), ["rest for 95 % of the training", "100 %", "100 %", *AGAIN]),
    "ticks": (ticks(), AGAIN),
    "ticks, -1": (
        with_placeholders(ticks(), FEW, "v1", -1.0),
        [r"column 'v1' \(v\): a spike to -1 .*'no v", *AGAIN],
    ),
    "ticks, 65535": (
        with_placeholders(ticks(), FEW, "v1", 65535.0),
        ["a spike to 65535 ", "0.0005128 times", *AGAIN],
    ),
    "spike of q": (put(300, "q1", 1.0).astype(float), [AT + r"'q1' \(q\): a jump to 1 rad"]),
    "spike of v": (put(300, "v1", 50.0).astype(float), [AT + r"'v1' \(v\): a spike to 50"]),
    "spike of u": (put(300, "u1", -400.0).astype(float), [AT + r"'u1' \(u\): a spike"]),
    "jump": (changed(q1=Q1 + 0.4 * (T >= 3)), [AT + r"'q1' \(q\): a jump to "]),
    "q often 0": (
        with_placeholders(motion(), MANY, "q1", 0.0),
        [r"line \d+, column 'q1' .* 0 rad.*'no v", "1.247 times"],
    ),
    "v often 99": (
        with_placeholders(motion(), MANY, "v1", 99.0),
        [r"line \d+, column 'v1' .* 99 rad/s.*'no v", "0.08884 times"],
    ),
    "q often -999": (
        with_placeholders(motion(), MANY, "q2", -999.0),
        [r"column 'q2' .* -999 .*'no v", "120.3 times", "than its noise"],
    ),
}


@pytest.mark.parametrize("fault", WARNED)
def test_a_fault_gets_its_warnings_and_no_others(tmp_path, fault):
    table, patterns = WARNED[fault]
    lines = warned(tmp_path, table).splitlines()
    assert len(lines) == len(patterns), lines
    for pattern, line in zip(patterns, lines, strict=True):
        assert re.search(pattern, line)


def test_the_check_names_degrees_and_a_reversed_force(tmp_path):
    degrees = changed(q2=np.degrees(Q2), v2=np.degrees(V2))
    assert re.match("run, column 'q2': an angle of ", checked(tmp_path, degrees))
    assert checked(tmp_path, random_force(1)) == ""
    assert "input 'u1' seems to push joint 1 backwards" in checked(tmp_path, random_force(-1))


def test_a_joint_that_turns_many_times_is_not_in_degrees(tmp_path):
    """A pendulum that turns over and back, and a wheel that rolls on; in degrees they swing."""
    rows = [(0.0, 9.0)]
    for force in np.repeat(motion(20.0)["u1"], 20):
        q, v = rows[-1]
        v += (15 * force - 9.81 * np.sin(q) - 0.5 * v) / 2000
        rows.append((q + v / 2000, v))
    q, v = np.transpose(rows[:-1:20])
    wheel = 5 * T + np.sin(T)
    table = motion().assign(q1=q[:1001], v1=v[:1001], q2=wheel, v2=5 + np.cos(T))
    assert np.ptp(q[:1001]) > 4 * np.pi
    assert "degrees" not in checked(tmp_path, table)
    assert checked(tmp_path, motion().assign(q1=628 * T, v1=628.0)) == ""  # 6.28 rad in each row
    assert "'q1': an angle" in checked(tmp_path, motion().assign(q1=50 * motion()["q1"]))


def test_a_free_motor_that_goes_to_and_fro_is_not_in_degrees(tmp_path):
    """A motor of 1e-4 kg m^2 with dry friction and position control, simulated at 10 kHz."""
    rows, q, v = [], 0.0, 0.0
    rng = np.random.default_rng(2)
    goals = np.repeat(rng.uniform(-100, 100, 30), 5000)
    for goal in goals[:100_100]:
        u = np.clip(2e-3 * (goal - q) - 4e-4 * v, -0.05, 0.05)
        rows.append((q, v, u))
        v += 1e-4 * (u - 0.002 * np.tanh(v) - 1e-5 * v) / 1e-4
        q += 1e-4 * v
    q, v, u = np.transpose(rows[:100_001:100])
    assert 50 < np.abs(q).max() < 180
    table = motion().assign(q1=q + 1e-3 * rng.normal(size=1001), v1=v, u1=u)
    assert "in degrees" not in checked(tmp_path, table)
    assert "'q1': an angle" in checked(tmp_path, table.assign(u1=np.roll(u, 300)))


@pytest.mark.parametrize("part", ["validation", "test"])
def test_a_robot_at_rest_outside_the_training(tmp_path, part):
    still = motion()
    still.loc[:, ["q1", "q2"]] += -still[["q1", "q2"]] + 0.1 + 1e-6 * np.arange(len(still))[:, None]
    still[["v1", "v2"]] = 1e-4
    text = warned_of_runs(tmp_path, {"b" if part == "validation" else "c": still})
    assert f"at rest for 100 % of the {part} samples" in text
    shares = [x for x in source(tmp_path, **RUNS).measurements if x.name == "share at rest"]
    assert {x.place: x.verdict for x in shares if x.verdict != "ok"} == {part: "warning"}


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        ([1.0] * 9 + [1.5, 2.0, 3.0], True),
        ([1.0] * 9, False),  # too few
        ([1.0] * 9 + [1.2, 1.3, 2.8], False),  # no multiples
        ([1.0] * 11 + [400.0], False),  # a lost value among the steps
    ],
)
def test_steps_of_a_resolution_are_many_equal_and_small(sizes, expected):
    assert _are_ticks(0.37 * np.array(sizes)) == expected


def test_a_step_removes_jumps(tmp_path):
    steps = dict(jumps=RemoveJumps(threshold=0.2, window=7))
    assert warned(tmp_path, put(300, "q1", 3.0), steps=steps) == ""


def test_copies_of_runs(tmp_path):
    text = warned_of_runs(tmp_path, {"c": motion(phase=1.0)})
    assert "test: 10 of the motions of c repeat one of b, of another split" in text


@pytest.mark.parametrize(("run", "split"), [("b", "validation"), ("c", "test")])
def test_a_motion_that_repeats_a_training_motion(tmp_path, run, split):
    again = motion()[200:601].reset_index(drop=True)
    for k in (1, 2):
        again[f"q{k}"] += 0.01 * again[f"q{k}"].std() * NOISE[k - 1][: len(again)]
    text = warned_of_runs(tmp_path, {run: again})
    assert f"{split}: 4 of the motions of {run} repeat one of a" in text
    assert warned_of_runs(tmp_path, {run: motion(4.0, phase=1.3)}) == ""


@pytest.mark.parametrize("apart", [0.0, 2e-5])
def test_bursts_of_stamps_are_warned_of_and_a_row_clock_repairs_them(tmp_path, apart):
    if apart:
        refused(tmp_path, in_bursts(apart=apart), r"the time jumps .*RowClock")
        text = warned(tmp_path, in_bursts(apart=apart), steps=RESAMPLE)
        assert "its stamps come in bursts" in text
    steps = {"clock": RowClock(longest=0.1, rate=100.0)}
    assert warned(tmp_path, in_bursts(apart=apart), steps=steps) == ""
    splits = source(tmp_path, steps=steps).load()
    assert float(splits.train[0].t[1]) == pytest.approx(0.01, rel=1e-3)
    lost = in_bursts().drop(index=range(300, 360))
    refused(tmp_path, lost, r"RowClock found the stamp .* rows are missing.*SplitGaps", steps=steps)
