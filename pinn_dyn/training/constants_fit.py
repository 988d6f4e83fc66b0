"""Result of a least-squares fit: constants, their covariance, and their distance from the prior."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

_UNEXPLAINED = 0.9
"""Share of the inputs from which the fit of the median joint explains nothing."""


class Prior(NamedTuple):
    """Prior of the parameters: mean ``(P,)``, and a root of the precision ``(P, P)``."""

    mean: Tensor
    root: Tensor


@dataclass(frozen=True)
class Fit:
    """Result of a least-squares fit.

    Attributes:
        covariance: posterior covariance of the standardized parameters z, ``(P, P)``.
        information: information about z in the data, without the prior, ``(P, P)``.
        prior: prior of z.
        residual: root mean square of the normalized data residuals.
        iterations: number of Gauss-Newton steps.
        z: the fitted z, ``(P,)``.
        stage: stage of the fit that found z.
        error: validation error of z, or NaN.
        stopped_in: stage in which the fit was interrupted, or None if it is finished.
    """

    covariance: Tensor
    information: Tensor
    prior: Prior
    residual: float
    iterations: int
    z: Tensor | None = None
    stage: str = ""
    error: float = math.nan
    stopped_in: int | None = None

    def state(self) -> dict[str, Any]:
        """Convert to tensors and numbers for a checkpoint."""
        values = {key: value for key, value in vars(self).items() if key != "prior"}
        return values | self.prior._asdict()

    @classmethod
    def from_state(cls, state: Any, count: int) -> Fit:
        """Build the fit of ``count`` parameters from a checkpoint."""
        values = dict(state)
        if getattr(values.get("covariance"), "shape", None) != (count, count):
            raise ValueError(f"the checkpoint has no fit of the model's {count} constants")
        prior = Prior(values.pop("mean"), values.pop("root"))
        return cls(prior=prior, **values)


class StoppedFit(KeyboardInterrupt):
    """Interrupt of a fit, with the result so far. The model has the best constants so far."""

    def __init__(self, fit: Fit):
        super().__init__()
        self.fit = fit


def posterior_covariance(information: Tensor, root: Tensor) -> Tensor:
    """Return (I + R^T R)^-1, ``(P, P)``, with information I and prior precision R^T R."""
    back = torch.linalg.inv(root)
    values, vectors = torch.linalg.eigh(back.T @ information @ back)
    half = back @ vectors / (1 + values.clamp(min=0)).sqrt()
    return half @ half.T


def doubtful_units(ratio: Tensor, largest: float, unexplained: Tensor) -> str | None:
    """Describe data whose units or signs are probably wrong, or return None.

    Args:
        ratio: fitted over initial force of each input, ``(M,)``.
        largest: ratio of the median input that right units do not exceed.
        unexplained: spread of the force errors of the fit over that of the input, ``(N,)``.
    """
    middle, share = float(ratio.median()), float(unexplained.median())
    if not 1 / largest < middle < largest:
        return (
            f"the fitted forces are {middle:.3g} times those of the initial bodies, expected less "
            f"than {largest:g} times more or fewer: check the units of u (Nm, N, or the drive "
            "gain) and of q and v (rad, m)"
        )
    if share > _UNEXPLAINED:
        return (
            f"the errors of the fit have {share:.0%} of the spread of the inputs: check the signs, "
            "the order and the units of the columns of q, v and u"
        )
    return None
