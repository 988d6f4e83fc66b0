"""Validation during training: roll-outs, their figures of merit, and pictures of them."""

from __future__ import annotations

import time

import lightning as L
import torch
from matplotlib.figure import Figure

from pinn_dyn.evaluation.figures import error_figure, terms_figure, trajectory_figure
from pinn_dyn.evaluation.learned_terms import compare_terms
from pinn_dyn.evaluation.metrics import member_metrics, rollout_metrics
from pinn_dyn.evaluation.prediction import (
    Prediction,
    predict_trajectories,
    predict_windows,
    samples_of,
    samples_of_window,
)
from pinn_dyn.evaluation.run_log import log_figures
from pinn_dyn.mechanics import MechanicalSystem, Predictor, Trajectory


class RolloutValidator:
    """Figures of merit of roll-outs on validation trajectories.

    Args:
        horizon: length of the trajectories, s.
        window: time between two re-sets to the measured state, s; open loop if None.
        step: step of the roll-outs, s; that of the training windows if None.
        training_step: step of the training windows, s.

    Raises:
        ValueError: if the step is longer than the horizon, or the window no part of it.
    """

    def __init__(
        self,
        *,
        horizon: float,
        step: float | None = None,
        training_step: float,
        window: float | None = None,
    ):
        self.horizon = horizon
        self.window = window
        self.step = training_step if step is None else step
        if not 0 < self.step <= horizon:
            raise ValueError(
                f"step is {self.step} s and horizon {horizon} s, expected 0 < step <= horizon"
            )
        if window is not None and not self.step <= window <= horizon:
            raise ValueError(
                f"window is {window} s, step {self.step} s and horizon {horizon} s, "
                "expected step <= window <= horizon, or window=null for open loop"
            )

    def __str__(self) -> str:
        """What it measures, in words: ``2 s open loop``."""
        if self.window is None:
            return f"{self.horizon:g} s open loop"
        return f"{self.horizon:g} s, re-set every {self.window:g} s"

    def check(self, truth: Trajectory) -> None:
        """Refuse data that these roll-outs do not fit, before a training has begun.

        Raises:
            ValueError: if the trajectory is shorter than the horizon, or the step no multiple of
                its sample time, or the window none of the step.
        """
        t = truth.until(self.horizon).t
        if self.window is None:
            samples_of("step", self.step, t)
        else:
            samples_of_window(self.window, self.step, t)

    def predict(self, model: Predictor, truth: Trajectory) -> Prediction:
        """Roll out the model along the first ``horizon`` seconds of the truth."""
        step = model.fixed_step or self.step
        truth = truth.until(self.horizon)
        if self.window is None:
            return predict_trajectories(model, truth, step=step)
        return predict_windows(model, truth, window=self.window, step=step)

    def __call__(self, model: Predictor, truth: Trajectory) -> dict[str, float]:
        """Error mean, median and worst, diverged count, and the seconds that it took.

        Of an ensemble these are of its mean prediction; with them come the mean error and the
        spread of its members.
        """
        start = time.perf_counter()
        prediction = self.predict(model, truth)
        metrics = rollout_metrics(
            prediction.q_hat, prediction.q, prediction.t, thresholds={}
        ).to_dict()
        names = ("error_mean", "error_median", "error_worst", "diverged")
        figures = {name: float(metrics[name]) for name in names}
        if prediction.members is not None:
            figures["member_error_mean"] = member_metrics(prediction)["member_error_mean"]
            figures["spread_mean"] = member_metrics(prediction)["spread_mean"]
        return {**figures, "rollout_seconds": time.perf_counter() - start}


class RolloutFigures(L.Callback):
    """Logs pictures of a validation roll-out, its error and the learned terms.

    Args:
        every_n_validations: draw at every n-th validation, and at the end of training.
        validator: makes the roll-outs.
        labels, input_labels: names and units of coordinates and inputs.
        system: the truth, for its terms; None for measured data.
        configurations: named configurations at which terms are compared, each ``(N,)``.
    """

    def __init__(
        self,
        *,
        every_n_validations: int,
        validator: RolloutValidator,
        labels: list[str],
        input_labels: list[str],
        system: MechanicalSystem | None,
        configurations: dict[str, list[float]],
    ):
        self.every_n_validations = every_n_validations
        self.validator = validator
        self.labels = labels
        self.input_labels = input_labels
        self.system = system
        self.configurations = configurations
        self._validations = 0

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw, every n-th time."""
        self._validations += 1
        if self._validations % self.every_n_validations == 0:
            self._draw(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw the final model, if the last validation did not."""
        if self._validations % self.every_n_validations:
            self._draw(trainer, pl_module)

    def _draw(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        datamodule = trainer.datamodule  # type: ignore[attr-defined]
        (truth,) = list(datamodule.val_dataloader())
        model = pl_module.model
        assert isinstance(model, Predictor)
        name = type(model).__name__
        predictions = {name: self.validator.predict(model, truth)}
        figures: dict[str, Figure] = {
            "rollout/trajectory": trajectory_figure(
                truth.until(self.validator.horizon),
                predictions,
                trajectory=0,
                title=f"Validation trajectory 0, {self.validator}",
                labels=self.labels,
                input_labels=self.input_labels,
            ),
            "rollout/error": error_figure(predictions, title=f"Validation error, {self.validator}"),
        }
        if self.system is not None and isinstance(model, MechanicalSystem) and self.configurations:
            names = list(self.configurations)
            q = torch.tensor([self.configurations[key] for key in names], dtype=torch.float64)
            comparison = compare_terms(model, self.system, q, names=names)
            for index, key in enumerate(names):
                figures[f"terms/{key}"] = terms_figure(
                    comparison,
                    configuration=index,
                    title=f"Learned and true terms at {key}",
                    inverse_mass=model.state == "qp",
                )
        # The step at which Lightning logs the errors of the same validation.
        log_figures(trainer.loggers, figures, trainer.global_step - 1)
