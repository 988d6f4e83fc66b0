"""Signals in several tables, with clocks of their own, with empty cells, and in long tables."""

import json

import numpy as np
import pandas as pd
import pytest

from pinn_dyn.data.logs import LogError, SplitGaps
from tests.data.logs_files import motion, source, write

TABLE = motion()
T, Q, V, U = ["t"], ["q1", "q2"], ["v1", "v2"], ["u1", "u2"]


def parts(table, clock=True):
    return {
        "pos": table[T + Q],
        "vel": table[(T if clock else []) + V],
        "eff": table[(T if clock else []) + U],
    }


def assert_equal(log, table=TABLE, atol=0.0):
    """All rows of the log are those of the table."""
    for part in log.cleaned:
        rows = np.round(100 * part.raw.t).astype(int)
        for key in "qvu":
            values = table[[f"{key}1", f"{key}2"]].to_numpy()[rows]
            np.testing.assert_allclose(getattr(part.raw, key), values, atol=atol + 1e-11)


@pytest.mark.parametrize(
    ("clock", "ending"), [("all files", "csv"), ("file of q", "npz"), ("own file", "json")]
)
def test_signals_in_files_with_the_same_rows_are_one_run(tmp_path, clock, ending):
    tables = parts(TABLE, clock == "all files")
    if clock == "own file":
        tables |= {"pos": TABLE[Q], "time": TABLE[T]}
    for name, table in tables.items():
        arrays = {key: column.to_numpy() for key, column in table.items()}
        if ending == "csv":
            write(tmp_path, table, f"{name}.csv")
        elif ending == "npz":
            np.savez(tmp_path / f"{name}.npz", **arrays)
        else:
            text = json.dumps({key: x.tolist() for key, x in arrays.items()})
            (tmp_path / f"{name}.json").write_text(text)
    log = source(tmp_path, files=f"*.{ending}")
    assert_equal(log)
    assert not log.warnings


def test_the_clock_of_a_joined_run_is_that_of_q(tmp_path):
    """The stamps of u are 2 % of a sample late, and its file comes first by its name."""
    write(tmp_path, TABLE[T + U].assign(t=TABLE.t + 2e-4), "1_eff.csv")
    write(tmp_path, TABLE[T + Q + V], "2_pos.csv")
    for part in source(tmp_path).cleaned:
        np.testing.assert_allclose(100 * part.raw.t, np.round(100 * part.raw.t), atol=1e-9)


NAMES = ["{run}_{part}", "{part}/{run}", "x-{part}_01_{number}"]


@pytest.mark.parametrize("form", NAMES)
def test_names_of_files_tell_the_runs_apart(tmp_path, form):
    runs = {k: motion(phase=0.7 * k) for k in (1, 2, 10)}
    for number, table in runs.items():
        for part, columns in parts(table).items():
            name = form.format(run=f"run{number}", part=part, number=number)
            (tmp_path / name).parent.mkdir(exist_ok=True)
            write(tmp_path, columns, f"{name}.csv")
    log = source(tmp_path, files="**/*.csv")
    assert len({part.raw.run for part in log.cleaned}) == 3
    for part in log.cleaned:
        match = [k for k, x in runs.items() if x["q1"][0] == pytest.approx(part.raw.q[0, 0])]
        if part.split == "train":
            np.testing.assert_allclose(part.raw.u[:9], runs[match[0]][U][:9], atol=1e-10)


def test_files_of_single_joints_have_columns_by_their_names(tmp_path):
    for run, phase in enumerate((0.0, 1.0, 2.0)):
        table = motion(phase=phase)
        for k, joint in ((1, "arm1"), (2, "arm10")):
            columns = {f"{name}{k}": name for name in "qvu"}
            (tmp_path / f"run{run}").mkdir(exist_ok=True)
            part = table[[*T, *columns]].rename(columns=columns)
            write(tmp_path / f"run{run}", part, f"{joint}.csv")
    columns = {
        key: dict(columns=[f"arm1/{key}", f"arm10/{key}"], unit=unit)
        for key, unit in (("q", "rad"), ("v", "rad/s"), ("u", "Nm"))
    }
    log = source(tmp_path, files="*/*.csv", **columns)
    assert len({part.raw.run for part in log.cleaned}) == 3
    for run, phase in enumerate((0.0, 1.0, 2.0)):
        (part, *_) = [x.raw for x in log.cleaned if f"{run}" in x.raw.run and x.split == "train"]
        for key in "qvu":
            expected = motion(phase=phase)[[f"{key}1", f"{key}2"]].to_numpy()[: len(part)]
            np.testing.assert_allclose(getattr(part, key), expected, atol=1e-10)


@pytest.mark.parametrize(
    ("q", "v"),
    [(["q1", "q2"], ["v2", "v1"]), (["arm.q", "tool.q"], ["d(tool)", "d(arm)"])],
)
def test_velocities_are_in_the_order_of_q(tmp_path, q, v):
    names = dict(zip([*Q, *V], [*q, *v[::-1]], strict=True))
    write(tmp_path, TABLE.assign(v2=TABLE["v2"] * 180 / np.pi).rename(columns=names))
    units = ["deg/s", "rad/s"]
    log = source(tmp_path, q=dict(columns=q, unit="rad"), v=dict(columns=v, unit=units))
    assert_equal(log)
    assert not log.warnings


def test_names_that_tell_nothing_are_refused(tmp_path):
    for name, table in zip(("a", "b", "c", "d"), [TABLE[T + Q], TABLE[T + V + U]] * 2, strict=True):
        write(tmp_path, table, f"{name}.csv")
    with pytest.raises(LogError, match=r"a, b, c, d hold parts of the columns.*run1_q"):
        source(tmp_path).load()


