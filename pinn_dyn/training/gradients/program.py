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
from pinn_dyn.training.gradients.state_windows import StateWindows
from pinn_dyn.training.losses import WindowLoss
from pinn_dyn.training.parameter_vector import ParameterVector

Program = Callable[..., list[Tensor]]
_ROWS = {"qv": ("q", "v", "dq", "dv"), "qp": ("q", "p", "dq", "dp")}
"""What a model of each state sees of windows, beside the input."""


class LossProgram:
    """The loss of windows and its gradient in the parameters, by one call of a compiled program.

    A compiled derivative still leaves some hundred operations around it to Python and autograd,
    which is half of the time of a small batch. Here the roll-out, the loss and the gradient are
    traced as one graph and compiled for the batch sizes that come. Parts of a batch are taken side
    by side on the threads of torch, on a GPU one after the other.

    Args:
        loss: of the model, by operations that can be traced.
        model: what is trained; of an ensemble all members as one, or one of them, whose parameters
            are then stacked over all.
        vector: its parameters.
    """

    def __init__(self, loss: WindowLoss, model: ContinuousPredictor, vector: ParameterVector):
        self._loss = _Loss(loss, model)
        self._names = [f"model.{name}" for name, _ in model.named_parameters()]
        self._vector = vector
        self._programs: dict[tuple[Any, ...], Program] = {}

    def __call__(self, windows: Windows, part: int) -> tuple[Tensor, Tensor]:
        """Loss and gradient, from parts of at least ``part`` windows each."""
        parts = windows.split(part)
        taken = self.side_by_side([self._vector.values.detach()] * len(parts), parts)
        return weighted_sum([len(part) / len(windows) for part in parts], taken)

    def side_by_side(
        self, values: Iterable[Tensor], batches: list[Windows]
    ) -> Iterable[list[Tensor]]:
        """Loss and gradient of each batch at the values ``(P,)`` that go with it."""
        names = _ROWS[self._loss.model.state]
        arguments = [
            (some, *_contiguous([*(getattr(batch, name) for name in names), *_samples(batch)]))
            for some, batch in zip(values, batches, strict=True)
        ]
        # A program is compiled here, before the threads call it.
        programs = list(map(self._program, batches, arguments))
        # Even a single batch goes to a thread of the pool: its small products gain by one thread.
        threads = torch.get_num_threads()
        alone = threads == 1 or self._vector.values.is_cuda
        run = map if alone else _pool(threads).map
        return run(_call, programs, arguments)

    def _program(self, windows: Windows, arguments: tuple[Any, ...]) -> Program:
        key = (windows.dq.shape, windows.dq.dtype)
        if key not in self._programs:
            with torch.no_grad():
                self._programs[key] = compile_graph(self._traced(windows), arguments)
                self._programs[key](*arguments)
        return self._programs[key]

    def _traced(self, windows: Windows) -> Program:
        state = self._loss.model.state

        def loss_and_gradient(vector: Tensor, *rows: Tensor) -> list[Tensor]:
            names = _ROWS[state]
            given: dict[str, Any] = dict(zip(names, rows, strict=False))
            batch = replace(windows, **given, input=windows.input.with_samples(*rows[len(names) :]))
            batch = StateWindows.of(batch, state)
            with torch.enable_grad():
                values = [value.detach().requires_grad_() for value in self._vector.split(vector)]
                parameters = dict(zip(self._names, values, strict=True))
                loss = functional_call(self._loss, parameters, (batch,))
                gradients = torch.autograd.grad(loss.sum(), values, allow_unused=True)
            return [loss.detach(), self._vector.joined(gradients, tuple(vector.shape[:-1]))]

        return loss_and_gradient


def weighted_sum(weights: list[float], parts: Iterable[Sequence[Tensor]]) -> tuple[Tensor, Tensor]:
    """The sum over parts (loss, gradient), each times its weight."""
    (loss, gradient), *others = parts
    if others:
        loss, gradient = weights[0] * loss, weights[0] * gradient
    for weight, (more, slope) in zip(weights[1:], others, strict=True):
        loss.add_(more, alpha=weight)
        gradient.add_(slope, alpha=weight)
    return loss, gradient


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


def _contiguous(values: Iterable[Tensor]) -> Iterable[Tensor]:
    """In the layout that a program is compiled for, also where they are parts of longer windows."""
    return [value.contiguous() for value in values]


def _call(program: Program, arguments: tuple[Any, ...]) -> list[Tensor]:
    with torch.no_grad():
        return program(*arguments)


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads of torch's own one thread each: the programs let go of Python's lock."""
    return ThreadPoolExecutor(threads, "windows", torch.set_num_threads, (1,))
