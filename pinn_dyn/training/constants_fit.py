"""Result of a least-squares fit: constants, their covariance, and their distance from the prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

_FAR = 3.0
"""Prior standard deviations from which a constant is reported: 3 of 1,000 by chance."""
_REPORTED = 5
_CHECKS = {
    "drive gain": "units and sign of its input",
    **dict.fromkeys(("torque offset", "force offset"), "sign of its input"),
}
"""Advice by the kind of the constant. The default is to check the units of the columns."""


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
        stopped_in: stage in which the fit was interrupted, or None if it is finished. All other
            values are then those of the last finished stage, or of the prior.
    """

    covariance: Tensor
    information: Tensor
    prior: Prior
    residual: float
    iterations: int
    stopped_in: int | None = None

    def state(self) -> dict[str, Any]:
        """Convert to tensors and numbers for a checkpoint."""
        values = {key: value for key, value in vars(self).items() if key != "prior"}
        return values | self.prior._asdict()

    @classmethod
    def from_state(cls, state: Any, count: int) -> Fit:
        """Build the fit of ``count`` parameters from a checkpoint.

        Raises:
            ValueError: if the checkpoint has no valid fit.
        """
        numbers = {"residual": (float,), "iterations": (int,), "stopped_in": (int, type(None))}
        square = {key: [count, count] for key in ("covariance", "information", "root")}
        shapes = {**square, "mean": [count]}
        if (
            not isinstance(state, dict)
            or state.keys() != numbers.keys() | shapes.keys()
            or not all(isinstance(state[key], kind) for key, kind in numbers.items())
            or not all(isinstance(state[key], Tensor) for key in shapes)
            or not all(list(state[key].shape) == shape for key, shape in shapes.items())
            or not all(state[key].dtype == torch.float64 for key in shapes)
            or not all(bool(state[key].isfinite().all()) for key in shapes)
            or bool(torch.linalg.inv_ex(state["root"]).info)
        ):
            raise ValueError(
                f"the checkpoint has no fit of the model's {count} constants: it is damaged or "
                "belongs to another model; fit again in a new folder"
            )
        values = {key: state[key] for key in state if key not in Prior._fields}
        return cls(prior=Prior(state["mean"], state["root"]), **values)


class StoppedFit(KeyboardInterrupt):
    """Interrupt of a fit. The model has the best constants so far.

    Attributes:
        fit: result so far, from which the fit can continue.
    """

    def __init__(self, fit: Fit):
        super().__init__()
        self.fit = fit


def posterior_covariance(information: Tensor, root: Tensor) -> Tensor:
    """Return (I + R^T R)^-1, ``(P, P)``, with information I and the root R of the prior precision.

    The eigenvalues of R^-T I R^-1 are used, since I + R^T R is nearly singular without noise.
    """
    back = torch.linalg.inv(root)
    values, vectors = torch.linalg.eigh(back.T @ information @ back)
    half = back @ vectors / (1 + values.clamp(min=0)).sqrt()
    return half @ half.T


def far_from_start(names: Sequence[str], z: Tensor, prior: Prior) -> list[str]:
    """Describe the parameters z ``(P,)`` that are very unlikely under the prior."""
    spread = torch.linalg.inv(prior.root).norm(dim=1)
    deviation = ((z - prior.mean) / spread).abs()
    far = [k for k in deviation.argsort(descending=True).tolist() if deviation[k] > _FAR]
    lines = []
    for k in far[:_REPORTED]:
        checks = (check for kind, check in _CHECKS.items() if names[k].startswith(kind))
        lines.append(
            f"{names[k]} is {float(deviation[k]):.1f} prior standard deviations from its start: "
            f"check {next(checks, 'the units of the columns')}"
        )
    more = len(far) - _REPORTED
    return [*lines, f"and {more} more"] if more > 0 else lines
