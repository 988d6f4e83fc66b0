"""Names of LeRobot, several runs in a file, and attributes of HDF5."""

import json

import h5py
import numpy as np
import pytest
import scipy.io
import torch

from pinn_dyn.data.logs import LogError
from tests.data import log_formats as formats
from tests.data.logs_files import arrays_of, motion, named, source

TABLE = motion(6.0)
HDF5 = dict(files="*.h5", **named("log/{}_{}", "log/t"))


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
    ],
)
def test_lerobot_entries_have_the_names_of_the_data_set(tmp_path, names):
    write_lerobot(tmp_path, names)
    q = [f"observation.state/{name}" for name in ("elbow.pos", "main_shoulder_pan")]
    log = source(tmp_path, **formats.LEROBOT | {"q": dict(columns=q, unit="rad")})
    run = log.cleaned[0].raw
    np.testing.assert_allclose(run.q, TABLE[["q2", "q1"]][: len(run)])


def test_lerobot_names_that_do_not_fit_are_answered_with_numbers_that_work(tmp_path):
    write_lerobot(tmp_path, ["elbow"])
    q = dict(columns=["observation.state/elbow"], unit="rad")
    with pytest.raises(LogError, match=r"1 names .* 2 entries.* observation.state_1 to .*_2;"):
        source(tmp_path, **formats.LEROBOT | {"q": q}).load()
    run = source(tmp_path, **formats.LEROBOT).cleaned[0].raw
    np.testing.assert_allclose(run.q, TABLE[["q1", "q2"]][: len(run)])


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
        ("npz", numbered),
        ("h5", shared_clock),
        ("h5", time_first),
        ("mat", numbered),
        ("pt", stacked),
    ],
)
def test_arrays_of_several_runs(tmp_path, kind, form):
    tables = [motion(6.0, phase=k) for k in range(3)]
    runs = [{**arrays_of(x), "u": arrays_of(x)["u"][:-1]} for x in tables]
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
    log = source(tmp_path, files=path.name, **formats.VECTORS)
    assert len(log.warnings) == 1  # of all runs: the last row is left out
    recordings = {part.raw.run: part.raw for part in log.cleaned if part.split == "train"}
    for k, table in enumerate(tables):
        run = recordings[f"{k}"]
        for name in "qvu":
            expected = table[[f"{name}1", f"{name}2"]].to_numpy()[: len(run)]
            np.testing.assert_allclose(getattr(run, name), expected)
