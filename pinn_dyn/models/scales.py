"""What a head is told of the data before it learns."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

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
