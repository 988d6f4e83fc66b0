"""What a head is told of the data before it learns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from pinn_dyn.models.mlp import MLP
from pinn_dyn.models.statistics import Statistics


@dataclass(frozen=True)
class Scales:
    """The scales that a head is built on, so that its network works on numbers near one.

    Attributes:
        statistics: means and standard deviations of q, v and u, in SI units.
        value: typical size of what the head gives, in the shape that its docstring names.
        angles: which coordinates are angles, and enter a network as sine and cosine.
    """

    statistics: Statistics
    value: Tensor
    angles: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """N."""
        return self.statistics.num_coordinates

    @property
    def inputs(self) -> int:
        """M."""
        return self.statistics.num_inputs

    def network(
        self,
        outputs: int,
        hidden: Sequence[int],
        activation: str,
        after: Sequence[int] | None = None,
    ) -> MLP:
        """A network of q; outside the data what it sees of q saturates, see :class:`MLP`."""
        data = self.statistics
        limits = (data.q_low, data.q_high)
        mean, std = data.q_mean, data.q_std
        return MLP(self.size, outputs, hidden, activation, mean, std, self.angles, after, limits)
