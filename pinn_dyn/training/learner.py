"""The LightningModule and the writer of its checkpoints."""

from __future__ import annotations

import copy
import math
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import lightning as L
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import WeightAveraging
from pydantic import PositiveFloat
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from pinn_dyn.atomic_files import save_whole
from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor, Trajectory
from pinn_dyn.models.cholesky import free_weights, output_limits, set_output_limits
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.gradients import Compiled, Eager, Engine
from pinn_dyn.training.losses import NonFiniteLossError, Penalized, WindowLoss
from pinn_dyn.training.parameter_vector import ELEMENTWISE, CompiledAdamW, ParameterVector, clipped


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoint writer that writes a file next to the checkpoint and renames it."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write a checkpoint, and replace an existing one."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_whole(path, checkpoint)


# Lightning warns that batch counts are wrong with dataloader_iter; training_step corrects them.
warnings.filterwarnings("ignore", ".*`dataloader_iter` (argument|step flavor)")

BLOCK_SECONDS = 0.5
"""Longest time between two calls of the callbacks, s."""
_LATEST = 50  # steps that the loss in lines of progress is averaged over

Validator = Callable[[Predictor, Trajectory], dict[str, float]]
"""Function from a model and true trajectories ``(K, T, N)`` to named metrics."""


class DynamicsLearner(L.LightningModule):
    """LightningModule that trains a predictor on windows and validates it by rollouts.

    A training step of Lightning comprises many optimizer steps. It ends if Lightning may have
    something to do: around each ``log_every_n_steps`` steps, at a validation, and after half a
    second. With several processes, or a callback that averages weights, it is a single step.

    Args:
        model: the predictor.
        loss: loss of the model on a batch of windows.
        optimizer: builder of the optimizer from the parameters.
        scheduler: builder of the learning-rate schedule from the optimizer and ``total_steps``.
        validator: metrics on validation trajectories.
        config, statistics: resolved configuration and scales of the data, saved in the checkpoint.
        compile: true to compile the dynamics for training.
        gradient_clip_val: largest norm, or largest entry, of the gradient, if any.
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
        # For the checkpoint. The hyperparameters of loggers are chosen elsewhere.
        hyperparameters = {"config": config, "statistics": statistics.to_dict()}
        self.save_hyperparameters(hyperparameters, logger=False)
        set_output_limits(model, {})  # remove the limits of an earlier training
        self.model = model
        self.loss = Penalized(loss) if model.penalized else loss
        self.validator = validator
        self._optimizer, self._scheduler, self._compile = optimizer, scheduler, compile
        self._clipping = gradient_clip_val, gradient_clip_algorithm == "value"
        self._compiled: CompiledAdamW | None = None
        self._losses: list[Tensor] = []  # losses of this epoch
        self._pace = math.inf  # time of a step, s

    def training_step(self, dataloader_iter: Iterator[tuple[Windows, int, int]]) -> None:
        """Take optimizer steps, one for each batch, until Lightning has something to do."""
        loop, trainer = self.trainer.fit_loop.epoch_loop, self.trainer
        before = loop.batch_progress.current.ready - 1  # steps of this epoch
        if before == 0:
            self._losses.clear()  # of an interrupted epoch
        # Without the hooks of Lightning around a step, which take as long as AdamW.
        optimizer: Any = self.optimizers(use_pl_optimizer=False)
        schedule: Any = self.lr_schedulers()
        options, state = [{**group} for group in optimizer.param_groups], schedule.state_dict()
        step, count = self.global_step, len(self._losses)
        fetched = islice(dataloader_iter, self._steps_until_due(before))
        start = time.monotonic()
        try:
            # Python between two steps evicts the data of the program from the cache: the schedule
            # also runs ahead.
            steps = list(self._prepared_steps(fetched, optimizer, schedule))
            if self._vector.parameters[0].grad is None:  # the trainer clears them at first
                self._vector.show_gradients()
            record, start = self._losses.extend, time.monotonic()
            for take in steps:
                record(take())
        except BaseException:
            for group, before_block in zip(optimizer.param_groups, options, strict=True):
                group.update(before_block)
            schedule.load_state_dict(state)
            for _ in self._losses[count:]:
                schedule.step()
            raise
        finally:
            done = len(self._losses) - count
            self._pace = (time.monotonic() - start) / max(done, 1)
            self._count_steps(done)
            if done:
                self._refuse_non_finite(torch.stack(self._losses[count:]), step)
        period = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if period and self.global_step % period == 0:
            losses = torch.stack(self._losses[-period:]).mean(0)
            reduce = trainer.strategy.reduce  # mean over processes
            figures = {"train/loss": float(reduce(losses))}
            for logger in trainer.loggers:
                logger.log_metrics(figures, self.global_step - 1)
        if before + done >= trainer.num_training_batches:
            # The mean of the epoch, over the processes that share a batch.
            mean = torch.stack(self._losses).mean()
            how = {"on_step": False, "on_epoch": True, "sync_dist": True, "batch_size": 1}
            self.log("train/loss", mean, logger=False, **how)  # type: ignore[arg-type]

    def _count_steps(self, done: int) -> None:
        """Count steps in the loop of Lightning, which has no public way to count several."""
        loop = self.trainer.fit_loop.epoch_loop
        loop.manual_optimization.optim_step_progress.increment_by(done)
        # Lightning counts a single step. Loggers and monitors use the private counter.
        loop.batch_progress.increment_by(done - 1)
        loop._batches_that_stepped += done - 1

    def _prepared_steps(
        self, batches: Iterator[tuple[Windows, int, int]], optimizer: Any, schedule: Any
    ) -> Iterator[Callable[[], list[Tensor]]]:
        """Yield a function for each batch that takes a step, by one program if possible."""
        program = self._compiled
        for step, (batch, _, _) in enumerate(batches, self.global_step):
            # The step is restored from a checkpoint, so a resumed training has the same progress.
            windows = self.loss.selected(batch, step / self._steps)
            take: Any = None
            if program is not None:
                take = self._gradients.step(windows, program)  # type: ignore[attr-defined]
            if take is None:
                program = None  # the schedule of later steps waits for this one
                yield partial(self._step, windows, optimizer, schedule)
            else:
                schedule.step()  # the function has the rate of this step
                yield take

    def _steps_until_due(self, before: int) -> int:
        """Return the number of steps until Lightning may have something to do."""
        trainer = self.trainer
        averaged = any(isinstance(item, WeightAveraging) for item in trainer.callbacks)  # type: ignore[attr-defined]
        if trainer.world_size > 1 or averaged:
            return 1
        steps = self.global_step
        due = [int(trainer.num_training_batches) - before, int(BLOCK_SECONDS / self._pace)]
        if period := trainer.log_every_n_steps:  # type: ignore[attr-defined]
            due += [period - steps % period, period - (steps + 1) % period]
        if isinstance(period := trainer.val_check_batch, int):
            due += [period - steps % period, period - before % period]
        if trainer.max_steps > 0:
            due.append(trainer.max_steps - self.global_step)
        return max(1, min(due))

    def _step(self, windows: Windows, optimizer: Any, schedule: Any) -> list[Tensor]:
        """Take a step of the optimizer and the schedule on a batch, and return the losses."""

        def closure() -> Tensor:
            losses, gradient = self._gradients(windows)
            gradient = self.trainer.strategy.reduce(gradient)  # mean over processes
            self._vector.gradient.copy_(clipped(gradient, *self._clipping))
            return losses

        losses = optimizer.step(closure)
        schedule.step()
        return [losses]

    def _refuse_non_finite(self, losses: Tensor, first: int) -> None:
        for step, loss in enumerate(losses.tolist(), first):
            if not math.isfinite(loss):
                raise NonFiniteLossError(
                    f"the training loss became {loss} at step {step} (epoch {self.current_epoch}): "
                    "reduce optimizer.lr, or use shorter windows (data.steps, data.stride)"
                )

    @property
    def latest_loss(self) -> float:
        """Mean loss of the latest steps of this epoch, 50 at most; NaN before the first."""
        losses = self._losses[-_LATEST:]
        return float(torch.stack(losses).mean()) if losses else math.nan

    def validation_step(self, batch: Trajectory, batch_idx: int) -> None:
        """Roll out all validation trajectories."""
        figures = self.validator(self.model, batch)
        named = {f"val/{key}": value for key, value in figures.items()}
        self.log_dict(named, batch_size=1, sync_dist=True)

    def on_validation_model_zero_grad(self) -> None:
        """Keep the gradients, which are views of one vector."""

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the output limits of the heads for these weights and the training windows."""
        weights = checkpoint["state_dict"]  # possibly averaged by a callback
        model = copy.deepcopy(self.model)
        model.load_state_dict({name.removeprefix("model."): x for name, x in weights.items()})
        q = self.trainer.datamodule.data.windows.q  # type: ignore[attr-defined]
        limits = output_limits(model, q.to(next(model.parameters())))
        weights.update({f"model.{name}": limit for name, limit in limits.items()})

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Remove the output limits for further training."""
        checkpoint["state_dict"] = free_weights(checkpoint["state_dict"])

    def configure_optimizers(self) -> Any:
        """Build the optimizer and the schedule, and the programs, in the training process."""
        if getattr(self.trainer.precision_plugin, "scaler", None) is not None:
            raise ValueError(
                f"trainer.precision {self.trainer.precision} scales the loss: use bf16-mixed or 32"
            )
        self._steps = int(self.trainer.estimated_stepping_batches)
        self._vector = ParameterVector(self.model.parameters())
        self._gradients: Engine = Eager(self.loss, self.model, self._vector)
        if self._compile and isinstance(self.model, ContinuousPredictor):
            self._gradients = Compiled(self.loss, self.model, self._vector, self._steps)
        optimizer = self._optimizer(self._vector.parameters)
        if type(optimizer) in ELEMENTWISE:  # which treat every number separately
            optimizer = self._optimizer([self._vector.values])
        scheduler = self._scheduler(optimizer, total_steps=self._steps)
        compiled = isinstance(self._gradients, Compiled) and self.trainer.world_size == 1
        if compiled and self.device.type == "cpu" and CompiledAdamW.supports(optimizer):
            self._compiled = CompiledAdamW(optimizer, self._vector, *self._clipping)
        schedule = {"scheduler": scheduler, "interval": "step", "name": "train/learning_rate"}
        return {"optimizer": optimizer, "lr_scheduler": schedule}
