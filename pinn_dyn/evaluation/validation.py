"""Validation during training: rollouts, their errors, and figures of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.data import DataSource
from pinn_dyn.evaluation.baselines import HoldPosition
from pinn_dyn.evaluation.learned_terms import compare_with_source
from pinn_dyn.evaluation.metrics import member_metrics, rollout_metrics
from pinn_dyn.evaluation.prediction import Prediction, predict_trajectories, samples_of_window
from pinn_dyn.evaluation.torque import residual_share
from pinn_dyn.mechanics import MechanicalSystem, Predictor, Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HORIZON = 2.0  # s, of long trajectories
_PARTS = (1 / 20, 1 / 4)  # of the longest window
_LARGEST_RATIO = 10.0
_LAGS = 8  # in a window, at which the motion of the training is measured


class RolloutValidator:
    """Errors of rollouts on validation trajectories.

    ``error_windowed`` selects the best checkpoint. It is the mean over the windows W of a
    twentieth, a quarter and the whole of ``window`` (of ``horizon`` if that is None) of::

        mean over trajectories of limited(mean over t of e_W(t) / mean of f_W)

    Here e_W is the error with the state reset to the measured state every W seconds, and f_W the
    same error of the baseline that holds its position, over all times and trajectories. Where the
    training moves further than that in W, its motion counts, so that rest is no unit. Ratios r
    above 5 are limited to 10 - 25/r, and a diverged trajectory counts as 10. Windows are rounded
    to whole steps.

    Args:
        horizon: length of the rollouts, s; None takes 2 s, or the shortest trajectory if that is
            shorter.
        window: time between two resets to the measured state, s; open loop if None.
        step: step of the rollouts, s; None takes that of the training windows.
        training_step: step of the training windows, s.

    Raises:
        ValueError: unless step <= window <= horizon.
    """

    def __init__(
        self,
        *,
        horizon: PositiveFloat | None = None,
        step: PositiveFloat | None = None,
        training_step: PositiveFloat,
        window: PositiveFloat | None = None,
    ):
        self._shortens = horizon is None
        self.horizon = horizon or _HORIZON
        self.window = window
        self.step = training_step if step is None else step
        self._training: Sequence[Trajectory] = ()
        if not self.step <= (window or self.horizon) <= self.horizon:
            raise ValueError(
                f"window is {window} s, step {self.step} s and horizon {self.horizon} s, "
                "expected step <= window <= horizon"
            )

    def __str__(self) -> str:
        if self.window is None:
            return f"{self.horizon:g} s open loop"
        return f"{self.horizon:g} s, reset every {self.window:g} s"

    def check(self, truth: Trajectory, training: Sequence[Trajectory] = ()) -> None:
        """Raise ValueError for data that do not fit horizon, window and step; keep the training."""
        self._training = training
        if self._shortens:
            self.horizon = min(self.horizon, truth.duration)
        samples_of_window(self.window, self.step, truth.until(self.horizon).t)

    def predict(self, model: Predictor, truth: Trajectory) -> Prediction:
        """Roll out the model along the first ``horizon`` seconds of the truth."""
        step = model.fixed_step or self.step
        truth = truth.until(self.horizon)
        return predict_trajectories(model, truth, window=self.window, step=step)

    def __call__(self, model: Predictor, truth: Trajectory) -> dict[str, float]:
        """Return mean, median, worst and windowed error, and the diverged count.

        A residual force adds its share, an ensemble the mean error and the spread of its members.
        """
        prediction = self.predict(model, truth)
        metrics = rollout_metrics(prediction.q_hat, prediction.q, prediction.t, thresholds={})
        names = ("error_mean", "error_median", "error_worst", "diverged")
        errors = {name: float(getattr(metrics, name)) for name in names}
        if prediction.members is not None:
            of_members = member_metrics(prediction)
            errors |= {name: of_members[name] for name in ("member_error_mean", "spread_mean")}
        if isinstance(model, MechanicalSystem) and model.has_residual:
            errors["residual_share"] = residual_share(model, truth.until(self.horizon))
        errors["error_windowed"] = float(self._windowed(model, truth, prediction).mean())
        return errors

    def part_errors(self, model: Predictor, truth: Trajectory) -> Tensor:
        """Return ``error_windowed`` of the quarters of K trajectories, ``(4 K,)``."""
        return self._windowed(model, truth, self.predict(model, truth), parts=4).flatten()

    def figures(self, model: Predictor, source: DataSource, truth: Trajectory) -> dict[str, Figure]:
        """Draw the rollout of the first trajectory, the errors and the learned terms."""
        # Imports matplotlib.
        from pinn_dyn.evaluation.figures import error_figure, terms_figure, trajectory_figure

        predictions = {type(model).__name__: self.predict(model, truth)}
        figures = {
            "rollout/trajectory": trajectory_figure(
                truth.until(self.horizon),
                predictions,
                trajectory=0,
                title=f"Validation trajectory 0, {self}",
                labels=source.labels,
                input_labels=source.input_labels,
            ),
            "rollout/error": error_figure(predictions, title=f"Validation error, {self}"),
        }
        if comparison := compare_with_source(model, source):
            for k, name in enumerate(comparison.names):
                title = f"Learned and true terms at {name}"
                figures[f"terms/{name}"] = terms_figure(comparison, configuration=k, title=title)
        return figures

    def _windowed(
        self, model: Predictor, truth: Trajectory, longest: Prediction, parts: int = 1
    ) -> Tensor:
        """Return ``error_windowed`` of parts in time of each trajectory, ``(K, parts)``.

        The prediction ``longest`` is that of the longest window.
        """
        step = model.fixed_step or self.step
        truth = truth.until(self.horizon)
        span = self.window or self.horizon
        steps = {max(1, round(part * span / step)) for part in _PARTS} - {round(span / step)}
        still = HoldPosition(model.num_coordinates, model.num_inputs)
        trials = [(span, longest, self.predict(still, truth))]
        for n in steps:
            window = n * step
            both = [
                predict_trajectories(x, truth, window=window, step=step) for x in (model, still)
            ]
            trials.append((window, both[0], both[1]))
        parts = min(parts, *(len(item.t) for _, item, _ in trials))
        ratios = [
            torch.stack([x.mean(dim=1) for x in item.error().tensor_split(parts, dim=1)], dim=1)
            / max(float(held.error().mean()), self._motion(window))
            for window, item, held in trials
        ]
        ratio, largest = torch.stack(ratios).nan_to_num(torch.inf), _LARGEST_RATIO
        limited = torch.where(ratio > largest / 2, largest - largest**2 / (4 * ratio), ratio)
        return limited.mean(dim=0)

    def _motion(self, window: float) -> float:
        """Return the mean distance in the training from the start of windows in s."""
        distances: list[Tensor] = []
        for item in self._training:
            samples, last = window / float(item.t[1] - item.t[0]), len(item.t) - 1
            lags = [min(math.ceil(k * samples / _LAGS), last) for k in range(1, _LAGS + 1)]
            distances += [(item.q[lag:] - item.q[:-lag]).norm(dim=-1).mean() for lag in lags]
        return float(torch.stack(distances).mean()) if distances else 0.0
