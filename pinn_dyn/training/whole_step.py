"""Loss and gradient of a batch as one compiled program."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor
from pinn_dyn.mechanics.compilation import compile_graph
from pinn_dyn.mechanics.ensemble import ContinuousStack
from pinn_dyn.mechanics.integration import step_grid
from pinn_dyn.mechanics.steps import take_steps

Gradients = list[Tensor | None]
"""One entry for each parameter of the model, None where the loss does not depend on it."""
TracedLoss = Callable[[ContinuousPredictor, Windows, Tensor, Tensor, Tensor], Tensor]
"""Maps a model, windows, x0, u and the measured increments to the loss."""
MOST_STAGES = 4
"""Evaluations of the dynamics in a window up to which it is compiled as a whole: the time to
compile grows with them."""
CHUNK = 256
"""Windows of MOST_STAGES evaluations that compiled dynamics take at once, four times as many of one
evaluation: what they keep for the gradient stays in the cache (measured in benchmarks/README.md).
Batches of less than twice as many are not cut."""


class WholeStep:
    """The loss of windows and its gradient in the parameters, by one call of a C++ program.

    A compiled derivative still leaves some hundred operations around it to Python and autograd,
    which is half of the time of a small batch. Here the roll-out, the loss and the gradient are
    traced as one graph and compiled for the batch sizes that come. The parts of a large batch, or
    the members of an ensemble, are taken side by side on the threads of torch.

    Args:
        model: the model that is trained, or the stack of an ensemble.
        loss: the loss of one model on windows, by operations that can be traced. What differs from
            batch to batch is given beside the windows: the state at the start ``(B, 2N)``, the
            input ``(B, K, M)`` and the measured increments ``(B, H, 2N)``.
        evaluations: of the dynamics in a window.

    Attributes:
        parameters: those of the model, in the order of the gradients.
    """

    def __init__(self, model: ContinuousPredictor, loss: TracedLoss, evaluations: int):
        single = model.template.model if isinstance(model, ContinuousStack) else model
        assert isinstance(single, ContinuousPredictor)
        self._window = _Window(single, loss)
        self._part = CHUNK * MOST_STAGES // evaluations
        self.parameters = list(model.parameters())  # walking through the modules takes its time
        self._programs: dict[tuple[Any, ...], Callable[..., list[Any]]] = {}

    def __call__(self, windows: Windows) -> list[tuple[float, Tensor, Gradients]]:
        """Share of the batch, loss and gradients of each of its parts."""
        parts = windows.split(self._part)
        values = [value.detach() for value in self.parameters]
        taken = self._side_by_side([values] * len(parts), parts)
        return [
            (len(part) / len(windows), loss, gradients)
            for part, (loss, *gradients) in zip(parts, taken, strict=True)
        ]

    def of_members(self, windows: Windows) -> tuple[Tensor, Gradients]:
        """Losses ``(E,)`` and gradients ``(E, ...)`` of an ensemble on windows ``(E, B, ...)``."""
        batches = [windows[index] for index in torch.arange(len(windows))]
        values = zip(*(value.detach().unbind() for value in self.parameters), strict=True)
        losses, *gradients = zip(*self._side_by_side(values, batches), strict=True)
        return torch.stack(losses), [None if g[0] is None else torch.stack(g) for g in gradients]

    def _side_by_side(
        self, values: Iterable[Sequence[Tensor]], batches: list[Windows]
    ) -> Iterable[list[Any]]:
        """Loss and gradients of each batch at the values of the parameters that go with it."""
        arguments = list(map(self._arguments, values, batches))
        # A program is compiled here, before the threads call it.
        programs = list(map(self._program, batches, arguments))
        # Even a single batch goes to a thread of the pool: its small products gain by one thread.
        threads = torch.get_num_threads()
        run = map if threads == 1 else _pool(threads).map
        return run(_call, programs, arguments)

    def _arguments(self, values: Sequence[Tensor], windows: Windows) -> tuple[Any, ...]:
        coordinates = self._window.model.coordinates
        x0 = windows.start(coordinates).mT.contiguous().mT  # the batch along memory
        return list(values), x0, windows.u, windows.increments(coordinates)

    def _program(self, windows: Windows, arguments: tuple[Any, ...]) -> Callable[..., list[Any]]:
        key = (windows.dq.shape, windows.dq.dtype)
        if key not in self._programs:
            with torch.no_grad():
                self._programs[key] = compile_graph(self._traced(windows), arguments)
                self._programs[key](*arguments)
        return self._programs[key]

    def _traced(self, windows: Windows) -> Callable[..., list[Any]]:
        names = [f"model.{name}" for name, _ in self._window.model.named_parameters()]

        def loss_and_gradients(
            values: list[Tensor], x0: Tensor, u: Tensor, measured: Tensor
        ) -> list[Any]:
            with torch.enable_grad():
                values = [value.detach().requires_grad_() for value in values]
                loss = functional_call(
                    self._window,
                    dict(zip(names, values, strict=True)),
                    (windows, x0, u, measured),
                )
                gradients = torch.autograd.grad(loss, values, allow_unused=True)
            return [loss.detach(), *gradients]

        return loss_and_gradients


class _Window(nn.Module):
    """The loss of a batch as a function of the parameters and of the data."""

    def __init__(self, model: ContinuousPredictor, loss: TracedLoss):
        super().__init__()
        self.model = model
        self.loss = loss

    def forward(self, windows: Windows, x0: Tensor, u: Tensor, measured: Tensor) -> Tensor:
        return self.loss(self.model, windows, x0, u, measured)


def rolled_out(model: ContinuousPredictor, windows: Windows, x0: Tensor, u: Tensor) -> Tensor:
    """Increments to each step, ``(B, H, 2N)``, by operations that can be traced."""
    t, t_input = windows.t - windows.t[0], windows.t_input - windows.t[0]
    grid = step_grid(t, t_input, model.substeps).to(x0)
    start = model.initial_state(x0, u[..., 0, :]) if model.learns_initial_state else x0
    path = take_steps(model.scheme(), start, grid, t_input.to(x0), u, windows.interpolation)
    increments = path[model.substeps :: model.substeps].movedim(0, -2)
    return increments + (start - x0).unsqueeze(-2) if model.learns_initial_state else increments


def _call(program: Callable[..., list[Any]], arguments: tuple[Any, ...]) -> list[Any]:
    with torch.no_grad():
        return program(*arguments)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads of torch's own one thread each: the programs let go of Python's lock."""
    return ThreadPoolExecutor(threads, "windows", torch.set_num_threads, (1,))
