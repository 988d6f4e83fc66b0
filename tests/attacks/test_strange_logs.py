"""Logs as strangers have them: one run in other units, signals twice, packed or with a preamble."""

import bz2
import gzip
import lzma

import numpy as np
import pytest

from pinn_dyn.data.logs import LogError, RowClock
from tests.data.logs_files import motion, source, write

RUNS = dict(validation=dict(runs=["b"], piece=1.0), test=dict(runs=["c"], piece=1.0))


def warnings(folder, runs, **changes):
    """Of a log of these runs: a, b (validation), c (test) and those with other names."""
    usual = {"a": motion(), "b": motion(phase=1.0), "c": motion(phase=2.5)}
    for name, table in {**usual, **runs}.items():
        write(folder, table, f"{name}.csv")
    return source(folder, **{**RUNS, **changes}).warnings


def scaled(factor, *names):
    table = motion(phase=3.3)
    table[list(names)] *= factor
    return table


def test_usual_runs_and_one_that_moves_one_input_alone_need_no_warning(tmp_path):
    rare = motion(phase=1.7)
    for name in ("q1", "v1", "u1"):
        rare[name] *= 60
    columns = dict(q=dict(columns=["q1", "q2"], unit="m"), v=dict(columns=["v1", "v2"], unit="m/s"))
    assert warnings(tmp_path, {"d": rare}, **columns) == []


@pytest.mark.parametrize("run", ["b", "c", "d"])
@pytest.mark.parametrize(("factor", "said"), [(-1, "-1"), (180 / np.pi, "0.01745")])
def test_velocities_of_one_run_have_another_unit_or_sign(tmp_path, run, factor, said):
    split = {"b": "validation", "c": "test", "d": "train"}[run]
    text = "\n".join(warnings(tmp_path, {run: scaled(factor, "v2")}))
    assert f"{run} ({split}), columns 'q2' and 'v2': the derivative of q is {said} times v" in text
    assert "and 'v1'" not in text


def test_velocities_of_one_run_are_zero(tmp_path):
    (text,) = warnings(tmp_path, {"c": scaled(0, "v1")})
    assert text == "c (test), columns 'q1' and 'v1': v is zero throughout this run, while q moves"


@pytest.mark.parametrize("run", ["b", "c", "d"])
def test_inputs_of_one_run_have_another_unit(tmp_path, run):
    assert [
        text
        for text in warnings(tmp_path, {run: scaled(1000, "u1", "u2")})
        if text.startswith(f"{run}: u spreads ") and text.endswith("has this run other units?")
    ]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.assign(u2=3 - 2 * t.u1), "'u1' (u) and 'u2' (u) are the same signal but for"),
        (lambda t: t.assign(u1=t.q1), "columns 'q1' (q) and 'u1' (u) are the same signal but for"),
    ],
    ids=["inputs", "an input that is a coordinate"],
)
def test_one_signal_twice(tmp_path, change, said):
    runs = {name: change(motion(phase=k)) for k, name in enumerate("abc")}
    assert any(said in text for text in warnings(tmp_path, runs))


@pytest.mark.parametrize("value", [0.0, -999.0])
def test_a_value_for_none_in_many_rows(tmp_path, value):
    """So many that the jumps are not unusual any more."""
    table = motion()
    table.loc[np.random.default_rng(0).choice(len(table), 60, replace=False), "q1"] = value
    said = f"column 'q1' (q): the value {value:.5g} rad comes in "
    assert any(said in text for text in warnings(tmp_path, {"a": table}))


def test_a_validation_that_repeats_a_training_motion(tmp_path):
    again = motion()[100:501] * 1.000001
    (text,) = warnings(tmp_path, {"b": again})
    assert text.startswith("validation: 4 of the motions of b repeat one of a")


def test_rows_that_are_written_twice_get_no_clock_of_their_numbers(tmp_path):
    table = motion()
    write(tmp_path, table.loc[table.index.repeat(2)])
    with pytest.raises(LogError, match="they were written twice; put Deduplicate before it"):
        source(tmp_path, steps={"clock": RowClock(longest=0.1)}).load()


CSV = motion(6.0).to_csv(index=False)
LINES = CSV.splitlines()
FILES = {
    "a gzip": (gzip.compress(CSV.encode()), "packed by gzip: end its name in .gz"),
    "an xz": (lzma.compress(CSV.encode()), "packed by xz: unpack it"),
    "a bzip2": (bz2.compress(CSV.encode()), "packed by bzip2: unpack it"),
    "Excel": (b"PK\x03\x04" + bytes(range(256)), "or a table of Excel: .* save it as CSV"),
    "macOS": (b"\x00\x05\x16\x07" + bytes(range(256)), "macOS writes such files .* delete it"),
    "a line of Excel": (b"sep=;\n" + CSV.replace(",", ";").encode(), "line 1 is 'sep=;'"),
    "a preamble": (b"Logger 1\n\n" + CSV.encode(), "line 1 has 1 columns and line 3 has 7"),
    "names of rows": (
        "\n".join([LINES[0], *(f"{k},{line}" for k, line in enumerate(LINES[1:]))]).encode(),
        "line 1 has 7 columns and line 2 has 8: .*name each column",
    ),
    "dates": (
        motion(6.0).assign(t=[f"2026-11-25T10:00:{x / 100:09.6f}" for x in range(601)])
        .to_csv(index=False).encode(),
        "write seconds instead, as by .*total_seconds",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("content", "said"), FILES.values(), ids=FILES)
def test_what_to_do_with_a_file_that_is_no_table(tmp_path, content, said):
    (tmp_path / "run.csv").write_bytes(content)
    with pytest.raises(LogError, match=said):
        source(tmp_path).load()
