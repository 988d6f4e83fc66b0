"""Loss and gradient of a batch as one compiled program."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, State
from pinn_dyn.mechanics.compilation import compile_graph, integrated_by
from pinn_dyn.mechanics.integrators import Wrapped
from pinn_dyn.models.learned_constants import Called
from pinn_dyn.training.losses import WindowLoss
from pinn_dyn.training.parameter_vector import MOVED, CompiledAdamW, ParameterVector


@dataclass(frozen=True)
class StateWindows(Windows):
    """Windows with precomputed states of a model."""

    x0: Tensor  # state at the start, (B, 2N), with the batch contiguous in memory
    dx: Tensor  # increments up to each step, (B, H, 2N)

    @classmethod
    def of(cls, windows: Windows, state: State) -> StateWindows:
        """Build from windows, for a model of this state."""
        values = {item.name: getattr(windows, item.name) for item in fields(Windows)}
        x0 = windows.start(state).mT.contiguous().mT
        return cls(**values, x0=x0, dx=windows.increments(state))

    def start(self, state: State, past: int = 0) -> Tensor:
        return self.x0

    def increments(self, state: State) -> Tensor:
        return self.dx


Program = Callable[..., list[Tensor]]
_ROWS = {"qv": ("q", "v", "dq", "dv"), "qp": ("q", "p", "dq", "dp")}
"""Fields of windows that a model of each state uses, besides the input."""


class LossProgram:
    """Compiled program for the loss of windows and its gradient.

    They are traced as one graph, and compiled for each batch size. Parts of a batch run in parallel
    threads, or one after another on a GPU.
    """

    def __init__(self, loss: WindowLoss, model: ContinuousPredictor, vector: ParameterVector):
        def traceable(model: ContinuousPredictor, windows: Any) -> Tensor:
            with integrated_by(model, Wrapped(model.integrator)):
                return loss(model, windows)

        self._loss, self._state = Called(model, traceable), model.state
        self._names = [f"model.{name}" for name, _ in model.named_parameters()]
        self._vector = vector
        self._programs: dict[tuple[Any, ...], Program] = {}

    def __call__(self, windows: Windows, part: int) -> tuple[Tensor, Tensor]:
        """Return loss and gradient, computed in parts of at least ``part`` windows."""
        parts = windows.split(part)
        arguments = [(self._vector.values.detach(), *self._rows(x)) for x in parts]
        # Compile before the threads call the program.
        pairs = zip(parts, arguments, strict=True)
        programs = [self._program(self._traced(x), x, rows) for x, rows in pairs]
        run = map if self._alone else _pool(torch.get_num_threads()).map
        shares = [len(x) / len(windows) for x in parts]
        return weighted_sum(shares, run(_call, programs, arguments))

    def step(self, windows: Windows, optimizer: CompiledAdamW) -> Callable[[], list[Tensor]]:
        """Return a function that takes a step on a batch on the CPU, and returns the loss.

        The step has the learning rate that the optimizer has now.
        """
        evaluate = self._traced(windows)

        def step(*arguments: Tensor) -> list[Tensor]:
            moved, rows = arguments[:MOVED], arguments[MOVED:]
            loss, gradient = evaluate(moved[0], *rows)
            optimizer.step(gradient, *moved)
            return [loss]

        arguments = *optimizer.arguments(), *self._rows(windows)
        program = self._program(step, windows, arguments)
        call = functools.partial(_call, program, arguments)
        return call if self._alone else lambda: _pool(torch.get_num_threads()).submit(call).result()

    def _rows(self, windows: Windows) -> list[Tensor]:
        rows = [getattr(windows, name) for name in _ROWS[self._state]]
        rows += [windows.input.u] + ([] if windows.input.rate is None else [windows.input.rate])
        return [row.contiguous() for row in rows]

    @property
    def _alone(self) -> bool:
        # A single batch also runs in the pool, since small products are faster with one thread.
        return torch.get_num_threads() == 1 or self._vector.values.is_cuda

    def _program(
        self, function: Program, windows: Windows, arguments: tuple[Tensor, ...]
    ) -> Program:
        key = (len(arguments), windows.dq.shape, windows.dq.dtype)
        if key not in self._programs:
            examples = tuple(value.clone() for value in arguments)  # a step changes them
            with torch.no_grad():
                self._programs[key] = compile_graph(function, examples)
                self._programs[key](*examples)
        return self._programs[key]

    def _traced(self, windows: Windows) -> Program:
        state = self._state

        def loss_and_gradient(vector: Tensor, *rows: Tensor) -> list[Tensor]:
            names = _ROWS[state]
            values_by_name: dict[str, Any] = dict(zip(names, rows, strict=False))
            input = windows.input.with_samples(*rows[len(names) :])
            batch = replace(windows, **values_by_name, input=input)
            batch = StateWindows.of(batch, state)
            with torch.enable_grad():
                values = [value.detach().requires_grad_() for value in self._vector.split(vector)]
                parameters = dict(zip(self._names, values, strict=True))
                loss = functional_call(self._loss, parameters, (batch,))
                gradients = torch.autograd.grad(loss, values, allow_unused=True)
            return [loss.detach(), self._vector.joined(gradients)]

        return loss_and_gradient


def weighted_sum(weights: list[float], parts: Iterable[Sequence[Tensor]]) -> tuple[Tensor, Tensor]:
    """Return the weighted sum of pairs (loss, gradient)."""
    losses, gradients = zip(*parts, strict=True)
    shares = losses[0].new_tensor(weights)
    return shares @ torch.stack(losses), shares @ torch.stack(gradients)


def _call(program: Program, arguments: tuple[Any, ...]) -> list[Tensor]:
    with torch.no_grad():
        return program(*arguments)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "windows", torch.set_num_threads, (1,))
