"""Figures, settings and run times in the logs of a training (TensorBoard and MLflow)."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping

import lightning as L
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger
from matplotlib.figure import Figure
from torch.utils.tensorboard.summary import hparams

Setting = str | int | float | bool


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

    A run that fails or is interrupted keeps its settings and last errors, without a success. The
    run time of a resumed training includes the time before the checkpoint. No list of settings is
    written for TensorBoard, which would take the list of the first run for all runs.

    Args:
        settings: names and values in which this run may differ from others.
        configuration: the whole configuration, YAML.
        provenance: commit, software and hardware.
    """

    def __init__(
        self,
        *,
        settings: Mapping[str, Setting],
        configuration: str,
        provenance: Mapping[str, str],
    ):
        self.settings = dict(settings)
        self.configuration = configuration
        self.provenance = dict(provenance)
        self._start, self._end = hparams(self.settings, {})[1:]
        self._started = _clocks()
        self._before = (0.0, 0.0)

    @property
    def seconds(self) -> tuple[float, float]:
        """Run time of the training so far: wall-clock and processor time, s."""
        parts = zip(self._before, _clocks(), self._started, strict=True)
        wall, cpu = (before + now - start for before, now, start in parts)
        return wall, cpu

    def state_dict(self) -> dict[str, float]:
        """Return the run time, for a training that is resumed."""
        wall, cpu = self.seconds
        return {"wall_seconds": wall, "cpu_seconds": cpu}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Restore the run time before the checkpoint."""
        self._before = (state_dict["wall_seconds"], state_dict["cpu_seconds"])

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log settings, configuration and provenance."""
        if not trainer.is_global_zero:
            return
        parameters = sum(p.numel() for p in pl_module.parameters())
        rows = {**self.provenance, "parameters": str(parameters)}
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.file_writer.add_summary(self._start)
                lines = ["| | |", "|---|---|", *(f"| {k} | {v} |" for k, v in rows.items())]
                logger.experiment.add_text("run/provenance", "\n".join(lines))
                code = f"```yaml\n{self.configuration}\n```"
                logger.experiment.add_text("run/configuration", code)
            elif isinstance(logger, MLFlowLogger):
                logger.log_hyperparams(self.settings)
                logger.experiment.log_text(logger.run_id, self.configuration, "config.yaml")
                for key, value in rows.items():
                    logger.experiment.set_tag(logger.run_id, key, value)

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the run time and the success."""
        if not trainer.is_global_zero:
            return
        # TensorBoard sorts metrics by name: this one comes after those of val/.
        seconds = {"wall_time/training_seconds": self.seconds[0]}
        for logger in trainer.loggers:
            logger.log_metrics(seconds, trainer.global_step - 1)
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.file_writer.add_summary(self._end)


def _clocks() -> tuple[float, float]:
    """Return the wall-clock time, and the processor time of this process and its children, s."""
    return time.perf_counter(), sum(os.times()[:4])
