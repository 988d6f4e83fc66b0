"""Mechanical systems whose parameters are physical constants: what a least-squares fit works on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, jacrev, vmap
from torch.nn.utils import parameters_to_vector

from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models.known_constants import Constants, Named


class LearnedConstants(MechanicalSystem):
    """A mechanical system whose only parameters are :class:`~.known_constants.Constants`.

    Its equation of motion is that of every mechanical system, as a force that is missing::

        e(q, v, a, u; z) = M a + C v + G + D v + F - A u - r = 0

    z ``(P,)`` are the standardized parameters, in the order of ``parameters()``. All below follows
    from the terms; what has closed formulas may override it.
    """

    def parameter_names(self) -> list[str]:
        """Return the meaning of each parameter, in the order of ``parameters()``.

        A parameter outside :class:`~.known_constants.Constants` has the name of its attribute.
        """
        names: list[str] = []
        for path, module in self.named_modules():
            if isinstance(module, Constants):
                names += module.names
                continue
            for name, parameter in module.named_parameters(path, recurse=False):
                names += [f"{name} {k + 1}" for k in range(parameter.numel())]
        return names

    def physical_constants(self) -> list[Named]:
        """All constants in their units."""
        return [part.named() for part in self._constants()]

    def drive_gain(self) -> Tensor:
        """k ``(N,)``, a factor of the force of each input: one, unless gains are learned.

        An identification divides by it: it could shrink all constants, the gains too, otherwise.
        """
        return torch.ones(self.num_coordinates, dtype=next(self.parameters()).dtype)

    def missing_force(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """e, ``(*batch, N)``: what the input lacks for the acceleration."""
        return self.inverse_dynamics(q, v, a) - self._applied_force(q, v, u)

    def force_scale(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """Spread of A u / k over samples ``(K, N)``, of M a / k where no input acts, ``(N,)``."""
        driven = (self._applied_force(q, v, u) / self.drive_gain()).std(0)
        inertial = (matvec(self.mass_matrix(q), a) / self.drive_gain()).std(0)
        scale = torch.where(driven > 1e-9 * inertial, driven, inertial)
        return torch.where(scale > 0, scale, 1.0)  # what stays at rest has none

    def slopes(self) -> Slopes:
        """The derivatives of e at the present z."""
        return Slopes(self)

    def samples(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Samples:
        """e at fixed samples of motion, each ``(K, N)`` or ``(K, M)``, as z changes."""
        return Samples(self, q, v, a, u)

    def _constants(self) -> Iterator[Constants]:
        parts: Iterator[nn.Module] = self.modules()
        return (part for part in parts if isinstance(part, Constants))


class Slopes:
    """Derivatives of the missing force e, one reverse pass for each of its N entries.

    Args:
        model: at the z of interest.
    """

    def __init__(self, model: LearnedConstants):
        self.model: Any = model

    def by_parameters(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """de/dz, ``(B, N, P)``, from samples ``(B, N)`` and ``(B, M)``."""
        of, z = self._of_parameters(lambda model, *sample: model.missing_force(*sample))
        return vmap(jacrev(of), in_dims=(None, 0, 0, 0, 0))(z, q, v, a, u)

    def by_state(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """de/d(q, v), ``(B, N, 2N)``, from samples ``(B, N)`` and ``(B, M)``."""
        return torch.cat(vmap(jacrev(self.model.missing_force, (0, 1)))(q, v, a, u), dim=-1)

    def gain(self) -> Tensor:
        """dk/dz, ``(N, P)``, of the drive gains."""
        of, z = self._of_parameters(lambda model: model.drive_gain())
        return jacrev(of)(z)

    def _of_parameters(
        self, function: Callable[..., Tensor]
    ) -> tuple[Callable[..., Tensor], Tensor]:
        """A function of the model as one of z and its arguments, and the present z ``(P,)``."""
        called = Called(self.model, function)
        names, values = zip(*called.named_parameters(), strict=True)

        def of(z: Tensor, *arguments: Tensor) -> Tensor:
            parts = z.split([value.numel() for value in values])
            shaped = (part.view_as(value) for part, value in zip(parts, values, strict=True))
            return functional_call(called, dict(zip(names, shaped, strict=True)), arguments)

        return of, parameters_to_vector(values).detach()


class Samples:
    """The missing force e at K fixed samples of motion, for whatever z the model has by then.

    What does not depend on z may be computed once.
    """

    def __init__(self, model: LearnedConstants, *at: Tensor):
        self.model: Any = model
        self.at = at

    def missing_force(self) -> Tensor:
        """e, ``(K, N)``."""
        return self.model.missing_force(*self.at)

    def by_parameters(self) -> Tensor:
        """de/dz, ``(K, N, P)``."""
        return self.model.slopes().by_parameters(*self.at)


class Called(nn.Module):
    """A function of a model as the forward pass of a module."""

    def __init__(self, model: nn.Module, function: Callable[..., Tensor]):
        super().__init__()
        self.model = model
        self.function = function

    def forward(self, *arguments: Any) -> Tensor:
        return self.function(self.model, *arguments)
