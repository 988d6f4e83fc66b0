"""Bags, HDF5, MATLAB 7.3, NPZ and Parquet give the trajectories that the same CSV gives."""

import os
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import yaml
from hydra.utils import instantiate
from rosbags.highlevel import AnyReader

from pinn_dyn.data.logs import LogError, LogSource, Request, Resample
from pinn_dyn.data.logs.columns import to_si
from pinn_dyn.data.logs.readers.bags import read_bag
from tests.data import log_formats as formats
from tests.data.logs_files import arrays_of, assert_read, motion, named, source

TABLE = motion(6.0)
QUERY = Request("/joint_states/t", ["/joint_states/position/elbow", "/commands/data/1"])


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """Decoded bags are kept here."""
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path_factory.mktemp("cache")))


@pytest.mark.parametrize("form", formats.FORMATS)
def test_a_table_is_read_back_from_each_format(tmp_path, form):
    write_to, columns = formats.FORMATS[form]
    write_to(tmp_path / f"run.{form}", TABLE)
    log = source(tmp_path, files=f"run.{form}", **columns)
    assert_read(log, TABLE)
    assert ("of gripper are dropped" in log.report) == ("gripper" in form)


def test_a_bag_is_decoded_once_until_it_changes(tmp_path, monkeypatch):
    formats.write_bag(tmp_path / "run", TABLE)
    table = read_bag(tmp_path / "run", QUERY)
    with monkeypatch.context() as patch:
        patch.delattr(AnyReader, "deserialize")
        again = read_bag(tmp_path / "run", QUERY)
    pd.testing.assert_frame_equal(again.frame, table.frame)
    (cached,) = Path(os.environ["PINN_DYN_CACHE"]).glob("bag-*.npz")
    cached.write_bytes(cached.read_bytes()[:100])  # a damaged file is decoded again
    again = read_bag(tmp_path / "run", QUERY)
    pd.testing.assert_frame_equal(again.frame, table.frame)
    shutil.rmtree(tmp_path / "run")
    formats.write_bag(tmp_path / "run", TABLE[:300])
    assert len(read_bag(tmp_path / "run", QUERY)) == 2 * 300


def test_of_another_clock_inputs_are_the_last_and_velocities_are_interpolated(tmp_path):
    formats.write_bag(tmp_path / "run", TABLE, late=0.004)
    log = source(tmp_path, files="run", **formats.BAG)
    first = log.load().train[0]
    # The command of a row is received 4 ms after it: the next row is the first that has it.
    np.testing.assert_allclose(first.u[:50], TABLE[["u1", "u2"]].to_numpy()[:50], atol=1e-9)
    np.testing.assert_allclose(first.q[:50], TABLE[["q1", "q2"]].to_numpy()[1:51], atol=1e-9)
    assert "1 of 601 rows lack a value and are dropped" in log.report
    u = dict(columns=formats.BAG["q"]["columns"], unit="Nm")
    q = dict(columns=formats.BAG["u"]["columns"], unit="rad")
    description = formats.BAG | {"time": dict(columns="/commands/t", unit="s"), "q": q, "u": u}
    run = source(tmp_path, files="run", **description).cleaned[0].raw
    np.testing.assert_allclose(run.q, TABLE[["u1", "u2"]].to_numpy()[: len(run)], atol=1e-9)
    np.testing.assert_allclose(run.v[:, 0], np.interp(run.t, TABLE["t"], TABLE["v1"]), atol=1e-9)


def test_the_last_of_several_commands_at_a_time_counts_and_rows_are_those_of_q(tmp_path):
    formats.write_bag(tmp_path / "run", TABLE, twice=True)
    for clock in ("t", "header/stamp"):
        time = dict(columns=f"/joint_states/{clock}", unit="s")
        log = source(tmp_path, files="run", **formats.BAG | {"time": time})
        assert_read(log, TABLE)
        assert not log.warnings
    log = source(tmp_path, files="run", **formats.BAG | {"time": {"rate": 100}})
    run = log.cleaned[0].raw
    np.testing.assert_allclose(run.q, TABLE[["q1", "q2"]][: len(run)])
    np.testing.assert_allclose(run.u, TABLE[["u1", "u2"]][: len(run)], atol=1e-9)


