"""Batches for the members of an ensemble."""

from __future__ import annotations

from collections.abc import Iterator

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Sampler

from pinn_dyn.data import DataSource, DynamicsData
from pinn_dyn.data.windows import BatchSampler, WindowLoader, Windows
from pinn_dyn.mechanics import Trajectory


class EnsembleData(L.LightningDataModule):
    """Data module in which member k has the training windows in the order of ``data.seed + k``."""

    def __init__(self, data: DynamicsData, members: int):
        super().__init__()
        self.data, self.members = data, members

    @property
    def source(self) -> DataSource:
        """Source of the trajectories."""
        return self.data.source

    @property
    def windows(self) -> Windows:
        """Training windows, the same for all members."""
        return self.data.windows

    def prepare_data(self) -> None:
        """Simulate or convert the data once, before other processes read them."""
        self.data.prepare_data()

    def train_dataloader(self) -> WindowLoader:
        """Return batches ``(E, B, ...)``."""
        self.data.trainer = self.trainer  # for the device and the processes
        seeds = range(self.data.seed, self.data.seed + self.members)
        return self.data.loader(MemberSampler([self.data.sampler(seed) for seed in seeds]))

    def val_dataloader(self) -> DataLoader[Trajectory]:
        """Return a single batch of all validation trajectories."""
        return self.data.val_dataloader()


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
