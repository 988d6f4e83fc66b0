"""What every data source must satisfy: inherit the suite and override the ``source`` fixture."""

import json

import pytest
import torch

from pinn_dyn.app.provenance import data_hash
from pinn_dyn.data import DataSource, DynamicsData, draw_windows, fingerprint_changes

SPLITS = ("train", "validation", "test")


class DataSourceContract:
    """The suite; a source of your own passes it with ``load`` and four attributes."""

    @pytest.fixture
    def source(self) -> DataSource:
        """A small source."""
        raise NotImplementedError("override this fixture")

    @pytest.fixture
    def again(self) -> DataSource:
        """The same source, built anew as another process would."""
        raise NotImplementedError("override this fixture")

    @pytest.fixture
    def changed(self) -> DataSource:
        """A source of other data that has the same class and name."""
        raise NotImplementedError("override this fixture")

    def test_names_units_and_angles_belong_to_the_coordinates_and_inputs(self, source):
        for split in SPLITS:
            for item in getattr(source.load(), split):
                assert item.q.shape == item.v.shape == (len(item.t), len(source.labels))
                assert item.u.shape == (len(item.t), len(source.input_labels))
        assert all(isinstance(x, str) for x in (*source.labels, *source.input_labels))
        assert set(source.angles) <= set(range(len(source.labels)))
        assert all(len(q) == len(source.labels) for q in source.configurations.values())
        if source.system is not None:
            assert source.system.num_coordinates == len(source.labels)
            assert source.system.num_inputs == len(source.input_labels)

    def test_trajectories_are_finite_in_double_precision_on_clocks_of_their_own(self, source):
        for split in SPLITS:
            trajectories = getattr(source.load(), split)
            assert trajectories
            for item in trajectories:
                assert item.t[0] == 0
                assert (item.t.diff() > 0).all()
                for value in (item.t, item.q, item.v, item.u):
                    assert value.dtype == torch.float64
                    assert value.isfinite().all()

    def test_no_motion_is_in_two_splits(self, source):
        starts = {
            split: [item.q[:3].tolist() for item in getattr(source.load(), split)]
            for split in SPLITS
        }
        for one, other in (SPLITS[:2], SPLITS[1:], SPLITS[::2]):
            assert not [start for start in starts[one] if start in starts[other]]

    def test_a_second_load_gives_the_same_numbers(self, source, again):
        for split in SPLITS:
            for one, other in zip(
                getattr(source.load(), split), getattr(again.load(), split), strict=True
            ):
                assert torch.equal(one.q, other.q)
                assert torch.equal(one.u, other.u)

    def test_the_fingerprint_is_of_the_data_and_of_nothing_else(self, source, again, changed):
        recorded = json.loads(json.dumps(source.fingerprint(), allow_nan=False))
        assert fingerprint_changes(recorded, again.fingerprint()) == []
        assert fingerprint_changes(recorded, changed.fingerprint())
        assert data_hash(source) == data_hash(again) != data_hash(changed)

    def test_windows_and_batches_can_be_drawn(self, source):
        windows = draw_windows(source.load().train, count=4, steps=2, stride=1, seed=0)
        assert windows.q.shape == (4, len(source.labels))
        data = DynamicsData(
            source, pairs=4, steps=2, stride=1, batch_size=2, batches_per_epoch=2, seed=0
        )
        assert len(list(data.train_dataloader())) == 2
