"""Bad logs: each is refused or reported with its place and what to do."""

import numpy as np
import pytest

from pinn_dyn.data.logs import Deduplicate, LogError, Resample, RowClock, SplitGaps
from tests.data.logs_files import motion, source, write


def refused(folder, table, message, **changes):
    write(folder, table)
    with pytest.raises(LogError, match=message):
        source(folder, **changes).load()


def warned(folder, table, **changes):
    write(folder, table)
    report = source(folder, **changes).report
    return report.split("## Warnings\n")[1].split("\n## ")[0].strip()


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


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (motion().rename(columns={"q2": "q_2"}), r"run.csv: no column 'q2'.*mean q_2.*has t, q1"),
        (put(41, "q2", "broken"), r"run.csv, line 43, column 'q2' \(q\): the value is 'broken'"),
        (
            put(17, "u1", np.nan),
            r"line 19, column 'u1' \(u\): the value is empty or NaN.*1 such row",
        ),
        (put(17, "v1", np.inf), r"line 19, column 'v1' \(v\): the value is 'inf'"),
        (
            clock(lambda t: np.where(t > 3, t - 3, t)),
            r"line 303.*goes back from 3 to 0.01.*SplitGaps",
        ),
        (clock(repeat), r"line 402, column 't': the time 3.99 s repeats.*Deduplicate"),
        (clock(lambda t: np.where(t > 3, t + 1, t)), r"line 303.*jumps from 3 to 4.01.*SplitGaps"),
        (clock(lambda t: 1000 * t), r"sample time would be 10 s.*unit of the time wrong \(ms\?\)"),
        (clock(lambda t: t + 0.004 * np.sin(40 * t)), r"needs a uniform clock.*Resample"),
        (motion().assign(u1=1.0, u2=0.0), r"every input \(u1, u2\) is constant"),
        (motion()[:0], r"has no rows"),
        (motion(2.0), r"too short to keep 2.0 s for test"),
    ],
    ids=str,
)
def test_bad_files_are_refused_with_place_and_cure(tmp_path, table, message):
    refused(tmp_path, table, message)


def test_the_named_step_is_the_cure(tmp_path):
    write(tmp_path, clock(repeat))
    steps = {"deduplicate": Deduplicate(), "resample": Resample(rate=100.0, max_gap=0.05)}
    assert len(source(tmp_path, steps=steps).load().train[0].t) == 601
    write(tmp_path, clock(lambda t: np.where(t > 3, t + 1, t)))
    assert len(source(tmp_path, steps={"gaps": SplitGaps(longest=0.05)}).load().train) == 2
    write(tmp_path, clock(lambda t: t + 0.004 * np.sin(40 * t)))
    steps = {"resample": Resample(rate=100.0, max_gap=0.05)}
    assert source(tmp_path, steps=steps).load().train[0].t.diff().std() < 1e-12


def test_two_clocks(tmp_path):
    table = motion()
    table["t_robot"] = 5.0 + table["t"]
    both = dict(columns=["t", "t_robot"], unit="s")
    write(tmp_path, table)
    assert len(source(tmp_path, time=both).load().train) == 1
    table["t_robot"] += 0.01 * table["t"]
    refused(tmp_path, table, r"line 10\d.*clocks 't' and 't_robot' disagree", time=both)


@pytest.mark.parametrize("rate", [50, 200])
def test_a_run_of_another_sample_time_is_named(tmp_path, rate):
    write(tmp_path, motion(), "a.csv")
    write(tmp_path, motion(phase=1.0), "b.csv")
    message = rf"c .*its sample time is {1 / rate:g} s, that of the others 0.01 s: add a Resample"
    write(tmp_path, motion(phase=2.0, rate=rate), "c.csv")
    with pytest.raises(LogError, match=message):
        source(tmp_path).load()


