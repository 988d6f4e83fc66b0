"""Analytic systems with known structure and learned constants."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from pydantic import PositiveFloat
from torch import Tensor, nn
from torch.func import functional_call

from pinn_dyn.mechanics import RK4, Integrator, MechanicalSystem
from pinn_dyn.models.known_constants import PositiveConstants
from pinn_dyn.models.learned_constants import Called, LearnedConstants
from pinn_dyn.models.statistics import Statistics


def _term(system: MechanicalSystem, name: str, *values: Tensor) -> Tensor:
    return getattr(system, name)(*values)


def _of_structure(name: str) -> Callable[..., Any]:
    """Build a method that calls the structure with the learned constants in its buffers."""

    def method(self: KnownSystem, *values: Tensor) -> Any:
        parts = self.learned.items()
        learned = {f"model.{key}": part().view(self.shapes[key]) for key, part in parts}
        return functional_call(self.structure, learned, (name, *values))

    return method


class KnownSystem(LearnedConstants):
    """Mechanical system with known terms and learned constants c::

        c_i = start_i exp(spread z_i) > 0,      z_i ~ N(0, 1)

    Args:
        statistics: scales of the data.
        structure: a system such as :class:`~pinn_dyn.systems.SoftArm`. Its attribute ``constants``
            has the units of each buffer to fit, as in ``{"mass": ["kg"]}``. The buffers are the
            initial guesses.
        spread: prior standard deviation of log c: 1.5 if a guess may be off by a factor of ten,
            0.3 for a data sheet.
        integrator: the integration method.

    Raises:
        ValueError: if the coordinates or inputs do not match the data, or the constants are not
            positive buffers with units.
    """

    def __init__(
        self,
        statistics: Statistics,
        structure: MechanicalSystem,
        spread: PositiveFloat = 1.5,
        integrator: Integrator | None = None,
    ):
        size, inputs = structure.num_coordinates, structure.num_inputs
        if (statistics.num_coordinates, statistics.num_inputs) != (size, inputs):
            raise ValueError(
                f"the data have {statistics.num_coordinates} coordinates and "
                f"{statistics.num_inputs} inputs, but {type(structure).__name__} has {size} "
                f"coordinates and {inputs} inputs"
            )
        super().__init__(size, inputs)
        self.integrator = integrator or RK4()
        self.input_affine, self.has_residual = structure.input_affine, structure.has_residual
        self.learned = nn.ModuleDict()
        self.shapes: dict[str, torch.Size] = {}
        for name, units in _units_of(structure).items():
            start = structure.get_buffer(name)
            names = [name] if len(units) == 1 else [f"{name} {k + 1}" for k in range(len(units))]
            self.learned[name] = PositiveConstants(start.flatten(), spread, names, units)
            self.shapes[name] = start.shape
        self.structure = Called(copy.deepcopy(structure), _term)

    mass_matrix = _of_structure("mass_matrix")
    potential_energy = _of_structure("potential_energy")
    damping_matrix = _of_structure("damping_matrix")
    input_matrix = _of_structure("input_matrix")
    typical_input = _of_structure("typical_input")
    _potential_force = _of_structure("_potential_force")
    inertial_force = _of_structure("inertial_force")
    _acceleration = _of_structure("_acceleration")
    mass_and_bias = _of_structure("mass_and_bias")
    damping_force = _of_structure("damping_force")
    friction_force = _of_structure("friction_force")
    friction_slope = _of_structure("friction_slope")
    input_force = _of_structure("input_force")
    _residual_force = _of_structure("_residual_force")
    applied_force = _of_structure("applied_force")


def _units_of(structure: MechanicalSystem) -> dict[str, list[str]]:
    constants = getattr(structure, "constants", {})
    sizes = {name: buffer.numel() for name, buffer in structure.named_buffers()}
    if not constants or any(sizes.get(name) != len(units) for name, units in constants.items()):
        raise ValueError(
            f"structure {type(structure).__name__} has the constants {constants}, expected a unit "
            f"for each entry of buffers of the sizes {sizes}; use model=known for rigid chains"
        )
    return constants
