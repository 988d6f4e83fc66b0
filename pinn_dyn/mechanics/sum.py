"""A sum of mechanical systems is a mechanical system."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from pinn_dyn.mechanics.integrators import Integrator, with_friction
from pinn_dyn.mechanics.system import MechanicalSystem


def _total(name: str) -> Callable[..., Tensor]:
    def method(self: Sum, *values: Tensor) -> Tensor:
        total, *terms = (getattr(part, name)(*values) for part in self._systems())
        for term in terms:
            total = total + term
        return total

    return method


class Sum(MechanicalSystem):
    """Mechanical system whose terms are the sums of the terms of its parts::

        X = sum over parts k of X_k,     for X = M, V, D, F, A and r

    The Coriolis forces add up, too. The sum of passive parts is passive.

    Args:
        parts: the systems by name, all of the same N and M.
        integrator: the integration method.

    Raises:
        ValueError: if the sizes of the parts differ.
    """

    def __init__(self, parts: Mapping[str, MechanicalSystem], integrator: Integrator | None = None):
        sizes = {name: (part.num_coordinates, part.num_inputs) for name, part in parts.items()}
        if len(set(sizes.values())) != 1:
            raise ValueError(f"the parts of a sum have (N, M) {sizes}, expected the same for all")
        super().__init__(*next(iter(sizes.values())))
        self.parts = nn.ModuleDict(parts)
        self.input_affine = all(part.input_affine for part in parts.values())
        self.has_residual = any(part.has_residual for part in parts.values())
        self.sticking = any(part.sticking for part in parts.values())
        self.integrator = with_friction(integrator, self.sticking)

    mass_matrix = _total("mass_matrix")
    potential_energy = _total("potential_energy")
    damping_matrix = _total("damping_matrix")
    input_matrix = _total("input_matrix")
    typical_input = _total("typical_input")
    _potential_force = _total("_potential_force")
    inertial_force = _total("inertial_force")
    damping_force = _total("damping_force")
    friction_force = _total("friction_force")
    friction_slope = _total("friction_slope")
    sliding_force = _total("sliding_force")
    input_force = _total("input_force")
    applied_force = _total("applied_force")
    _residual_force = _total("_residual_force")

    def mass_and_bias(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        (mass, bias), *terms = (part.mass_and_bias(q, v) for part in self._systems())
        for part_mass, part_bias in terms:
            mass, bias = mass + part_mass, bias + part_bias
        return mass, bias

    def stiffness_matrix(self, q: Tensor) -> Tensor | None:
        matrices = [part.stiffness_matrix(q) for part in self._systems()]
        stiff = [matrix for matrix in matrices if matrix is not None]
        return torch.stack(stiff).sum(0) if stiff else None

    def _systems(self) -> list[MechanicalSystem]:
        parts: list[Any] = list(self.parts.values())
        return parts
