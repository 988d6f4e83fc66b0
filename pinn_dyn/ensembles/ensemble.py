"""Several models of one robot as one predictor."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from pinn_dyn.mechanics import Predictor, Signal

_SHARED = ("num_coordinates", "num_inputs", "state", "fixed_step", "history_steps", "input_history")


class Ensemble(Predictor):
    """Mean prediction of E models of the same robot::

        x^(t) = mean over members i of x^_i(t)

    Args:
        members: the models, such as those of several seeds.

    Raises:
        ValueError: if the sizes, states, steps or histories of the members differ.
    """

    def __init__(self, members: Iterable[Predictor]):
        models = list(members)
        first: Any = models[0]
        super().__init__(first.num_coordinates, first.num_inputs, first.state)
        for name in _SHARED:
            values = {getattr(model, name) for model in models}
            if len(values) > 1:
                raise ValueError(
                    f"the members differ in {name}: {sorted(values, key=str)}: train them with the "
                    "same settings but the seed"
                )
        self._models = nn.ModuleList(models)
        self.history_steps, self.input_history = first.history_steps, first.input_history
        self.fixed_step = first.fixed_step

    @property
    def members(self) -> list[Predictor]:
        return list(self._models)  # type: ignore[arg-type]

    def member_increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        return torch.stack([model.increments(x0, t, input) for model in self.members])

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        return self.member_increments(x0, t, input).mean(0)
