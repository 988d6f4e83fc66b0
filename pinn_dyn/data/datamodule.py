"""The LightningDataModule: windows for training, whole trajectories for validation and test."""

from __future__ import annotations

import lightning as L
import torch
from torch.utils.data import DataLoader

from pinn_dyn.data.source import DataSource, Splits
from pinn_dyn.data.windows import BatchSampler, WindowDataset, Windows, draw_windows
from pinn_dyn.mechanics import Trajectory, stack
from pinn_dyn.models.statistics import Statistics


class DynamicsData(L.LightningDataModule):
    """Training pairs from a data source, drawn from its training trajectories alone.

    Args:
        source: where the trajectories come from.
        pairs: number of training windows.
        steps: steps H of a window; 1 gives the paper's transition pairs.
        stride: samples of the data in a step.
        batch_size: windows in a batch.
        batches_per_epoch: batches in what the trainer counts as an epoch.
        seed: seed of the windows and their order.

    Raises:
        ValueError: on counts below 1, or a batch larger than the number of pairs.
    """

    def __init__(
        self,
        source: DataSource,
        *,
        pairs: int,
        steps: int,
        stride: int,
        batch_size: int,
        batches_per_epoch: int,
        seed: int,
    ):
        super().__init__()
        for name, value in (("batch_size", batch_size), ("batches_per_epoch", batches_per_epoch)):
            if value < 1:
                raise ValueError(f"{name} is {value}, expected at least 1")
        if batch_size > pairs:
            raise ValueError(
                f"batch_size is {batch_size}, expected at most the number of pairs, {pairs}"
            )
        self.source = source
        self.pairs = pairs
        self.steps = steps
        self.stride = stride
        self.batch_size = batch_size
        self.batches_per_epoch = batches_per_epoch
        self.seed = seed
        self._splits: Splits | None = None
        self._windows: Windows | None = None

    def prepare_data(self) -> None:
        """Simulate or convert the data once, before other processes read them."""
        self.splits  # noqa: B018

    @property
    def splits(self) -> Splits:
        """The trajectories."""
        if self._splits is None:
            self._splits = self.source.load()
        return self._splits

    @property
    def windows(self) -> Windows:
        """The training windows."""
        if self._windows is None:
            splits = self.splits
            self._windows = draw_windows(
                splits.train,
                count=self.pairs,
                steps=self.steps,
                stride=self.stride,
                seed=self.seed,
            )
        return self._windows

    @property
    def statistics(self) -> Statistics:
        """Scales of the training windows."""
        return self.windows.statistics()

    def train_dataloader(self) -> DataLoader[Windows]:
        """Batches of windows, in single precision."""
        windows = self.windows.to(torch.device("cpu"), torch.float32)
        return DataLoader(
            WindowDataset(windows),
            batch_size=None,
            sampler=BatchSampler(
                len(windows),
                batch_size=self.batch_size,
                batches=self.batches_per_epoch,
                seed=self.seed,
            ),
        )

    def val_dataloader(self) -> DataLoader[Trajectory]:
        """One batch: all validation trajectories."""
        return DataLoader([stack(self.splits.validation)], batch_size=None)  # type: ignore[arg-type]
