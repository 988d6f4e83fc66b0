"""The LightningModule: trains any predictor on windows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import lightning as L
import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Predictor, Trajectory
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.losses import WindowLoss

Validator = Callable[[Predictor, Trajectory], dict[str, float]]
"""Maps a model and true trajectories ``(K, T, N)`` to named figures of merit."""


class NonFiniteLossError(RuntimeError):
    """The training loss became NaN or infinite."""


class DynamicsLearner(L.LightningModule):
    """Trains a predictor: windows in, loss on them, roll-outs to validate.

    Args:
        model: the predictor.
        loss: loss of the model on a batch of windows.
        optimizer: builds the optimizer from the parameters.
        scheduler: builds the learning-rate schedule from the optimizer and ``total_steps``.
        validator: figures of merit on validation trajectories.
        config: the resolved configuration as plain values; saved in the checkpoint.
        statistics: scales of the data; saved in the checkpoint.
        compile: compile the dynamics for training.

    Raises:
        NonFiniteLossError: in training, when the loss is NaN or infinite.
    """

    def __init__(
        self,
        model: Predictor,
        *,
        loss: WindowLoss,
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler],
        validator: Validator,
        config: dict[str, Any],
        statistics: Statistics,
        compile: bool,
    ):
        super().__init__()
        self.save_hyperparameters({"config": config, "statistics": statistics.to_dict()})
        self.model = model
        self.loss = loss
        self.validator = validator
        self._optimizer = optimizer
        self._scheduler = scheduler
        if compile:
            loss.compile_dynamics(model)

    def training_step(self, batch: Windows, batch_idx: int) -> Tensor:
        """Loss of one batch of windows."""
        # Both counts come back with a checkpoint: a resumed training is as far as it was.
        progress = self.global_step / self.trainer.estimated_stepping_batches
        loss = self.loss(self.model, batch, progress)
        if not torch.isfinite(loss):
            raise NonFiniteLossError(
                f"the training loss became {float(loss.detach())} at step {self.global_step} "
                f"(epoch {self.current_epoch}); the checkpoints written before are kept. Lower "
                "optimizer.lr, shorten the window (data.steps, data.stride) or raise the heads' "
                "epsilon, then start again"
            )
        self.log("train/loss", loss, prog_bar=True, on_step=False, on_epoch=True, batch_size=1)
        return loss

    def validation_step(self, batch: Trajectory, batch_idx: int) -> None:
        """Roll out all validation trajectories."""
        figures = self.validator(self.model, batch)
        self.log_dict({f"val/{key}": value for key, value in figures.items()}, batch_size=1)
        self.log("error", figures["error_mean"], prog_bar=True, logger=False, batch_size=1)

    def configure_optimizers(self) -> Any:
        """The optimizer, with its learning rate scheduled per step."""
        optimizer = self._optimizer(self.model.parameters())
        scheduler = self._scheduler(
            optimizer, total_steps=int(self.trainer.estimated_stepping_batches)
        )
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }
