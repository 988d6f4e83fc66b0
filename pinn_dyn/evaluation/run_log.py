"""Figures, settings and run times in the logs of a training (TensorBoard and MLflow)."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping

import lightning as L
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from matplotlib.figure import Figure
from torch.utils.tensorboard.summary import hparams


def log_figures(loggers: Iterable[Logger], figures: Mapping[str, Figure], step: int) -> None:
    """Log named figures at a training step, to the loggers that can show them."""
    for logger in loggers:
        for name, figure in figures.items():
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_figure(name, figure, step)
            elif isinstance(logger, MLFlowLogger):
                file = f"{name}/step_{step:07d}.png"  # numbers of one width sort by value
                logger.experiment.log_figure(logger.run_id, figure, file)


class RunDescription(L.Callback):
    """Settings of a run in its log at the start, and its run time at the end.

    The run time of a resumed training includes the time before the checkpoint.

    Args:
        settings: names and values in which this run may differ from others.
        configuration: the whole configuration, YAML.
        provenance: commit, software and hardware.
    """

    def __init__(
        self,
        *,
        settings: Mapping[str, str | int | float | bool],
        configuration: str,
        provenance: Mapping[str, str],
    ):
        self.settings = dict(settings)
        self.configuration = configuration
        self.provenance = dict(provenance)
        # The list of settings would be that of the first run for all runs.
        _, self._start, self._end = hparams(self.settings, {})
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Run time of the training so far, s."""
        return time.perf_counter() - self._started

    def state_dict(self) -> dict[str, float]:
        return {"wall_seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        self._started = time.perf_counter() - state_dict["wall_seconds"]

    @rank_zero_only
    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the settings; MLflow gets configuration and provenance too."""
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.file_writer.add_summary(self._start)
            elif isinstance(logger, MLFlowLogger):
                logger.log_hyperparams(self.settings)
                logger.experiment.log_text(logger.run_id, self.configuration, "config.yaml")
                for key, value in self.provenance.items():
                    logger.experiment.set_tag(logger.run_id, key, value)

    @rank_zero_only
    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the run time, and the success for TensorBoard."""
        for logger in trainer.loggers:
            # TensorBoard sorts metrics by name: this one comes after those of val/.
            logger.log_metrics({"wall_time/seconds": self.seconds}, trainer.global_step - 1)
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.file_writer.add_summary(self._end)
