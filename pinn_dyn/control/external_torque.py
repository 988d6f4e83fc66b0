"""The external torque of a model as a function for other programs."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.control.observer import MomentumObserver, rest_speeds
from pinn_dyn.exports.exported import ExportedFunction, Ranges, drawn_states
from pinn_dyn.mechanics import MechanicalSystem

NAME = "external_torque"


def external_torque_function(
    model: MechanicalSystem, ranges: Ranges | None = None
) -> ExportedFunction:
    """Return ``external_torque(q, v, u, bandwidth, h, memory_in)`` -> tau_ext, memory_out.

    It is one call of :class:`~.observer.MomentumObserver`, h seconds after the previous call, with
    the measured state and the input that acts at the same instant.

    Args:
        model: the model, in float64.
        ranges: of q, v, u, bandwidth and h for the comparison; 20 to 100 1/s and 0.5 to 1.5 ms.
    """
    n, m = model.num_coordinates, model.num_inputs
    rest, double = rest_speeds(model), torch.float64

    def external_torque(q: Tensor, v: Tensor, *values: Tensor) -> tuple[Tensor, Tensor]:
        *inputs, bandwidth, h, memory = values
        u = inputs[0] if inputs else q.new_zeros(0)
        observer = MomentumObserver(model, bandwidth, rest=rest)
        driven = observer.driven(q, v, u)
        residual, memory = observer.estimate(q, v, torch.zeros_like(q), driven, memory, h)
        before, force, band = memory.tensor_split([1 + 2 * n, 1 + 3 * n])  # the start of the next
        return residual, torch.cat([before, force + driven, band])

    usual = {
        "bandwidth": (torch.tensor(20.0, dtype=double), torch.tensor(100.0, dtype=double)),
        "h": (torch.tensor(5e-4, dtype=double), torch.tensor(1.5e-3, dtype=double)),
    }
    memory_size = MomentumObserver(model, 1.0, rest=rest).memory_size
    sizes = {"q": n, "v": n, "u": m, "bandwidth": None, "h": None, "memory_in": memory_size}
    states = drawn_states({k: x for k, x in sizes.items() if x != 0}, {**usual, **(ranges or {})})
    about = (
        "External torque of the joints, h seconds after the previous call, through a low-pass of "
        "the bandwidth in 1/s. Zero memory_in before the first call, then memory_out."
    )
    return ExportedFunction(NAME, external_torque, states, ("tau_ext", "memory_out"), about)