def test_stamps_since_1970_are_shown_in_seconds_of_the_run(tmp_path):
    late = TABLE.assign(t=TABLE["t"] + 1_764_000_000.25)
    formats.write_bag(tmp_path / "run", late)
    log = source(tmp_path, files="run", **formats.BAG)
    expected = arrays_of(TABLE)["q"][:200]
    np.testing.assert_allclose(log.load().train[0].q[:200], expected, atol=1e-6)
    assert log.names()["train"][0].startswith("run (0 to ")
    steps = {"resample": Resample(rate=100.0, max_gap=0.005)}
    with pytest.raises(LogError, match=r"run \(0 to .* s\): Resample .* after t = 0 s"):
        source(tmp_path, files="run", steps=steps, **formats.BAG).load()


@pytest.mark.parametrize("name", ["run/run.mcap", "run.bag", "run.bag.active"])
def test_a_bag_cut_short_is_named(tmp_path, name):
    version = 2 if "mcap" in name else 1
    path = tmp_path / name
    formats.write_bag(tmp_path / name.split("/")[0], TABLE, version=version)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    cure = f" Repair it by rosbag reindex {path.name}" if version == 1 else ""
    cure += " and rename it to run.bag" if path.suffix == ".active" else ""
    with pytest.raises(LogError, match=rf"{path.name}: cannot be read as .* cut short\?{cure}"):
        source(tmp_path, files=name, **formats.BAG).load()


def test_python_objects_in_npz_are_refused(tmp_path):
    formats.write_npz(tmp_path / "objects.npz", TABLE, q=np.array([{"a": 1}], dtype=object))
    with pytest.raises(LogError, match=r"cannot be read as \.npz, save plain arrays: Object"):
        source(tmp_path, files="objects.npz", **formats.VECTORS).load()


def test_lerobot_files_have_vectors_and_episodes_also_without_their_column(tmp_path):
    formats.write_lerobot(tmp_path, TABLE)
    parts = source(tmp_path, **formats.LEROBOT).cleaned
    assert len({part.raw.run for part in parts}) == 3
    np.testing.assert_allclose(parts[0].raw.q[:, 0], TABLE["q1"][: len(parts[0].raw)])
    np.testing.assert_allclose(parts[0].raw.u[:, 1], TABLE["u2"][: len(parts[0].raw)])
    log = source(tmp_path, **{**formats.LEROBOT, "trajectory": None})
    assert len({part.raw.run for part in log.cleaned}) == 3
    assert "the time goes back to 0 s: a run is assumed to start there (2 such rows)" in log.report


PAGE = (Path(__file__).parents[2] / "docs" / "bags_and_other_logs.md").read_text()
BLOCKS = [yaml.safe_load(text) for text in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)]


def test_the_configurations_of_the_documentation_read_such_files(tmp_path):
    table = motion(30.0)
    formats.write_bag(tmp_path / "bag", table)
    formats.write_hdf5(tmp_path / "run.h5", table)
    formats.write_lerobot(tmp_path, table)
    (tmp_path / "bag" / "bag.mcap").rename(tmp_path / "bag.mcap")
    assert [x["files"] for x in BLOCKS] == [
        *("*.mcap", "*.h5", "data/*/*.parquet"),
    ]
    for block in BLOCKS:
        given = {key: value for key, value in block.items() if key != "defaults"}
        given["steps"] = {key: instantiate(x) for key, x in given.get("steps", {}).items()}
        train = LogSource(root=str(tmp_path), **given).load().train[0]
        for name in ("q2", "u1", "u2"):  # q1 differs from episode to episode
            column = (train.q if name[0] == "q" else train.u)[:300, int(name[1]) - 1]
            _, factor = to_si(given[name[0]]["unit"])
            np.testing.assert_allclose(column, factor * table[name][:300], atol=1e-6)


def test_groups_of_hdf5_are_runs(tmp_path):
    """robomimic and the like write the episodes of a file as groups."""
    with h5py.File(tmp_path / "demos.h5", "w") as file:
        for k, phase in enumerate((0.0, 1.0, 2.5)):
            table = motion(4.0, phase=phase)
            for name in "tqvu":
                columns = [x for x in table if x.startswith(name)]
                file[f"data/demo_{k}/obs/{name}"] = table[columns].to_numpy()
        file["data/total"] = 3
    log = source(
        tmp_path,
        files="*.h5",
        validation=dict(runs=["demo_1"], piece=1.0),
        test=dict(runs=["demo_2"], piece=1.0),
        **named("data/*/obs/{}_{}", "data/*/obs/t"),
    )
    (run,) = log.load().train
    np.testing.assert_allclose(run.q[:, 1], motion(4.0)["q2"])
