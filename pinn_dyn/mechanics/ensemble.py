"""Ensembles: models of one kind that differ in their weights, evaluated as one batched model."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap

from pinn_dyn.mechanics.predictor import ContinuousPredictor, Predictor
from pinn_dyn.mechanics.steps import Scheme
from pinn_dyn.mechanics.trajectory import Interpolation


class Ensemble(Predictor):
    """The mean prediction of E models of one kind::

        x^(t) = mean over members i of x^_i(t)

    The members are not kept one by one: each parameter is stacked over them, ``(E, ...)``, and one
    pass through the stack (:class:`ContinuousStack` or :class:`DiscreteStack`) moves all of them.

    Args:
        members: models of the same classes and sizes, with the same scales of the data.

    Raises:
        ValueError: on fewer than two members, or members of different parameters or scales.

    Attributes:
        size: E.
        stack: the members as one model with a leading dimension E, as training uses it.
    """

    def __init__(self, members: Sequence[Predictor]):
        if len(members) < 2:
            raise ValueError(f"an ensemble of {len(members)} members: expected at least two")
        first = members[0]
        super().__init__(first.num_coordinates, first.num_inputs, first.coordinates)
        self.size = len(members)
        self._check(members)
        continuous = isinstance(first, ContinuousPredictor)
        self.stack = ContinuousStack(members) if continuous else DiscreteStack(members)

    @property
    def fixed_step(self) -> float | None:  # type: ignore[override]
        """The one step in s that the members predict in, or None."""
        return self.stack.template.model.fixed_step

    def member(self, index: int) -> Predictor:
        """A copy of one member as a model of its own.

        Raises:
            ValueError: if there is no such member.
        """
        if not 0 <= index < self.size:
            raise ValueError(
                f"member is {index}, expected one of the {self.size} members, 0 to {self.size - 1}"
            )
        return self.stack.template.taken_apart(index)

    def member_increments(
        self,
        x0: Tensor,
        t: Tensor,
        u: Tensor,
        *,
        t_input: Tensor | None = None,
        interpolation: Interpolation = "linear",
    ) -> Tensor:
        """Increments of each member, ``(E, *batch, T, 2N)``; arguments of :meth:`increments`."""
        return self.stack.increments(
            x0.expand(self.size, *x0.shape),
            t,
            u.expand(self.size, *u.shape),
            t_input=t_input,
            interpolation=interpolation,
        )

    def increments(
        self,
        x0: Tensor,
        t: Tensor,
        u: Tensor,
        *,
        t_input: Tensor | None = None,
        interpolation: Interpolation = "linear",
    ) -> Tensor:
        """Mean increment over the members, ``(*batch, T, 2N)``."""
        paths = self.member_increments(x0, t, u, t_input=t_input, interpolation=interpolation)
        return paths.mean(0)

    @staticmethod
    def _check(members: Sequence[Predictor]) -> None:
        first = members[0]
        shapes = {name: value.shape for name, value in first.named_parameters()}
        scales = dict(first.named_buffers())
        for k, other in enumerate(members):
            if {name: value.shape for name, value in other.named_parameters()} != shapes:
                raise ValueError(
                    f"member {k} has other parameters than member 0: expected one kind of model"
                )
            if any(not torch.equal(value, scales[name]) for name, value in other.named_buffers()):
                raise ValueError(
                    f"member {k} has other scales (buffers) than member 0: build all members from "
                    "the same statistics"
                )


class _Template(nn.Module):
    """One model whose parameters have a leading dimension E; buffers are shared by all members."""

    def __init__(self, members: Sequence[Predictor]):
        super().__init__()
        self.model = copy.deepcopy(members[0])
        for name, _ in members[0].named_parameters():
            values = torch.stack([item.get_parameter(name).detach() for item in members])
            self._set(self.model, name, values)

    def forward(self, method: str, **arguments: Any) -> Tensor:
        """A method of the model, with a member's parameters in the place of the stacked ones."""
        return getattr(self.model, method)(**arguments)

    def mapped(self, method: str, stacked: dict[str, Tensor], **shared: Any) -> Tensor:
        """The method for all members; ``stacked`` arguments have a leading dimension E."""

        def one(parameters: dict[str, Tensor], own: dict[str, Tensor]) -> Tensor:
            return functional_call(self, parameters, (method,), {**own, **shared})

        return vmap(one)(dict(self.named_parameters()), stacked)

    def taken_apart(self, index: int) -> Predictor:
        """One member."""
        model = copy.deepcopy(self.model)
        for name, value in self.model.named_parameters():
            self._set(model, name, value.detach()[index].clone())
        return model

    @staticmethod
    def _set(model: nn.Module, name: str, value: Tensor) -> None:
        path, _, last = name.rpartition(".")
        setattr(model.get_submodule(path), last, nn.Parameter(value))


class ContinuousStack(ContinuousPredictor):
    """E models given by state derivatives, as one: x ``(E, *batch, 2N)``, u ``(E, *batch, M)``.

    What is compiled for training is the derivative, or a Rosenbrock step, of all members at once.
    """

    def __init__(self, members: Sequence[Predictor]):
        first = members[0]
        assert isinstance(first, ContinuousPredictor)
        super().__init__(first.num_coordinates, first.num_inputs, first.coordinates)
        self.integrator, self.substeps = first.integrator, first.substeps
        self.learns_initial_state = first.learns_initial_state
        self.template = _Template(members)

    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """dx/dt of every member, ``(E, *batch, 2N)``."""
        return self.template.mapped("state_derivative", {"x": x, "u": u})

    def initial_state(self, x0: Tensor, u0: Tensor) -> Tensor:
        """Where each member starts, ``(E, *batch, 2N)``."""
        return self.template.mapped("initial_state", {"x0": x0, "u0": u0})

    def scheme(self) -> Scheme:
        """The method of integration of the members; each of its steps is that of all of them."""

        def step(increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor) -> Tensor:
            # The members of the inputs (stages, E, *batch, M) come second.
            stacked = {"increment": increment, "start": start, "inputs": inputs.movedim(1, 0)}
            return self.template.mapped("integration_step", stacked, h=h)

        single = self.template.model
        assert isinstance(single, ContinuousPredictor)
        return replace(single.scheme(), step=step)


class DiscreteStack(Predictor):
    """E models that predict in steps of their own, as one; as :class:`ContinuousStack`."""

    def __init__(self, members: Sequence[Predictor]):
        first = members[0]
        super().__init__(first.num_coordinates, first.num_inputs, first.coordinates)
        self.template = _Template(members)

    def increments(
        self,
        x0: Tensor,
        t: Tensor,
        u: Tensor,
        *,
        t_input: Tensor | None = None,
        interpolation: Interpolation = "linear",
    ) -> Tensor:
        """Increments of every member, ``(E, *batch, T, 2N)``."""
        settings = {"t": t, "t_input": t_input, "interpolation": interpolation}
        return self.template.mapped("increments", {"x0": x0, "u": u}, **settings)
