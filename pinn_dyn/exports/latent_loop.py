"""Rollouts of models with a latent state as a loop in C."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from pinn_dyn.exports.c_loop import Steps
from pinn_dyn.exports.compiled import STATES, Compiled


class LatentLoop(nn.Module):
    """Steps of a model's latent state, in C for long paths in float64 without gradients.

    See :class:`~.compiled.Compiled` for the conditions of code in C.

    Args:
        model: the model. :meth:`install` replaces its ``latent_path(z, ends)``.
        threads: number of threads that share the trajectories.
    """

    def __init__(self, model: nn.Module, threads: PositiveInt = 1):
        super().__init__()
        self.model, self.threads = model, threads
        self._compiled = Compiled(self)

    def install(self) -> None:
        """Replace the method of this model object."""
        vars(self.model)["latent_path"] = self.latent_path

    def _steps(self, z: Tensor, ends: Tensor) -> Sequence[Tensor]:
        kind: Any = type(self.model)
        path: Sequence[Tensor] = kind.latent_path(self.model, z, ends)
        return path

    def integration_step(
        self, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        """Return z_{k+1} - start from z_k = start + increment, with inputs ``(1, *batch, 2M)``."""
        return self._steps(start + increment, inputs)[1] - start

    def latent_path(self, z: Tensor, ends: Tensor) -> Sequence[Tensor]:
        """Return the latent states z_0, ... z_T, ``(*batch, S)`` each.

        Args:
            z: z_0, ``(*batch, S)``.
            ends: inputs at the start and the end of each step, ``(T, *batch, 2M)``.
        """
        batch, steps = z.shape[:-1], len(ends)
        fits = z.dtype == torch.float64 and z.is_cpu and not torch.is_grad_enabled()
        if not fits or not z.numel() or not ends.numel():
            return self._steps(z, ends)
        x = z.reshape(-1, z.shape[-1])
        rows = ends.expand(steps, *batch, -1).reshape(steps, 1, len(x), -1)
        inputs, lengths = rows.movedim(2, 0), z.new_ones(steps)
        kind = Steps(self, x, inputs[:, :STATES], lengths[:STATES])
        loop = self._compiled.find(kind)
        if loop is None:
            with self._compiled.in_python(kind):
                return self._steps(z, ends)
        path = loop(x, torch.zeros_like(x), inputs, lengths, self.threads)
        return torch.cat([x[:, None], path], dim=1).reshape(*batch, steps + 1, -1).unbind(-2)
