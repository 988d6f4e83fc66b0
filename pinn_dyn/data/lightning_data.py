"""The LightningDataModule of training windows and validation trajectories."""

from __future__ import annotations

import lightning as L
import torch
from torch.utils.data import DataLoader

from pinn_dyn.data.datamodule import DynamicsData
from pinn_dyn.data.windows import BatchSampler, WindowLoader
from pinn_dyn.mechanics import Trajectory, stack_until


class LightningData(L.LightningDataModule):
    """Data module of Lightning for the windows and trajectories of :class:`DynamicsData`."""

    def __init__(self, data: DynamicsData):
        super().__init__()
        self.data = data

    def prepare_data(self) -> None:
        """Simulate or convert the data once, before other processes read them."""
        self.data.splits  # noqa: B018

    def sampler(self, seed: int) -> BatchSampler:
        """Return the order of the windows by a seed, a share for each of several processes."""
        trainer = self.trainer
        return BatchSampler(
            len(self.data.windows),
            batch_size=self.data.batch_size,
            batches=self.data.batches_per_epoch,
            seed=seed,
            rank=0 if trainer is None else trainer.global_rank,
            processes=1 if trainer is None else trainer.world_size,
        )

    def train_dataloader(self) -> WindowLoader:
        """Return batches in single precision, from windows on the device that trains."""
        device = torch.device("cpu") if self.trainer is None else self.trainer.strategy.root_device
        windows = self.data.windows.to(device, torch.float32)
        return WindowLoader(windows, self.sampler(self.data.seed))

    def val_dataloader(self) -> DataLoader[Trajectory]:
        """Return one batch: all validation trajectories, up to the end of the shortest."""
        truth = stack_until(self.data.splits.validation)
        return DataLoader([truth], batch_size=None)  # type: ignore[arg-type]
