"""Logs as a data source: columns, units, splits without leakage, pieces, report."""

import math

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pinn_dyn.data import draw_windows
from pinn_dyn.data.logs import (
    UNITS,
    Butterworth,
    Columns,
    InputDelay,
    LogError,
    SplitGaps,
)
from pinn_dyn.data.logs.splits import default_split
from pinn_dyn.data.source import StoredSource, store
from pinn_dyn.mechanics import stack
from tests.data.logs_files import motion, source, write


@pytest.fixture
def folder(tmp_path):
    write(tmp_path, motion())
    return tmp_path


def test_a_clean_log_arrives_as_it_is(folder):
    table, splits = motion(), source(folder).load()
    (train,) = splits.train
    assert train.q.dtype == torch.float64
    assert len(train.t) == 601  # 10 s less 2 + 0.5 + 1 + 0.5 s
    np.testing.assert_allclose(train.t, table["t"][:601], atol=1e-12)
    for signal in "qvu":
        wanted = table[[f"{signal}1", f"{signal}2"]].to_numpy()
        np.testing.assert_allclose(getattr(train, signal), wanted[:601], atol=1e-11)
        np.testing.assert_allclose(getattr(splits.test[1], signal), wanted[900:1001], atol=1e-11)
    assert draw_windows(splits.train, count=50, steps=2, stride=5, seed=0).q.shape == (50, 2)
    assert stack(splits.validation).q.shape == (2, 51, 2)
    assert stack(splits.test).t[-1] == pytest.approx(1.0)


def test_the_delay_of_a_data_set_is_the_last_step(folder):
    """After the cleaning, so that no input is interpolated across a gap."""
    late = InputDelay([0.015, 0.02])
    expected = source(folder, steps={"smooth": Butterworth(5.0), "late": late}).load()
    log = source(folder, steps={"smooth": Butterworth(5.0)}, delay=[0.015, 0.02])
    torch.testing.assert_close(log.load().train[0].u, expected.train[0].u, rtol=0, atol=0)
    both = source(folder, steps={"late": late}, delay=0.1)
    np.testing.assert_allclose(both.input_delay, [0.115, 0.12])


def test_units_signs_scales_and_offsets(folder):
    table = motion()
    table["q1"] = np.degrees(table["q1"]) * -1 + 30
    table["v1"] = np.degrees(table["v1"]) * -1
    table["u2"] = 1000 * table["u2"] / 5
    table["t"] *= 1000
    write(folder, table)
    changed = source(
        folder,
        time=dict(columns="t", unit="ms"),
        q=dict(columns=["q1", "q2"], unit=["deg", "rad"], sign=[-1, 1], offset=[30, 0]),
        v=dict(columns=["v1", "v2"], unit=["deg/s", "rad/s"], sign=[-1, 1]),
        u=dict(columns=["u1", "u2"], unit=["Nm", "mNm"], scale=[1.0, 5.0]),
    )
    (train,) = changed.load().train
    plain = motion()
    np.testing.assert_allclose(train.q, plain[["q1", "q2"]][:601], atol=1e-9)
    np.testing.assert_allclose(train.v, plain[["v1", "v2"]][:601], atol=1e-9)
    np.testing.assert_allclose(train.u, plain[["u1", "u2"]][:601], atol=1e-9)
    assert changed.labels == ["q1 [rad]", "q2 [rad]"]
    assert changed.input_labels == ["u1 [Nm]", "u2 [Nm]"]


units = st.sampled_from(sorted(set(UNITS) - {"%"}))
numbers = st.floats(-1e6, 1e6)


@given(units, numbers, st.sampled_from([1, -1]), st.floats(0.01, 100), numbers)
def test_conversion_to_si_and_back_is_the_identity(unit, value, sign, scale, offset):
    columns = Columns("x", unit=unit, sign=sign, scale=scale, offset=offset)
    (si,) = columns.to_si(np.array([[value]]))[0]
    assert si == pytest.approx(sign * scale * UNITS[unit][1] * (value - offset))
    (back,) = columns.from_si(np.array([[si]]))[0]
    assert back == pytest.approx(value, rel=1e-9, abs=1e-9 * max(abs(offset), 1))


# Written out by hand: the factor of each unit to SI.
@pytest.mark.parametrize(
    ("unit", "value", "si"),
    [
        *(("rpm", 60.0, 2 * math.pi), ("rev", 0.5, math.pi), ("deg", 180.0, math.pi)),
        *(("psi", 14.503773773, 1e5), ("bar", 1.0, 1e5), ("mbar", 1.0, 100.0)),
        *(("mA", 250.0, 0.25), ("mm", 12.0, 0.012), ("min", 2.0, 120.0), ("us", 5.0, 5e-6)),
        *(("kN", 2.0, 2000.0), ("mNm", 5.0, 0.005), ("%", 50.0, 0.5), ("MPa", 1.0, 1e6)),
    ],
)
def test_factors_of_units(unit, value, si):
    assert UNITS[unit][1] * value == pytest.approx(si)


