"""Repeated functions, which are a loop in C code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.exports.program import Program, trace

Function = Callable[[Tensor, Tensor], Tensor]

_PARTS: ContextVar[list[tuple[Function, Tensor, Tensor]] | None] = ContextVar("parts", default=None)
"""Repeated functions of the program that is recorded, with example arguments."""
_NUMBER: ContextVar[int | None] = ContextVar("number", default=None)
"""Number of the next repeated function in a program with loops; None without loops."""


def repeated(function: Function, x: Tensor, rows: Tensor) -> Tensor:
    """Return x after x <- function(x, row) for each row of ``(*batch, n, R)``.

    Args:
        function: takes x ``(*batch, S)`` and a row ``(*batch, R)``, and returns the next x.
        x: the start.
        rows: the rows, the first one first.
    """
    number, parts = _NUMBER.get(), _PARTS.get()
    if number is not None:
        _NUMBER.set(number + 1)
        return _iterate(f"part{number}", x.contiguous(), rows.contiguous())
    if parts is not None:
        parts.append((function, x.clone(), rows[..., 0, :].clone()))
    for row in rows.unbind(-2):
        x = function(x, row)
    return x


@torch.library.custom_op("pinn_dyn::iterate", mutates_args=())
def _iterate(name: str, x: Tensor, rows: Tensor) -> Tensor:
    """Stand for the loop over the rows of a function with one result in a program."""
    return x.clone()


def programs(
    name: str,
    function: Callable[..., Any],
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
) -> dict[str, Program]:
    """Return the operations of a function by its name, after those of its repeated functions."""
    with _set(_PARTS, []) as parts, torch.no_grad():
        function(*inputs.values())
    result = {}
    for k, (part, x, row) in enumerate(parts):
        result[f"part{k}"] = trace(part, {"x": x, "y": row}, ["result"], lines=False)
    with _set(_NUMBER, 0 if parts else None):
        result[name] = trace(function, inputs, outputs)
    return result


@contextmanager
def _set(variable: ContextVar[Any], value: Any) -> Any:
    token = variable.set(value)
    try:
        yield value
    finally:
        variable.reset(token)
