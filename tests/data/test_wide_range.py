"""The paper's range of the one-segment arm: what inputs and motions cover, what is beyond."""

import shlex

import numpy as np
import pytest
from omegaconf import OmegaConf

from pinn_dyn.run.configuration.build import build_source
from reproduce import read_entries
from tests.support.composing import compose

T = np.linspace(0, 5, 501)


def build(name, *overrides):
    cfg = compose("train", f"dataset={name}", *overrides)
    return build_source({"dataset": OmegaConf.to_container(cfg.dataset, resolve=True)})


@pytest.fixture(scope="module")
def wide():
    return build("soft_arm_1_wide")


@pytest.fixture(scope="module")
def beyond():
    entry = read_entries()["beyond/soft_arm_1_wide"]
    words = shlex.split(entry["evaluate"])
    return build("soft_arm_1_wide", *(f"++{word}" for word in words if "dataset." in word))


def drawn(source, split, count):
    """Initial configurations and inputs of a split, before any is drawn anew."""
    index = ("train", "validation", "test").index(split)
    rng = np.random.default_rng([source.seed, index])
    q, _ = source.initial_states.draw(count, rng)
    return q, source.excitation.draw(count, source.duration, rng)(T)


def test_inputs_cover_the_papers_range_and_no_more(wide):
    _, u = drawn(wide, "train", wide.counts["train"][0])
    low, high = u.min((0, 1)), u.max((0, 1))
    assert (low >= [-2.0, -2.0, -1.3]).all()
    assert (high <= [2.0, 2.0, 2.6]).all()
    assert (low[:2] < -1.8).all()
    assert low[2] < -1.2
    assert (high[:2] > 1.8).all()
    assert high[2] > 2.3


def longest_rest(moving):
    return np.diff(np.flatnonzero(np.concatenate([[True], moving, [True]]))).max() - 1


def test_inputs_are_held_for_a_tenth_of_a_second_to_two(wide):
    """Levels of the fast steps last 0.1 to 0.5 s and of the slow ones up to 2 s, ramps included."""
    _, u = drawn(wide, "train", 60)
    rate = 1 / (T[1] - T[0])
    moving = np.abs(np.diff(u[..., 0], axis=1)) * rate > 1e-9
    kinds = len(wide.excitation.parts)
    held = np.array([max(map(longest_rest, moving[k::kinds])) for k in range(kinds)]) / rate
    assert (held[:2] < 0.02).all()  # sines never stand still
    assert (held[2:4] > 1.5).all()
    assert (held[2:4] <= 2.0).all()
    assert (held[4:] > 0.3).all()
    assert (held[4:] <= 0.5).all()


def test_inputs_beyond_the_range_exceed_it(beyond):
    _, u = drawn(beyond, "test", 20)
    assert (np.abs(u[..., :2]).max((0, 1)) > 2.2).all()
    assert u[..., 2].max() > 2.7
    assert u[..., 2].min() >= -1.3 - 1e-9
    assert np.abs(u[..., :2]).max() <= 2.6
