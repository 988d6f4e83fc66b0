"""The order of windows in batches."""

import torch

from pinn_dyn.data.windows import BatchSampler


def batches(epoch=0, seed=0, size=64, batch_size=16, number=4):
    sampler = BatchSampler(size, batch_size=batch_size, batches=number, seed=seed)
    sampler.set_epoch(epoch)
    return torch.stack(list(sampler))


def test_batches_depend_on_the_seed_and_the_epoch_alone():
    assert torch.equal(batches(epoch=3), batches(epoch=3))
    assert not torch.equal(batches(epoch=3), batches(epoch=4))
    assert not torch.equal(batches(seed=0), batches(seed=1))
    # Sweeps have seeds in a row.
    assert not torch.equal(batches(seed=0, epoch=1), batches(seed=1, epoch=0))
    # A sampler that has been through earlier epochs gives what a fresh one gives.
    sampler = BatchSampler(64, batch_size=16, batches=4, seed=0)
    for epoch in range(4):
        sampler.set_epoch(epoch)
        last = torch.stack(list(sampler))
    assert torch.equal(last, batches(epoch=3))


def test_no_window_comes_twice_in_a_pass_that_does_not_divide_evenly():
    order = batches(size=70, number=8)
    assert order.shape == (8, 16)
    for one_pass in order.reshape(2, 64):
        assert len(set(one_pass.tolist())) == 64


def test_the_shares_of_several_processes_are_the_batch_of_one():
    settings = dict(batch_size=12, batches=7, seed=3)
    alone = BatchSampler(64, **settings)
    shares = [BatchSampler(64, **settings, rank=rank, processes=3) for rank in range(3)]
    for sampler in (alone, *shares):
        sampler.set_epoch(2)
    for batch, *parts in zip(alone, *shares, strict=True):
        assert [len(part) for part in parts] == [4, 4, 4]
        assert sorted(torch.cat(parts).tolist()) == sorted(batch.tolist())
