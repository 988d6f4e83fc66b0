"""Functions that a program calls several times: C code has them once, and calls them in a loop."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.exports.program import Program, trace
from pinn_dyn.mechanics.compilation import Wrapped
from pinn_dyn.mechanics.integrators import Sticking

Function = Callable[[Tensor, Tensor], Tensor]

_PARTS: ContextVar[dict[str, tuple[Function, Tensor, Tensor]] | None]
_PARTS = ContextVar("parts", default=None)
"""Repeated functions of the program that is recorded by name, with example arguments."""
_CALLED: ContextVar[frozenset[str]] = ContextVar("called", default=frozenset())
"""Repeated functions that the recorded program calls."""


def repeated(name: str, function: Function, x: Tensor, rows: Tensor) -> Tensor:
    """Return x after x <- function(x, row) for each row of ``(*batch, n, R)``.

    Args:
        name: name of the function in C code.
        function: takes x ``(*batch, S)`` and a row ``(*batch, R)``, and returns the next x.
        x: the start.
        rows: the rows, the first one first.
    """
    if name in _CALLED.get():
        return torch.ops.pinn_dyn.iterate(name, x.contiguous(), rows.contiguous())
    parts = _PARTS.get()
    if parts is not None and name not in parts:
        parts[name] = function, x.clone(), rows[..., 0, :].clone()
    for row in rows.unbind(-2):
        x = function(x, row)
    return x


def sharing(model: Any) -> Any:
    """Return a shallow copy of a model whose steps call one function for all their stages.

    The function is the mass matrix and the bias force of a system with sticking friction, or the
    state derivative of another model.
    """
    shared, integrator = copy.copy(model), model.integrator
    while isinstance(integrator, Wrapped):
        integrator = integrator.inner
    n = model.num_coordinates

    def derivative(x: Tensor, u: Tensor) -> Tensor:
        return repeated("derivative", model.state_derivative, x, u.unsqueeze(-2))

    def packed(x: Tensor, _: Tensor) -> Tensor:
        mass, bias = model._mass_and_bias(x[..., :n], x[..., n : 2 * n])
        return torch.cat([mass.flatten(-2), bias], dim=-1)

    def mass_and_bias(q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        unused = q.new_zeros(*q.shape[:-1], n * (n + 1))
        x = torch.cat([q, v, unused[..., 2 * n :]], dim=-1)
        result = repeated("mass_and_bias", packed, x, unused[..., None, :1])
        return result[..., : n * n].unflatten(-1, (n, n)), result[..., n * n :]

    if isinstance(integrator, Sticking):
        shared._mass_and_bias = mass_and_bias
    else:
        shared.state_derivative = derivative
    return shared


def programs(
    name: str,
    function: Callable[..., Any],
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
) -> dict[str, Program]:
    """Return the operations of a function by its name, after those of its repeated functions."""
    with _set(_PARTS, {}) as parts, torch.no_grad():
        function(*inputs.values())
    result = {}
    for part, (repeated_function, x, row) in reversed(parts.items()):
        with _set(_CALLED, frozenset(parts) - {part}):
            result[part] = trace(repeated_function, {"x": x, "y": row}, ["result"])
    with _set(_CALLED, frozenset(parts)):
        result[name] = trace(function, inputs, outputs)
    return result


@contextmanager
def _set(variable: ContextVar[Any], value: Any) -> Iterator[Any]:
    token = variable.set(value)
    try:
        yield value
    finally:
        variable.reset(token)
