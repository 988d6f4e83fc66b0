"""A sum of mechanical systems is a mechanical system."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor, nn

from pinn_dyn.mechanics.integrators import RK4, Integrator
from pinn_dyn.mechanics.system import MechanicalSystem


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
                    f"take {name}.delay=none, and shift the input by the step InputDelay"
                )
        super().__init__(*next(iter(sizes.values())))
        self.integrator = integrator or RK4()
        self.parts = nn.ModuleDict(parts)
        self.input_affine = all(part.input_affine for part in parts.values())
        self.has_residual = any(part.has_residual for part in parts.values())

    def mass_matrix(self, q: Tensor) -> Tensor:
        return self._total(lambda part: part.mass_matrix(q))

    def potential_energy(self, q: Tensor) -> Tensor:
        return self._total(lambda part: part.potential_energy(q))

    def damping_matrix(self, q: Tensor) -> Tensor:
        return self._total(lambda part: part.damping_matrix(q))

    def input_matrix(self, q: Tensor) -> Tensor:
        return self._total(lambda part: part.input_matrix(q))

    def _potential_force(self, q: Tensor) -> Tensor:
        return self._total(lambda part: part._potential_force(q))

    def _inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        return self._total(lambda part: part._inertial_force(q, v, a))

    def _mass_and_bias(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        (mass, bias), *others = (part._mass_and_bias(q, v) for part in self._systems())
        for other_mass, other_bias in others:
            mass, bias = mass + other_mass, bias + other_bias
        return mass, bias

    def _damping_force(self, q: Tensor, v: Tensor) -> Tensor:
        return self._total(lambda part: part._damping_force(q, v))

    def _friction_force(self, v: Tensor) -> Tensor:
        return self._total(lambda part: part._friction_force(v))

    def _friction_slope(self, v: Tensor) -> Tensor:
        return self._total(lambda part: part._friction_slope(v))

    def _input_force(self, q: Tensor, u: Tensor) -> Tensor:
        return self._total(lambda part: part._input_force(q, u))

    def _applied_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return self._total(lambda part: part._applied_force(q, v, u))

    def _residual_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return self._total(lambda part: part._residual_force(q, v, u))

    def _kinetic_gradient(self, q: Tensor, v: Tensor) -> Tensor:
        return self._total(lambda part: part._kinetic_gradient(q, v))

    def _momentum(self, q: Tensor, v: Tensor) -> Tensor:
        return self._total(lambda part: part._momentum(q, v))

    def _systems(self) -> list[MechanicalSystem]:
        parts: list[Any] = list(self.parts.values())
        return parts

    def _total(self, term: Callable[[MechanicalSystem], Tensor]) -> Tensor:
        first, *others = (term(part) for part in self._systems())
        for other in others:
            first = first + other
        return first
