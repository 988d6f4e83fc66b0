"""LeRobot's names, Parquet of structs and lists, compound data sets and attributes of HDF5."""

import json

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
import torch

from pinn_dyn.data.logs import LogError
from tests.data import log_formats as formats
from tests.data.logs_files import motion, source

TABLE = motion(6.0)
Q, V, U = (TABLE.filter(regex=f"^{name}").to_numpy() for name in "qvu")
HDF5 = dict(
    files="*.h5",
    time=dict(columns="log/t", unit="s"),
    q=dict(columns=["log/q_1", "log/q_2"], unit="rad"),
    v=dict(columns=["log/v_1", "log/v_2"], unit="rad/s"),
    u=dict(columns=["log/u_1", "log/u_2"], unit="Nm"),
)


def raw(log):
    return log.cleaned[0].raw


def assert_motion(log):
    run = raw(log)
    for ours, theirs in ((run.t, TABLE["t"]), (run.q, Q), (run.u, U)):
        np.testing.assert_allclose(ours, theirs[: len(run)], atol=1e-9)


def write_lerobot(folder, names):
    formats.write_lerobot(folder, TABLE)
    (folder / "meta").mkdir()
    info = {"features": {"observation.state": {"names": names}, "timestamp": {"names": None}}}
    (folder / "meta" / "info.json").write_text(json.dumps(info))


@pytest.mark.parametrize(
    "names",
    [
        ["main_shoulder_pan", "elbow.pos"],
        {"motors": ["main_shoulder_pan", "elbow.pos"]},
        {"axes": [["main_shoulder_pan"], ["elbow.pos"]]},
        {"main_shoulder_pan": 0, "elbow.pos": 1},
    ],
)
def test_lerobot_entries_have_the_names_of_the_data_set(tmp_path, names):
    write_lerobot(tmp_path, names)
    q = [f"observation.state/{name}" for name in ("elbow.pos", "main_shoulder_pan")]
    run = raw(source(tmp_path, **formats.LEROBOT | {"q": dict(columns=q, unit="rad")}))
    np.testing.assert_allclose(run.q, Q[: len(run), ::-1])


def test_lerobot_names_that_do_not_fit_are_answered_with_numbers_that_work(tmp_path):
    write_lerobot(tmp_path, ["elbow"])
    q = dict(columns=["observation.state/elbow"], unit="rad")
    with pytest.raises(LogError, match=r"1 names .* 2 entries.* observation.state_1 to .*_2;"):
        source(tmp_path, **formats.LEROBOT | {"q": q}).load()
    assert_motion(source(tmp_path, **formats.LEROBOT))


def test_parquet_of_structs_nested_lists_and_an_index(tmp_path):
    frame = pd.DataFrame({"state": [{"q": {"a": x, "b": y}} for x, y in Q]})
    frame["u"] = [[[x], [y]] for x, y in U]
    frame.set_axis(pd.Index(TABLE["t"], name="t")).to_parquet(tmp_path / "run.parquet")
    q = dict(columns=["state.q.a", "state.q.b"], unit="rad")
    u = dict(columns=["u_1", "u_2"], unit="Nm")
    assert_motion(source(tmp_path, files="run.parquet", q=q, v=None, u=u))


def test_hdf5_of_compound_data_and_images(tmp_path):
    rows = np.zeros(len(TABLE), [("t", "f8"), *((name, "f8", 2) for name in "qvu"), ("mode", "S4")])
    rows["t"], rows["q"], rows["v"], rows["u"] = TABLE["t"], Q, V, U
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["log"] = rows
        file.create_dataset("images", (len(TABLE), 9999, 9999, 3), "u1")  # 180 GB: not loaded
    assert_motion(source(tmp_path, **HDF5))


def stacked(runs):
    return {name: np.stack([run[name] for run in runs]) for name in runs[0]}


def numbered(runs):
    return {f"{name}_{k}": x for k, run in enumerate(runs) for name, x in run.items()}


def shared_clock(runs):
    return stacked(runs) | {"t": runs[0]["t"]}


def time_first(runs):
    """Runs of parallel simulators, ``(T, runs, N)``."""
    return {name: np.moveaxis(x, 0, 1) for name, x in stacked(runs).items()}


def test_a_star_stands_for_the_run_in_names_without_groups(tmp_path):
    runs = {f"trial_{k}": motion(6.0, phase=k) for k in range(3)}
    arrays = {f"{run}_{x}": table[x] for run, table in runs.items() for x in table}
    np.savez(tmp_path / "run.npz", **arrays)
    with pytest.raises(LogError, match=r"no variable 't' for the time, write 'trial_\*_t', and"):
        source(tmp_path, files="run.npz", time="t").load()
    log = source(
        tmp_path,
        files="run.npz",
        time="trial_*_t",
        q=dict(columns=["trial_*_q1", "trial_*_q2"], unit="rad"),
        v=None,
        u=dict(columns=["trial_*_u1", "trial_*_u2"], unit="Nm"),
    )
    for part in log.cleaned:
        expected = runs[f"trial_{part.raw.run}"].set_index("t").loc[part.raw.t, ["q1", "q2"]]
        np.testing.assert_array_equal(part.raw.q, expected)
    assert {part.raw.run for part in log.cleaned} == {"0", "1", "2"}


