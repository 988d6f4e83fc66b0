"""Losses: how far predicted windows are from measured ones."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor
from pinn_dyn.mechanics.ensemble import ContinuousStack
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.whole_step import (
    CHUNK,
    MOST_STAGES,
    Gradients,
    WholeStep,
    rolled_out,
)

STEPS_FOR_WHOLE = 20_000
"""Training steps from which it pays to compile loss and gradient as one program; it always does for
the many members of an ensemble."""


class WindowLoss(nn.Module, abc.ABC):
    """A loss of a model on a batch of windows, a number near one before anything is learned."""

    @abc.abstractmethod
    def forward(self, model: Predictor, windows: Windows, progress: float) -> Tensor:
        """The loss, a scalar; ``progress`` is the part of the training that is over, 0 to 1.

        Of the stacked members of an ensemble it has one entry for each, ``(E,)``.
        """

    @abc.abstractmethod
    def compile_dynamics(self, model: Predictor, steps: int) -> None:
        """From now on train with compiled dynamics of the model, for about ``steps`` steps."""


class IncrementLoss(WindowLoss):
    """Mean squared error of predicted state increments, each in units of its own spread.

    ::

        loss = mean over windows, steps h and components i of w_i ((dx^_hi - dx_hi) / s_hi)^2

    dx_h is the increment of the state from the window's start to its h-th step and s_h its
    standard deviation over the training windows. With one step this is the paper's loss
    ||x_{k+1} - x^_{k+1}||^2, normalized; with more it is the multi-step loss.

    The weight w of the configuration half is 1, as in the paper's Hamiltonian loss; it is 0 for
    windows of one step where dq/dt = v holds by construction, as in the paper's Lagrangian loss,
    and a roll-out starts at the measured v.
    Over several steps it is 1 again: a measured q is better than a velocity derived from it. The
    weight of the other half is 1 too, or the ``velocity_weight``: below 1 where the log has no v,
    and its derivative of q is smoother than the motion. A window costs four evaluations of the
    dynamics per step.

    With ``huber`` = d the mean over components r^2 of each window and step counts as ::

        2 d^2 (sqrt(1 + r^2 / d^2) - 1)

    that is r^2 where it is small and 2 d r where it is large (pseudo-Huber; Charbonnier et al.
    1997, "Deterministic edge-preserving regularization in computed imaging"). The squared error
    follows the few fast motions of a log; this one follows the mean error, of which the slow
    motions and the rest make up more.

    A curriculum ``[k_1, ... k_S]`` divides the training into S equal stages; stage s rolls out and
    compares the first k_s steps of a window alone. Short roll-outs first are cheap, and keep a
    model that knows nothing yet from diverging over a long window.

    Args:
        statistics: scales of the data.
        model: the model that will be trained.
        curriculum: steps in each stage, increasing to the H of the windows; H throughout if None.
        velocity_weight: w of the velocity half, or of the momentum half.
        huber: d, in units of the spread of the increments; None: the squared error.

    Raises:
        ValueError: on a curriculum that does not increase from at least 1 to H, or a weight or a
            ``huber`` that is not positive.
    """

    scale: Tensor

    def __init__(
        self,
        statistics: Statistics,
        model: Predictor,
        curriculum: Sequence[int] | None = None,
        velocity_weight: float = 1.0,
        huber: float | None = None,
    ):
        super().__init__()
        if not velocity_weight > 0:
            raise ValueError(f"velocity_weight is {velocity_weight}, expected a positive number")
        if huber is not None and not huber > 0:
            raise ValueError(
                f"huber is {huber}, expected a positive number, or null for the squared error"
            )
        self.huber = huber
        momentum = model.coordinates == "momentum"
        std = statistics.momentum_increment_std if momentum else statistics.velocity_increment_std
        scale = std.float().clone()
        scale[:, model.num_coordinates :] /= velocity_weight**0.5
        self.register_buffer("scale", scale, persistent=False)
        steps = std.shape[0]
        self.curriculum = [steps] if curriculum is None else list(curriculum)
        # Strictly increasing from at least 1 to the steps of a window.
        if self.curriculum != sorted({k for k in self.curriculum if k >= 1} | {steps}):
            raise ValueError(
                f"curriculum is {curriculum}, expected step counts that increase from at least 1 "
                f"to the {steps} of the windows (data.steps)"
            )
        self._compiled = False
        self._long_training = False
        self._whole: WholeStep | None = None
        exact_rate = (
            isinstance(model, ContinuousPredictor)
            and not momentum
            and not model.learns_initial_state
        )
        self.exact_coordinates = model.num_coordinates if exact_rate else 0

    def steps(self, progress: float) -> int:
        """How many steps of a window count when this part of the training is over."""
        stages = len(self.curriculum)
        return self.curriculum[min(int(progress * stages), stages - 1)]

    def forward(self, model: Predictor, windows: Windows, progress: float) -> Tensor:
        longest = windows
        windows = windows.first(self.steps(progress))
        on_cpu = windows.q.device.type == "cpu"
        if not (self._compiled and on_cpu and torch.is_grad_enabled()):
            return self._mean(model, windows)
        assert isinstance(model, ContinuousPredictor)
        ensemble = isinstance(model, ContinuousStack)
        evaluations = self.evaluations(model, longest)
        if (self._long_training or ensemble) and evaluations <= MOST_STAGES:
            self._whole = self._whole or WholeStep(model, self._traced, evaluations)
            if ensemble:
                known = self._whole.of_members(windows)
                return _MemberGradients.apply(*known, *self._whole.parameters)
            return _KnownGradients.apply(self._whole(windows), *self._whole.parameters)
        if ensemble or len(windows) < 2 * CHUNK:
            return self._mean(model, windows)
        parts = [
            (len(part) / len(windows), *self._mean_and_gradients(model, part))
            for part in windows.split(CHUNK)
        ]
        return _KnownGradients.apply(parts, *model.parameters())

    def _mean_and_gradients(self, model: Predictor, windows: Windows) -> tuple[Tensor, Gradients]:
        loss = self._mean(model, windows)
        gradients = torch.autograd.grad(loss, list(model.parameters()), allow_unused=True)
        return loss.detach(), list(gradients)

    def _mean(self, model: Predictor, windows: Windows) -> Tensor:
        x0 = windows.start(model.coordinates)
        if self._compiled:
            # One compiled function for all stages, though the first needs no gradient in x; and
            # the batch along memory, as the models compute.
            x0 = x0.mT.contiguous().mT.requires_grad_(torch.is_grad_enabled())
        predicted = model.increments(
            x0,
            windows.t,
            windows.u,
            t_input=windows.t_input,
            interpolation=windows.interpolation,
        )
        return self.error(predicted[..., 1:, :], windows.increments(model.coordinates))

    def _traced(
        self, model: ContinuousPredictor, windows: Windows, x0: Tensor, u: Tensor, measured: Tensor
    ) -> Tensor:
        return self.error(rolled_out(model, windows, x0, u), measured)

    def evaluations(self, model: ContinuousPredictor, windows: Windows) -> int:
        """Evaluations of the dynamics in a window."""
        return len(model.scheme().nodes) * model.substeps * (len(windows.t) - 1)

    def error(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """The loss of increments over the first k steps, ``(B, k, 2N)``.

        Increments of an ensemble, ``(E, B, k, 2N)``, give one loss for each member, ``(E,)``.
        """
        steps = predicted.shape[-2]
        residual = (predicted - measured) / self.scale[:steps]
        residual = residual[..., self.exact_coordinates if steps == 1 else 0 :]
        if self.huber is None:
            return torch.mean(residual**2, dim=(-3, -2, -1))
        square = torch.mean(residual**2, dim=-1)
        # 2 d^2 (sqrt(1 + r^2/d^2) - 1) without the loss of digits where r is small.
        return torch.mean(2 * square / (torch.sqrt(1 + square / self.huber**2) + 1), dim=(-2, -1))

    def compile_dynamics(self, model: Predictor, steps: int) -> None:
        if isinstance(model, ContinuousPredictor):
            model.compile_derivative()
            self._compiled = True
            self._long_training = steps >= STEPS_FOR_WHOLE


def refuse_learned_initial_state(model: Predictor) -> None:
    """Refuse to train a model whose initial state no window would teach.

    Raises:
        ValueError: if it learns its initial state: only a roll-out starts there.
    """
    if isinstance(model, ContinuousPredictor) and model.learns_initial_state:
        raise ValueError(
            "the model learns the velocity at which roll-outs start, and this loss rolls nothing "
            "out: take loss=increment, or model/initial_velocity=measured"
        )


class _KnownGradients(torch.autograd.Function):
    """The weighted sum of losses whose gradients are known: the backward pass hands them out.

    So it cannot be differentiated twice.
    """

    @staticmethod
    def forward(
        ctx: Any, parts: list[tuple[float, Tensor, Gradients]], *parameters: Tensor
    ) -> Tensor:
        ctx.weights = [weight for weight, _, _ in parts]
        ctx.gradients = list(zip(*(gradients for _, _, gradients in parts), strict=True))
        losses = [loss if weight == 1 else weight * loss for weight, loss, _ in parts]
        return losses[0] if len(losses) == 1 else torch.stack(losses).sum()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        weights = [float(upstream[0]) * weight for weight in ctx.weights]
        return None, *(_weighted(weights, values) for values in ctx.gradients)


class _MemberGradients(torch.autograd.Function):
    """The losses ``(E,)`` of an ensemble, whose gradients ``(E, ...)`` are known.

    Each loss moves the parameters of its own member alone.
    """

    @staticmethod
    def forward(ctx: Any, losses: Tensor, gradients: Gradients, *parameters: Tensor) -> Tensor:
        ctx.gradients = gradients
        return losses

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        (weights,) = upstream
        scaled = [
            None if gradient is None else gradient * weights.reshape(-1, *[1] * (gradient.ndim - 1))
            for gradient in ctx.gradients
        ]
        return None, None, *scaled


def _weighted(weights: list[float], values: tuple[Tensor | None, ...]) -> Tensor | None:
    """The weighted sum; None where the loss does not depend on the parameter."""
    first, *rest = values
    if first is None:
        return None
    total = first if weights[0] == 1 else weights[0] * first
    for weight, value in zip(weights[1:], rest, strict=True):
        assert value is not None
        total.add_(value, alpha=weight)
    return total
