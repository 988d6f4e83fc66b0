"""Batches for members: the same windows, each in the order of its own seed."""

import torch

from pinn_dyn.data import LightningData
from pinn_dyn.data.windows import BatchSampler, MemberSampler
from tests.support.ensembles import make_data


def test_the_members_have_the_orders_of_their_own_seeds():
    alone = [BatchSampler(64, batch_size=16, batches=6, seed=seed) for seed in (5, 6, 7)]
    together = MemberSampler(
        [BatchSampler(64, batch_size=16, batches=6, seed=seed) for seed in (5, 6, 7)]
    )
    assert len(together) == 6
    for epoch in (0, 3):
        together.set_epoch(epoch)
        for sampler in alone:
            sampler.set_epoch(epoch)
        found = torch.stack(list(together), dim=1)
        assert torch.equal(found, torch.stack([torch.stack(list(x)) for x in alone]))


def test_the_members_get_batches_of_the_same_windows():
    data = make_data()
    both = list(LightningData(data, 2).train_dataloader())
    single = list(LightningData(data).train_dataloader())
    assert len(both) == len(single) == 8
    for batch, first in zip(both, single, strict=True):
        assert batch.q.shape == (2, 32, 2)
        assert batch.u.shape == (2, 32, 5, 1)
        for name in ("q", "dv", "u", "p"):
            assert torch.equal(getattr(batch, name)[0], getattr(first, name))
        short = batch.first(1)
        assert short.dq.shape == (2, 32, 1, 2)
        assert torch.equal(short.u, batch.u[:, :, :3])
    windows = data.windows.q.float()
    second = torch.cat([batch.q[1] for batch in both])
    assert (second[:, None] == windows).all(-1).any(-1).all()
    assert not torch.equal(second, torch.cat([batch.q[0] for batch in both]))
