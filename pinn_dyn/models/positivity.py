"""Maps from free numbers to the entries of a Cholesky factor with a positive diagonal."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor


class Positivity(abc.ABC):
    """Map from free numbers y to the entries of a triangular factor, in units of their scale."""

    start: float  # initial y of the diagonal entries

    @abc.abstractmethod
    def diagonal(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return L_ii and its slope in y_ii, at y of any shape."""

    @abc.abstractmethod
    def lower(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return L_ij, i > j, and its slope in y_ij."""


@dataclass(frozen=True)
class Positive(Positivity):
    """L_ii = softplus(y_ii) + floor,   L_ij = y_ij.

    Args:
        floor: smallest diagonal entry, in units of the scale; 0 allows a semi-definite matrix.
        initial: initial diagonal entry without the floor; below 1 for a robot of little inertia.
    """

    floor: NonNegativeFloat = 1e-3
    initial: PositiveFloat = 1.0

    @property
    def start(self) -> float:  # type: ignore[override]
        """Inverse of the softplus at ``initial``."""
        return math.log(math.expm1(self.initial))

    def diagonal(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return F.softplus(y) + self.floor, torch.sigmoid(y)

    def lower(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return y, torch.ones_like(y)


@dataclass(frozen=True)
class Bounded(Positivity):
    """L_ii = b sigmoid(y_ii) + floor,   L_ij = b (2 sigmoid(y_ij) - 1),   b the limit.

    This is the scaled sigmoid of the paper for a real arm. The initial diagonal is 0.63 b.

    Args:
        limit: b, in units of the scale.
        floor: smallest diagonal entry, in units of the scale.
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
