"""Training in one call, from Python: notebooks and scripts that need no run folder."""

from __future__ import annotations

from functools import partial

import lightning as L
from torch.optim import AdamW

from pinn_dyn.data.datamodule import DynamicsData
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models.output_limits import output_limits, set_output_limits
from pinn_dyn.training.learner import DynamicsLearner
from pinn_dyn.training.losses import IncrementLoss, WindowLoss
from pinn_dyn.training.schedule import one_cycle


def fit(
    model: Predictor,
    data: DynamicsData,
    *,
    epochs: int,
    learning_rate: float,
    loss: WindowLoss | None = None,
    compile: bool = False,
    progress: bool = True,
) -> list[float]:
    """Train a model on the CPU, as train.py does by default, and write no file.

    AdamW with a weight decay of 1e-5, a learning rate that rises over the first 5 % of the steps
    and falls along a cosine, gradients clipped to norm 1.

    Args:
        model: what is trained, in place.
        data: its training windows; the validation trajectories are left to the caller.
        epochs: how often to go through ``data.batches_per_epoch`` batches.
        learning_rate: at its peak.
        loss: :class:`IncrementLoss` if None.
        compile: compile the dynamics first, which takes half a minute and a C++ compiler.
        progress: show a progress bar.

    Returns:
        The mean loss of each epoch.

    Raises:
        ValueError: if epochs or learning_rate is not positive.
        NonFiniteLossError: if the loss becomes NaN or infinite.
    """
    if epochs < 1 or not learning_rate > 0:
        raise ValueError(
            f"epochs is {epochs} and learning_rate {learning_rate}, expected positive numbers"
        )
    statistics = data.statistics
    learner = DynamicsLearner(
        model,
        loss=IncrementLoss(statistics, model) if loss is None else loss,
        optimizer=partial(AdamW, lr=learning_rate, weight_decay=1e-5, fused=True),
        scheduler=one_cycle,
        validator=lambda model, truth: {},
        config={},
        statistics=statistics,
        compile=compile,
        gradient_clip_val=1.0,
    )
    losses = _Losses()
    L.Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=epochs,
        limit_val_batches=0,
        callbacks=[losses],
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=progress,
        use_distributed_sampler=False,
    ).fit(learner, data)
    set_output_limits(model, output_limits(model, data.windows.q.to(next(model.parameters()))))
    model.eval()
    return losses.values


class _Losses(L.Callback):
    """Keeps the mean loss of each epoch."""

    def __init__(self) -> None:
        self.values: list[float] = []

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.values.append(float(trainer.callback_metrics["train/loss"]))
