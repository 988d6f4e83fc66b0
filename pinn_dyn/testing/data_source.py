"""Suite for data sources. Inherit it and override ``source``, ``again`` and ``changed``."""

import pytest
import torch

from pinn_dyn.data import (
    DataSource,
    DynamicsData,
    LightningData,
    data_changes,
    data_identity,
    draw_windows,
)

SPLITS = ("train", "validation", "test")


class DataSourceContract:
    """Suite for a source of trajectories."""

    @pytest.fixture
    def source(self) -> DataSource:
        """Return a small source."""
        raise NotImplementedError("override the fixture 'source'")

    @pytest.fixture
    def again(self) -> DataSource:
        """Return the same source, built again."""
        raise NotImplementedError("override the fixture 'again'")

    @pytest.fixture
    def changed(self) -> DataSource:
        """Return a source of the same class and name with different data."""
        raise NotImplementedError("override the fixture 'changed'")

    def test_labels_and_angles_match_the_trajectories(self, source):
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

    def test_trajectories_are_finite_float64_start_at_zero_and_differ(self, source):
        for split in SPLITS:
            trajectories = getattr(source.load(), split)
            assert trajectories
            for item in trajectories:
                assert item.t[0] == 0
                assert (item.t.diff() > 0).all()
                for value in (item.t, item.q, item.v, item.u):
                    assert value.dtype == torch.float64
                    assert value.isfinite().all()

        runs = [item for split in SPLITS for item in getattr(source.load(), split)]
        starts = {tuple(item.q[:3].flatten().tolist()) for item in runs}
        assert len(starts) == len(runs)  # no motion is in two splits

    def test_a_second_load_gives_the_same_numbers_and_identity(self, source, again, changed):
        for split in SPLITS:
            pairs = zip(getattr(source.load(), split), getattr(again.load(), split), strict=True)
            for first, second in pairs:
                assert torch.equal(first.q, second.q)
                assert torch.equal(first.u, second.u)
        recorded = data_identity(source)
        assert data_changes(recorded, data_identity(again)) == []
        assert data_changes(recorded, data_identity(changed))

    def test_windows_and_batches_can_be_drawn(self, source):
        windows = draw_windows(source.load().train, count=4, steps=2, stride=1, seed=0)
        assert windows.q.shape == (4, len(source.labels))
        data = DynamicsData(
            source, pairs=4, steps=2, stride=1, batch_size=2, batches_per_epoch=2, seed=0
        )
        assert len(list(LightningData(data).train_dataloader())) == 2