def test_an_empty_pattern_names_itself_and_the_folder(tmp_path):
    with pytest.raises(LogError, match=rf"nothing matches '\*.txt' in the folder {tmp_path}"):
        source(tmp_path, files="*.txt").load()
    write(tmp_path, motion(), "b.csv")
    with pytest.raises(LogError, match=r"which has b\.csv: mend dataset\.files or dataset\.root"):
        source(tmp_path, files="*.txt").load()
    with pytest.raises(LogError, match="absent', which is no folder"):
        source(tmp_path / "absent").load()


def test_a_folder_that_is_no_bag_names_what_is_in_it(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run_0.mcap").touch()
    with pytest.raises(LogError, match=r"folder without metadata.yaml.* as 'run/\*.mcap'"):
        source(tmp_path, files="run").load()
    (tmp_path / "csv").mkdir()
    write(tmp_path / "csv", motion())
    with pytest.raises(LogError, match=r"nothing matches 'c\*' .*, but a folder: .* 'csv/\*.csv'"):
        source(tmp_path, files="c*").load()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("run.ulg", r"\.ulg is not read, but CSV .*bags of ROS.*ulog2csv"),
        ("run.pickle", r"read_pickle.*if you trust"),
        ("run.tdms", r"nptdms"),
        ("run.json", r"read_json"),
        ("run.XLSX", r"read_excel"),
        ("run.foo", r"cannot be read as CSV.*What is read is CSV .*NPZ, Parquet, .*to_parquet"),
    ],
)
def test_files_of_other_formats_are_told_how_to_convert(tmp_path, name, message):
    (tmp_path / name).write_bytes(b"ULog\x01\x12\xff\x00" * 50)
    with pytest.raises(LogError, match=rf"{name}: .*{message}"):
        source(tmp_path, files="run.*").load()


def test_runs_that_do_not_exist_or_do_not_suffice(tmp_path):
    write(tmp_path, motion())
    piece = dict(piece=1.0)
    with pytest.raises(LogError, match=r"no run 'runs': did you mean run"):
        source(tmp_path, test=dict(runs=["runs"], **piece)).load()
    with pytest.raises(LogError, match=r"1 runs to choose from.*split by 'seconds'"):
        source(tmp_path, test=dict(runs=1, **piece)).load()
    both = dict(runs=["run"], **piece)
    with pytest.raises(LogError, match=r"'run' is in validation and in test"):
        source(tmp_path, test=both, validation=both).load()
    with pytest.raises(LogError, match=r"train: after splitting no stretch.*shortest, 20 s"):
        source(tmp_path, shortest=20.0).load()


def test_rows_longer_than_the_header(tmp_path):
    text = motion().to_csv(index=False).splitlines()
    (tmp_path / "run.csv").write_text("\n".join([text[0], *(f"{row},1" for row in text[1:])]))
    with pytest.raises(LogError, match=r"run.csv: cannot be read as CSV"):
        source(tmp_path).load()


def test_a_good_log_has_no_warning(tmp_path, caplog):
    assert warned(tmp_path, motion()) == "- none"
    assert not caplog.records


def test_warnings_are_logged_once(tmp_path, caplog):
    write(tmp_path, motion().assign(u2=0.0))
    log = source(tmp_path)
    log.load()
    assert "input 'u2' is constant" in log.report
    assert [record.getMessage() for record in caplog.records] == [
        "oscillator: input 'u2' is constant in all runs: its column of A cannot be learned"
    ]


def test_angles_in_degrees(tmp_path):
    table = motion()
    table[["q2", "v2"]] = np.degrees(table[["q2", "v2"]])
    text = warned(tmp_path, table)
    assert text.startswith("- run, column 'q2': ")
    assert "is it in degrees? Its unit is given as 'rad'" in text
    assert "derivative" not in text


@pytest.mark.parametrize(("factor", "said"), [(180 / np.pi, 0.01745), (-1.0, -1.0), (0.5, 2.0)])
def test_velocity_that_disagrees_by_a_factor(tmp_path, factor, said):
    text = warned(tmp_path, motion().assign(v2=factor * motion()["v2"]))
    assert text.startswith("- columns 'q2' and 'v2': the derivative of q is ")
    measured = float(text.split("derivative of q is ")[1].split(" ")[0])
    assert measured == pytest.approx(said, rel=1e-2)
    assert ("degrees" in text) == (factor > 50)


