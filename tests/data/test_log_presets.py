"""The presets: four recorded data sets where they are at hand, and the templates."""

import re
from pathlib import Path

import pytest
import torch

from pinn_dyn.app.config import composed
from pinn_dyn.data import draw_windows, logs
from pinn_dyn.mechanics import stack
from pinn_dyn.run.configuration.build import build_source
from tests.data.logs_files import motion, write
from tests.support.recorded_logs import LOGS, needs_logs

ROOT = Path(__file__).resolve().parents[2]


def preset(name, *overrides):
    return build_source(composed("train", [f"dataset={name}", *overrides]))


@needs_logs
@pytest.mark.parametrize(
    ("name", "train", "validation", "test", "step", "coordinates", "inputs"),
    [
        ("panda_gaz", 1, 1, 1, 0.002, 7, 7),
        ("double_pendulum", 7, 5, 10, 0.002, 2, 2),
        ("soft_neck", 103, 6, 12, 0.02, 2, 6),
        ("trunk", 1, 4, 15, 0.01, 4, 6),
    ],
)
def test_recorded_data_sets(name, train, validation, test, step, coordinates, inputs, monkeypatch):
    monkeypatch.setenv("PINN_DYN_LOGS", str(LOGS))
    source = preset(name)
    splits = source.load()
    assert [len(x) for x in (splits.train, splits.validation, splits.test)] == [
        train,
        validation,
        test,
    ]
    windows = draw_windows(splits.train, count=1000, steps=4, stride=1, seed=0)
    assert windows.t[1] == pytest.approx(step)
    assert windows.q.shape[1] == coordinates == len(source.labels)
    assert windows.u.shape[2] == inputs == len(source.input_labels)
    # v belongs to q: the trapezoidal rule over four steps leaves little of each increment. Late
    # frames are in the trunk's q, which is not filtered.
    left = 0.15 if name == "trunk" else 0.1
    for item in (stack(splits.validation), stack(splits.test)):
        dq = item.q[:, 4:] - item.q[:, :-4]
        weights = torch.tensor([0.5, 1, 1, 1, 0.5], dtype=torch.float64) * step
        integral = (item.v.unfold(1, 5, 1) * weights).sum(-1)
        assert (dq - integral).std() < left * dq.std()
    assert "## Warnings\n\n- none" in source.report


def test_neck_with_its_moving_average(tmp_path):
    table = motion(300.0, rate=10.0)
    write(tmp_path, table.assign(u3=-table["u1"], u4=-table["u2"]), "neck.csv")
    source = preset("neck", f"dataset.root='{tmp_path}'", "dataset.files=neck.csv")
    splits = source.load()
    assert len(splits.test) == 10
    assert splits.test[0].t[-1] == pytest.approx(5.0)
    assert splits.train[0].u.shape[1] == 4
    assert "mean of 50 samples (5 s) of q, v, u" in source.report


def test_the_documentation_names_every_unit_and_step():
    text = (ROOT / "docs" / "csv_logs.md").read_text()
    assert [unit for unit in logs.UNITS if f"`{unit}`" not in text] == []
    steps = [
        name
        for name in logs.__all__
        if name != "Step"
        and isinstance(getattr(logs, name), type)
        and issubclass(getattr(logs, name), logs.Step)
    ]
    assert len(steps) == 13
    assert [name for name in steps if f"`{name}" not in text] == []


def test_the_sections_that_measurements_link_to_exist():
    rooms = ROOT / "pinn_dyn" / "data" / "logs", ROOT / "pinn_dyn" / "log_check"
    code = [path for room in rooms for path in room.rglob("*.py")]
    links = set(re.findall(r'"docs/(\w+\.md)#([\w-]+)"', "".join(x.read_text() for x in code)))
    assert len(links) >= 3
    for page, anchor in links:
        headings = re.findall(r"^#+ (.*)$", (ROOT / "docs" / page).read_text(), re.MULTILINE)
        anchors = [re.sub(r"[^\w -]", "", x).lower().replace(" ", "-") for x in headings]
        assert anchor in anchors
