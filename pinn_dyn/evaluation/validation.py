"""Validation during training: roll-outs, their figures of merit, and pictures of them."""

from __future__ import annotations

import time

import lightning as L
import torch
from matplotlib.figure import Figure

from pinn_dyn.evaluation.figures import error_figure, terms_figure, trajectory_figure
from pinn_dyn.evaluation.learned_terms import compare_terms
from pinn_dyn.evaluation.metrics import member_metrics, rollout_metrics
from pinn_dyn.evaluation.prediction import Prediction, predict_trajectories
from pinn_dyn.evaluation.run_log import log_figures
from pinn_dyn.mechanics import MechanicalSystem, Predictor, Trajectory


class RolloutValidator:
    """Figures of merit of open-loop roll-outs on validation trajectories.

    Args:
        horizon: length of the roll-outs, s.
        step: step of the roll-outs, s; that of the training windows if None.
        training_step: step of the training windows, s.

    Raises:
        ValueError: if the step is longer than the horizon.
    """

    def __init__(self, *, horizon: float, step: float | None, training_step: float):
        self.horizon = horizon
        self.step = training_step if step is None else step
        if not 0 < self.step <= horizon:
            raise ValueError(
                f"validator: step is {self.step} s and horizon {horizon} s, expected "
                "0 < step <= horizon"
            )

    def predict(self, model: Predictor, truth: Trajectory) -> Prediction:
        """Roll out the model along the first ``horizon`` seconds of the truth."""
        step = model.fixed_step or self.step
        return predict_trajectories(model, truth.until(self.horizon), step=step)

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
        horizon = self.validator.horizon
        figures: dict[str, Figure] = {
            "rollout/trajectory": trajectory_figure(
                truth.until(horizon),
                predictions,
                trajectory=0,
                title=f"Validation trajectory 0, {horizon:g} s open loop",
                labels=self.labels,
                input_labels=self.input_labels,
            ),
            "rollout/error": error_figure(
                predictions, title=f"Validation error, {horizon:g} s open loop"
            ),
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
                    inverse_mass=model.coordinates == "momentum",
                )
        # The step at which Lightning logs the errors of the same validation.
        log_figures(trainer.loggers, figures, trainer.global_step - 1)
