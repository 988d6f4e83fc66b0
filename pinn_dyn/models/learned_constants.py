"""Mechanical systems whose parameters are physical constants, for least-squares fits."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, jacrev, vmap
from torch.nn.utils import parameters_to_vector

from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models.known_constants import HasConstants


class LearnedConstants(HasConstants, MechanicalSystem):
    """Mechanical system whose parameters are :class:`~.known_constants.Constants`::

        e(q, v, a, u; z) = M a + C v + G + D v + F - A u - r = 0

    e is the missing force. z ``(P,)`` are the parameters in the order of ``parameters()``. The
    methods of this class use the terms of the system. A subclass may override them by closed
    formulas.
    """

    @property
    def has_passive_joints(self) -> bool:
        """True if coordinates have no input; zero inertia would fit their equation."""
        return self.num_inputs < self.num_coordinates

    @property
    def identified_by_forces(self) -> bool:
        """True if filtering the input has the same effect as filtering the force."""
        return self.input_affine

    def saturated(self, v: Tensor, u: Tensor) -> Tensor:
        """Return true where a drive does not reach its command, ``(*batch, N)``, bool."""
        return torch.zeros_like(v, dtype=torch.bool)

    def absent_parameters(self) -> Tensor | None:
        """Return z ``(P,)`` that switches optional effects off, or None without such effects.

        Entries are NaN for all other parameters.
        """
        return None

    def parameter_names(self) -> list[str]:
        """Return the meaning of each parameter, or the name of its attribute."""
        return [name for part in HasConstants.physical_constants(self) for name in part.names]

    def drive_gain(self) -> Tensor:
        """Return the gain k of each coordinate's input, ``(N,)``; 1 if no gains are learned."""
        return torch.ones(self.num_coordinates, dtype=next(self.parameters()).dtype)

    def motor_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the force that the inputs exert on the joints, ``(*batch, N)``."""
        return self.applied_force(q, v, u)

    def missing_force(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """Return e, ``(*batch, N)``, the required force minus the force of the input."""
        return self.inverse_dynamics(q, v, a) - self.applied_force(q, v, u)

    def force_scale(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """Return the standard deviation of motor force / k over samples, ``(N,)``.

        For a coordinate without a motor force, return that of M a / k.
        """
        driven = (self.motor_force(q, v, u) / self.drive_gain()).std(0)
        inertial = (matvec(self.mass_matrix(q), a) / self.drive_gain()).std(0)
        scale = torch.where(driven > 1e-9 * inertial, driven, inertial)
        return torch.where(scale > 0, scale, 1.0)  # a joint at rest has no scale

    def force_ratio(self, q: Tensor, v: Tensor, a: Tensor) -> tuple[Tensor, float]:
        """Return the ratio of fitted to initial force per input, ``(M,)``, and a likely limit."""
        return torch.ones(self.num_inputs), math.inf

    def slopes(self) -> Slopes:
        """Return the derivatives of e at the current z."""
        return Slopes(self)

    def samples(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Samples:
        """Return e at K fixed samples of motion, ``(K, N)`` and ``(K, M)``, for changing z."""
        return Samples(self, q, v, a, u)


class Slopes:
    """Derivatives of the missing force e of a model, by reverse passes."""

    def __init__(self, model: LearnedConstants):
        self.model: Any = model

    def by_parameters(self, *at: Tensor) -> Tensor:
        """Return de/dz, ``(B, N, P)``, from samples q, v, a ``(B, N)`` and u ``(B, M)``.

        A sticking law takes the share of forward motion as another sample
        (:class:`~.sliding.Sliding`).
        """
        function, z = self._of_parameters(lambda model, *sample: model.missing_force(*sample))
        return vmap(jacrev(function), in_dims=(None, *(0 for _ in at)))(z, *at)

    def by_state(self, *at: Tensor) -> Tensor:
        """Return de/d(q, v), ``(B, N, 2N)``, from the samples of :meth:`by_parameters`."""
        return torch.cat(vmap(jacrev(self.model.missing_force, (0, 1)))(*at), dim=-1)

    def gain(self) -> Tensor:
        """Return dk/dz, ``(N, P)``, of the drive gains."""
        function, z = self._of_parameters(lambda model: model.drive_gain())
        return jacrev(function)(z)

    def _of_parameters(
        self, function: Callable[..., Tensor]
    ) -> tuple[Callable[..., Tensor], Tensor]:
        """Return a function of the model as a function of z ``(P,)``, and the current z."""
        called = Called(self.model, function)
        names, values = zip(*called.named_parameters(), strict=True)

        def function_of_z(z: Tensor, *arguments: Tensor) -> Tensor:
            parts = z.split([value.numel() for value in values])
            shaped = (part.view_as(value) for part, value in zip(parts, values, strict=True))
            return functional_call(called, dict(zip(names, shaped, strict=True)), arguments)

        return function_of_z, parameters_to_vector(values).detach()


class Samples:
    """Missing force e at K fixed samples of motion, for the current z of the model."""

    def __init__(self, model: LearnedConstants, *at: Tensor):
        self.model: Any = model
        self.at = at

    def missing_force(self) -> Tensor:
        """Return e, ``(K, N)``."""
        return self.model.missing_force(*self.at)

    def by_parameters(self) -> Tensor:
        """Return de/dz, ``(K, N, P)``."""
        return self.model.slopes().by_parameters(*self.at)


class Called(nn.Module):
    """Module whose forward pass is a function of a model."""

    def __init__(self, model: nn.Module, function: Callable[..., Tensor]):
        super().__init__()
        self.model = model
        self.function = function

    def forward(self, *arguments: Any) -> Tensor:
        return self.function(self.model, *arguments)
