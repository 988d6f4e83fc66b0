"""A function of small tensors as a list of elementary operations of fixed shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, fx
from torch._decomp import core_aten_decompositions, get_decompositions
from torch._guards import TracingContext, tracing
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import get_proxy_mode, make_fx

from pinn_dyn.exports.decompositions import DECOMPOSITIONS
from pinn_dyn.mechanics.integrators import Sticking

MOVES = "view _unsafe_view reshape permute transpose t expand unsqueeze squeeze slice select"
MOVES += " diagonal repeat index index_select cat split_with_sizes unbind flip alias detach copy"
MOVES += " slice_scatter select_scatter"
"""Operations that put numbers at other positions."""
_OF_SHAPES_ALONE = (
    torch.ops.aten.full_like.default,
    torch.ops.aten.new_zeros.default,
    torch.ops.aten._new_zeros_with_same_feature_meta.default,
)


class Program:
    """The operations of a function for one state, without control flow and random numbers.

    All numbers are float64. Every node of the graph has ``meta["val"]``, its value at the example
    inputs, of which shapes and strides hold for all inputs. Operations on constants alone are
    evaluated and stored.

    Attributes:
        graph_module: the operations, by name in :data:`torch.ops.aten`.
        inputs, outputs: shape of each input and output by its name, in the order of the function.
        constants: the evaluation of the stored constants, with the tensors that the function reads.
    """

    def __init__(
        self,
        graph_module: fx.GraphModule,
        inputs: Mapping[str, torch.Size],
        outputs: Mapping[str, torch.Size],
        constants: fx.GraphModule,
    ):
        self.graph_module, self.constants = graph_module, constants
        self.inputs, self.outputs = dict(inputs), dict(outputs)

    def __call__(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs in eager PyTorch."""
        return self.graph_module(*arguments)

    def constants_with(self, tensors: Mapping[int, Tensor]) -> dict[str, Tensor]:
        """Return the constants by the names of their nodes, if the function reads other tensors.

        Args:
            tensors: the other tensor for the address of the data of a tensor.
        """
        read = dict(self.constants.named_buffers()) | dict(self.constants.named_parameters())
        with torch.no_grad():
            result: dict[str, Tensor] = torch.func.functional_call(
                self.constants, {k: tensors.get(x.data_ptr(), x) for k, x in read.items()}, ()
            )
        return result

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
    """Return the sources of an operation that moves numbers, and the positions that it reads.

    The positions have the shape of the result and count the numbers of all sources in turn. They
    are a list for an operation with several results.
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
    """Return the error for an operation that an export does not have, with its line of code."""
    trace = (node.meta.get("stack_trace") or "").strip().split("\n")[0]
    line = f", {trace[0].lower() + trace[1:]}" if trace else ""
    return TypeError(
        f"{node.target}{line}: {form} has no such operation, write the head with others"
    )


def is_traced() -> bool:
    """Return true while :func:`trace` records a function: its operations may not branch."""
    return get_proxy_mode() is not None


def trace(
    function: Callable[..., Tensor | tuple[Tensor, ...]],
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
    lines: bool = True,
) -> Program:
    """Record a function at example inputs, without a batch dimension, in float64.

    Args:
        function: takes the inputs by position, and returns a tensor for each output.
        inputs: example value of each input by its name.
        outputs: names of the outputs.
        lines: record the lines of code, for messages.
    """

    def run(*arguments: Tensor) -> tuple[Tensor, ...]:
        with torch.no_grad():
            result = function(*arguments)
        return (result,) if isinstance(result, Tensor) else tuple(result)

    softmax = get_decompositions([torch.ops.aten._softmax])
    table = {**core_aten_decompositions(), **softmax, **DECOMPOSITIONS}
    values = tuple(value.clone() for value in inputs.values())  # make_fx merges equal tensors
    with tracing(TracingContext(FakeTensorMode())):  # else make_fx creates a mode for every node
        traced = make_fx(torch.func.functionalize(run), table, record_stack_traces=lines)
        module = traced(*values)
    constants = _fold_constants(module, values)
    results = module(*values)
    shapes = {name: value.shape for name, value in zip(outputs, results, strict=True)}
    sizes = {name: value.shape for name, value in inputs.items()}
    return Program(module, sizes, shapes, constants)


@torch.library.custom_op("pinn_dyn::call", mutates_args=())
def _call(name: str, size: int, arguments: list[Tensor]) -> Tensor:
    """Stand for a call of a function with one result in a program."""
    return arguments[0].new_ones(size)


@contextmanager
def calling_part(model: Any, state: Tensor, u: Tensor) -> Iterator[Program]:
    """Let programs call the part of a model that the stages of a step share, within a context.

    It is the mass matrix and the bias force of a system with sticking friction, in one array, or
    the state derivative of another model.

    Args:
        model: a continuous predictor.
        state, u: example of a state ``(S,)`` and an input ``(M,)``.
    """
    is_sticking = isinstance(model.integrator, Sticking)
    name = "_mass_and_bias" if is_sticking else "state_derivative"
    original, n = getattr(model, name), len(state) // 2
    inputs = {"x": state[:n], "y": state[n:]} if is_sticking else {"x": state, "y": u}

    def part(x: Tensor, y: Tensor) -> Tensor:
        if not is_sticking:
            return original(x, y)
        mass, bias = original(x, y)
        return torch.cat([mass.flatten(), bias])

    def replacement(x: Tensor, y: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        size = n * (n + 1) if is_sticking else 2 * n
        result = _call("part", size, [x.contiguous(), y.contiguous()])
        return (result[: n * n].reshape(n, n), result[n * n :]) if is_sticking else result

    program = trace(part, inputs, ["result"], lines=False)
    setattr(model, name, replacement)
    try:
        yield program
    finally:
        vars(model).pop(name, None)


class _Values(fx.Interpreter):
    """Interpreter that stores the value of each node, and whether it depends on an input."""

    def run_node(self, node: fx.Node) -> Any:
        value = super().run_node(node)
        node.meta["val"] = value
        node.meta["constant"] = node.op == "get_attr" or (
            node.op == "call_function"
            and (
                node.target in _OF_SHAPES_ALONE
                or all(x.meta["constant"] for x in node.all_input_nodes)
            )
        )
        return value


def _fold_constants(module: fx.GraphModule, arguments: tuple[Tensor, ...]) -> fx.GraphModule:
    """Store the constants of a graph; return their evaluation."""
    graph = module.graph
    for node in graph.nodes:
        if node.target is torch.ops.aten.squeeze_.dim:
            node.target = torch.ops.aten.squeeze.dim
        elif node.target is torch.ops.aten._linalg_check_errors.default:
            graph.erase_node(node)
    graph.eliminate_dead_code()
    _Values(module).run(*arguments)
    evaluation = fx.Graph(module)
    copies: dict[fx.Node, fx.Node] = {}
    for node in graph.nodes:
        if not node.meta.get("constant"):
            continue
        if all(x in copies for x in node.all_input_nodes):
            copies[node] = evaluation.node_copy(node, copies.__getitem__)
        else:  # of the shape of an input alone
            name = f"shaped_{node.name}"
            module.register_buffer(name, node.meta["val"].detach().clone())
            copies[node] = evaluation.get_attr(name)
    stored = {}
    for node in list(graph.nodes):
        if node.op != "call_function" or not node.meta["constant"]:
            continue
        value = node.meta["val"]
        if isinstance(value, Tensor) and not all(user.meta["constant"] for user in node.users):
            name = f"constant_{node.name}"
            module.register_buffer(name, value.detach().clone().contiguous())
            with graph.inserting_before(node):
                replacement = graph.get_attr(name)
            node.replace_all_uses_with(replacement)
            stored[replacement.name] = copies[node]
    stored |= {x.name: copies[x] for x in graph.find_nodes(op="get_attr") if x in copies}
    graph.eliminate_dead_code()
    evaluation.output(stored)
    evaluation.eliminate_dead_code()
    constants = fx.GraphModule(module, evaluation)
    module.recompile()
    _Values(module).run(*arguments)
    return constants
