"""Mechanics in latent coordinates: coupled oscillators, which are stable by construction."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from pydantic import Field, PositiveInt
from torch import Tensor, nn

from pinn_dyn.mechanics import double_copy
from pinn_dyn.mechanics.arrays import spd_solve
from pinn_dyn.models.initial_velocity import InitialVelocityHead
from pinn_dyn.models.mlp import Activation
from pinn_dyn.models.modes import Modes, modes_of
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.models.subspace_encoder import EncodedPredictor, LinearAndMLP

_SLOWEST, _FASTEST = 0.4, 1.2  # initial eigenfrequencies, rad in a step
_DAMPING = 0.5  # initial damping ratio
_SPREAD = 0.3  # initial entries of the factors of K and D, times the root of n
_COUPLING = 0.1  # initial entries of W, times the root of n
_NEWTON_STEPS, _HALVINGS = 100, 8


class Linearization(NamedTuple):
    """Equilibrium of oscillators under a constant input, and slopes there.

    Attributes:
        z, q: latent coordinates ``(*batch, n)`` and configuration ``(*batch, N)`` at rest.
        stiffness: Hessian of V, ``(*batch, n, n)``.
        input: df/du at du = 0, ``(*batch, n, M)``.
        output: dq/dx for x = (z, z'), ``(*batch, N, 2n)``.
    """

    z: Tensor
    q: Tensor
    stiffness: Tensor
    input: Tensor
    output: Tensor


def _slopes(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Return dy/dx ``(*batch, n, m)`` of y = f(x) ``(*batch, n)``, row by row."""
    rows = torch.func.vmap(torch.func.jacrev(function))(x.reshape(-1, x.shape[-1]))
    return rows.reshape(*x.shape[:-1], *rows.shape[1:])


class CoupledOscillators(EncodedPredictor):
    r"""Oscillators in latent coordinates with stiffness, damping and coupling::

        z'' = f(u, du) - K z - D z' - W^T tanh(W z + b)
        V(z) = z^T K z / 2 + sum of log cosh(W z + b)

    Symbols: latent coordinates z ``(*batch, n)``; K and D ``(n, n)``, symmetric positive definite
    by their Cholesky factors; W ``(n, n)``, b ``(n,)``; force f, a linear map plus an MLP, of the
    mean u of the inputs at both ends of a step and of their change du over the step. Tendons rub
    and valves throttle, so their force depends on the rate of the motors. At rest it is f(u, 0).
    The unit of time is a step, that of mass is 1. The coupling is the slope of a convex potential,
    so the system with a constant input has one equilibrium, which is globally stable, and it is
    input-to-state stable.

    A step takes the forces at the mean of z at both ends, and the coupling by its slope at the
    start and the bound W^T W of its Hessian::

        w = (2 I + K/2 + D + W^T W/2)^-1 (2 z' + f - K z - W^T tanh(W z + b))
        z_{k+1} = z + w,      z'_{k+1} = 2 w - z',      w = (z' + z'_{k+1}) / 2

    For any parameters and any step, the energy E = V(z) + z'^T z' / 2 changes by at most
    w^T f - w^T D w: the unforced system never gains energy, since log cosh lies below its expansion
    with the Hessian bound. All rollouts are bounded: the linear part x_{k+1} = A x_k, with the
    coupling as a force, decays to zero, and the force is bounded by that of the inputs, whose
    changes are bounded with them, and by the norm of W.

    Source: Stölzle and Della Santina (2024), "Input-to-state stable coupled oscillator networks for
    closed-form model-based control in latent space". The encoder and the output are those of
    :class:`EncodedPredictor`, with the latent state (z, z').

    Args:
        statistics: scales of the data.
        history: time before the start that the encoder sees, s; n steps of the training windows.
        oscillators: number n of latent coordinates.
        hidden, activation: widths and activation of the hidden layers of encoder and output.
        force_hidden: widths of the hidden layers of f.
        fade, initial_velocity: see :class:`EncodedPredictor`.
    """

    def __init__(
        self,
        statistics: Statistics,
        history: Annotated[float, Field(ge=0, le=2)] = 0.0,
        oscillators: PositiveInt = 24,
        hidden: Sequence[PositiveInt] = (128,),
        activation: Activation = "tanh",
        force_hidden: Sequence[PositiveInt] = (64,),
        fade: Annotated[float, Field(gt=0, lt=1)] | None = None,
        initial_velocity: InitialVelocityHead | None = None,
    ):
        self._force_hidden = force_hidden
        sizes = 2 * oscillators, hidden, activation
        super().__init__(statistics, history, *sizes, fade, initial_velocity)

    def _add_transition(
        self, inputs: int, latent: int, hidden: Sequence[int], activation: Activation
    ) -> None:
        n = latent // 2
        frequency = torch.linspace(math.log(_SLOWEST), math.log(_FASTEST), n)
        mixed = _SPREAD * torch.randn(2, n, n) / n**0.5
        self.force = LinearAndMLP(2 * inputs, n, self._force_hidden, activation)
        self.stiffness = nn.Parameter(torch.diag(frequency) + mixed[0].tril(-1))
        damping = (frequency + math.log(2 * _DAMPING)) / 2
        self.damping = nn.Parameter(torch.diag(damping) + mixed[1].tril(-1))
        self.coupling = nn.Parameter(_COUPLING * torch.randn(n, n) / n**0.5)
        self.bias = nn.Parameter(torch.randn(n))

    def matrices(self) -> tuple[Tensor, Tensor]:
        """Return K and D, ``(n, n)`` each, in units of a step."""
        factors = (
            raw.tril(-1) + torch.diag(raw.diagonal().exp())
            for raw in (self.stiffness, self.damping)
        )
        K, D = (factor @ factor.T for factor in factors)
        return K, D

    def flow(self, ratio: float = 1.0) -> tuple[Tensor, Tensor]:
        """Return A ``(2n, 2n)`` and B ``(2n, n)`` of a step x_{k+1} = A x_k + B force.

        Args:
            ratio: length of the step in steps of the training windows.
        """
        K, D = self.matrices()
        one = torch.eye(len(K)).to(K)
        bound = K + self.coupling.T @ self.coupling
        S = torch.linalg.inv(2 * one + ratio**2 / 2 * bound + ratio * D)
        A = torch.cat([torch.cat([one, 0 * one], dim=1), torch.cat([0 * one, -one], dim=1)])
        B = torch.cat([ratio * S, 2 * S])
        return A + B @ torch.cat([-ratio * K, 2 * one], dim=1), ratio * B

    def coupling_force(self, z: Tensor) -> Tensor:
        """Return W^T tanh(W z + b), ``(*batch, n)``."""
        return torch.tanh(F.linear(z, self.coupling, self.bias)) @ self.coupling

    def step_force(self, ends: Tensor) -> Tensor:
        """Return f of the normalized inputs at the ends of a step, ``(*batch, 2M)``."""
        start, end = ends.chunk(2, dim=-1)
        return self.force(torch.cat([(start + end) / 2, end - start], dim=-1))

    def latent_force(self, u: Tensor) -> Tensor:
        """Return f(u, 0), ``(*batch, n)``, at a constant u ``(*batch, M)``."""
        return self.step_force((torch.cat([u, u], dim=-1) - self._input_mean) / self._input_std)

    def stiffness_at(self, z: Tensor) -> Tensor:
        """Return the Hessian of V, ``(*batch, n, n)``."""
        slope = 1 - torch.tanh(F.linear(z, self.coupling, self.bias)).square()
        return self.matrices()[0] + self.coupling.T @ (slope.unsqueeze(-1) * self.coupling)

    def equilibrium(
        self, force: Tensor, start: Tensor | None = None, steps: int | None = None
    ) -> Tensor:
        """Return z with K z + W^T tanh(W z + b) = force, ``(*batch, n)``, in float64.

        Newton's method minimizes the convex function V(z) - z^T force. A step is halved until its
        end has the slope of a descent. With a number of ``steps``, the operations do not depend on
        the numbers, and the result is not tested.

        Raises:
            RuntimeError: if it does not converge.
        """
        K, _ = self.matrices()
        bound = K + self.coupling.T @ self.coupling
        z = torch.linalg.solve(bound, force.unsqueeze(-1))[..., 0] if start is None else start
        for _ in range(steps or _NEWTON_STEPS):
            slope = F.linear(z, K) + self.coupling_force(z) - force
            step = spd_solve(self.stiffness_at(z), slope)
            # NaN is returned.
            if not steps and not bool((slope.norm(dim=-1) > 1e-9 * (1 + force.norm(dim=-1))).any()):
                return z - step  # with the derivative of z
            length = torch.ones_like(z[..., :1])
            for _ in range(_HALVINGS):
                end = z - length * step
                ahead = F.linear(end, K) + self.coupling_force(end) - force
                beyond = (ahead * step).sum(-1, keepdim=True) < -0.5 * (slope * step).sum(
                    -1, keepdim=True
                )
                length = torch.where(beyond, length / 2, length)
            z = z - length * step
        if steps:
            return z
        raise RuntimeError(f"no equilibrium was found within {_NEWTON_STEPS} steps of Newton")

    def rest(
        self, u: Tensor, start: Tensor | None = None, steps: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return z and q of the equilibrium under a constant u, ``(*batch, n or N)``, in float64.

        Args:
            u: input, ``(*batch, M)``.
            start: z to start from, such as that of a similar input.
            steps: number of steps of Newton's method, see :meth:`equilibrium`.

        Raises:
            RuntimeError: see :meth:`equilibrium`.
        """
        z = self.equilibrium(self.latent_force(u), start, steps)
        return z, self.observe(torch.cat([z, torch.zeros_like(z)], dim=-1))

    def observe(self, x: Tensor) -> Tensor:
        """Return q ``(*batch, N)`` of the latent state x = (z, z')."""
        size = self.num_coordinates
        return self.mean[:size] + self.std[:size] * self.output(x)[..., :size]

    def linearize(
        self, u: Tensor, start: Tensor | None = None, steps: int | None = None
    ) -> Linearization:
        """Return the slopes of the model at its equilibrium, see :meth:`rest`."""
        z, q = self.rest(u, start, steps)
        x = torch.cat([z, torch.zeros_like(z)], dim=-1)
        slopes = _slopes(self.latent_force, u), _slopes(self.observe, x)
        return Linearization(z, q, self.stiffness_at(z), *slopes)

    def transition(self, at: Linearization, ratio: float = 1.0) -> tuple[Tensor, Tensor]:
        """Return A ``(2n, 2n)`` and B ``(2n, M)`` of a linearized step, see :meth:`flow`."""
        n = len(self.bias)
        A, B = self.flow(ratio)
        A = A - F.pad(B @ (at.stiffness - self.matrices()[0]), (0, n))
        return A, B @ at.input

    def modes(self, u: Tensor | None = None) -> Modes:
        """Return the modes of the model at its equilibrium under a constant input.

        The model is linearized in float64 over a step of the training windows, so that poles are
        those of its predictions. Poles faster than the step allows stand at half of its rate.

        Args:
            u: input, ``(M,)``; None takes the mean of the training data.
        """
        model, size = double_copy(self).requires_grad_(False), self.num_coordinates
        u = model._input_mean[: model.num_inputs] if u is None else u.double()
        at = model.linearize(u)
        A, B = model.transition(at)
        B = B * model._input_std[: model.num_inputs]
        return modes_of(A, B, at.output, step=model.fixed_step, spread=model.std[:size])

    def latent_path(self, z: Tensor, ends: Tensor) -> list[Tensor]:
        n = len(self.bias)
        A, B = self.flow()
        path = [z]
        for drive in F.linear(self.step_force(ends), B):
            z = F.linear(z, A) + drive - F.linear(self.coupling_force(z[..., :n]), B)
            path.append(z)
        return path
