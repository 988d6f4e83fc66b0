"""Loss and gradient of a batch as one compiled program."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor
from pinn_dyn.mechanics.compilation import Unrolled, compile_graph, integrated_by
from pinn_dyn.training.gradients.known import Gradients
from pinn_dyn.training.gradients.state_windows import StateWindows
from pinn_dyn.training.losses import WindowLoss


class LossProgram:
    """The loss of windows and its gradient in the parameters, by one call of a C++ program.

    A compiled derivative still leaves some hundred operations around it to Python and autograd,
    which is half of the time of a small batch. Here the roll-out, the loss and the gradient are
    traced as one graph and compiled for the batch sizes that come. Parts of a batch are taken side
    by side on the threads of torch.

    Args:
        loss: of the model, by operations that can be traced.
        model: what is trained.
    """

    def __init__(self, loss: WindowLoss, model: ContinuousPredictor):
        self._loss = _Loss(loss, model)
        self._names = [f"model.{name}" for name, _ in model.named_parameters()]
        self._parameters = list(model.parameters())  # walking through the modules takes its time
        self._programs: dict[tuple[Any, ...], Callable[..., list[Any]]] = {}

    def __call__(self, windows: Windows, part: int) -> list[tuple[float, Tensor, Gradients]]:
        """Share of the batch, loss and gradients of parts of at least ``part`` windows each."""
        parts = windows.split(part)
        values = [value.detach() for value in self._parameters]
        taken = self.side_by_side([values] * len(parts), parts)
        return [
            (len(part) / len(windows), loss, gradients)
            for part, (loss, *gradients) in zip(parts, taken, strict=True)
        ]

    def side_by_side(
        self, values: Iterable[Sequence[Tensor]], batches: list[Windows]
    ) -> Iterable[list[Any]]:
        """Loss and gradients of each batch at the values of the parameters that go with it."""
        laid_out = [StateWindows.of(batch, self._loss.model.state) for batch in batches]
        arguments = [
            (list(some), batch.x0, batch.dx, _samples(batch))
            for some, batch in zip(values, laid_out, strict=True)
        ]
        # A program is compiled here, before the threads call it.
        programs = list(map(self._program, laid_out, arguments))
        # Even a single batch goes to a thread of the pool: its small products gain by one thread.
        threads = torch.get_num_threads()
        run = map if threads == 1 else _pool(threads).map
        return run(_call, programs, arguments)

    def _program(
        self, windows: StateWindows, arguments: tuple[Any, ...]
    ) -> Callable[..., list[Any]]:
        key = (windows.dq.shape, windows.dq.dtype)
        if key not in self._programs:
            with torch.no_grad():
                self._programs[key] = compile_graph(self._traced(windows), arguments)
                self._programs[key](*arguments)
        return self._programs[key]

    def _traced(self, windows: StateWindows) -> Callable[..., list[Any]]:
        def loss_and_gradients(
            values: list[Tensor], x0: Tensor, dx: Tensor, samples: list[Tensor]
        ) -> list[Any]:
            batch = replace(windows, x0=x0, dx=dx, input=windows.input.with_samples(*samples))
            with torch.enable_grad():
                values = [value.detach().requires_grad_() for value in values]
                given = dict(zip(self._names, values, strict=True))
                loss = functional_call(self._loss, given, (batch,))
                gradients = torch.autograd.grad(loss, values, allow_unused=True)
            return [loss.detach(), *gradients]

        return loss_and_gradients


class _Loss(nn.Module):
    """The loss of a batch as a function of the parameters and of the data."""

    def __init__(self, loss: WindowLoss, model: ContinuousPredictor):
        super().__init__()
        self.model = model
        self.loss = loss

    def forward(self, windows: Windows) -> Tensor:
        with integrated_by(self.model, Unrolled(self.model.integrator)):
            return self.loss(self.model, windows)


def _samples(windows: Windows) -> list[Tensor]:
    u, rate = windows.input.u, windows.input.rate
    return [u] if rate is None else [u, rate]


def _call(program: Callable[..., list[Any]], arguments: tuple[Any, ...]) -> list[Any]:
    with torch.no_grad():
        return program(*arguments)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads of torch's own one thread each: the programs let go of Python's lock."""
    return ThreadPoolExecutor(threads, "windows", torch.set_num_threads, (1,))
