"""What a least-squares fit found: constants, how certain they are, and how far from their start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

_FAR = 3.0
"""Standard deviations a priori: of a thousand constants three are farther from their start."""
_MOST_NAMED = 5
_CHECKS = {
    "drive gain": "units and sign of its input",
    **dict.fromkeys(("torque offset", "force offset"), "sign of its input"),
}
"""What to look at first; else the units of the columns."""


class Prior(NamedTuple):
    """What is known of the parameters before: their mean ``(P,)``, and a root of P ``(P, P)``."""

    mean: Tensor
    root: Tensor


@dataclass(frozen=True)
class Fit:
    """What a least-squares fit found.

    Attributes:
        covariance: of the standardized parameters z, ``(P, P)``, prior included.
        information: of z from the data alone, ``(P, P)``.
        prior: what was known of z before.
        residual: root mean square of the normalized data residuals.
        iterations: of Gauss-Newton.
        stopped_in: number of the stage in which the fit was stopped, None if it is finished. The
            rest is then of the last stage that was finished, or of the prior.
    """

    covariance: Tensor
    information: Tensor
    prior: Prior
    residual: float
    iterations: int
    stopped_in: int | None = None

    def state(self) -> dict[str, Any]:
        """As tensors and numbers, for a checkpoint."""
        values = {key: value for key, value in vars(self).items() if key != "prior"}
        return values | self.prior._asdict()

    @classmethod
    def from_state(cls, state: Any, count: int) -> Fit:
        """The fit of ``count`` parameters that a checkpoint holds.

        Raises:
            ValueError: if it is none.
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
                f"the checkpoint has no fit of the model's {count} constants: it is damaged or of "
                "another model, fit again in a new folder"
            )
        values = {key: state[key] for key in state if key not in Prior._fields}
        return cls(prior=Prior(state["mean"], state["root"]), **values)


class StoppedFit(KeyboardInterrupt):
    """A fit was interrupted; the model has the best constants so far.

    Attributes:
        fit: what was found by then, to go on from.
    """

    def __init__(self, fit: Fit):
        super().__init__()
        self.fit = fit


def posterior_covariance(information: Tensor, root: Tensor) -> Tensor:
    """(I + R^T R)^-1, ``(P, P)``, from information I and the root R of the prior's precision.

    By the eigenvalues of R^-T I R^-1: of data without noise I + R^T R cannot be inverted as it is.
    """
    back = torch.linalg.inv(root)
    values, vectors = torch.linalg.eigh(back.T @ information @ back)
    half = back @ vectors / (1 + values.clamp(min=0)).sqrt()
    return half @ half.T


def far_from_start(names: Sequence[str], z: Tensor, prior: Prior) -> list[str]:
    """In words, the parameters z ``(P,)`` that the prior holds for all but impossible."""
    spread = torch.linalg.inv(prior.root).norm(dim=1)
    deviation = ((z - prior.mean) / spread).abs()
    far = [k for k in deviation.argsort(descending=True).tolist() if deviation[k] > _FAR]
    found = []
    for k in far[:_MOST_NAMED]:
        first = (what for kind, what in _CHECKS.items() if names[k].startswith(kind))
        found.append(
            f"{names[k]} is {float(deviation[k]):.1f} prior deviations from its start: check "
            f"{next(first, 'the units of the columns')}"
        )
    more = len(far) - _MOST_NAMED
    return [*found, f"and {more} more"] if more > 0 else found