def test_borders_are_cut_before_filters_see_them(folder):
    """Whatever stands in the test rows and in the guard, training does not change."""
    steps = {"filter": Butterworth(cutoff=5.0)}
    before = source(folder, steps=steps).load()
    table = motion()
    changed = ["q1", "q2", "v1", "v2", "u1", "u2"]
    table.loc[752:, changed] = np.random.default_rng(0).normal(size=(249, 6))
    table.loc[601:649, changed] = 5.0
    write(folder, table)
    after = source(folder, steps=steps).load()
    for name in ("train", "validation"):
        for one, other in zip(getattr(before, name), getattr(after, name), strict=True):
            assert torch.equal(one.q, other.q)
            assert torch.equal(one.v, other.v)
    assert not torch.equal(before.test[0].q, after.test[0].q)


def test_no_row_is_in_two_splits_even_without_a_guard(folder):
    parts = source(folder, guard=0.0).cleaned
    times = np.concatenate([part.raw.t for part in parts])
    assert len(times) == len(np.unique(times))
    assert [part.split for part in parts] == ["train", "validation", "test"]


@pytest.mark.parametrize(
    ("seconds", "starts"),
    [(2.0, [0, 50, 100, 150]), (1.99, [0, 50, 99, 149]), (1.98, [0, 50, 100])],
)
def test_pieces_share_their_ends_and_one_sample_less_costs_none(tmp_path, seconds, starts):
    write(tmp_path, motion(), "a.csv")
    table = motion(seconds, phase=2.0)
    write(tmp_path, table, "b.csv")
    splits = source(
        tmp_path, validation=dict(seconds=1.0, piece=1.0), test=dict(runs=["b"], piece=0.5)
    ).load()
    found = [int(np.abs(table["q1"] - float(item.q[0, 0])).argmin()) for item in splits.test]
    assert found == starts
    assert all(len(item.t) == 51 for item in splits.test)


@pytest.fixture
def runs(tmp_path):
    for k in range(8):
        write(tmp_path, motion(3.0, phase=0.3 * k), f"run_{k}.csv")
    return tmp_path


def names(parts, split):
    return {part.raw.run for part in parts if part.split == split}


def test_whole_runs_are_drawn_by_the_seed(runs):
    def drawn(seed):
        return source(
            runs, validation=dict(runs=1, piece=1.0), test=dict(runs=2, piece=1.0), seed=seed
        )

    first = drawn(0).cleaned
    sets = [names(first, split) for split in ("train", "validation", "test")]
    assert [len(found) for found in sets] == [5, 1, 2]
    assert len(set.union(*sets)) == 8
    assert names(drawn(0).cleaned, "test") == sets[2]
    assert any(names(drawn(seed).cleaned, "test") != sets[2] for seed in (1, 2, 3))
    splits = drawn(0).load()
    assert len(splits.test) == 6
    starts = [tuple(x.q[0].tolist()) for x in splits.train + splits.validation + splits.test]
    assert len(set(starts)) == len(starts)


def test_the_default_split_draws_long_runs_by_the_seed():
    """Ten runs, two of them short: two are the test and two the validation."""
    clocks = {f"run {k}": np.arange(100 if k < 2 else 300) / 100 for k in range(10)}
    drawn = [default_split(clocks, seed)[:2] for seed in range(5)]
    for parts in drawn:
        found = [name for part in parts for name in part.names]
        assert len(set(found)) == 4
        assert not {"run 0", "run 1"} & set(found)
    assert len({tuple(test.names) for _, test in drawn}) > 1


def test_named_runs_and_the_end_of_the_others(runs):
    mixed = source(
        runs, validation=dict(seconds=0.5, piece=0.5), test=dict(runs=["run_3"], piece=2)
    )
    parts = mixed.cleaned
    assert names(parts, "test") == {"run_3"}
    assert (
        names(parts, "validation")
        == names(parts, "train")
        == {f"run_{k}" for k in range(8)} - {"run_3"}
    )
    assert "1 s are dropped" in mixed.report


@pytest.mark.parametrize(
    ("validation", "test", "message"),
    [
        (["run_33"], ["run_1"], r"validation.runs: no run 'run_33'.*run_3.* The runs are run_0"),
        (["run_3"], ["run_1", "run_3"], "run 'run_3' is in validation and in test"),
    ],
)
def test_runs_that_cannot_be_split_are_refused_by_name(runs, validation, test, message):
    parts = dict(validation=dict(runs=validation, piece=1.0), test=dict(runs=test, piece=1.0))
    with pytest.raises(LogError, match=message):
        source(runs, **parts).load()


def test_a_column_tells_runs_apart(tmp_path):
    tables = [motion(2.0, phase=k).assign(id=k) for k in range(4)]
    write(tmp_path, pd.concat(tables))
    split = source(
        tmp_path,
        trajectory="id",
        validation=dict(runs=[1], piece=2.0),
        test=dict(runs=[3], piece=2.0),
    )
    splits = split.load()
    np.testing.assert_allclose(splits.validation[0].q, tables[1][["q1", "q2"]], atol=1e-11)
    np.testing.assert_allclose(splits.test[0].u, tables[3][["u1", "u2"]], atol=1e-11)
    assert len(splits.train) == 2


