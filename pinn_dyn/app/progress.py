"""Progress of a training without a terminal: one line per epoch."""

from __future__ import annotations

import logging

import lightning as L

log = logging.getLogger(__name__)


class EpochLines(L.Callback):
    """Logs the training loss of every epoch, and the error of validated epochs.

    Args:
        error: name of the logged validation error.
    """

    def __init__(self, error: str):
        self.error = error

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the line of the epoch."""
        names = {"train/loss": "training loss"}
        if (trainer.current_epoch + 1) % (trainer.check_val_every_n_epoch or 1) == 0:
            names[self.error] = "validation error"
        texts = [
            f"{text} {float(trainer.callback_metrics[name]):.4g}"
            for name, text in names.items()
            if name in trainer.callback_metrics
        ]
        if trainer.is_global_zero:
            epoch, epochs = trainer.current_epoch + 1, trainer.max_epochs
            log.info(
                "epoch %d of %s, step %d: %s", epoch, epochs, trainer.global_step, ", ".join(texts)
            )
