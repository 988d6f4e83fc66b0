"""Compiled programs: functions with all that they call, integrators, and when they pay."""

from __future__ import annotations

import types
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch._dynamo import config as dynamo_config
from torch._higher_order_ops.scan import scan
from torch._inductor import compile as compile_fx_graph
from torch.fx.experimental.proxy_tensor import make_fx

from pinn_dyn.mechanics.integrators import Dynamics, Integrator
from pinn_dyn.mechanics.integrators.integrator import BLOCK
from pinn_dyn.mechanics.predictor import ContinuousPredictor
from pinn_dyn.mechanics.signal import Signal

# When compiling pays. Each number is from benchmarks/training_step.py or, for roll-outs,
# benchmarks/long_rollout.py, on two cores; benchmarks/README.md has the tables.

STEPS_FOR_DERIVATIVE = 5_000
"""Training steps from which it pays to compile the derivative: at batch 256 and N = 3 that saves 11
ms of a step and takes 19 to 33 s."""
STEPS_FOR_PROGRAM = 20_000
"""Training steps from which it pays to compile loss and gradient as one program: that saves another
4 ms of a step, and takes 54 s longer at N = 3 (made up for in 14,000 steps), 124 s at N = 7 (28,000
steps). For the members of an ensemble it always pays."""
MOST_EVALUATIONS = 4
"""Evaluations of the dynamics in a window up to which it is compiled as one program: the time to
compile grows with them."""
CHUNK = 256
"""Windows of MOST_EVALUATIONS that are taken at once, four times as many of one evaluation: what
they keep for the gradient stays in the cache (8,192 by the midpoint loss in parts of 256 took 76 ms
at N = 3, of 1,024 55 ms). Less than twice as many are not cut."""
WORK_FOR_LOOP = 4_500_000
"""Steps times (batch + 300) from which a compiled loop pays in a roll-out: it saves 2 ms of a step
and 7 us for each trajectory, and takes 20 s to compile."""

# Products over at most so many numbers are sums that the compiler fuses with their neighbours.
_SHORT = 8
# A loop over fewer numbers runs in one thread: starting others takes longer than its work.
_WORTH_THREADS = 1024


@contextmanager
def integrated_by(model: ContinuousPredictor, integrator: Integrator) -> Iterator[None]:
    """The model with another integrator, for a while."""
    own, model.integrator = model.integrator, integrator
    try:
        yield
    finally:
        model.integrator = own