def test_a_reversed_torque(tmp_path):
    table = motion()
    rng = np.random.default_rng(0)
    # A force that the position does not explain, with the motion that follows from it.
    force = np.interp(table["t"], np.arange(0, 11, 0.25), rng.normal(size=44))
    v = np.cumsum(force) * 0.01
    table["v1"], table["q1"], table["u1"] = v, np.cumsum(v) * 0.01, force
    assert warned(tmp_path, table) == "- none"
    assert "input 'u1' seems to push backwards" in warned(tmp_path, table.assign(u1=-force))


def in_bursts(seconds=10.0, rows=8, late=0.002, apart=0.0):
    """The log of ``motion``, written by a logger that empties its buffer every so many rows."""
    table = motion(seconds)
    t = table["t"].to_numpy()
    number = np.arange(len(t))
    # A burst is written when its last row is there.
    written = t[np.minimum(rows * (number // rows) + rows - 1, len(t) - 1)]
    return table.assign(t=written + late + apart * (number % rows))


def test_stamps_in_bursts_are_refused_or_warned_of_by_their_cure(tmp_path):
    refused(tmp_path, in_bursts(), r"line 3, column 't': the time .* repeats.*bursts.*RowClock")
    refused(tmp_path, in_bursts(apart=2e-5), r"the time jumps .*RowClock step: its stamps come")
    steps = {"resample": Resample(rate=100.0, max_gap=0.2)}
    said = warned(tmp_path, in_bursts(apart=2e-5), steps=steps)
    assert "run: stamps come in bursts" in said
    assert "RowClock" in said


@pytest.mark.parametrize("apart", [0.0, 2e-5])
@pytest.mark.parametrize("rate", [None, 100.0])
def test_a_row_clock_mends_bursts(tmp_path, apart, rate):
    steps = {"clock": RowClock(longest=0.1, rate=rate)}
    write(tmp_path, in_bursts(apart=apart))
    found = source(tmp_path, steps=steps)
    assert "## Warnings\n\n- none" in found.report
    write(tmp_path, motion())
    expected = source(tmp_path).load()
    for name in ("train", "test"):
        ours, theirs = getattr(found.load(), name)[0], getattr(expected, name)[0]
        assert float(ours.t[1]) == pytest.approx(float(theirs.t[1]), rel=1e-3)
    assert len(found.load().test) == len(expected.test)


def test_lost_rows_are_no_bursts(tmp_path):
    table = in_bursts()
    write(tmp_path, table.drop(index=range(300, 360)))
    with pytest.raises(LogError, match=r"RowClock found the stamp .* rows are missing.*SplitGaps"):
        source(tmp_path, steps={"clock": RowClock(longest=0.1)}).load()
    steps = {"gaps": SplitGaps(longest=0.3), "clock": RowClock(longest=0.1, rate=100.0)}
    assert len(source(tmp_path, steps=steps).load().train) == 2


def test_a_clock_that_contradicts_the_velocities_is_told_from_jitter(tmp_path):
    """Stamps that swing about the true times, and samples that were taken at such times."""
    uniform = motion()["t"].to_numpy()
    swing = uniform + 0.0115 * np.sin(0.5 * np.arange(len(uniform)))
    assert (np.diff(swing) > 0).all()
    steps = {"resample": Resample(rate=100.0, max_gap=0.05)}
    said = warned(tmp_path, motion().assign(t=swing), steps=steps)
    assert "coordinate 1: by the stamps v leaves" in said
    assert "by a uniform clock" in said
    sampled = (
        motion().drop(columns="t").apply(lambda x: np.interp(swing, uniform, x)).assign(t=swing)
    )
    assert warned(tmp_path, sampled, steps=steps) == "- none"
