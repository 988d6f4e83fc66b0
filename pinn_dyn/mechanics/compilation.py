"""Compiled functions and integrators, and thresholds from which compiling pays off."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule, Node
from torch.fx.experimental.proxy_tensor import make_fx

from pinn_dyn.mechanics.integrators import Dynamics, Integrator, Wrapped
from pinn_dyn.mechanics.predictor import ContinuousPredictor
from pinn_dyn.mechanics.signal import Signal

# Thresholds measured by benchmarks/training_step.py and benchmarks/long_rollout.py on two cores.

STEPS_FOR_DERIVATIVE = 5_000
"""Training steps from which compiling the state derivative pays off: 11 ms per step for 19 to
33 s at batch 256 and N = 3."""
STEPS_FOR_PROGRAM = 20_000
"""Training steps from which compiling loss and gradient as one program pays off: another 4 ms per
step for 54 s at N = 3 and 124 s at N = 7."""
MOST_EVALUATIONS = 4
"""Largest number of evaluations of the dynamics in a window that is compiled as one program."""
CHUNK = 256
"""Number of windows with MOST_EVALUATIONS evaluations that are computed at once. The values for
the gradient then stay in the cache. Batches of less than twice this number are not split."""
LARGEST_PLANNED = 7_000
"""Largest number of operations of a program whose memory is planned, an experimental option of the
compiler: an RK4 step with gradients has 6,500 at N = 3. The recursion is too deep at N = 7."""
_SHORT = 8
"""Largest number of terms for which the compiler can fuse a product as a sum."""


log = logging.getLogger(__name__)


@contextmanager
def integrated_by(model: ContinuousPredictor, integrator: Integrator) -> Iterator[None]:
    """Replace the integrator of a model within a context."""
    original, model.integrator = model.integrator, integrator
    try:
        yield
    finally:
        model.integrator = original


class CompiledDynamics(Wrapped):
    """Integrator that compiles the derivative or the step of its dynamics, with gradients."""

    def __init__(self, inner: Integrator, dynamics: Dynamics):
        super().__init__(inner)
        _keep_rows()
        # Compiled at the first call. A method calls only one of the two.
        self._compiled = SimpleNamespace(
            state_derivative=torch.compile(dynamics.state_derivative),
            integration_step=torch.compile(dynamics.integration_step),
        )

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        return self.inner.path(self._compiled, start, grid, signal)


def compile_graph(
    function: Callable[..., Any], arguments: tuple[Tensor, ...]
) -> Callable[..., Any]:
    """Trace a function once and compile it for arguments of the same shapes and types.

    The program does not check its arguments. On a CPU it runs in one thread; on a GPU it is a
    CUDA graph.
    """
    from torch._inductor import compile as compile_fx_graph  # the import takes a second

    _keep_rows()
    graph = make_fx(function, _DECOMPOSITIONS)(*arguments)
    for node in graph.graph.nodes:  # drop the recorded shapes, in favor of those of the arguments
        node.meta.clear()
    _share_constants(graph)
    if arguments[0].is_cuda:
        # Combined kernels of independent heads need fewer launches.
        program = compile_fx_graph(graph, list(arguments), {"combo_kernels": True})
        return _Recorded(program, arguments)
    # Avoid the wrappers of torch.compile, which take 0.15 ms per call.
    if len(graph.graph.nodes) <= LARGEST_PLANNED:
        try:
            return compile_fx_graph(copy.deepcopy(graph), list(arguments), _OPTIONS | _PLANNED)
        except Exception as error:
            log.info("memory planning failed (%s): compiling without it", type(error).__name__)
    return compile_fx_graph(graph, list(arguments), _OPTIONS)


def _share_constants(graph: GraphModule) -> None:
    """Merge equal constants. The compiler then evaluates equal features only once."""
    constants: list[tuple[Node, Tensor]] = []
    for node in graph.graph.find_nodes(op="get_attr"):
        value = getattr(graph, node.target)
        matches = (first for first, x in constants if x.dtype == value.dtype and x.equal(value))
        if first := next(matches, None):
            node.replace_all_uses_with(first)
        else:
            constants.append((node, value))
    graph.graph.eliminate_dead_code()
    graph.recompile()


class _Recorded:
    def __init__(self, program: Callable[..., list[Tensor]], arguments: tuple[Tensor, ...]):
        self._arguments = [value.clone() for value in arguments]
        program(*self._arguments)  # loads the kernels, which is not possible during recording
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._results = program(*self._arguments)

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        torch._foreach_copy_(self._arguments, list(arguments))
        self._graph.replay()
        return [value.clone() for value in self._results]


def _keep_rows() -> None:
    """Make the compiler pass matrices to triangular solves in row-major order, without copies."""
    from torch._inductor import lowering  # the import takes a second

    solve = torch.ops.aten.linalg_solve_triangular.default
    lowering.add_layout_constraint(solve, lowering.constrain_to_fx_strides)


_OPTIONS: dict[str, Any] = {
    "cpp.threads": 1,
    "cpp_wrapper": True,
    "cpp.enable_floating_point_contract_flag": "fast",  # a * b + c is one operation
}
_OPTIONS |= {"post_grad_fusion_options": {"decompose_mm_pass": {}}}
# One block of memory per call instead of a hundred, which take 8 % of a step at N = 3.
_PLANNED = {"memory_planning": True, "memory_pool": "intermediates"}


def _mm(a: Tensor, b: Tensor) -> Tensor:
    if b.shape[1] == 1 and a.shape[0] > 1:
        # The compiler fuses products with a single row.
        return (b.T @ a.T).T
    # Skip a single row: the compiler would evaluate its inputs for every column.
    if a.shape[1] <= _SHORT and b.shape[1] > _SHORT and a.shape[0] > 1:
        total = a[:, :1] * b[:1]
        for k in range(1, a.shape[1]):
            total = total + a[:, k : k + 1] * b[k : k + 1]
        return total
    return NotImplemented


def _addmm(bias: Tensor, a: Tensor, b: Tensor) -> Tensor:
    product = _mm(a, b)
    return product if product is NotImplemented else bias + product


def _softplus(z: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Tensor:
    if z.shape[-1:] == (1,):
        return NotImplemented
    # log(1 + e) = 2 atanh(r) with r <= 1/3, by a series that is faster than the logarithm.
    decay = torch.exp(-z.abs())
    ratio = decay / (2 + decay)
    square, terms = ratio * ratio, 8 if z.dtype == torch.float32 else 17
    series = torch.full_like(z, 2 / (2 * terms - 1))
    for k in reversed(range(1, terms)):
        series = series * square + 2 / (2 * k - 1)
    return z.clamp(min=0) + ratio * series


def _sigmoid(z: Tensor) -> Tensor:
    if z.shape[-1:] == (1,):
        return NotImplemented
    # The same exponential as in _softplus, which the compiler shares.
    decay = torch.exp(-z.abs())
    share = 1 / (1 + decay)
    return torch.where(z >= 0, share, decay * share)


def _softplus_backward(gradient: Tensor, z: Tensor, beta: float, threshold: float) -> Tensor:
    return NotImplemented if z.shape[-1:] == (1,) else gradient * _sigmoid(z)


# These are faster for long vectors, and slower for a single column.
_DECOMPOSITIONS: dict[Any, Callable[..., Any]] = {
    torch.ops.aten.mm.default: _mm,
    torch.ops.aten.addmm.default: _addmm,
    torch.ops.aten.softplus.default: _softplus,
    torch.ops.aten.softplus_backward.default: _softplus_backward,
    torch.ops.aten.sigmoid.default: _sigmoid,
}
