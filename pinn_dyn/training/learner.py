"""The LightningModule: trains any predictor on windows."""

from __future__ import annotations

import copy
import math
import time
import warnings
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, Literal

import lightning as L
import torch
from lightning.pytorch.callbacks import WeightAveraging
from pydantic import PositiveFloat
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor, Trajectory
from pinn_dyn.models.output_limits import free_weights, output_limits, set_output_limits
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.gradients import Compiled, Eager, Engine
from pinn_dyn.training.losses import Penalized, WindowLoss
from pinn_dyn.training.parameter_vector import ELEMENTWISE, ParameterVector

# What is said to be wrong by them, such as the counts of batches, is put right below.
warnings.filterwarnings("ignore", ".*`dataloader_iter` (argument|step flavor)")

MOST_SECONDS = 0.5
"""Of steps in a row, until the progress is shown."""

Validator = Callable[[Predictor, Trajectory], dict[str, float]]
"""Maps a model and true trajectories ``(K, T, N)`` to named figures of merit."""


class NonFiniteLossError(RuntimeError):
    """The training loss became NaN or infinite."""


class DynamicsLearner(L.LightningModule):
    """Trains a predictor: windows in, loss on them, roll-outs to validate.

    A training step of Lightning is many steps of the optimizer, as its own hundreds of calls take
    as long as the step of a small network. It ends where something may be due: before and after
    each ``log_every_n_steps`` steps, at a validation, and after half a second. Of several processes
    each step is one of its own, as they have to keep together, and so it is where a callback
    averages the weights over the steps.

    Args:
        model: the predictor.
        loss: loss of the model on a batch of windows.
        optimizer: builds the optimizer from the parameters.
        scheduler: builds the learning-rate schedule from the optimizer and ``total_steps``.
        validator: figures of merit on validation trajectories.
        config: the resolved configuration as plain values; saved in the checkpoint.
        statistics: scales of the data; saved in the checkpoint.
        compile: compile the dynamics for training.
        gradient_clip_val: largest norm of the gradient, or its largest entry; None: any.
        gradient_clip_algorithm: ``"norm"`` or ``"value"``.

    Raises:
        ValueError: in training, if the precision scales the loss.
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
        gradient_clip_val: PositiveFloat | None = None,
        gradient_clip_algorithm: Literal["norm", "value"] | None = None,
    ):
        super().__init__()
        self.automatic_optimization = False
        # For the checkpoint; what the loggers compare is chosen elsewhere.
        hyperparameters = {"config": config, "statistics": statistics.to_dict()}
        self.save_hyperparameters(hyperparameters, logger=False)
        set_output_limits(model, {})  # those of an earlier training
        self.model = model
        self.loss = Penalized(loss) if model.penalized else loss
        self.validator = validator
        self._optimizer = optimizer
        self._scheduler = scheduler
        self._compile = compile
        self._most, self._by_value = gradient_clip_val, gradient_clip_algorithm == "value"
        self._losses: list[Tensor] = []  # of this epoch

    def gradients(self, vector: ParameterVector, steps: int) -> Engine:
        """How loss and gradient in the parameters are taken, in a training of so many steps."""
        if self._compile and isinstance(self.model, ContinuousPredictor):
            return Compiled(self.loss, self.model, vector, steps)
        return Eager(self.loss, self.model, vector)

    def training_step(self, dataloader_iter: Iterator[tuple[Windows, int, int]]) -> None:
        """Steps of the optimizer, one for each batch, until something may be due."""
        loop, trainer = self.trainer.fit_loop.epoch_loop, self.trainer
        before = loop.batch_progress.current.ready - 1  # in this epoch; Lightning counted one
        if before == 0:
            self._losses.clear()  # of an epoch that was cut short
        # Not by way of Lightning, whose hooks around a step take as long as AdamW.
        optimizer = self.optimizers(use_pl_optimizer=False)
        schedule = self.lr_schedulers()
        step, until, done = self.global_step, time.monotonic() + MOST_SECONDS, 0
        known = len(self._losses)
        try:
            for batch, _, _ in islice(dataloader_iter, self._steps_until_due(before)):
                optimizer.step(self._closure(batch, step + done))  # type: ignore[union-attr, arg-type]
                schedule.step()  # type: ignore[union-attr]
                done += 1
                if time.monotonic() > until:
                    break
        finally:
            loop.manual_optimization.optim_step_progress.increment_by(done)
            # Lightning itself counts one. The last of its counters is private, and no public call
            # moves it: its loggers and monitors take the step from there.
            loop.batch_progress.increment_by(done - 1)
            loop._batches_that_stepped += done - 1
            if self.device.type == "cuda" and (new := self._losses[known:]):
                self._refuse_non_finite(torch.stack(new), step)
        if before + done >= trainer.num_training_batches:
            self.log_losses(torch.stack(self._losses).mean(0))
            self._losses.clear()

    def _steps_until_due(self, before: int) -> int:
        """Steps until Lightning may have something to do, after so many in this epoch."""
        trainer = self.trainer
        averaged = any(isinstance(one, WeightAveraging) for one in trainer.callbacks)  # type: ignore[attr-defined]
        if trainer.world_size > 1 or averaged:
            return 1
        steps = self.global_step
        due = [int(trainer.num_training_batches) - before]
        if every := trainer.log_every_n_steps:  # type: ignore[attr-defined]
            due += [every - steps % every, every - (steps + 1) % every]
        if isinstance(every := trainer.val_check_batch, int):
            due += [every - steps % every, every - before % every]
        if trainer.max_steps > 0:
            due.append(trainer.max_steps - self.global_step)
        return max(1, min(due))

    def _closure(self, batch: Windows, step: int) -> Callable[[], Tensor]:
        """What gives the parameters the gradient of a batch, and returns the loss."""
        # The step comes back with a checkpoint: a resumed training is as far as it was.
        windows = self.loss.selected(batch, step / self._steps)

        def closure() -> Tensor:
            losses, gradient = self._gradients(windows)
            if not losses.is_cuda:  # a GPU would have to be waited for: it is asked later
                self._refuse_non_finite(losses[None], step)
            gradient = self.trainer.strategy.reduce(gradient)  # mean over processes
            self._vector.gradient.copy_(clipped(gradient, self._most, self._by_value))
            if self._vector.parameters[0].grad is None:  # the trainer clears them once
                self._vector.show_gradients()
            self._losses.append(losses)
            return losses.sum()  # a single number, but for the members of an ensemble

        return closure

    def _refuse_non_finite(self, losses: Tensor, first: int) -> None:
        """Raise where the losses of the steps from ``first`` on, a row each, are not finite."""
        for step, loss in enumerate(losses.reshape(len(losses), -1).sum(1).tolist(), first):
            if not math.isfinite(loss):
                raise NonFiniteLossError(
                    f"the training loss became {loss} at step {step} (epoch "
                    f"{self.current_epoch}); the checkpoints written before are kept. Lower "
                    "optimizer.lr, shorten the window (data.steps, data.stride) or raise the "
                    "heads' epsilon, then start again"
                )

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

    def on_validation_model_zero_grad(self) -> None:
        """Keep the gradients, which are views of one vector."""

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add how far the heads may go beyond what these weights give on the training windows."""
        weights = checkpoint["state_dict"]  # those of a callback that averages them, maybe
        model = copy.deepcopy(self.model)
        model.load_state_dict({name.removeprefix("model."): x for name, x in weights.items()})
        q = self.trainer.datamodule.windows.q  # type: ignore[attr-defined]
        limits = self.output_limits(model, q.to(next(model.parameters())))
        weights.update({f"model.{name}": limit for name, limit in limits.items()})

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on learning without limits."""
        checkpoint["state_dict"] = free_weights(checkpoint["state_dict"])

    def output_limits(self, model: Predictor, q: Tensor) -> dict[str, Tensor]:
        """How far the heads of a model may go beyond what they give at q ``(K, N)``."""
        return output_limits(model, q)

    def parameter_vector(self) -> ParameterVector:
        """The parameters of the model as one vector."""
        return ParameterVector(self.model.parameters())

    def built_optimizer(self, vector: ParameterVector) -> Optimizer:
        """The optimizer, of all numbers at once where it takes each by itself."""
        optimizer = self._optimizer(vector.parameters)
        return self._optimizer([vector.values]) if type(optimizer) in ELEMENTWISE else optimizer

    def configure_optimizers(self) -> Any:
        """The optimizer, with its learning rate scheduled per step.

        The model is on its device now. What is compiled is compiled here, in the process that
        trains: it does not reach another one.
        """
        if getattr(self.trainer.precision_plugin, "scaler", None) is not None:
            raise ValueError(
                f"trainer.precision is {self.trainer.precision}, which scales the loss: take "
                "bf16-mixed or 32"
            )
        self._steps = int(self.trainer.estimated_stepping_batches)
        self._vector = self.parameter_vector()
        self._gradients = self.gradients(self._vector, self._steps)
        optimizer = self.built_optimizer(self._vector)
        scheduler = self._scheduler(optimizer, total_steps=self._steps)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {
                "scheduler": scheduler,
                "interval": "step",
                "name": "train/learning_rate",  # in the log
            },
        }


def clipped(gradient: Tensor, largest: float | None, by_value: bool = False) -> Tensor:
    """A gradient ``(*members, P)`` scaled down to a norm, each member's own, or cut off at a value.

    Args:
        gradient: of all parameters.
        largest: norm, or value; None: as it is.
        by_value: whether it is a value.
    """
    if largest is None:
        return gradient
    if by_value:
        return gradient.clamp(-largest, largest)
    norm = torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
    # As in most steps: one operation, not five; a GPU would have to be waited for.
    if norm.numel() == 1 and not norm.is_cuda and float(norm) < largest:
        return gradient
    return gradient * (largest / (norm + 1e-6)).clamp(max=1.0)
