"""A loop in C over trajectories of robots with different constants, in vectors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pinn_dyn.exports.c_library import QUICK, load_code
from pinn_dyn.exports.c_loop import Loop, loop_code, traced
from pinn_dyn.exports.live_numbers import LiveNumbers
from pinn_dyn.exports.program import Program
from pinn_dyn.mechanics import ContinuousPredictor


class LoopOfDraws(Loop):
    """Compiled loop of models that differ in their constants, one for each trajectory.

    Args:
        models: the models, with float64 tensors of the same shapes. Trajectory k is that of model
            ``k % len(models)``.
        x, inputs, h: example of a state, of inputs at the stages and of a step.

    Raises:
        TypeError: if an operation of the models has no code in C.
        FileNotFoundError: without a C compiler.
    """

    def __init__(
        self,
        models: Sequence[ContinuousPredictor],
        x: Tensor,
        inputs: Tensor,
        h: Tensor,
    ):
        programs = traced(models[0], x, inputs, h)
        every = torch.stack([_constants(programs, models[0], model) for model in models])
        numbers = _Drawn([*programs.values()], every)
        code = loop_code(programs, numbers, several=True)
        self._of_models = torch.cat([every[:, numbers.index], every.new_zeros(len(every), 1)], 1)
        self._trajectories = 0
        super().__init__(load_code(code, QUICK), self._of_models)

    def __call__(
        self,
        increment: Tensor,
        start: Tensor,
        inputs: Tensor,
        lengths: Tensor,
        threads: int = 1,
    ) -> Tensor:
        if len(start) != self._trajectories:
            lanes = self._lanes
            index = torch.arange(-(-len(start) // lanes) * lanes) % len(self._of_models)
            self._values = self._of_models[index].unflatten(0, (-1, lanes)).mT.contiguous()
            self._trajectories = len(start)
        return super().__call__(increment, start, inputs, lengths, threads)

    def _values_of(self, part: slice) -> Tensor:
        return self._values.flatten()[part.start * self._of_models.shape[-1] :]


def _constants(
    programs: dict[str, Program], first: ContinuousPredictor, model: ContinuousPredictor
) -> Tensor:
    """Return all constants of the programs of a model for the tensors of another."""
    pairs = zip(_tensors(first), _tensors(model), strict=True)
    tensors = {x.data_ptr(): y for x, y in pairs}
    parts = []
    for program in programs.values():
        leaves = [tensors.get(x.data_ptr(), x) for x in program.constants.leaves]
        parts.append(program.constants.with_leaves(leaves).evaluate())
    return torch.cat(parts)


def _tensors(model: ContinuousPredictor) -> list[Tensor]:
    return [*model.parameters(), *model.buffers()]


class _Drawn(LiveNumbers):
    """Numbers that differ between trajectories."""

    read, address = "((real *)values)", "values + b * {}"
