"""The LightningDataModule of training windows and validation trajectories."""

from __future__ import annotations

import lightning as L
import torch
from torch.utils.data import DataLoader

from pinn_dyn.data.datamodule import DynamicsData
from pinn_dyn.data.windows import BatchSampler, WindowLoader
from pinn_dyn.mechanics import Trajectory, stack_until


class LightningData(L.LightningDataModule):
    """LightningDataModule for the windows and trajectories of :class:`DynamicsData`."""

    def __init__(self, data: DynamicsData):
        super().__init__()
        self.data = data

    def prepare_data(self) -> None:
        """Simulate or convert the data in a single process before other processes read them."""
        self.data.splits  # noqa: B018

    def sampler(self, seed: int) -> BatchSampler:
        """Return the batches drawn with a seed; each of several processes gets a share."""
        rank, processes = 0, 1
        if self.trainer is not None:
            rank, processes = self.trainer.global_rank, self.trainer.world_size
        return BatchSampler(
            len(self.data.windows),
            batch_size=self.data.batch_size,
            batches=self.data.batches_per_epoch,
            seed=seed,
            rank=rank,
            processes=processes,
        )

    def train_dataloader(self) -> WindowLoader:
        """Return batches in single precision, from windows on the training device."""
        device = torch.device("cpu") if self.trainer is None else self.trainer.strategy.root_device
        windows = self.data.windows.to(device, torch.float32)
        return WindowLoader(windows, self.sampler(self.data.seed))

    def val_dataloader(self) -> DataLoader[Trajectory]:
        """Return a single batch of all validation trajectories, cut to the shortest duration."""
        truth = stack_until(self.data.splits.validation)
        return DataLoader([truth], batch_size=None)  # type: ignore[arg-type]
