"""Progress of a training without a terminal: one line per epoch."""

from __future__ import annotations

import logging

import lightning as L

log = logging.getLogger(__name__)


class EpochLines(L.Callback):
    """Log of the training loss of every epoch, and of the ``error`` of validated epochs."""

    def __init__(self, error: str):
        self.error = error

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the line of the epoch."""
        epoch, metrics = trainer.current_epoch + 1, trainer.callback_metrics
        text = (
            f"training loss {float(metrics['train/loss']):.4g}" if "train/loss" in metrics else ""
        )
        if epoch % (trainer.check_val_every_n_epoch or 1) == 0 and self.error in metrics:
            text += f", validation error {float(metrics[self.error]):.4g}"
        if trainer.is_global_zero:
            steps = trainer.global_step
            log.info("epoch %d of %s, step %d: %s", epoch, trainer.max_epochs, steps, text)
