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
from pinn_dyn.mechanics import ContinuousPredictor, Predictor, Trajectory
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.gradients import Compiled, Eager, Engine
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
        # For the checkpoint; what the loggers compare is chosen elsewhere.
        hyperparameters = {"config": config, "statistics": statistics.to_dict()}
        self.save_hyperparameters(hyperparameters, logger=False)
        self.model = model
        self.loss = loss
        self.validator = validator
        self._optimizer = optimizer
        self._scheduler = scheduler
        self._compile = compile
        self._losses: list[Tensor] = []  # of this epoch

    def setup(self, stage: str) -> None:
        """Compile here, in the process that trains: compiled code does not reach another one."""
        if stage == "fit":
            self._gradients = self.gradients(int(self.trainer.estimated_stepping_batches))

    def gradients(self, steps: int) -> Engine:
        """How the gradient of the loss is taken, in a training of so many steps."""
        if self._compile and isinstance(self.model, ContinuousPredictor):
            return Compiled(self.loss, self.model, steps)
        return Eager(self.loss, self.model)

    def training_step(self, batch: Windows, batch_idx: int) -> Tensor:
        """Loss of one batch of windows."""
        if batch_idx == 0:
            self._losses.clear()  # of an epoch that was cut short
        # Both counts come back with a checkpoint: a resumed training is as far as it was.
        progress = self.global_step / self.trainer.estimated_stepping_batches
        losses = self._gradients(self.loss.selected(batch, progress))
        loss = losses.sum()  # a single number, but for the members of an ensemble
        if not torch.isfinite(loss):
            raise NonFiniteLossError(
                f"the training loss became {float(loss.detach())} at step {self.global_step} "
                f"(epoch {self.current_epoch}); the checkpoints written before are kept. Lower "
                "optimizer.lr, shorten the window (data.steps, data.stride) or raise the heads' "
                "epsilon, then start again"
            )
        self._losses.append(losses.detach())
        if self.trainer.is_last_batch:
            self.log_losses(torch.stack(self._losses).mean(0))
            self._losses.clear()
        return loss

    def log_losses(self, losses: Tensor) -> None:
        """Log the mean loss of an epoch.

        Once an epoch: a call of ``log`` at every step takes as long as a small network's step.
        """
        self.log(
            "train/loss",
            losses.mean(),
            prog_bar=True,
            on_step=False,
            on_epoch=True,
            batch_size=1,
            sync_dist=True,  # the mean over processes that share a batch
        )

    def validation_step(self, batch: Trajectory, batch_idx: int) -> None:
        """Roll out all validation trajectories."""
        figures = self.validator(self.model, batch)
        # Processes that train together all roll out the same; sync_dist says that this is known.
        named = {f"val/{key}": value for key, value in figures.items()}
        named |= {f"model/{key}": value for key, value in self.model.learned_figures().items()}
        self.log_dict(named, batch_size=1, sync_dist=True)
        error = figures["error_mean"]
        self.log("error", error, prog_bar=True, logger=False, batch_size=1, sync_dist=True)

    def built_optimizer(self) -> Optimizer:
        """The optimizer of the parameters of the model."""
        return self._optimizer(self.model.parameters())

    def configure_optimizers(self) -> Any:
        """The optimizer, with its learning rate scheduled per step."""
        optimizer = self.built_optimizer()
        steps = int(self.trainer.estimated_stepping_batches)
        scheduler = self._scheduler(optimizer, total_steps=steps)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {
                "scheduler": scheduler,
                "interval": "step",
                "name": "train/learning_rate",  # in the log
            },
        }
