"""Maps from free numbers y to the entries of a Cholesky factor with a positive diagonal.

``diagonal`` returns L_ii and its slope in y_ii, ``lower`` the same of L_ij, i > j, both at y of any
shape and in units of the scale. ``start`` is the initial y of the diagonal entries.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor


@dataclass(frozen=True)
class Positive:
    """L_ii = softplus(y_ii) + floor,   L_ij = y_ij.

    Args:
        floor: smallest diagonal entry, in units of the scale; 0 allows a semi-definite matrix.
        initial: initial diagonal entry without the floor; below 1 for a robot of little inertia.
    """

    floor: NonNegativeFloat = 1e-3
    initial: PositiveFloat = 1.0

    @property
    def start(self) -> float:
        """Inverse of the softplus at ``initial``."""
        return math.log(math.expm1(self.initial))

    def diagonal(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return F.softplus(y) + self.floor, torch.sigmoid(y)

    def lower(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return y, torch.ones_like(y)


@dataclass(frozen=True)
class Bounded:
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


Positivity = Positive | Bounded
