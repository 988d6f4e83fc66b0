import numpy as np
import pytest
import torch
from PIL import Image

from pinn_dyn.control.closed_loop import ClosedLoopRecord
from pinn_dyn.control.contracts import Motion
from pinn_dyn.evaluation.animation import animate
from pinn_dyn.systems import SoftArm

RED = np.array([0xCC, 0, 0])


def make_record(q, q_ref, t):
    zero = torch.zeros_like(q)
    return ClosedLoopRecord(t, q, zero, zero, zero, Motion(q_ref, zero, zero), [None])


@pytest.fixture
def bending():
    """Two segments that bend up to a set point within 0.5 s, sampled at 10 ms."""
    t = 0.01 * torch.arange(51, dtype=torch.float64)
    goal = torch.tensor([1.0, 0.4, 0.1, -0.5, 0.8, 0.0], dtype=torch.float64)
    q_ref = goal.expand(1, 51, 6)
    return make_record(q_ref * (2 * t)[:, None], q_ref, t)


def stop(record, sample, reason="0.20 s: too fast"):
    record.q[0, sample:] = torch.nan
    record.stopped[0] = reason


def frames(path):
    """The pixels of a GIF and the time of each of its frames in ms."""
    with Image.open(path) as image:
        found, times = [], []
        for k in range(image.n_frames):
            image.seek(k)
            found.append(np.asarray(image.convert("RGB")).astype(int))
            times.append(image.info["duration"])
    return found, times


def count_red(pixels):
    return int((np.abs(pixels - RED).sum(-1) < 60).sum())


def test_a_gif_runs_in_real_time_and_ends_with_the_last_sample(bending, tmp_path):
    path = tmp_path / "arm.gif"
    animate(bending, 0, SoftArm(2), path)
    found, times = frames(path)
    # From 0 s up to 0.45 s, and the last sample at 0.5 s.
    assert times == [50] * 10 + [1000]
    assert path.stat().st_size < 200_000
    # The path of the tip grows.
    assert count_red(found[-1]) > count_red(found[7]) > count_red(found[0])
    # The wanted shape is grey, and covered once the arm has come there; the legend is below.
    grey = [(np.abs(x[40:-40] - 0.7 * 255).max(-1) < 8).sum() for x in (found[0], found[-1])]
    assert grey[0] > 300 + grey[1]


def test_a_stopped_run_is_drawn_up_to_its_stop(bending, tmp_path):
    stop(bending, 21)
    animate(bending, 0, SoftArm(2), tmp_path / "arm.gif")
    assert frames(tmp_path / "arm.gif")[1] == [50] * 4 + [1000]  # 0 to 0.15 s, 0.2 s
