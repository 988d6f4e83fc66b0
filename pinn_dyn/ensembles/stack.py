"""E models of one kind as one batched model."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap

from pinn_dyn.mechanics import ContinuousPredictor, Predictor, Signal

Model = TypeVar("Model", bound=Predictor)


class Template(nn.Module, Generic[Model]):
    """A model whose parameters have a leading dimension E. All members share the buffers."""

    def __init__(self, members: Sequence[Model]):
        super().__init__()
        self.model: Model = copy.deepcopy(members[0])
        for name, _ in members[0].named_parameters():
            values = torch.stack([item.get_parameter(name).detach() for item in members])
            self._set(self.model, name, values)

    def forward(self, evaluate: Callable[..., Tensor], arguments: tuple[Any, ...]) -> Tensor:
        return evaluate(self.model, *arguments)

    def mapped(self, evaluate: Callable[..., Tensor], *stacked: Any) -> Tensor:
        """Return ``evaluate(model, *arguments)`` of all members, for arguments ``(E, ...)``."""

        def member_value(parameters: dict[str, Tensor], *arguments: Any) -> Tensor:
            return functional_call(self, parameters, (evaluate, arguments))

        return vmap(member_value)(dict(self.named_parameters()), *stacked)

    def member(self, index: int) -> Model:
        """Return a copy of a member."""
        model = copy.deepcopy(self.model)
        for name, value in self.model.named_parameters():
            self._set(model, name, value.detach()[index].clone())
        return model

    @staticmethod
    def _set(model: nn.Module, name: str, value: Tensor) -> None:
        path, _, last = name.rpartition(".")
        setattr(model.get_submodule(path), last, nn.Parameter(value))


class ContinuousStack(ContinuousPredictor):
    """E continuous models as one model with x ``(E, *batch, 2N)`` and u ``(E, *batch, M)``."""

    def __init__(self, members: Sequence[ContinuousPredictor]):
        first = members[0]
        super().__init__(first.num_coordinates, first.num_inputs, first.state)
        self.integrator = first.integrator
        self.learns_initial_state = first.learns_initial_state
        self.template: Template[ContinuousPredictor] = Template(members)

    def penalty(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        return self.template.mapped(lambda model, *at: model.penalty(*at), q, v, a, u)

    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        return self.template.mapped(lambda model, *xu: model.state_derivative(*xu), x, u)

    def initial_state(self, x0: Tensor, u0: Tensor) -> Tensor:
        if not self.learns_initial_state:
            return x0
        return self.template.mapped(lambda model, *xu: model.initial_state(*xu), x0, u0)

    def integration_step(
        self, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        # The inputs are (stages, E, *batch, M).
        return self.template.mapped(
            lambda model, *arguments: model.integration_step(*arguments, h),
            increment,
            start,
            inputs.movedim(1, 0),
        )


class DiscreteStack(Predictor):
    """E discrete-time models as one model, with tensors as in :class:`ContinuousStack`."""

    def __init__(self, members: Sequence[Predictor]):
        first = members[0]
        super().__init__(first.num_coordinates, first.num_inputs, first.state)
        self.past_steps = first.past_steps
        self.template: Template[Predictor] = Template(members)

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        def member_increments(model: Predictor, x0: Tensor, *samples: Tensor) -> Tensor:
            return model.increments(x0, t, input.with_samples(*samples))

        samples = [input.u] if input.rate is None else [input.u, input.rate]
        return self.template.mapped(member_increments, x0, *samples)
