"""Functions of a model for other programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.exports.exported_function import ExportedFunction, Ranges, drawn_states
from pinn_dyn.mechanics import ContinuousPredictor, MechanicalSystem, Predictor

Outputs = Tensor | tuple[Tensor, ...]


def model_functions(model: Predictor, ranges: Ranges | None = None) -> list[ExportedFunction]:
    """Return the functions of a model in float64, without gradients.

    - mechanical systems: ``forward_dynamics(q, v, u)``, ``inverse_dynamics(q, v, a)`` and
      ``terms(q)``, which returns M, D, G and A, with matrices row by row;
    - black boxes of the acceleration: ``forward_dynamics``;
    - both: ``step(q, v, u, h)``, q and v after h seconds with u held, by the model's integrator;
    - black boxes of the next state: ``next_state(q, v, u, u_next)`` after the model's step;
    - models with a latent state: ``start(q, v, u, q_past, u_past)``, the memory at the start of a
      rollout, and ``next_state(memory, u, u_next)``, memory, q and v after the model's step.

    Args:
        model: the model.
        ranges: smallest and largest q, v, u, a and h; the default is [-1, 1], and [0.5, 1.5] ms for
            h.

    Raises:
        TypeError: if the model has none of these functions, such as an ensemble.
    """
    n, m = model.num_coordinates, model.num_inputs
    sizes = {"q": n, "v": n, "a": n, "u": m, "u_next": m, "h": None}
    past = model.history_steps
    sizes |= {"q_past": past * n, "u_past": past * m, "memory": getattr(model, "memory_size", 0)}
    steps = torch.tensor([5e-4, 1.5e-3], dtype=torch.float64)
    states = drawn_states(sizes, {"h": (steps[0], steps[1]), **(ranges or {})})

    def exported(
        function: Callable[..., Outputs], inputs: str, outputs: str, about: str
    ) -> ExportedFunction:
        def of_present_inputs(*values: Tensor, **copy: Any) -> Outputs:
            arguments = dict(zip(names, values, strict=True))
            none = {x: values[0].new_zeros(0) for x in inputs.split() if x not in names}
            result = function(**arguments, **none, **copy)
            return result if isinstance(result, Tensor) else tuple(x for x in result if x.numel())

        names = [x for x in inputs.split() if sizes[x] != 0]
        results = [x for x in outputs.split() if x != "A" or m]
        values = {x: states[x] for x in names}
        calls = model if isinstance(model, ContinuousPredictor) and function is step else None
        return ExportedFunction(function.__name__, of_present_inputs, values, results, about, calls)

    def forward_dynamics(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        assert isinstance(model, ContinuousPredictor)
        return model.state_derivative(torch.cat([q, v]), u)[n:]

    def step(
        q: Tensor, v: Tensor, u: Tensor, h: Tensor, model: Predictor = model
    ) -> tuple[Tensor, Tensor]:
        assert isinstance(model, ContinuousPredictor)
        return held_step(model, q, v, u, h)

    def next_state(q: Tensor, v: Tensor, u: Tensor, u_next: Tensor) -> tuple[Tensor, ...]:
        x = torch.cat([q, v])
        return (x + model.increment(x, u, u_next)).split(n)  # type: ignore[operator]

    functions: list[tuple[Callable[..., Outputs], str, str, str]]
    last = (step, "q v u h", "q_next v_next", "State after h seconds, u held.")
    if isinstance(model, MechanicalSystem):
        force, terms = "Force tau = M a + C v + G + D v + F.", "M, D, G and A, matrices row by row."
        functions = [
            (model.forward_dynamics, "q v u", "a", "Acceleration a."),
            (model.inverse_dynamics, "q v a", "tau", force),
            (model.terms, "q", "M D G A", terms),
            last,
        ]
    elif isinstance(model, ContinuousPredictor):
        functions = [(forward_dynamics, "q v u", "a", "Acceleration a."), last]
    elif sizes["memory"]:
        about = f"State after {model.fixed_step:g} s, with u at its start and end."
        begin = "Memory of a rollout. Of q_past and u_past, the latest samples come first."
        latent: Any = model
        functions = [
            (latent.next_state, "memory u u_next", "memory_next q_next v_next", about),
            (latent.start, "q v u q_past u_past", "memory", begin),
        ]
    elif hasattr(model, "increment"):
        about = f"State after {model.fixed_step:g} s, with u at its start and end."
        functions = [(next_state, "q v u u_next", "q_next v_next", about)]
    else:
        raise TypeError(
            f"a {type(model).__name__} has no function of a state to export: export a single "
            "member of an ensemble, such as run.members[0]"
        )
    return [exported(*function) for function in functions]


def held_step(
    model: ContinuousPredictor, q: Tensor, v: Tensor, u: Tensor, h: Tensor
) -> tuple[Tensor, Tensor]:
    """Return q and v ``(*batch, N)`` after a step of h seconds with the input u held."""
    system = model if isinstance(model, MechanicalSystem) and model.state == "qp" else None
    start = torch.cat([q, system.momentum(q, v) if system else v], dim=-1)
    inputs = u.expand(len(model.integrator.nodes), *u.shape)
    state = start + model.integration_step(0 * start, start, inputs, h)
    q, v = state.split(model.num_coordinates, dim=-1)
    return q, system.velocity(q, v) if system else v
