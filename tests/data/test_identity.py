"""Identity of data, and the description that is the key of a simulation in the cache."""

import json

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pinn_dyn.data import DataSource, Splits, StoredSource, data_changes, data_identity, store
from pinn_dyn.mechanics import Signal, Trajectory

# Identity.


class Swings(DataSource):
    """Random motions; ``change`` edits the trajectories of each split."""

    name, labels, input_labels = "swings", ["q [rad]"], ["u [Nm]"]

    def __init__(self, change=lambda splits: None):
        self.change = change

    def load(self):
        random = torch.Generator().manual_seed(0)

        def motion(samples):
            q, v, u = torch.randn(3, samples, 1, generator=random, dtype=torch.float64)
            t = torch.arange(samples, dtype=torch.float64)
            return Trajectory(q, v, Signal(t, u))

        splits = {
            "train": [motion(50), motion(60)],
            "validation": [motion(40)],
            "test": [motion(30)],
        }
        self.change(splits)
        return Splits(**splits)


def changes(change=lambda splits: None):
    recorded = json_like(data_identity(Swings()))
    return data_changes(recorded, data_identity(Swings(change)))


def json_like(identity):
    """The identity as a checkpoint keeps it."""
    for part in identity.values():
        for key in ("names", "lengths", "hashes"):
            assert json.loads(json.dumps(part[key])) == part[key]
    return identity


def edited(signal, size):
    def change(splits):
        getattr(splits["train"][1], signal)[17] += size

    return change


def test_the_same_data_have_no_changes():
    assert changes() == []


@pytest.mark.parametrize("signal", ["q", "v", "u"])
@given(size=st.floats(1e-3, 1e3), sign=st.sampled_from([-1, 1]))
def test_a_changed_number_is_found(signal, size, sign):
    assert changes(edited(signal, sign * size)) == ["train trajectory 1 in train has other values"]


def test_other_times_of_the_same_samples_are_found():
    """The same samples at other times, as after a corrected unit of the time."""

    def slower(splits):
        motion = splits["train"][1]
        splits["train"][1] = Trajectory(motion.q, motion.v, Signal(2 * motion.t, motion.u))

    assert changes(slower) == ["train trajectory 1 in train has other values"]


def test_rounding_is_no_change():
    assert changes(edited("q", 1e-12)) == []


def test_trajectories_that_came_went_or_were_cut_are_named():
    assert changes(lambda s: s["train"].pop()) == ["train trajectory 1 is no longer in train"]
    assert changes(lambda s: s["test"].append(s["train"][0])) == [
        "test trajectory 1 is new in test"
    ]
    shorter = changes(lambda s: s.update(test=[s["test"][0].until(20)]))
    assert shorter == ["test trajectory 0 in test has 21 samples, it had 30"]


def test_stored_data_have_the_identity_of_their_source(tmp_path):
    store(Swings(), tmp_path / "data.pt")
    stored = StoredSource(str(tmp_path / "data.pt"), "swings", ["q [rad]"], ["u [Nm]"])
    assert data_changes(data_identity(Swings()), data_identity(stored)) == []


# Description of a simulation.
