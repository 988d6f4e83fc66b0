"""What Lightning's loggers have no common call for: figures, texts, and what a run is made of."""

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
                # Numbers of one width sort as they should.
                file = f"{name}/step_{step:07d}.png"
                logger.experiment.log_figure(logger.run_id, figure, file)


class RunDescription(L.Callback):
    """Logs what a run is made of when it starts, and what it took when it has ended.

    A run that fails or is interrupted has its settings and its last errors among the others, and
    no success. What a resumed one took includes the time up to the checkpoint it goes on from.
    TensorBoard compares the settings that any of the runs has: no list of them is written, as
    TensorBoard would take the one of the first run for all.

    Args:
        settings: names and values that tell this run from others.
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
        """What the training has taken so far, by the clock and of the processor, s."""
        parts = zip(self._before, _clocks(), self._started, strict=True)
        wall, cpu = (before + now - start for before, now, start in parts)
        return wall, cpu

    def state_dict(self) -> dict[str, float]:
        """The seconds, for a training that is resumed."""
        wall, cpu = self.seconds
        return {"wall_seconds": wall, "cpu_seconds": cpu}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """The inverse of :meth:`state_dict`."""
        self._before = (state_dict["wall_seconds"], state_dict["cpu_seconds"])

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the settings and the configuration."""
        if not trainer.is_global_zero:
            return
        parameters = sum(p.numel() for p in pl_module.parameters())
        rows = {**self.provenance, "parameters": str(parameters)}
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.file_writer.add_summary(self._start)
                table = "\n".join(
                    ["| | |", "|---|---|", *(f"| {k} | {v} |" for k, v in rows.items())]
                )
                logger.experiment.add_text("run/provenance", table)
                code = f"```yaml\n{self.configuration}\n```"
                logger.experiment.add_text("run/configuration", code)
            elif isinstance(logger, MLFlowLogger):
                logger.log_hyperparams(self.settings)
                logger.experiment.log_text(logger.run_id, self.configuration, "config.yaml")
                for key, value in rows.items():
                    logger.experiment.set_tag(logger.run_id, key, value)

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the seconds that the training took, and the success."""
        if not trainer.is_global_zero:
            return
        # TensorBoard shows the metrics that come first by name: after those of val/.
        seconds = {"wall_time/training_seconds": self.seconds[0]}
        for logger in trainer.loggers:
            logger.log_metrics(seconds, trainer.global_step - 1)
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.file_writer.add_summary(self._end)


def _clocks() -> tuple[float, float]:
    """Now, and the processor time of this process and of those that it has waited for, s."""
    return time.perf_counter(), sum(os.times()[:4])
