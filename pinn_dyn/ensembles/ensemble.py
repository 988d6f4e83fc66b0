"""Ensembles: models that differ in their weights only, evaluated as one batched model."""

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
    """Mean prediction of E models of the same architecture::

        x^(t) = mean over members i of x^_i(t)

    Each parameter is stacked over the members, ``(E, ...)``, so that one pass computes all.

    Args:
        members: models of the same classes and sizes, built from the same statistics.

    Raises:
        ValueError: if scales differ.

    Attributes:
        size: E.
        stack: the members as one model with a leading dimension E, for training.
        prefix: prefix of the names of a member's parameters in the ensemble.
    """

    prefix = "stack.template.model."

    def __init__(self, members: Sequence[Predictor]):
        first = members[0]
        super().__init__(first.num_coordinates, first.num_inputs, first.state)
        self.size = len(members)
        self._check(members)
        continuous = [item for item in members if isinstance(item, ContinuousPredictor)]
        self.stack = ContinuousStack(continuous) if continuous else DiscreteStack(members)
        self.penalized = first.penalized
        self.past_steps, self.input_history = first.past_steps, first.input_history
        limits = joint_limits([given_limits(item) for item in members])
        set_output_limits(self.stack.template.model, limits)

    @property
    def fixed_step(self) -> float | None:  # type: ignore[override]
        """Step of discrete-time members in s, or None."""
        return self.stack.template.model.fixed_step

    def member(self, index: int) -> Predictor:
        """Return a copy of a member as an independent model."""
        return self.stack.template.member(index)

    def member_increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Return increments of each member, ``(E, *batch, T, 2N)``."""

        def for_each(value: Tensor) -> Tensor:
            return value.expand(self.size, *value.shape)

        return self.stack.increments(for_each(x0), t, input.mapped(for_each))

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        return self.member_increments(x0, t, input).mean(0)

    @staticmethod
    def _check(members: Sequence[Predictor]) -> None:
        scales = free_weights(dict(members[0].named_buffers()))
        for k, member in enumerate(members):
            buffers = free_weights(dict(member.named_buffers()))
            if any(not torch.equal(value, scales[name]) for name, value in buffers.items()):
                raise ValueError(
                    f"member {k} has other scales than member 0: build all from one Statistics"
                )
