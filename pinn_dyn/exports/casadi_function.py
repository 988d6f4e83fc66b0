"""A program as a CasADi function, with exact derivatives."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, fx

from pinn_dyn.exports.program import MOVES, Program, moved, operation, unsupported

if TYPE_CHECKING:
    import casadi

    from pinn_dyn.exports.exported_function import Calls

# Elementwise operations with another name in CasADi, and with the same name.
_NAMES = {"add": "plus", "sub": "minus", "mul": "times", "div": "rdivide", "pow": "power"}
_NAMES |= {"abs": "fabs", "where": "if_else", "maximum": "fmax", "minimum": "fmin"}
_NAMES |= {"logical_not": "logic_not", "logical_and": "logic_and", "logical_or": "logic_or"}
_SAME = "sqrt exp expm1 log log1p sin cos tan asin acos atan atan2 sinh cosh tanh erf sign floor"
_NAMES |= {name: name for name in f"{_SAME} lt le gt ge eq".split()}
_OPERATORS = {"neg": operator.neg, "reciprocal": lambda x: 1 / x}


def casadi_function(program: Program, name: str) -> casadi.Function:
    """Return a program as a CasADi function of column vectors, with exact derivatives.

    An output with two axes is a matrix. The graph consists of matrix operations (``casadi.MX``).

    Raises:
        ImportError: if CasADi is not installed.
        TypeError: if CasADi lacks an operation of the program.
    """
    ca = import_casadi()
    graph = program.graph_module.graph
    inputs = [ca.MX.sym(key, shape.numel()) for key, shape in program.inputs.items()]
    writer = _CasadiWriter(ca, dict(zip(graph.find_nodes(op="placeholder"), inputs, strict=True)))
    for node in graph.nodes:
        if node.op == "get_attr":
            writer.values[node] = ca.MX(ca.DM(node.meta["val"].flatten().tolist()))
        elif node.op == "call_function":
            writer.values[node] = writer.evaluate(node)
    outputs = [
        writer.matrix(node).T if node.meta["val"].ndim == 2 else writer.values[node]
        for node in program.results()
    ]
    return ca.Function(name, inputs, outputs, list(program.inputs), list(program.outputs))


def import_casadi() -> Any:
    """Return the module ``casadi``."""
    try:
        import casadi
    except ImportError as error:
        raise ImportError("CasADi is not installed: pip install 'pinn_dyn[mpc]'") from error
    return casadi


def write_casadi(functions: Sequence[Any], path: Path, info: str, real: str) -> Calls:
    """Write a function for ``casadi.Function.load``, and return the function of the file.

    The file does not contain ``info``.

    Raises:
        ValueError: if ``real`` is ``"float"``.
    """
    if real != "double":
        raise ValueError(f"{path}: CasADi computes with doubles: set real='double', or use .c")
    (function,) = functions
    casadi_function(function.program, function.name).save(str(path))
    loaded = import_casadi().Function.load(str(path))

    def call(*inputs: np.ndarray) -> list[np.ndarray]:
        rows = [loaded.call([*map(np.ravel, state)]) for state in zip(*inputs, strict=True)]
        return [np.stack([np.array(x) for x in column]) for column in zip(*rows, strict=True)]

    return {function.name: call}


class _CasadiWriter:
    """Nodes of a program as columns of numbers, in the row-major order of their tensors."""

    def __init__(self, ca: Any, values: dict[fx.Node, Any]):
        self.ca, self.values = ca, values

    def evaluate(self, node: fx.Node) -> Any:
        """Return the numbers of an operation, or a list for an operation with several results."""
        arguments: list[Any] = list(node.args)
        if node.target is operator.getitem:
            return self.values[arguments[0]][arguments[1]]
        name = operation(node)
        if name in MOVES.split() or name in ("clone", "_to_copy"):
            sources, index = moved(node)
            numbers = self.ca.vertcat(*(self.values[source] for source in sources))
            is_single = isinstance(index, Tensor)
            return numbers[_flat(index)] if is_single else [numbers[_flat(x)] for x in index]
        shape = node.meta["val"].shape
        if name == "mm":
            return self.ca.vec(self.ca.mtimes(*map(self.matrix, reversed(arguments))))
        if name in ("sum", "amin", "amax"):
            source, dims, *_ = (*arguments, None)
            positions = _positions(source)
            axes = [d % positions.ndim for d in dims or range(positions.ndim)]
            order = [*(d for d in range(positions.ndim) if d not in axes), *axes]
            numbers = self.values[source][_flat(positions.permute(order))]
            columns = self.ca.reshape(numbers, -1, shape.numel())
            if name == "sum":
                return self.ca.sum1(columns).T
            larger = self.ca.fmax if name == "amax" else self.ca.fmin
            return functools.reduce(larger, self.ca.vertsplit(columns)).T
        return self._elementwise(node, name, [self._operand(x, shape) for x in arguments])

    def matrix(self, node: fx.Node) -> Any:
        """Return the transpose of a matrix, since CasADi stores columns."""
        return self.ca.reshape(self.values[node], node.meta["val"].shape[1], -1)

    def _operand(self, argument: Any, shape: torch.Size) -> Any:
        if not isinstance(argument, fx.Node):
            return argument
        value = argument.meta["val"]
        if value.numel() == 1 or value.shape == shape:
            return self.values[argument]
        return self.values[argument][_flat(_positions(argument).expand(shape))]

    def _elementwise(self, node: fx.Node, name: str, x: list[Any]) -> Any:
        if name in _OPERATORS:
            return _OPERATORS[name](*x)
        if name not in _NAMES:
            raise unsupported(node, "CasADi")
        return getattr(self.ca, _NAMES[name])(*x)


def _positions(node: Any) -> Tensor:
    shape = node.meta["val"].shape
    return torch.arange(shape.numel()).reshape(shape)


def _flat(index: Tensor) -> list[int]:
    return index.flatten().tolist()
