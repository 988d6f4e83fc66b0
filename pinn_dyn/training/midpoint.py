"""The equation of motion in the middle of a short step as a loss."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.losses import IncrementLoss, refuse_learned_initial_state


class MidpointLoss(IncrementLoss):
    """Mean squared error of the increment of the state in one step, by the midpoint rule.

    A step of length h leads from measured (q_0, v_0) to measured (q_1, v_1). The cubic through
    both, with those slopes (Hermite interpolation), gives its middle::

        q_m = (q_0 + q_1)/2 - h dv/8        dq = q_1 - q_0
        v_m = 3 dq/(2 h) - (v_0 + v_1)/4    dv = v_1 - v_0

    and there the dynamics dv/dt = a(q, v, u) are evaluated once::

        dv^ = h a(q_m, v_m, mean of u over the step)
        loss = mean over windows and components i of ((dv^_i - dv_i) / s_i)^2

    s is the standard deviation of dv over the training windows. Where the state is (q, p) its
    middle is the mean of both ends, and the increments of q and of p are compared. The mean of u
    is exact for inputs that are linear between samples, or held.

    The error of the rule is h^2/24 of the second derivative of a along the motion (h^2/12 with
    momenta): a hundredth of a for an oscillation of r rad/s with r h = 0.5, and 1/2400 with
    r h = 0.1. The terms learn it with the motion: halve ``data.stride`` to see whether it matters.

    One evaluation of the dynamics per window, where the roll-out of one step in
    :class:`IncrementLoss` costs four; no roll-out and no stiffness, so ``integrator`` and
    ``substeps`` are for validation and test alone.

    Assumptions: q and v are measured or simulated with little noise. Noise in v is divided by a
    short h, as in a loss on accelerations by finite differences; for noisy logs take longer
    windows and :class:`IncrementLoss`.

    Source: not in the paper, whose losses roll out. Midpoint quadrature of the equation of motion
    along a Hermite interpolant, as in direct collocation (Betts 2010, "Practical Methods for
    Optimal Control and Estimation Using Nonlinear Programming").

    Args:
        statistics: scales of the data.
        model: the model that will be trained.

    Raises:
        TypeError: if the model has no state derivative, as ``model=mlp``.
        ValueError: if the windows have more than one step, or the model learns its initial state.
    """

    def __init__(self, statistics: Statistics, model: Predictor):
        if not isinstance(model, ContinuousPredictor):
            raise TypeError(
                f"model is a {type(model).__name__}, expected one with a state derivative, such as "
                "model=lnn or model=acceleration: take loss=increment"
            )
        refuse_learned_initial_state(model)
        steps = statistics.velocity_increment_std.shape[0]
        if steps != 1:
            raise ValueError(f"the windows have {steps} steps, expected one: set data.steps=1")
        super().__init__(statistics, model)

    def _mean(self, model: Predictor, windows: Windows) -> Tensor:
        assert isinstance(model, ContinuousPredictor)
        x0, measured = windows.start(model.coordinates), windows.increments(model.coordinates)
        return self._traced(model, windows, x0, windows.u, measured)

    def _traced(
        self, model: ContinuousPredictor, windows: Windows, x0: Tensor, u: Tensor, measured: Tensor
    ) -> Tensor:
        h, dx = (windows.t[1] - windows.t[0]).to(x0), measured.squeeze(-2)
        middle = midpoint(h, x0, dx) if model.coordinates == "velocity" else x0 + 0.5 * dx
        rate = model.state_derivative(middle, _mean_input(windows, u))
        return self.error((h * rate).unsqueeze(-2), measured)

    def evaluations(self, model: ContinuousPredictor, windows: Windows) -> int:
        """Evaluations of the dynamics in a window."""
        return 1

    def compile_dynamics(self, model: Predictor, steps: int) -> None:
        # Always as a whole: there is a quarter of a roll-out to compile.
        self._compiled = self._long_training = True


def _mean_input(windows: Windows, u: Tensor) -> Tensor:
    """The mean of u ``(*batch, K, M)`` over the step, ``(*batch, M)``."""
    if windows.interpolation == "hold":
        return u[..., :-1, :].mean(-2)
    return (0.5 * (u[..., 1:, :] + u[..., :-1, :])).mean(-2)


def midpoint(h: Tensor, x0: Tensor, increment: Tensor) -> Tensor:
    """The state in the middle of a cubic from x0 to x0 + increment, ``(*batch, 2N)``.

    Args:
        h: length of the step, s.
        x0: (q, v) at its start, ``(*batch, 2N)``.
        increment: of (q, v) over the step, ``(*batch, 2N)``.
    """
    (q, v), (dq, dv) = x0.chunk(2, -1), increment.chunk(2, -1)
    return torch.cat([q + 0.5 * dq - h * dv / 8, 1.5 * dq / h - 0.5 * v - 0.25 * dv], dim=-1)
