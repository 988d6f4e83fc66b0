"""The weak form of the equation of motion as a loss: momentum gained against impulse."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Interpolation, MechanicalSystem, Predictor
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.losses import WindowLoss, refuse_learned_initial_state


class ImpulseLoss(WindowLoss):
    """Mean squared error of the velocity that the impulse over a window gives, in its own spread.

    Over a window from t_0 to t_H the equation of motion, integrated once, balances momentum::

        M(q_H) v_H - M(q_0) v_0 = J,   J = integral of d(v^T M v / 2)/dq - G - D v - F(v) + A u

    With q, v and u measured, this predicts the change dv = v_H - v_0, which the loss compares::

        dv^ = M(q_H)^-1 (J - (M(q_H) - M(q_0)) v_0)
        loss = mean over windows and components i of ((dv^_i - dv_i) / s_i)^2

    s is the standard deviation of dv over the training windows. J is Simpson's rule through the
    H + 1 measured states, with u as the data declare it between its samples; its error falls as
    H^-4 where the motion is smooth. Held inputs bend v at every sample, which leaves H^-2.

    Nothing is rolled out, and no acceleration is needed. A window costs H + 1 evaluations of the
    forces in one batch (no tangent pass through M), three of M and one solve; the roll-out of
    :class:`IncrementLoss` costs 4 H evaluations of the dynamics one after another.

    The balance alone is homogeneous: terms at half the scale halve its residual, and M = V = D =
    A = 0 solves it. M(q_H)^-1 in front cancels any common factor of the terms and leaves a
    velocity, whose scale the data fix. So the loss is that of the predicted motion, as in
    :class:`IncrementLoss`: terms that differ by a factor have the same loss, and forces that vanish
    beside M predict a motion free of forces, not the measured one.

    Assumptions: q and v are measured or well filtered (noise in v_0 and v_H enters in full, where
    a roll-out over many steps averages it out), and the motion is smooth over two steps.

    Source: the weak form for model learning, as Messenger and Bortz (2021), "Weak SINDy", with
    the constant test function, on the Lagrangian equations.

    Args:
        statistics: scales of the data.
        model: the model that will be trained, a mechanical system.

    Raises:
        TypeError: if the model has no mass matrix, as a black box.
        ValueError: if the windows have an odd number of steps, the force is not linear in u, or the
            model learns its initial state.
    """

    scale: Tensor

    def __init__(self, statistics: Statistics, model: Predictor):
        super().__init__()
        if not isinstance(model, MechanicalSystem):
            raise TypeError(
                f"model is a {type(model).__name__}, expected a mechanical system with a mass "
                "matrix, such as model=lnn: use loss=increment for a black box"
            )
        refuse_learned_initial_state(model)
        if not model.input_affine:
            raise ValueError(
                "the force is not linear in the input (model/input=nonlinear), and its impulse "
                "needs A(q) u: take loss=increment"
            )
        steps = statistics.velocity_increment_std.shape[0]
        if steps % 2:
            raise ValueError(
                f"the windows have {steps} steps, expected an even number for Simpson's rule: "
                "set data.steps=2"
            )
        std = statistics.velocity_increment_std[-1, model.num_coordinates :]
        self.register_buffer("scale", std.float(), persistent=False)
        self._increment: Callable[..., Tensor] = velocity_increment

    def forward(self, model: Predictor, windows: Windows, progress: float) -> Tensor:
        q = torch.cat([windows.q.unsqueeze(1), windows.q.unsqueeze(1) + windows.dq], dim=1)
        v = torch.cat([windows.v.unsqueeze(1), windows.v.unsqueeze(1) + windows.dv], dim=1)
        steps, samples = windows.dv.shape[1], windows.u.shape[1] - 1
        weights = input_weights(steps, samples // steps, windows.interpolation).to(q)
        weights = weights * windows.t[1]
        predicted = self._increment(model, q, v, weights.sum(-1), weights @ windows.u)
        return torch.mean(((predicted - windows.dv[:, -1]) / self.scale) ** 2)

    def compile_dynamics(self, model: Predictor, steps: int) -> None:
        self._increment = torch.compile(velocity_increment)


def velocity_increment(
    model: MechanicalSystem, q: Tensor, v: Tensor, weights: Tensor, inputs: Tensor
) -> Tensor:
    """dv^ = M(q_H)^-1 (J - (M(q_H) - M(q_0)) v_0), ``(B, N)``, with J by quadrature.

    Args:
        model: the terms.
        q, v: states at the nodes, ``(B, H + 1, N)``.
        weights: weights of the nodes, ``(H + 1,)``, s.
        inputs: weighted inputs of the nodes, ``(B, H + 1, M)``, so that the impulse of the input
            is the sum of A(q_j) inputs_j.
    """
    force = model._kinetic_gradient(q, v) - model.potential_force(q) - model.dissipative_force(q, v)
    impulse = weights.unsqueeze(-1) * force + matvec(model.input_matrix(q), inputs)
    start, end, v0 = q[:, 0], q[:, -1], v[:, 0]
    # Not M(q_H) v_H - M(q_0) v_0: dv is known to more digits than the difference of two states.
    turned = model.momentum(end, v0) - model.momentum(start, v0)
    return model.velocity(end, impulse.sum(1) - turned)


@functools.cache
def input_weights(steps: int, stride: int, interpolation: Interpolation) -> Tensor:
    """W ``(H + 1, K)`` with the integral of a(t) u(t) dt = h * sum of W_jk a(t_j) u(t_k).

    a is the parabola through nodes 0, 1, 2, then 2, 3, 4 and so on, u goes between its samples as
    ``interpolation`` says, and the integral of their product is exact. With u = 1 the weights of
    the nodes, the sums over k, are those of Simpson's rule.

    Args:
        steps: H, even; the step from node to node is h.
        stride: samples of the input in a step; K = H * stride + 1.
        interpolation: how u moves between samples.
    """

    def parabolas(s: Tensor) -> Tensor:
        """The three that are 1 at one node and 0 at the others, nodes at s = -1, 0, 1."""
        return torch.stack([s * (s - 1) / 2, 1 - s * s, s * (s + 1) / 2])

    s = torch.linspace(-1, 1, 2 * stride + 1, dtype=torch.float64)
    left, right = parabolas(s[:-1]), parabolas(s[1:])
    centre = parabolas(0.5 * (s[:-1] + s[1:]))
    # Simpson's rule between samples too, exact for a parabola times a straight line.
    panel = torch.zeros(3, 2 * stride + 1, dtype=torch.float64)
    if interpolation == "linear":
        panel[:, :-1] += (left + 2 * centre) / (6 * stride)
        panel[:, 1:] += (2 * centre + right) / (6 * stride)
    else:
        panel[:, :-1] += (left + 4 * centre + right) / (6 * stride)
    weights = torch.zeros(steps + 1, steps * stride + 1, dtype=torch.float64)
    for node in range(0, steps, 2):
        weights[node : node + 3, node * stride : (node + 2) * stride + 1] += panel
    return weights
