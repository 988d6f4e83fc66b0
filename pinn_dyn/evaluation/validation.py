"""Validation during training: roll-outs, their figures of merit, and pictures of them."""

from __future__ import annotations

import time

import lightning as L
import torch
from matplotlib.figure import Figure

from pinn_dyn.evaluation.baselines import HoldPosition
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
from pinn_dyn.evaluation.torque import residual_share
from pinn_dyn.mechanics import MechanicalSystem, Predictor, Trajectory

_PARTS = (1 / 20, 1 / 4)  # of the longest window
_WORST = 10.0
_APART = 1.5  # last above best: beyond the usual ups and downs
_REMEDIES = (
    "See last.ckpt too (evaluate.py checkpoint=last), at longer windows (data.steps), or at "
    "whether the validation motions are like the training ones"
)


class RolloutValidator:
    """Figures of merit of roll-outs on validation trajectories.

    ``error_windowed``, by which the best checkpoint is chosen, is the mean over windows W of a
    twentieth, a quarter and the whole of ``window`` (of ``horizon`` if that is None) of::

        mean over trajectories of min(10, mean over t of e_W(t) / mean of f_W)

    e_W is the error with the state re-set to the measured one every W seconds, and f_W that of
    standing still instead, over all times and trajectories. So 1 is what a model is worth that
    predicts no motion; a trajectory that diverged counts as 10, and no long roll-out alone decides.
    The windows are rounded to whole steps.

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
        """Error mean, median, worst and windowed, diverged count, and the seconds that it took.

        With a residual force comes its share, see :func:`.residual_share`.
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
        if isinstance(model, MechanicalSystem) and model.has_residual:
            figures["residual_share"] = residual_share(model, truth.until(self.horizon))
        figures["error_windowed"] = self._windowed(model, truth, prediction)
        return {**figures, "rollout_seconds": time.perf_counter() - start}

    def _windowed(self, model: Predictor, truth: Trajectory, longest: Prediction) -> float:
        """``error_windowed``; the roll-outs of the longest window are there already."""
        step = model.fixed_step or self.step
        truth = truth.until(self.horizon)
        span = self.window or self.horizon
        steps = {max(1, round(part * span / step)) for part in _PARTS} - {round(span / step)}
        still = HoldPosition(model.num_coordinates, model.num_inputs)
        found, floors = [longest], [self.predict(still, truth)]
        for n in steps:
            found.append(predict_windows(model, truth, window=n * step, step=step))
            floors.append(predict_windows(still, truth, window=n * step, step=step))
        ratios = [
            (item.error().mean(dim=1) / floor.error().mean()).nan_to_num(_WORST).clamp(max=_WORST)
            for item, floor in zip(found, floors, strict=True)
        ]
        return float(torch.stack(ratios).mean())


class ValidationHistory(L.Callback):
    """Keeps the figures of every validation, to tell how the best checkpoint came about.

    Attributes:
        rows: of each validation the epoch, the mean training loss of that epoch, ``error_mean``
            and ``error_windowed``.
    """

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self._validated = False

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """The loss of the epoch is known only at its end."""
        self._validated = True

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Keep the figures of this epoch, if it was validated."""
        if self._validated:
            names = ("train/loss", "val/error_mean", "val/error_windowed")
            found = {n: float(trainer.callback_metrics.get(n, torch.nan)) for n in names}
            self.rows.append({"epoch": trainer.current_epoch, **found})
        self._validated = False

    def state_dict(self) -> dict[str, list[dict[str, float]]]:
        """The rows, for a training that is resumed."""
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, list[dict[str, float]]]) -> None:
        """The inverse of :meth:`state_dict`."""
        self.rows = list(state_dict["rows"])

    def summary(self) -> str:
        """Best beside last; empty without a validation."""
        if not self.rows:
            return ""
        best, last = self._best(), self.rows[-1]
        return "; ".join(
            f"{name} (epoch {row['epoch']:.0f}): windowed {row['val/error_windowed']:.3g}, "
            f"mean {row['val/error_mean']:.3g}"
            for name, row in (("best.ckpt", best), ("last.ckpt", last))
        )

    def warning(self) -> str | None:
        """What to be wary of: a best that the last has left far behind, or the first validation."""
        if len(self.rows) < 2:
            return None
        best, last = self._best(), self.rows[-1]
        if best is self.rows[0] and last["train/loss"] < best["train/loss"]:
            return (
                "best.ckpt is of the first validation, while the training loss fell from "
                f"{best['train/loss']:.3g} to {last['train/loss']:.3g} after it: the model fits "
                f"its windows better and predicts worse. {_REMEDIES}"
            )
        errors = [row["val/error_windowed"] for row in (best, last)]
        # Not <=: an error that is no number is far away too.
        if not errors[1] <= _APART * errors[0]:
            return (
                f"last.ckpt errs by {errors[1]:.3g} (windowed), best.ckpt (epoch "
                f"{best['epoch']:.0f}) by {errors[0]:.3g}: what the best one is worth may be luck. "
                f"{_REMEDIES}"
            )
        return None

    def _best(self) -> dict[str, float]:
        return min(self.rows, key=lambda row: row["val/error_windowed"])


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
                )
        # The step at which Lightning logs the errors of the same validation.
        log_figures(trainer.loggers, figures, trainer.global_step - 1)
