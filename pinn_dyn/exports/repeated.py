"""Functions that a program calls several times. C code contains them once, and calls in a loop."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.exports.program import Program, trace
from pinn_dyn.mechanics.integrators import Sticking, Wrapped

Function = Callable[[Tensor, Tensor], Tensor]

_PARTS: ContextVar[dict[str, tuple[Function, Tensor, Tensor]] | None]
_PARTS = ContextVar("parts", default=None)
"""Repeated functions of the currently recorded program by name, with example arguments."""
_SIZES: ContextVar[Mapping[str, int]] = ContextVar("sizes", default=MappingProxyType({}))
"""Repeated functions of the currently recorded program, with the sizes of their results."""


def repeated(name: str, function: Function, x: Tensor, rows: Tensor) -> Tensor:
    """Return x after x <- function(x, row) for each row of ``(*batch, n, R)``.

    Args:
        name: name of the function in C code.
        function: function from x ``(*batch, S)`` and a row ``(*batch, R)`` to the next x. With a
            single row, the result may have another size.
        x: the first x.
        rows: the rows, in the order of the calls.
    """
    size = _SIZES.get().get(name)
    if size is not None:
        return torch.ops.pinn_dyn.call(name, x.contiguous(), rows.contiguous(), size)
    parts = _PARTS.get()
    if parts is not None and name not in parts:
        parts[name] = function, x.clone(), rows[..., 0, :].clone()
    for row in rows.unbind(-2):
        x = function(x, row)
    return x


def sharing(model: Any) -> Any:
    """Return a shallow copy of a model whose steps call a shared function in all stages.

    For a system with sticking friction, the function returns the mass matrix and the bias force in
    an array. For any other model, it is the state derivative. The copy has the model's tensors.
    """
    shared, integrator = copy.copy(model), model.integrator
    while isinstance(integrator, Wrapped) and not isinstance(integrator, Sticking):
        integrator = integrator.inner
    n = model.num_coordinates

    def derivative(x: Tensor, u: Tensor) -> Tensor:
        return repeated("derivative", model.state_derivative, x, u.unsqueeze(-2))

    def packed(q: Tensor, v: Tensor) -> Tensor:
        mass, bias = model.mass_and_bias(q, v)
        return torch.cat([mass.flatten(-2), bias], dim=-1)

    def mass_and_bias(q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        result = repeated("mass_and_bias", packed, q, v.unsqueeze(-2))
        return result[..., : n * n].unflatten(-1, (n, n)), result[..., n * n :]

    if isinstance(integrator, Sticking):
        vars(shared).update(integrator=integrator, mass_and_bias=mass_and_bias)
    else:
        vars(shared).update(integrator=integrator, state_derivative=derivative)
    return shared


def programs(
    name: str,
    function: Callable[..., Any],
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
) -> dict[str, Program]:
    """Return the operations of the repeated functions and of a function, by name."""
    with _set(_PARTS, {}) as parts, torch.no_grad():
        function(*inputs.values())
    result: dict[str, Program] = {}
    sizes: dict[str, int] = {}
    for part, (repeated_function, x, row) in reversed(parts.items()):
        with _set(_SIZES, sizes):
            result[part] = trace(repeated_function, {"x": x, "y": row}, ["result"])
        sizes = {**sizes, part: result[part].outputs["result"].numel()}
    with _set(_SIZES, sizes):
        result[name] = trace(function, inputs, outputs)
    return result


@contextmanager
def _set(variable: ContextVar[Any], value: Any) -> Iterator[Any]:
    token = variable.set(value)
    try:
        yield value
    finally:
        variable.reset(token)
