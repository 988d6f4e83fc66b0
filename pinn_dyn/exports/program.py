"""A function of small tensors as a list of elementary operations with fixed shapes."""

from __future__ import annotations

import contextlib
import functools
import operator
import sys
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch import Tensor, fx
from torch._decomp import core_aten_decompositions, get_decompositions
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from pinn_dyn.exports.decompositions import DECOMPOSITIONS

MOVES = "view _unsafe_view reshape permute transpose t expand unsqueeze squeeze slice select"
MOVES += " diagonal repeat index index_select cat split_with_sizes unbind flip alias detach copy"
MOVES += " slice_scatter select_scatter"
"""Operations that put numbers at other positions."""
_OF_SHAPES_ALONE = (
    torch.ops.aten.full_like.default,
    torch.ops.aten.new_zeros.default,
    torch.ops.aten._new_zeros_with_same_feature_meta.default,
)


class Constants:
    """Numbers of a program that depend only on tensors of the model.

    Attributes:
        leaves: tensors that the operations read.
        operations: names of operations of PyTorch, with arguments and options. The argument
            ``"%k"`` is leaf k, or, after the last leaf, the result of an operation.
        results: indices of the leaves and results that the program reads.
    """

    def __init__(
        self, leaves: Sequence[Tensor], operations: Sequence[Sequence[Any]], results: Sequence[int]
    ):
        self.leaves, self.operations, self.results = [*leaves], [*operations], [*results]

    def evaluate(self) -> Tensor:
        """Return all numbers that the program reads in a row, ``(n,)``, float64."""
        values: list[Any] = [*self.leaves]
        with torch.no_grad():
            for name, arguments, options in self.operations:
                function = _function(name)
                values.append(function(*_replaced(arguments, values), **_replaced(options, values)))
            arrays = [values[k].detach().flatten().double() for k in self.results]
        return torch.cat([torch.zeros(0, dtype=torch.float64), *arrays])


@functools.cache
def _function(name: str) -> Any:
    """Return an operation of PyTorch by its name, such as ``aten::add.Tensor``."""
    if name == "getitem":
        return operator.getitem
    packet, _, overload = name.removeprefix("aten::").partition(".")
    return getattr(getattr(torch.ops.aten, packet), overload or "default")


def _replaced(item: Any, values: Any) -> Any:
    """Replace nodes, and references such as ``"%3"``, in arguments by their values."""
    if isinstance(item, fx.Node):
        return values[item]
    if isinstance(item, str) and item.startswith("%"):
        return values[int(item[1:])]
    if isinstance(item, (list, tuple)):
        return [_replaced(x, values) for x in item]
    if isinstance(item, Mapping):
        return {key: _replaced(x, values) for key, x in item.items()}
    return item


