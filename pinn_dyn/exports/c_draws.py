"""A loop in C over trajectories of robots with different constants, in vectors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pinn_dyn.exports.c_loop import Loop, Numbers, loop_code, traced
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
        first = _tensors(models[0])
        programs = traced(models[0], x, inputs, h)
        numbers = _Drawn(len(models))
        for program in programs.values():
            tables = [
                program.constants_with(
                    {a.data_ptr(): b for a, b in zip(first, _tensors(model), strict=True)}
                )
                for model in models
            ]
            for node in program.graph_module.graph.find_nodes(op="get_attr"):
                rows = torch.stack([table[node.name].flatten() for table in tables])
                is_shared = bool(((rows == rows[:1]) | rows.isnan()).all())
                if not is_shared:
                    numbers.drawn[node.meta["val"].data_ptr()] = rows
        code, values = loop_code(programs, True, numbers)
        super().__init__(code, values)
        self._of_models, self._trajectories = values, 0

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


def _tensors(model: ContinuousPredictor) -> list[Tensor]:
    return [*model.parameters(), *model.buffers()]


class _Drawn(Numbers):
    """Numbers that differ between trajectories are arguments. The code contains the others.

    Args:
        models: number D of models.

    Attributes:
        drawn: values of an array for all models, ``(D, n)``, by the address of its data.
    """

    read, address = "((real *)values)", "values + b * {}"

    def __init__(self, models: int):
        super().__init__("double")
        self.drawn: dict[int, Tensor] = {}
        self._models = models

    def elements(self, values: Tensor) -> list[float | str]:
        if values.data_ptr() not in self.drawn:
            return values.tolist()
        start = sum(x.shape[-1] for x in self.values)
        self.values.append(self.drawn[values.data_ptr()])
        return [f"VALUES[{start + k}]" for k in range(len(values))]

    def padding(self) -> Tensor:
        return torch.zeros(self._models, 1, dtype=torch.float64)

    def _definition(self, kind: str, name: str, values: Tensor) -> str:
        if kind != "int":
            raise TypeError("draws of the constants have no code for networks")
        return super()._definition(kind, name, values)
