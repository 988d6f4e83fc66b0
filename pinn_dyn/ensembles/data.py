"""Batches for the members of an ensemble."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.utils.data import Sampler

from pinn_dyn.data import DynamicsData, LightningData
from pinn_dyn.data.windows import BatchSampler


class EnsembleData(LightningData):
    """Data module in which member k has the training windows in the order of ``data.seed + k``."""

    def __init__(self, data: DynamicsData, members: int):
        super().__init__(data)
        self.members = members

    def sampler(self, seed: int) -> MemberSampler:
        """Return the positions in batches ``(E, B)``."""
        seeds = range(seed, seed + self.members)
        return MemberSampler([super(EnsembleData, self).sampler(seed) for seed in seeds])


class MemberSampler(Sampler[Tensor]):
    """Sampler of batches ``(E, batch_size)`` from a sampler for each member."""

    def __init__(self, samplers: list[BatchSampler]):
        self.samplers = samplers

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, as the trainer does at its start."""
        for sampler in self.samplers:
            sampler.set_epoch(epoch)

    def __len__(self) -> int:
        return len(self.samplers[0])

    def __iter__(self) -> Iterator[Tensor]:
        return map(torch.stack, zip(*self.samplers, strict=True))
