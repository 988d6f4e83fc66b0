"""Rollouts as a loop in C. Models that differ only in their numbers share the compiled code."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from pinn_dyn.exports.c_code import PRELUDE
from pinn_dyn.exports.c_lanes import LOOP, ONE, SEVERAL
from pinn_dyn.exports.compiled import STATES, Compiled, Function, Kind, agree, spread_around
from pinn_dyn.exports.live_numbers import LiveNumbers
from pinn_dyn.exports.program import Program
from pinn_dyn.exports.repeated import programs, sharing
from pinn_dyn.exports.scalar_code import c_function
from pinn_dyn.mechanics.compilation import Wrapped
from pinn_dyn.mechanics.integrators import Dynamics, Integrator
from pinn_dyn.mechanics.predictor import ContinuousPredictor
from pinn_dyn.mechanics.signal import Signal

NUMBERS = 2**21
"""Number of inputs that are computed at once, to limit the memory of large batches."""
SEVERAL_FROM = 4
"""Number of trajectories from which they are computed side by side in vectors."""


class CLoop(Wrapped):
    """Integrator that runs paths as a loop in C, in float64 and without gradients.

    The states are those of the inner integrator up to rounding. :class:`~.compiled.Compiled` says
    when the inner integrator computes a path.

    Args:
        inner: the method.
        members: number of leading dimensions of the state for members: 1 for an ensemble, or 0.
        threads: number of threads that share the trajectories.
    """

    def __init__(self, inner: Integrator, members: int = 0, threads: PositiveInt = 1):
        super().__init__(inner)
        self.members, self.threads = members, threads
        self._compiled: Compiled | None = None

    def ready(self, dynamics: ContinuousPredictor, x: Tensor, h: float) -> Function | None:
        """Return the loop for paths from states x ``(B, S)`` with steps of h s, if there is one.

        It stays the loop of the present numbers of the model.
        """
        u = x.new_zeros(len(x), 1, len(self.nodes), dynamics.num_inputs)
        steps = Steps(dynamics, x, u, x.new_tensor([h]), self.members)
        return self._code(dynamics).find(steps)

    def _code(self, dynamics: Dynamics) -> Compiled:
        if self._compiled is None:
            self._compiled = Compiled(dynamics)
        return self._compiled

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        fits = start.dtype == torch.float64 and start.is_cpu and not torch.is_grad_enabled()
        if not start.numel() or not fits:
            return self.inner.path(dynamics, start, grid, signal)
        leading, batch = start.shape[: self.members], start.shape[self.members : -1]
        x = start.reshape(*leading, -1, start.shape[-1]).movedim(self.members, 0).contiguous()

        def rows(inputs: Tensor) -> Tensor:
            inputs = inputs.reshape(*inputs.shape[: 2 + self.members], len(x), -1)
            return inputs.movedim(2 + self.members, 0)

        u, lengths = next(self.blocks(grid, signal, STATES))
        steps = Steps(cast(nn.Module, dynamics), x, rows(u), lengths, self.members)
        code = self._code(dynamics)
        loop = code.find(steps)
        if loop is None:
            with code.in_python(steps):
                return self.inner.path(dynamics, start, grid, signal)
        blocks = [torch.zeros_like(x)[:, None]]
        size = max(1, NUMBERS // max(1, u[0].numel()))
        for inputs, lengths in self.blocks(grid, signal, size):
            blocks.append(loop(blocks[-1][:, -1], x, rows(inputs), lengths, self.threads))
        path = torch.cat(blocks, dim=1).movedim(0, 1 + self.members)
        return path.reshape(-1, *leading, *batch, start.shape[-1])


class Loop:
    """Compiled loop of a model over the steps of one trajectory after another.

    Args:
        library: the compiled code.
        values: numbers of the model, the first argument of the code.
    """

    def __init__(self, library: ctypes.CDLL, values: Tensor):
        self._library, self._values = library, values
        pointer, size = ctypes.c_void_p, ctypes.c_long
        self._library.roll_out.argtypes = [pointer, size, size, *[pointer] * 4]
        self._lanes: int = self._library.number_of_lanes()

    def _values_of(self, part: slice) -> Tensor:
        """Return the numbers of a part of the trajectories, which starts with a vector of them."""
        return self._values

    def __call__(
        self,
        increment: Tensor,
        start: Tensor,
        inputs: Tensor,
        lengths: Tensor,
        threads: int = 1,
    ) -> Tensor:
        """Return the increments after the steps, ``(B, T, ...)``, of B trajectories."""
        count, steps = start.shape[0], lengths.shape[0]  # several times faster than len(x)
        path = start.new_empty(count, steps + 1, *start.shape[1:])
        path[:, 0] = increment
        rows = start.contiguous(), inputs.contiguous(), path
        lengths = lengths.contiguous()

        def roll_out(part: slice, rows: Sequence[Tensor]) -> None:
            x, u, out = (y.data_ptr() for y in rows)
            sizes, values = (rows[0].shape[0], steps), self._values_of(part)
            self._library.roll_out(values.data_ptr(), *sizes, x, u, lengths.data_ptr(), out)

        size = -(-count // (threads * self._lanes)) * self._lanes
        if size >= count:
            roll_out(slice(0, count), rows)
        else:  # the calls release the interpreter
            parts = [slice(k, k + size) for k in range(0, count, size)]
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(roll_out, parts, ([x[part] for x in rows] for part in parts)))
        return path[:, 1:]


class Steps(Kind):
    """The steps of a path.

    Args:
        dynamics: the model.
        x: states at the start, ``(B, *members, S)``.
        u: inputs of the first steps, ``(B, T, stages, *members, M)``.
        lengths: their lengths, ``(T,)``, s.
        members: number of dimensions for members.
    """

    def __init__(self, dynamics: Any, x: Tensor, u: Tensor, lengths: Tensor, members: int = 0):
        self._dynamics, self._x, self._u, self._lengths = dynamics, x, u, lengths
        self._members = members
        self._several = len(x) >= SEVERAL_FROM
        self.name = "paths" if self._several else "path"

    def programs(self) -> dict[str, Program]:
        return traced(self._dynamics, self._x[0], self._u[0, 0], self._lengths[0])

    def text(self, programs: dict[str, Program], numbers: LiveNumbers) -> str:
        return loop_code(programs, numbers, self._several)

    def loaded(self, library: ctypes.CDLL, values: Tensor) -> Function:
        return Loop(library, values)

    def agrees(self, function: Function) -> bool:
        """Compare steps from states of a path, and from states and with inputs beside it."""
        example, h = (self._x[0], self._u[0, 0]), self._lengths.mean()
        path = function(torch.zeros_like(self._x), self._x, self._u, self._lengths)
        states = torch.cat([self._x[:, None], self._x[:, None] + path[:, :-1]], dim=1)
        rows = torch.cat([states.flatten(2), self._u.flatten(2)], dim=-1).flatten(0, 1)
        rows = spread_around(rows[rows.isfinite().all(-1)])
        x, u = rows.split([value.numel() for value in example], dim=-1)
        x, u = x.reshape(STATES, *example[0].shape), u.reshape(STATES, *example[1].shape)
        steps = function(torch.zeros_like(x), x, u[:, None], h[None])[:, 0]
        first = self._members
        expected = self._dynamics.integration_step(
            torch.zeros_like(x).movedim(0, first), x.movedim(0, first), u.movedim(0, first + 1), h
        )
        return agree(steps, expected.movedim(first, 0))


def traced(dynamics: Any, x: Tensor, inputs: Tensor, h: Tensor) -> dict[str, Program]:
    """Return the programs of a step of a model, after the part that it calls."""
    step = {"increment": torch.zeros_like(x), "start": x, "inputs": inputs, "h": h}
    if x.ndim == 1 and isinstance(dynamics, ContinuousPredictor):  # no ensemble, with stages
        dynamics = sharing(dynamics)
    return programs("integration_step", dynamics.integration_step, step, ["end"])


def loop_code(programs: dict[str, Program], numbers: LiveNumbers, several: bool) -> str:
    """Return the code of the loop of a model. ``several`` is true for trajectories side by side."""
    functions = []
    numbers.block = (8, 2) if several else numbers.block
    for name, program in programs.items():
        parameters = ["values", *program.inputs, *program.outputs]
        kinds = {"values": "double *", "h": "double "}
        text = ", ".join(f"{kinds.get(x, 'real *restrict ')}{x}" for x in parameters)
        lines = c_function(program, numbers).lines
        functions += [f"static void {name}({text})", "{", *lines, "}"]
    shapes = programs["integration_step"].inputs
    sizes = {"size": shapes["start"].numel(), "stages": shapes["inputs"].numel()}
    loop = LOOP.format(values=numbers.address.format(len(numbers.index) + 1), **sizes)
    parts = [SEVERAL] if several else [ONE, PRELUDE]
    parts += [f"#define VALUES {numbers.read}", *numbers.definitions(), *functions, loop]
    return "\n".join(parts)
