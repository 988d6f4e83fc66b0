"""A sum of mechanical systems is a mechanical system."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor, nn

from pinn_dyn.mechanics.integrators import RK4, Integrator
from pinn_dyn.mechanics.system import MechanicalSystem


def _total(name: str) -> Callable[..., Tensor]:
    """The method that adds what those of the parts give."""

    def method(self: Sum, *values: Tensor) -> Tensor:
        first, *others = (getattr(part, name)(*values) for part in self._systems())
        for other in others:
            first = first + other
        return first

    return method


class Sum(MechanicalSystem):
    """The mechanical system whose terms are the sums of those of its parts::

        X = sum over parts k of X_k,     X one of M, V, D, F, A and r

    The kinetic energy is that of all parts at the same q and v, so the Coriolis force adds too. M
    is positive definite if one M_k is and the others are semi-definite; passive parts have a
    passive sum.

    Args:
        parts: the systems by name, all of the same N and M.
        integrator: the method of integration of the sum.

    Raises:
        ValueError: on no parts, or parts of different sizes.
    """

    def __init__(self, parts: Mapping[str, MechanicalSystem], integrator: Integrator | None = None):
        sizes = {name: (part.num_coordinates, part.num_inputs) for name, part in parts.items()}
        if len(set(sizes.values())) != 1:
            found = ", ".join(f"{name}: {size}" for name, size in sizes.items()) or "none"
            raise ValueError(f"the parts of a sum have (N, M) {found}; expected the same for all")
        for name, part in parts.items():
            if part.input_history:
                raise ValueError(
                    f"the part {name} of a sum learns a delay of the input, which all parts share: "
                    f"take ~{name}.delay, and shift the input by the step InputDelay"
                )
        super().__init__(*next(iter(sizes.values())))
        self.integrator = integrator or RK4()
        self.parts = nn.ModuleDict(parts)
        self.input_affine = all(part.input_affine for part in parts.values())
        self.has_residual = any(part.has_residual for part in parts.values())

    mass_matrix = _total("mass_matrix")
    potential_energy = _total("potential_energy")
    damping_matrix = _total("damping_matrix")
    input_matrix = _total("input_matrix")
    _potential_force = _total("_potential_force")
    _inertial_force = _total("_inertial_force")
    _damping_force = _total("_damping_force")
    _friction_force = _total("_friction_force")
    _friction_slope = _total("_friction_slope")
    _input_force = _total("_input_force")
    _applied_force = _total("_applied_force")
    _residual_force = _total("_residual_force")
    _kinetic_gradient = _total("_kinetic_gradient")
    _momentum = _total("_momentum")

    def _mass_and_bias(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        (mass, bias), *others = (part._mass_and_bias(q, v) for part in self._systems())
        for other_mass, other_bias in others:
            mass, bias = mass + other_mass, bias + other_bias
        return mass, bias

    def _systems(self) -> list[MechanicalSystem]:
        parts: list[Any] = list(self.parts.values())
        return parts
