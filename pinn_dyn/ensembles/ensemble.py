"""Ensembles: models of one kind that differ in their weights, evaluated as one batched model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pinn_dyn.ensembles.stack import ContinuousStack, DiscreteStack
from pinn_dyn.mechanics import ContinuousPredictor, Predictor, Signal
from pinn_dyn.models.output_limits import (
    free_weights,
    given_limits,
    joint_limits,
    set_output_limits,
)


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
        prefix: of the names in a member, in the ensemble's own.
    """

    prefix = "stack.template.model."

    def __init__(self, members: Sequence[Predictor]):
        if len(members) < 2:
            raise ValueError(f"an ensemble of {len(members)} members: expected at least two")
        first = members[0]
        super().__init__(first.num_coordinates, first.num_inputs, first.state)
        self.size = len(members)
        self._check(members)
        continuous = [item for item in members if isinstance(item, ContinuousPredictor)]
        self.stack = ContinuousStack(continuous) if continuous else DiscreteStack(members)
        self.penalized = first.penalized
        limits = joint_limits([given_limits(item) for item in members])
        set_output_limits(self.stack.template.model, limits)

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

    def member_increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Increments of each member, ``(E, *batch, T, 2N)``; arguments of :meth:`increments`."""

        def for_each(value: Tensor) -> Tensor:
            return value.expand(self.size, *value.shape)

        return self.stack.increments(for_each(x0), t, input.mapped(for_each))

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Mean increment over the members, ``(*batch, T, 2N)``."""
        return self.member_increments(x0, t, input).mean(0)

    @staticmethod
    def _check(members: Sequence[Predictor]) -> None:
        first = members[0]
        shapes = {name: value.shape for name, value in first.named_parameters()}
        scales = free_weights(dict(first.named_buffers()))
        for k, other in enumerate(members):
            if {name: value.shape for name, value in other.named_parameters()} != shapes:
                raise ValueError(
                    f"member {k} has other parameters than member 0: expected one kind of model"
                )
            own = free_weights(dict(other.named_buffers()))
            if any(not torch.equal(value, scales[name]) for name, value in own.items()):
                raise ValueError(
                    f"member {k} has other scales (buffers) than member 0: build all members from "
                    "the same statistics"
                )