class Program:
    """Operations of a function of a single state, without control flow and random numbers.

    All numbers are float64. Each node of the graph has ``meta["val"]``, its value at the example
    inputs. Its shape and strides hold for all inputs. Results of operations on constants are
    computed once and stored.

    Attributes:
        graph_module: the operations, by name in :data:`torch.ops.aten`.
        inputs, outputs: shape of each input and output by name, in the order of the function.
        constants: computation of the stored constants from the tensors that the function reads.
    """

    def __init__(
        self,
        graph_module: fx.GraphModule,
        inputs: Mapping[str, torch.Size],
        outputs: Mapping[str, torch.Size],
        constants: Constants,
    ):
        self.graph_module, self.constants = graph_module, constants
        self.inputs, self.outputs = dict(inputs), dict(outputs)

    def __call__(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs in eager PyTorch."""
        return self.graph_module(*arguments)

    def stored(self) -> list[Tensor]:
        """Return the stored constants, in the order of the results of ``constants``."""
        nodes = self.graph_module.graph.find_nodes(op="get_attr")
        return [node.meta["val"] for node in nodes]

    def results(self) -> list[fx.Node]:
        """Return the nodes of the outputs."""
        (output,) = self.graph_module.graph.find_nodes(op="output")
        return list(output.args[0])


def operation(node: fx.Node) -> str:
    """Return the name of an operation in :data:`torch.ops.aten`, without its overload."""
    target = node.target
    if isinstance(target, torch._ops.OpOverload):
        return str(target.overloadpacket.__name__)
    return getattr(target, "__name__", str(target))


def moved(node: fx.Node) -> tuple[list[fx.Node], Any]:
    """Return the sources of an operation that only moves numbers, and the positions that it reads.

    The positions have the shape of the result and count the numbers of all sources in a row. For an
    operation with several results, they are a list.
    """
    sources: list[fx.Node] = []

    def positions(source: fx.Node) -> Tensor:
        value = source.meta["val"]
        if value.dtype == torch.int64:  # indices
            return value
        start = sum(x.meta["val"].numel() for x in sources)
        sources.append(source)
        return torch.arange(start, start + value.numel()).reshape(value.shape)

    options = {key: x for key, x in node.kwargs.items() if key != "dtype"}
    target: Any = node.target
    return sources, target(*fx.map_arg(node.args, positions), **options)


def unsupported(node: fx.Node, form: str) -> TypeError:
    """Return an error for an operation that an export lacks, with the line of code."""
    line = f", {node.meta['line']}" if node.meta.get("line") else ""
    return TypeError(
        f"{node.target}{line}: {form} has no such operation, write the head with other operations"
    )


_IS_TRACED: ContextVar[bool] = ContextVar("is_traced", default=False)


def is_traced() -> bool:
    """Return true while a function is recorded or compiled, and must not branch on values."""
    return _IS_TRACED.get() or torch.compiler.is_compiling()


def trace(
    function: Callable[..., Tensor | tuple[Tensor, ...]],
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
) -> Program:
    """Record a function at example inputs, without a batch dimension, in float64.

    The function runs once, at these inputs. The operations of this thread are recorded.

    Args:
        function: function that takes the inputs by position, and returns a tensor per output.
        inputs: example value of each input, by name.
        outputs: names of the outputs.

    Raises:
        TypeError: if Python reads a number that depends on an input, as in a branch.
    """

    def run(*arguments: Tensor) -> tuple[Tensor, ...]:
        with torch.no_grad():
            result = function(*arguments)
        return (result,) if isinstance(result, Tensor) else tuple(result)

    values = tuple(value.detach().clone() for value in inputs.values())
    recorder = _Recorder(dict(zip(inputs, values, strict=True)))
    token = _IS_TRACED.set(True)
    try:
        with recorder:
            results = torch.func.functionalize(run)(*values)
    finally:
        _IS_TRACED.reset(token)
    shapes = {name: value.shape for name, value in zip(outputs, results, strict=True)}
    sizes = {name: value.shape for name, value in inputs.items()}
    module, constants = recorder.finished(results)
    return Program(module, sizes, shapes, constants)


_RULES: dict[Any, Callable[..., Any]] = {
    **core_aten_decompositions(),
    **get_decompositions([torch.ops.aten._softmax]),
}
_RULES = {
    x: y for x, y in _RULES.items() if x._schema.name.removeprefix("aten::") not in MOVES.split()
}
_RULES |= DECOMPOSITIONS
_CHECKS = (
    torch.ops.aten._linalg_check_errors.default,
    torch.ops.aten.is_same_size.default,
    torch.ops.aten._has_same_storage_numel.default,
)


class _Recorder(TorchDispatchMode):
    """Mode that records the operations on inputs, and separately the operations on constants.

    Args:
        inputs: value of each input, by name.
    """

    def __init__(self, inputs: Mapping[str, Tensor]):
        super().__init__()
        self._graph, self._folded = fx.Graph(), fx.Graph()
        self._nodes: dict[int, fx.Node] = {}
        self._constants: dict[int, fx.Node] = {}
        self._stored: dict[fx.Node, fx.Node] = {}
        self._kept: list[Any] = []  # keeps tensors alive, since their addresses identify them
        for name, value in inputs.items():
            self._keep(value, self._graph.placeholder(name))

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # otherwise PyTorch imports its compiler, which takes three seconds

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        options = kwargs or {}
        if function in _CHECKS:
            return function(*args, **options)
        if not any(id(x) in self._nodes for x in tree_leaves((args, options))):
            result = function(*args, **options)
            if all(isinstance(x, Tensor) for x in tree_leaves(result)):
                self._record(self._folded, function, args, options, result)
            return result
        for rule in (_RULES.get(function), function.decompose):
            if rule is not None:
                with self:
                    result = rule(*args, **options)
                if result is not NotImplemented:
                    return result
        result = function(*args, **options)
        if function in _OF_SHAPES_ALONE:
            self._leaf(result)
            return result
        if function is torch.ops.aten.squeeze_.dim:
            function = torch.ops.aten.squeeze.dim
        values = tree_leaves(result)
        if function._schema.is_mutable or not all(isinstance(x, Tensor) for x in values):
            raise TypeError(f"{function} on a number that depends on an input cannot be recorded")
        node = self._record(self._graph, function, args, options, result)
        node.meta["line"] = _line_of_code()
        return result

    def _record(
        self, graph: fx.Graph, function: Any, args: Any, options: Any, result: Any
    ) -> fx.Node:
        """Record an operation on inputs, or on constants."""
        operand = functools.partial(self._operand, graph)
        node = graph.call_function(function, *tree_map(operand, (tuple(args), dict(options))))
        if isinstance(result, Tensor):
            self._keep(result, node)
            return node
        node.meta["val"] = result
        for k, value in enumerate(result):
            self._keep(value, graph.call_function(operator.getitem, (node, k)))
        return node

    def _keep(self, value: Tensor, node: fx.Node) -> None:
        self._kept.append(value)
        nodes = self._nodes if node.graph is self._graph else self._constants
        nodes[id(value)] = node
        node.meta["val"] = value.detach()

    def _leaf(self, value: Tensor) -> None:
        self._keep(value, self._folded.get_attr(f"leaf{len(self._kept)}"))

    def _operand(self, graph: fx.Graph, value: Any) -> Any:
        """Return the node of a tensor in a graph. A tensor without an operation is a leaf."""
        if not isinstance(value, Tensor):
            return value
        if id(value) in self._nodes:
            return self._nodes[id(value)]
        if id(value) not in self._constants:
            self._leaf(value)
        constant = self._constants[id(value)]
        if graph is self._folded:
            return constant
        if constant not in self._stored:
            node = self._stored[constant] = self._graph.get_attr(f"constant{len(self._stored)}")
            node.meta["val"] = constant.meta["val"].clone().contiguous()
        return self._stored[constant]

    def finished(self, results: Sequence[Tensor]) -> tuple[fx.GraphModule, Constants]:
        """Return the graph with these results, and the computation of its constants."""
        output = self._graph.output([self._operand(self._graph, x) for x in results])
        output.meta["val"] = [*results]
        self._graph.eliminate_dead_code()
        stored = self._graph.find_nodes(op="get_attr")
        module = fx.GraphModule({x.target: x.meta["val"] for x in stored}, self._graph)
        constants = {x: constant for constant, x in self._stored.items()}
        read = [constants[x] for x in stored]
        self._folded.output(read)
        self._folded.eliminate_dead_code()
        leaves = self._folded.find_nodes(op="get_attr")
        calls = [x for x in self._folded.nodes if x.op == "call_function"]
        index = {x: k for k, x in enumerate([*leaves, *calls])}
        names = {x: f"%{k}" for x, k in index.items()}
        operations = [
            [_name(x.target), _replaced(x.args, names), _replaced(x.kwargs, names)] for x in calls
        ]
        tensors = [x.meta["val"] for x in leaves]
        return module, Constants(tensors, operations, [index[x] for x in read])


def _name(function: Any) -> str:
    return "getitem" if function is operator.getitem else function.name()


def _line_of_code() -> str:
    """Return the innermost line of code outside of PyTorch and this package."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and frame.f_code.co_filename.startswith(_FOLDERS):
        frame = frame.f_back
    if frame is None:
        return ""
    return f'file "{frame.f_code.co_filename}", line {frame.f_lineno}, in {frame.f_code.co_name}'


_FOLDERS = (str(Path(torch.__file__).parent), str(Path(__file__).parent), contextlib.__file__)


# torch.library.custom_op would import the compiler of PyTorch, which takes three seconds.
if not hasattr(torch.ops.pinn_dyn, "call"):  # exists if this module is imported again
    _LIBRARY = torch.library.Library("pinn_dyn", "DEF")
    _LIBRARY.define("call(str name, Tensor x, Tensor rows, int size) -> Tensor")
    _LIBRARY.impl("call", lambda name, x, rows, size: x.new_ones(size), "CompositeExplicitAutograd")
