"""Rollouts of a model along test trajectories, over the whole horizon or window by window."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from pydantic import PositiveInt
from torch import Tensor

from pinn_dyn.exports.c_loop import CLoop
from pinn_dyn.exports.latent_loop import LatentLoop
from pinn_dyn.mechanics import (
    ContinuousPredictor,
    MechanicalSystem,
    Predictor,
    Signal,
    Trajectory,
    double_copy,
    samples_of,
)
from pinn_dyn.models.subspace_encoder import EncodedPredictor

Model = TypeVar("Model", bound=Predictor)

WINDOWS = (0.1, 0.5, 1.0)
"""Default windows, s."""


@dataclass(frozen=True)
class Prediction:
    """Predicted and true configurations of K trajectories at the same times.

    Attributes:
        t: times, ``(T,)``, s.
        q_hat: predicted configuration, ``(K, T, N)``; not finite where the rollout broke down.
        q: true configuration, ``(K, T, N)``.
        members: predictions of the members of an ensemble, whose mean is q_hat, or of draws of
            fitted constants, ``(E, K, T, N)``.
        v_hat, v: predicted and true velocity, ``(K, T, N)``; only for full rollouts of one model.
    """

    t: Tensor
    q_hat: Tensor
    q: Tensor
    members: Tensor | None = None
    v_hat: Tensor | None = None
    v: Tensor | None = None

    def error(self) -> Tensor:
        """Return the configuration error e(t) = |q_hat(t) - q(t)|_2, ``(K, T)``."""
        return torch.linalg.vector_norm(self.q_hat - self.q, dim=-1)

    def every(self, samples: int) -> Prediction:
        """Return the rollouts at every ``samples``-th time, for a comparison on a coarser grid."""
        thinned: dict[str, Any] = {
            name: None if values is None else values[..., ::samples, :]
            for name, values in vars(self).items()
            if name != "t"
        }
        return Prediction(self.t[::samples], **thinned)

    def deviation(self) -> Tensor:
        """Return the standard deviation of each coordinate over the E members, ``(K, T, N)``."""
        assert self.members is not None, "a single model has no spread"
        return self.members.std(dim=0)

    def spread(self) -> Tensor:
        """Return the spread s(t) of the E members of an ensemble, ``(K, T)``::

        s(t)^2 = sum over members i of |q_hat_i(t) - mean(t)|^2 / (E - 1)
        """
        return torch.linalg.vector_norm(self.deviation(), dim=-1)


def predict_trajectories(
    model: Predictor,
    truth: Trajectory,
    *,
    window: float | None = None,
    step: float | None = None,
) -> Prediction:
    """Roll out a model in float64 from each true initial state under the true input.

    If a trajectory breaks down (mass matrix not positive definite), its q_hat is NaN from there on.
    With a window, the state is reset to the true state after each. At a reset the prediction is the
    end of the window before. An incomplete window is left out.

    Args:
        model: predictor with N coordinates and M inputs.
        truth: K test trajectories stacked, q ``(K, T, N)``, with a constant sample time.
        window: time between two resets in s, an integer multiple of the step; None for no reset.
        step: step of the rollout in s, an integer multiple of the sample time; None takes the
            sample times of the data.

    Raises:
        ValueError: if step, window and sample time do not fit, or the trajectory is too short.
    """
    stride, samples = samples_of_window(window, step, truth.t)
    last = (truth.t.shape[0] - 1) // samples * samples
    if last == 0:
        span = f"step is {step}" if window is None else f"window is {window}"
        raise ValueError(f"{span} s, but the trajectories last only {truth.duration:g} s")
    starts = slice(0, last, samples)
    x0 = truth.states(model.state, starts, model.history_steps, stride).double()
    input = truth.since(model.input_history).input
    past = input.t.shape[0] - truth.t.shape[0]
    input = input.part(slice(past + last + 1)).to(truth.q.device, torch.float64)
    size = past + samples + 1  # neighbors share the sample between them, and their past
    pieces = input.mapped(lambda u: u.unfold(1, size, samples).movedim(-1, -2).flatten(0, 1))
    pieces = replace(pieces, t=input.t[:size])
    copy = model_for_rollouts(model, truth.q.device)
    states = _roll_out(copy, x0.flatten(0, 1), pieces.t[past::stride], pieces)
    q, v = (x[:, : last + 1 : stride].double() for x in (truth.q, truth.v))
    ends = states[..., 1:, : model.num_coordinates].reshape(len(states), len(q), -1, q.shape[-1])
    paths = torch.cat([q[:, :1].expand(len(states), -1, -1, -1), ends], dim=2)
    members = paths if len(paths) > 1 else None
    v_hat = _velocities(copy, states) if window is None else None
    t, v_true = truth.t[: last + 1 : stride].double(), None if v_hat is None else v
    return Prediction(t, paths.mean(0), q, members, v_hat, v_true)


def predict_with_members(
    model: Predictor,
    members: Predictor | None,
    truth: Trajectory,
    *,
    window: float | None = None,
    step: float | None = None,
) -> Prediction:
    """Roll out a model as :func:`predict_trajectories`, and the members of an ensemble beside it.

    Args:
        model: the model, or the ensemble itself.
        members: ensemble whose members give the spread, such as draws of constants, or None.
        truth, window, step: see :func:`predict_trajectories`.
    """
    prediction = predict_trajectories(model, truth, window=window, step=step)
    if members is None or members is model:
        return prediction
    beside = predict_trajectories(members, truth, window=window, step=step)
    return replace(prediction, members=beside.members)


def model_for_rollouts(
    model: Model, device: torch.device | str = "cpu", threads: PositiveInt = 1
) -> Model:
    """Copy the model in float64, with loops in C for long rollouts on a CPU."""
    copy = double_copy(model, device)
    if torch.device(device).type != "cpu":
        return copy
    for part in copy.members:
        if isinstance(part, ContinuousPredictor):
            part.integrator = CLoop(part.integrator, threads)
        elif isinstance(part, EncodedPredictor):
            LatentLoop(part, threads).install()
    return copy


@torch.no_grad()
def _roll_out(model: Predictor, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
    """Return the states ``(E, B, T, 2N)`` at the times t; E is 1 unless for an ensemble."""
    return x0[..., None, : 2 * model.num_coordinates] + model.member_increments(x0, t, input)


@torch.no_grad()
def _velocities(model: Predictor, states: Tensor) -> Tensor | None:
    if len(model.members) > 1:
        return None
    q, v_or_p = states[0].split(model.num_coordinates, dim=-1)
    if model.state == "qv":
        return v_or_p
    if not isinstance(model, MechanicalSystem):
        return None
    pieces = zip(q.flatten(0, 1).split(2048), v_or_p.flatten(0, 1).split(2048), strict=True)
    return torch.cat([model.velocity(*piece) for piece in pieces]).reshape(q.shape)


def samples_of_window(window: float | None, step: float | None, t: Tensor) -> tuple[int, int]:
    """Return the number of sample times in a step and in a window; None is the whole of t."""
    stride = 1 if step is None else samples_of("step", step, t)
    if window is None:
        return stride, stride * max((len(t) - 1) // stride, 1)
    samples = samples_of("window", window, t)
    if samples % stride:
        raise ValueError(
            f"window is {window} s and step is {step} s: window must be a multiple of step"
        )
    return stride, samples


def default_windows(horizon: float, grid: float) -> list[float]:
    """Return the windows of 0.1, 0.5 and 1 s that are multiples of the grid, below the horizon.

    If none fits, return the multiple of the grid next to a tenth of the horizon.
    """
    ratios = {w: w / grid for w in WINDOWS if 0.5 * grid < w < 0.99 * horizon}
    fitting = [window for window, ratio in ratios.items() if abs(ratio - round(ratio)) < 1e-3]
    tenth = max(1, round(horizon / 10 / grid)) * grid
    return fitting or ([tenth] if tenth < horizon else [])


def common_stride(steps: Sequence[float], t: Tensor) -> int:
    """Return the number of samples between the common times of rollouts with different steps in s.

    Raises:
        ValueError: if a step is no multiple of that of t, ``(T,)``, or only the start is common.
    """
    stride = math.lcm(*(samples_of("step", step, t) for step in set(steps)))
    if stride > len(t) - 1:
        raise ValueError(
            f"models with steps of {sorted(set(steps))} s have no time in common within "
            f"{float(t[-1] - t[0]):g} s: evaluate them separately, or with step=..."
        )
    return stride