class _Wrapped(Integrator):
    """The steps of another integrator."""

    def __init__(self, inner: Integrator):
        super().__init__(inner.substeps)
        self.inner = inner
        self.nodes, self.order, self.mean_input = inner.nodes, inner.order, inner.mean_input

    def step(
        self, dynamics: Dynamics, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        return self.inner.step(dynamics, increment, start, inputs, h)


class Unrolled(_Wrapped):
    """Paths by operations that can be traced: those of the contract, whatever the method has."""


class CompiledDynamics(_Wrapped):
    """Paths of compiled dynamics, with gradients.

    Only the derivative is compiled, or a step, not the unrolled integrator: that keeps compilation
    short.

    Args:
        inner: the method.
        dynamics: what it integrates, from now on at one batch shape.
    """

    def __init__(self, inner: Integrator, dynamics: Dynamics):
        super().__init__(inner)
        _keep_rows()
        # Each is compiled when it is first called: a method calls one of the two.
        self._compiled = SimpleNamespace(
            state_derivative=torch.compile(dynamics.state_derivative),
            integration_step=torch.compile(dynamics.integration_step),
        )

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        return self.inner.path(self._compiled, start, grid, signal)


class CompiledLoop(_Wrapped):
    """Paths by one compiled loop, without gradients: for long roll-outs.

    Without the thousands of small operations of a long roll-out. Compiling takes half a minute to a
    minute for a new model, some 15 s for one of the same shape (the compiler's cache on disk).
    """

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        u = signal.u[..., 0, :].expand(BLOCK, len(self.nodes), *signal.batch, signal.num_inputs)
        arguments = (u.contiguous(), start.new_zeros(BLOCK))
        loop = compile_loop(dynamics.integration_step, torch.zeros_like(start), start, arguments)
        blocks = [torch.zeros_like(start)[None]]
        for inputs, lengths in self.blocks(grid, signal):
            # The loop has BLOCK steps; the last block is filled up with steps of length zero.
            lacking = BLOCK - lengths.shape[0]
            filled = torch.cat([inputs, inputs[-1:].expand(lacking, *inputs.shape[1:])])
            path = loop(blocks[-1][-1], start, filled, F.pad(lengths, (0, lacking)))
            blocks.append(path[: lengths.shape[0]])
        return torch.cat(blocks)


class RecordedSteps(_Wrapped):
    """Paths on a GPU by steps that are replayed from a CUDA graph, without gradients.

    A step is some hundred small kernels, and to launch one takes longer than its work. Dynamics
    that wait for the GPU, which cannot be recorded, are integrated as the inner method does.
    """

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        blocks = [torch.zeros_like(start)[None]]
        step = None
        for inputs, lengths in self.blocks(grid, signal):
            if step is None:
                try:
                    step = _RecordedStep(dynamics, start, inputs[0], lengths[0].to(start))
                except RuntimeError:
                    return self.inner.path(dynamics, start, grid, signal)
            pairs = zip(inputs, lengths.to(start), strict=True)
            blocks.append(torch.stack([step(stages, h) for stages, h in pairs]))
        return torch.cat(blocks)


class _RecordedStep:
    """A step as a CUDA graph, which goes on from the increment that it ended with before."""

    def __init__(self, dynamics: Dynamics, start: Tensor, inputs: Tensor, h: Tensor):
        self._increment = torch.zeros_like(start)
        self._inputs, self._h = inputs.clone(), h.clone()
        arguments = self._increment, start, self._inputs, self._h
        with _refusing_to_wait():
            dynamics.integration_step(*arguments)  # loads the kernels, as in _Recorded
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._increment.copy_(dynamics.integration_step(*arguments))

    def __call__(self, inputs: Tensor, h: Tensor) -> Tensor:
        self._inputs.copy_(inputs)
        self._h.copy_(h)
        self._graph.replay()
        return self._increment.clone()


@contextmanager
def _refusing_to_wait() -> Iterator[None]:
    """Within it, an operation that waits for the GPU raises RuntimeError."""
    before = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's, that this mode is a prototype
        torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode(before)


def compile_graph(
    function: Callable[..., Any], arguments: tuple[Tensor, ...]
) -> Callable[..., Any]:
    """The function, compiled for arguments of these shapes and types alone.

    It is traced once: numbers and tensors that are not arguments become constants of the program.
    The program checks nothing when called. On a CPU it runs in one thread; on a GPU it is recorded
    as a CUDA graph, and one call launches all its kernels.
    """
    _keep_rows()
    graph = make_fx(function, _DECOMPOSITIONS)(*arguments)
    for node in graph.graph.nodes:  # shapes are taken from the arguments: those noted do not fit
        node.meta.clear()
    if arguments[0].is_cuda:
        # Kernels of independent heads become one: a launch takes as long as their work.
        program = compile_fx_graph(graph, list(arguments), {"combo_kernels": True})
        return _Recorded(program, arguments)
    # Past torch.compile: between two steps its wrappers are out of the cache, and take 0.15 ms.
    return compile_fx_graph(graph, list(arguments), {"cpp.threads": 1, **_OPTIONS})


class _Recorded:
    """A program of a GPU as a CUDA graph: arguments are copied to where those of it lie."""

    def __init__(self, program: Callable[..., list[Tensor]], arguments: tuple[Tensor, ...]):
        self._arguments = [value.clone() for value in arguments]
        program(*self._arguments)  # loads the kernels, which can't be done while recording
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._results = program(*self._arguments)

    def __call__(self, *arguments: Tensor) -> list[Tensor]:
        torch._foreach_copy_(self._arguments, list(arguments))
        self._graph.replay()
        return [value.clone() for value in self._results]


def compile_loop(
    step: Callable[..., Tensor], state: Tensor, constant: Tensor, inputs: tuple[Tensor, ...]
) -> Callable[..., Tensor]:
    """The loop x_{k+1} = step(x_k, c, *inputs_k), compiled into one program without gradients.

    Compiled for arguments of these shapes and types alone, as by :func:`compile_graph`.

    Args:
        step: what is repeated.
        state: x, ``(...)``.
        constant: c, the same in all steps.
        inputs: the inputs of all steps, each ``(T, ...)``.

    Returns:
        A function of the same four, with the inputs one by one, that gives x_1 to x_T,
        ``(T, ...)``.
    """
    # make_fx does not see that a method has its first argument already.
    graph = make_fx(lambda *arguments: step(*arguments), _DECOMPOSITIONS)(
        state, constant, *[each[0] for each in inputs]
    )

    def loop(state: Tensor, constant: Tensor, *inputs: Tensor) -> Tensor:
        def body(state: Tensor, now: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
            following = graph(state, constant, *now)
            return following, following.clone()

        return scan(body, state, inputs)[1]

    # The compiler keeps its programs with the code of a function, which all loops here share.
    own = types.FunctionType(loop.__code__.replace(), loop.__globals__, closure=loop.__closure__)
    program = _compile(own, {"cpp.threads": 1} if state.numel() < _WORTH_THREADS else {})
    # The counter of the loop is a number that the compiler must not ask for the value of.
    with dynamo_config.patch(capture_scalar_outputs=True), torch.no_grad():
        program(state, constant, *inputs)
    return program


def _keep_rows() -> None:
    """Let the compiler hand matrices to triangular solves in rows, as they are given.

    It leaves the order open, and takes columns, of which each solve makes a copy: at N = 48 a sixth
    of a step.
    """
    from torch._inductor import lowering  # takes a second, and only compiling needs it

    solve = torch.ops.aten.linalg_solve_triangular.default
    lowering.add_layout_constraint(solve, lowering.constrain_to_fx_strides)


_OPTIONS = {"cpp_wrapper": True, "post_grad_fusion_options": {"decompose_mm_pass": {}}}


def _compile(function: Callable[..., Any], options: dict[str, Any]) -> Callable[..., Any]:
    _keep_rows()
    options = {**options, **_OPTIONS, "guard_filter_fn": torch.compiler.skip_all_guards_unsafe}
    return torch.compile(function, dynamic=False, options=options)


def _mm(a: Tensor, b: Tensor) -> Tensor:
    if b.shape[1] == 1 and a.shape[0] > 1:
        # The compiler turns products with a single row into loops that it fuses.
        return (b.T @ a.T).T
    # Not for a single row: the compiler would evaluate what it is made of for every column.
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
    return z.clamp(min=0) + torch.log(1 + torch.exp(-z.abs()))


def _sigmoid(z: Tensor) -> Tensor:
    if z.shape[-1:] == (1,):
        return NotImplemented
    # The same exponential as in _softplus: beside it, it costs none.
    decay = torch.exp(-z.abs())
    share = 1 / (1 + decay)
    return torch.where(z >= 0, share, decay * share)


def _softplus_backward(gradient: Tensor, z: Tensor, beta: float, threshold: float) -> Tensor:
    return NotImplemented if z.shape[-1:] == (1,) else gradient * _sigmoid(z)


# Long vectors gain by these; a single column, evaluated again for each row that needs it, loses.
_DECOMPOSITIONS: dict[Any, Callable[..., Any]] = {
    torch.ops.aten.mm.default: _mm,
    torch.ops.aten.addmm.default: _addmm,
    torch.ops.aten.softplus.default: _softplus,
    torch.ops.aten.softplus_backward.default: _softplus_backward,
    torch.ops.aten.sigmoid.default: _sigmoid,
}