@pytest.mark.parametrize(
    ("kind", "form"),
    [
        ("npz", stacked),
        ("npz", numbered),
        ("h5", shared_clock),
        ("h5", time_first),
        ("mat", time_first),
        ("mat", numbered),
        ("pt", stacked),
        ("pt", shared_clock),
    ],
)
def test_arrays_of_several_runs(tmp_path, kind, form):
    tables = [motion(6.0, phase=k) for k in range(3)]
    runs = [
        {"t": x["t"].to_numpy()}
        | {name: x[[f"{name}1", f"{name}2"]].to_numpy()[: 601 - (name == "u")] for name in "qvu"}
        for x in tables
    ]
    arrays = form(runs) | {"M": np.eye(3)}
    path = tmp_path / f"run.{kind}"
    if kind == "npz":
        np.savez(path, **arrays)
    elif kind == "mat":
        scipy.io.savemat(path, arrays)
    elif kind == "pt":
        torch.save({name: torch.tensor(x) for name, x in arrays.items()}, path)
    else:
        with h5py.File(path, "w") as file:
            for name, x in arrays.items():
                file[name] = x
    columns = {
        name: dict(columns=[f"{name}_1", f"{name}_2"], unit=unit)
        for name, unit in (("q", "rad"), ("v", "rad/s"), ("u", "Nm"))
    }
    log = source(tmp_path, files=path.name, **columns)
    assert len(log.warnings) == 1  # of all runs: the last row is left out
    recordings = {part.raw.run: part.raw for part in log.cleaned if part.split == "train"}
    for k, table in enumerate(tables):
        run = recordings[f"{k}"]
        for name in "qvu":
            expected = table[[f"{name}1", f"{name}2"]].to_numpy()[: len(run)]
            np.testing.assert_allclose(getattr(run, name), expected)


def test_the_rate_in_an_hdf5_file_without_clock_is_named(tmp_path):
    formats.write_hdf5(tmp_path / "run.h5", TABLE)
    with h5py.File(tmp_path / "run.h5", "a") as file:
        del file["log/t"]
        file["log"].attrs["fps"] = 100
    with pytest.raises(LogError, match=r"write time: \{rate: 100\}.*log/q \(601, 2\).*log@fps"):
        source(tmp_path, **HDF5).load()
    assert_motion(source(tmp_path, **HDF5 | {"time": {"rate": 100}}))


@pytest.mark.parametrize("kind", ["arrays", "runs", "records", "vectors", "lines"])
def test_json_holds_arrays_runs_or_records(tmp_path, kind):
    tables = [motion(phase=0.5 * k) for k in range(2 if kind == "runs" else 1)]
    names = {key: [f"{key}1", f"{key}2"] for key in "qvu"}
    arrays = [
        {"t": x["t"].tolist(), "state": {"q": x[names["q"]].to_numpy().tolist()}}
        | {key: x[names[key]].to_numpy().tolist() for key in "vu"}
        for x in tables
    ]
    records = tables[0].to_dict("records")
    values = arrays[0]["t"], arrays[0]["state"]["q"], arrays[0]["v"], arrays[0]["u"]
    rows = zip(*values, strict=True)
    vectors = [{"t": t, "state": {"q": q}, "v": v, "u": u} for t, q, v, u in rows]
    contents = {"arrays": arrays[0], "runs": arrays, "records": records, "vectors": vectors}
    text = json.dumps(contents.get(kind))
    if kind == "lines":
        text = "\n".join(map(json.dumps, vectors))
    (tmp_path / f"log.{'jsonl' if kind == 'lines' else 'json'}").write_text(text)
    bases = {"q": "state.q", "v": "v", "u": "u"}
    columns = {key: [f"{base}_1", f"{base}_2"] for key, base in bases.items()}
    units = dict(q="rad", v="rad/s", u="Nm")
    if kind == "records":
        columns = names
    signals = {key: dict(columns=columns[key], unit=units[key]) for key in "qvu"}
    log = source(tmp_path, files="log.*", **signals)
    assert len({part.raw.run for part in log.cleaned}) == len(tables)
    for part in log.cleaned:
        table = tables[int(part.raw.run) if kind == "runs" else 0]
        rows = np.round(100 * part.raw.t).astype(int)
        for key in "qvu":
            np.testing.assert_allclose(getattr(part.raw, key), table[names[key]].to_numpy()[rows])