def test_signals_with_clocks_of_their_own_are_joined_on_the_clock_of_q(tmp_path):
    fast = motion(rate=800.0)
    epoch = pd.Timestamp("2026-11-27T14:00:00").value
    for name, table in {
        "pos": TABLE[T + Q],
        "vel": fast[T + V][301::7],  # 114 Hz, from 0.38 s on
        "eff": fast[T + U][0::4],  # 200 Hz: every second at a sample of q
    }.items():
        ns = epoch + (1e9 * table["t"]).round().astype(np.int64)
        write(tmp_path, table.assign(t=ns), f"{name}.csv")
    log = source(tmp_path, time=dict(columns="t", unit="ns"))
    assert_equal(log, atol=2e-4)
    assert "values of u (u1, u2) are missing and held, over at most" in log.report
    assert not log.warnings


def test_a_restart_in_a_joined_file_is_named(tmp_path):
    write(tmp_path, TABLE[T + Q + V], "pos.csv")
    write(tmp_path, pd.concat([TABLE[T + U][:600], TABLE[T + U][:600]]), "eff.csv")
    with pytest.raises(LogError, match=r"eff.csv, line 602.*expected a single run in each file"):
        source(tmp_path).load()


def outer_join(u_rate=125):
    fast = motion(rate=500.0)
    table = fast.copy()
    table.loc[np.arange(len(fast)) % 5 > 0, Q + V] = np.nan
    table.loc[np.arange(len(fast)) % round(500 / u_rate) > 0, U] = np.nan
    return table.dropna(subset=Q + U, how="all")


def test_slower_signals_are_held_or_interpolated(tmp_path):
    write(tmp_path, outer_join())
    log = source(tmp_path)
    held = TABLE.copy()
    held[U] = motion(rate=500.0)[U].iloc[(np.arange(1001) * 5) // 4 * 4].to_numpy()
    assert_equal(log, held)
    assert not log.warnings
    write(tmp_path, TABLE.assign(v1=TABLE["v1"].where(TABLE.index % 4 == 0)))
    log = source(tmp_path)
    assert_equal(log, atol=2e-3)
    assert "values of v (v1) are missing and interpolated, over at most 0.04 s" in log.report


def test_rare_commands_between_the_samples_are_no_samples(tmp_path):
    commands = motion(rate=1000.0)[T + U][::93].assign(t=lambda x: x["t"] + 0.0004)
    write(tmp_path, pd.concat([TABLE[T + Q + V], commands]).sort_values("t"))
    log = source(tmp_path)
    assert len(log.load().train[0].t) > 580
    assert "rows lack a value" in log.report
    assert not [text for text in log.warnings if "missing" in text]


def test_single_missing_cells_are_filled_with_a_warning(tmp_path):
    q1 = TABLE["q1"].astype(object)
    write(tmp_path, TABLE.assign(q1=q1.where(TABLE.index != 17, "-nan(ind)")))
    log = source(tmp_path)
    assert_equal(log, atol=1e-3)
    assert "1 of 1001 values of q (q1) are missing and interpolated" in "\n".join(log.warnings)


@pytest.mark.parametrize("column", ["q1", "u2"])
def test_a_sensor_that_fails_splits_the_run(tmp_path, column):
    table = outer_join() if column == "u2" else TABLE.copy()
    table.loc[table["t"].between(2.0, 4.0), column] = np.nan
    write(tmp_path, table)
    message = rf"column '{column}' .* no value for 2\.0\d* s(?s:.*)SplitGaps"
    with pytest.raises(LogError, match=message):
        source(tmp_path).load()
    assert len(source(tmp_path, max_age=3.0).load().train) == 1
    log = source(tmp_path, steps={"split": SplitGaps(longest=0.1)})
    assert len(log.load().train) == 2
    assert "rows are dropped" in "\n".join(log.warnings)
    assert all(not (2.05 < t < 3.95) for part in log.cleaned for x in part.clean for t in x.t)


def long_table(table):
    rows = [table[T].assign(joint=f"j{k}", **{x: table[f"{x}{k}"] for x in "qvu"}) for k in (1, 2)]
    return pd.concat(rows).sort_values(["t", "joint"], ascending=[True, False])


LONG = {
    key: dict(columns=[f"{key}/j1", f"{key}/j2"], unit=unit)
    for key, unit in zip("qvu", ("rad", "rad/s", "Nm"), strict=True)
}


def test_a_second_row_of_a_joint_is_named(tmp_path):
    write(tmp_path, long_table(TABLE).iloc[np.r_[:4, 3:2002]])
    with pytest.raises(LogError, match=r"line 6.*second row of this joint"):
        source(tmp_path, long="joint", **LONG).load()


@pytest.mark.parametrize("clock", [True, False])
def test_rows_of_single_joints_become_columns(tmp_path, clock):
    table = long_table(TABLE)
    write(tmp_path, table if clock else table.drop(columns="t"))
    log = source(tmp_path, long="joint", **LONG, **({} if clock else {"time": {"rate": 100}}))
    assert_equal(log)
    assert not log.warnings


def test_a_packed_file_is_to_be_unpacked(tmp_path):
    (tmp_path / "run.zip").write_bytes(b"PK")
    with pytest.raises(LogError, match=r"no reader for '.zip': unpack it, and name the files"):
        source(tmp_path, files="run.zip").load()
