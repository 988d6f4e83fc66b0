"""What keeps the diagonal of a Cholesky factor positive, and its other entries in their range."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor


class Positivity(abc.ABC):
    """Entries of a triangular factor from free numbers y; each method gives values and slopes.

    All entries are in units of the scale of their row.

    Attributes:
        floor: no entry of the diagonal is below it.
        start: the y of a diagonal entry before training.
    """

    floor: float
    start: float

    @abc.abstractmethod
    def diagonal(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """L_ii and its slope in y_ii, at y of any shape."""

    @abc.abstractmethod
    def lower(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """L_ij, i > j, and its slope in y_ij."""


@dataclass(frozen=True)
class Positive(Positivity):
    """L_ii = softplus(y_ii) + floor,   L_ij = y_ij.

    Args:
        floor: smallest diagonal entry, in units of the scale; 0 allows a semi-definite matrix.
        initial: what the floor is added to before training; below 1 in the mass matrix of a robot
            that moves almost without inertia.
    """

    floor: NonNegativeFloat = 1e-3
    initial: PositiveFloat = 1.0

    @property
    def start(self) -> float:  # type: ignore[override]
        """The inverse of the softplus at ``initial``."""
        return math.log(math.expm1(self.initial))

    def diagonal(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return F.softplus(y) + self.floor, torch.sigmoid(y)

    def lower(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return y, torch.ones_like(y)


@dataclass(frozen=True)
class Bounded(Positivity):
    """L_ii = b sigmoid(y_ii) + floor,   L_ij = b (2 sigmoid(y_ij) - 1),   b the limit.

    The paper's scaled sigmoid for a real arm, b = 3.5. The diagonal starts at 0.63 b.

    Args:
        limit: b, in units of the scale.
        floor: smallest diagonal entry, in units of the scale; 0 allows a semi-definite matrix.
    """

    limit: PositiveFloat = 3.5
    floor: NonNegativeFloat = 1e-3
    start = math.log(math.expm1(1.0))

    def diagonal(self, y: Tensor) -> tuple[Tensor, Tensor]:
        share = torch.sigmoid(y)
        return self.limit * share + self.floor, self.limit * share * (1 - share)

    def lower(self, y: Tensor) -> tuple[Tensor, Tensor]:
        share = torch.sigmoid(y)
        return self.limit * (2 * share - 1), 2 * self.limit * share * (1 - share)