def test_short_stretches_are_dropped_and_named(folder):
    table = motion()
    table.loc[300:, "t"] += 0.4
    table.loc[305:, "t"] += 0.4
    write(folder, table)
    split = source(folder, steps={"gaps": SplitGaps(longest=0.1)})
    assert [len(item.t) for item in split.load().train] == [300, 296]
    assert "train run (3.4 to 3.44 s) after gaps: 0.04 s, shorter than 0.1 s" in split.report
    assert "2 gaps, after 2.99 s, 3.44 s" in split.report


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(q=dict(columns=["q1"], unit="dgr")), r"q: unit is 'dgr': did you mean deg.*"),
        (dict(q=dict(columns=["q1", "q1"], unit="rad")), "'q1' is twice in q, v and u"),
        (dict(q=dict(columns=["q1"], unit="Nm"), v=None), "q has the column 'q1' in Nm"),
        (dict(v=dict(columns=["v1", "v2"], unit="m/s")), r"v has the units .*m/s.*per second"),
        (dict(test=dict(piece=1.0)), r"test: expected either runs or seconds"),
        (dict(test=None), r"both validation and test"),
    ],
)
def test_wrong_descriptions_are_refused(tmp_path, changes, message):
    with pytest.raises(LogError, match=message):
        source(tmp_path, **changes)


def test_whole_runs_of_unequal_length_are_one_roll_out_each(tmp_path):
    for k, seconds in enumerate((4.0, 3.0, 2.5, 3.5)):
        write(tmp_path, motion(seconds, phase=0.3 * k), f"run_{k}.csv")
    log = source(
        tmp_path,
        validation=dict(runs=["run_0"], piece=1.0),
        test=dict(runs=["run_1", "run_2"], piece="whole"),
    )
    found = log.load().test
    assert [item.duration for item in found] == pytest.approx([3.0, 2.5])
    assert float(found[0].q[0, 0]) == pytest.approx(motion(3.0, phase=0.3)["q1"][0])
    assert "2 trajectories of 2.5 to 3 s" in log.report


def test_pieces_are_as_long_as_the_median_run_but_at_most_5_s(tmp_path):
    for k, seconds in enumerate((4.0, 12.0, 2.0, 3.0, 6.0)):
        write(tmp_path, motion(seconds, phase=0.3 * k), f"run_{k}.csv")
    parts = dict(validation={"runs": ["run_2", "run_3"]}, test={"runs": ["run_1"]})
    splits = source(tmp_path, **parts).load()
    assert [item.duration for item in splits.validation] == pytest.approx([2.5])
    assert [item.duration for item in splits.test] == pytest.approx([5.0, 5.0])


def test_pieces_know_the_motion_before_them(folder):
    """Models of a delay or with a memory look back. The first piece of a stretch has no past."""
    first, second = source(folder, u=dict(columns=["u1", "u2"], unit="Nm")).load().test
    assert len(first.past) == 0
    count = len(second.past)
    assert count == min(200, len(first.t) - 1)  # 2 s
    assert torch.equal(second.past, first.u[-count - 1 : -1])
    assert torch.equal(second.past_q, first.q[-count - 1 : -1])


def test_a_stored_source_keeps_the_motion_before_its_pieces(folder, tmp_path):
    log = source(folder, u=dict(columns=["u1", "u2"], unit="Nm"))
    store(log, tmp_path / "data.pt")
    stored = StoredSource(str(tmp_path / "data.pt"), "log", log.labels, log.input_labels)
    for before, after in zip(log.load().test, stored.load().test, strict=True):
        assert torch.equal(before.past, after.past)
        assert torch.equal(before.past_q, after.past_q)


@pytest.mark.parametrize("runs", [1, 3])
def test_frames_in_memory_are_read_as_files(tmp_path, runs):
    """One frame, frames by run and files give the same trajectories and the same split."""
    tables = {f"r{k}": motion(4.0, phase=0.7 * k) for k in range(runs)}
    for name, table in tables.items():
        write(tmp_path, table, f"{name}.csv")
    default = dict(validation=None, test=None, root=".")
    frame = pd.concat([table.assign(run=name) for name, table in tables.items()])
    sources = [
        source(tmp_path, files=tables, **default),
        source(tmp_path, files=frame, trajectory="run", **default),
        source(tmp_path, validation=None, test=None),
    ]
    first, *others = [log.load() for log in sources]
    for splits in others:
        for name in ("train", "validation", "test"):
            for ours, theirs in zip(getattr(first, name), getattr(splits, name), strict=True):
                torch.testing.assert_close(ours.q, theirs.q, rtol=1e-9, atol=1e-9)
    assert min(map(len, (first.train, first.validation, first.test))) >= 1
