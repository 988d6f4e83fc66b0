"""Validation during training: rollouts, their errors, and figures of them."""

from __future__ import annotations

import time

import lightning as L
import torch
from matplotlib.figure import Figure
from pydantic import PositiveFloat, PositiveInt

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
_LARGEST_RATIO = 10.0
_MAX_GAP = 1.5  # ratio of the last error to the best: beyond the usual ups and downs
_ADVICE = (
    "Evaluate last.ckpt too (evaluate.py checkpoint=last), train on longer windows (data.steps), "
    "or check whether the validation motions resemble the training motions"
)


class RolloutValidator:
    """Errors of rollouts on validation trajectories.

    ``error_windowed`` selects the best checkpoint. It is the mean over the windows W of a
    twentieth, a quarter and the whole of ``window`` (of ``horizon`` if that is None) of::

        mean over trajectories of min(10, mean over t of e_W(t) / mean of f_W)

    Here e_W is the error with the state reset to the measured state every W seconds, and f_W the
    same error of the baseline that holds its position, over all times and trajectories. So 1 is
    the result of a model that predicts no motion. A diverged trajectory counts as 10. Windows are
    rounded to whole steps.

    Args:
        horizon: length of the trajectories, s.
        window: time between two resets to the measured state, s; open loop if None.
        step: step of the rollouts, s; None takes that of the training windows.
        training_step: step of the training windows, s.

    Raises:
        ValueError: unless step <= window <= horizon.
    """

    def __init__(
        self,
        *,
        horizon: PositiveFloat = 2.0,
        step: PositiveFloat | None = None,
        training_step: PositiveFloat,
        window: PositiveFloat | None = None,
    ):
        self.horizon = horizon
        self.window = window
        self.step = training_step if step is None else step
        if not self.step <= (horizon if window is None else window) <= horizon:
            raise ValueError(
                f"window is {window} s, step {self.step} s and horizon {horizon} s, "
                "expected step <= window <= horizon, or window=null for open loop"
            )

    def __str__(self) -> str:
        if self.window is None:
            return f"{self.horizon:g} s open loop"
        return f"{self.horizon:g} s, reset every {self.window:g} s"

    def check(self, truth: Trajectory) -> None:
        """Refuse data that do not fit the rollouts, before the training begins.

        Raises:
            ValueError: if the trajectory is shorter than the horizon, the step is no multiple of
                the sample time, or the window is no multiple of the step.
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
        """Return mean, median, worst and windowed error, diverged count, and run time in s.

        With a residual force comes its share, see :func:`.residual_share`. The errors of an
        ensemble are those of its mean prediction, with the mean error and the spread of its
        members.
        """
        start = time.perf_counter()
        prediction = self.predict(model, truth)
        metrics = rollout_metrics(prediction.q_hat, prediction.q, prediction.t, thresholds={})
        names = ("error_mean", "error_median", "error_worst", "diverged")
        errors = {name: float(getattr(metrics, name)) for name in names}
        if prediction.members is not None:
            of_members = member_metrics(prediction)
            errors |= {name: of_members[name] for name in ("member_error_mean", "spread_mean")}
        if isinstance(model, MechanicalSystem) and model.has_residual:
            errors["residual_share"] = residual_share(model, truth.until(self.horizon))
        errors["error_windowed"] = self._windowed(model, truth, prediction)
        return {**errors, "rollout_seconds": time.perf_counter() - start}

    def _windowed(self, model: Predictor, truth: Trajectory, longest: Prediction) -> float:
        """Return ``error_windowed``, with ``longest`` for the longest window."""
        step = model.fixed_step or self.step
        truth = truth.until(self.horizon)
        span = self.window or self.horizon
        steps = {max(1, round(part * span / step)) for part in _PARTS} - {round(span / step)}
        still = HoldPosition(model.num_coordinates, model.num_inputs)
        pairs = [(longest, self.predict(still, truth))]
        for n in steps:
            pairs.append(
                (
                    predict_windows(model, truth, window=n * step, step=step),
                    predict_windows(still, truth, window=n * step, step=step),
                )
            )
        ratios = [item.error().mean(dim=1) / baseline.error().mean() for item, baseline in pairs]
        limited = torch.stack(ratios).nan_to_num(_LARGEST_RATIO).clamp(max=_LARGEST_RATIO)
        return float(limited.mean())


class ValidationHistory(L.Callback):
    """Errors of every validation, from which the best checkpoint is explained.

    Attributes:
        rows: for each validation the epoch, the mean training loss of that epoch, ``error_mean``
            and ``error_windowed``.
    """

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self._validated = False

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Note that this epoch was validated; the training loss is known at its end."""
        self._validated = True

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Append the errors of this epoch, if it was validated."""
        if self._validated:
            names = ("train/loss", "val/error_mean", "val/error_windowed")
            metrics = {n: float(trainer.callback_metrics.get(n, torch.nan)) for n in names}
            self.rows.append({"epoch": trainer.current_epoch, **metrics})
        self._validated = False

    def state_dict(self) -> dict[str, list[dict[str, float]]]:
        """Return the rows, for a training that is resumed."""
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, list[dict[str, float]]]) -> None:
        """Restore the rows."""
        self.rows = list(state_dict["rows"])

    def summary(self) -> str:
        """Return the errors of the best and of the last checkpoint; empty without a validation."""
        rows = {"best.ckpt": self._best(), "last.ckpt": self.rows[-1]} if self.rows else {}
        return "; ".join(
            f"{name} (epoch {row['epoch']:.0f}): windowed {row['val/error_windowed']:.3g}, "
            f"mean {row['val/error_mean']:.3g}"
            for name, row in rows.items()
        )

    def warning(self) -> str | None:
        """Return a warning if the best checkpoint is the first, or far better than the last."""
        if len(self.rows) < 2:
            return None
        best, last = self._best(), self.rows[-1]
        if best is self.rows[0] and last["train/loss"] < best["train/loss"]:
            return (
                "best.ckpt is from the first validation, although the training loss fell from "
                f"{best['train/loss']:.3g} to {last['train/loss']:.3g} after it: the model fits "
                f"its windows better and predicts worse. {_ADVICE}"
            )
        errors = [row["val/error_windowed"] for row in (best, last)]
        if not errors[1] <= _MAX_GAP * errors[0]:  # also if the last error is NaN
            return (
                f"the windowed error of last.ckpt is {errors[1]:.3g}, that of best.ckpt (epoch "
                f"{best['epoch']:.0f}) {errors[0]:.3g}: the best checkpoint may be a lucky one. "
                f"{_ADVICE}"
            )
        return None

    def _best(self) -> dict[str, float]:
        return min(self.rows, key=lambda row: row["val/error_windowed"])


class RolloutFigures(L.Callback):
    """Figures of a validation rollout, its error and the learned terms in the training log.

    Args:
        every_n_validations: number of validations between two drawings; the end of the training
            is always drawn.
    """

    def __init__(self, *, every_n_validations: PositiveInt = 4):
        self.every_n_validations = every_n_validations
        self._validations = 0

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw at every n-th validation."""
        self._validations += 1
        if self._validations % self.every_n_validations == 0:
            self._draw(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw the final model, unless the last validation did."""
        if self._validations % self.every_n_validations:
            self._draw(trainer, pl_module)

    def _draw(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        datamodule = trainer.datamodule  # type: ignore[attr-defined]
        (truth,) = list(datamodule.val_dataloader())
        model, validator, source = pl_module.model, pl_module.validator, datamodule.source
        assert isinstance(model, Predictor)
        assert isinstance(validator, RolloutValidator)
        predictions = {type(model).__name__: validator.predict(model, truth)}
        figures: dict[str, Figure] = {
            "rollout/trajectory": trajectory_figure(
                truth.until(validator.horizon),
                predictions,
                trajectory=0,
                title=f"Validation trajectory 0, {validator}",
                labels=source.labels,
                input_labels=source.input_labels,
            ),
            "rollout/error": error_figure(predictions, title=f"Validation error, {validator}"),
        }
        names = list(source.configurations)
        if source.system is not None and isinstance(model, MechanicalSystem) and names:
            q = torch.tensor([*source.configurations.values()], dtype=torch.float64)
            comparison = compare_terms(model, source.system, q, names=names)
            for k, name in enumerate(names):
                title = f"Learned and true terms at {name}"
                figures[f"terms/{name}"] = terms_figure(comparison, configuration=k, title=title)
        # The step at which Lightning logs the errors of the same validation.
        log_figures(trainer.loggers, figures, trainer.global_step - 1)
