"""Result of a least-squares fit: constants, their covariance, and their distance from the prior."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

_UNEXPLAINED = 0.9
"""Share of the inputs from which the fit of the median joint explains nothing."""
_LARGEST_SHARE = 0.9
"""Largest corrected share of a block of residuals in the information on a direction."""
COVARIANCE, FIT = "covariance", "fit"
"""Keys of the covariance of the constants, and of the fit, in a checkpoint."""
UNKNOWN = torch.tensor(math.nan)
"""Validation error without validation."""


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
        success: false if the kept stage ended at its largest number of evaluations.
        z: the fitted z, ``(P,)``.
        stage: stage of the fit that found z.
        errors: smallest validation errors of the stages, ``(V,)``, or NaN.
        stopped_in: stage in which the fit was interrupted, or None if it is finished.
        scores: covariance of the data's gradient, see :func:`block_scores`; None: the information.
        identified: z after the inverse dynamics, if that was a stage of the fit, ``(P,)``.
        left_out: z without each of R runs, ``(R, P)``, see :func:`left_out`; None if unknown.
    """

    covariance: Tensor
    information: Tensor
    prior: Prior
    residual: float
    iterations: int
    success: bool = True
    z: Tensor | None = None
    stage: str = ""
    errors: Tensor = UNKNOWN
    stopped_in: int | None = None
    scores: Tensor | None = None
    identified: Tensor | None = None
    left_out: Tensor | None = None

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
        values.pop("error", None)  # of earlier versions
        return cls(prior=prior, **values)


def posterior_covariance(information: Tensor, root: Tensor, scores: Tensor | None = None) -> Tensor:
    """Return the covariance of an estimate with the prior precision R^T R, ``(P, P)``::

        H^-1 (B + R^T R) H^-1,    H = I + R^T R

    I is the information and B the covariance of the scores. The default B = I gives H^-1. Variances
    are limited to those of the prior. Source: White (1982), "Maximum likelihood estimation of
    misspecified models".
    """
    back, values, vectors = _whitened(information, root)
    half = vectors / (1 + values).sqrt()
    if scores is not None:
        side = back @ half
        spread = side.T @ scores @ side + torch.diag(1 / (1 + values))
        vectors, deviations, _ = torch.linalg.svd(half @ torch.linalg.cholesky(spread))
        half = vectors * deviations.clamp(max=1)
    half = back @ half
    return half @ half.T


def block_scores(
    slopes: Tensor, errors: Tensor, partitions: Sequence[Tensor], root: Tensor
) -> Tensor:
    """Return the covariance B of the scores J^T r::

        B = sum over k of J_k^T J_k r_k^2 + sum over partitions and their blocks b of s_b s_b^T
        s_b = (1 - J_b^T J_b H^-1)^-1 J_b^T r_b,    H = J^T J + R^T R

    Residuals of a block may have any correlation: that of a filter, or the repeated error of a
    friction law at one speed. The factor in s_b replaces the residuals by those of a fit without
    the block. The mean is over the directions that the data determine.

    Sources: Cameron, Gelbach and Miller (2011), "Robust inference with multiway clustering"; Bell
    and McCaffrey (2002), "Bias reduction in standard errors for linear regression".

    Args:
        slopes, errors: J ``(K, P)`` and r ``(K,)``, in units of the noise.
        partitions: block number of each residual, ``(K,)`` each.
        root: root R of the precision of the prior, ``(P, P)``.
    """
    back, values, vectors = _whitened(slopes.T @ slopes, root)
    slopes = slopes @ (back @ vectors / (1 + values).sqrt())
    scores = [slopes * errors[:, None]]
    for blocks in partitions:
        for number in blocks.unique():
            part = slopes[blocks == number]
            share, axes = torch.linalg.eigh(part.T @ part)
            score = axes.T @ (part.T @ errors[blocks == number])
            scores.append((axes @ (score / (1 - share.clamp(max=_LARGEST_SHARE))))[None])
    joined = torch.cat(scores)
    covariance = joined.T @ joined
    dual = root.T @ vectors * (1 + values).sqrt()
    return dual @ covariance @ dual.T


def left_out(
    z: Tensor, slopes: Tensor, errors: Tensor, parts: Sequence[Tensor], root: Tensor
) -> Tensor:
    """Return z of a fit without each of B parts, by a Gauss-Newton step, ``(B, P)``::

        z_b = z + (H - J_b^T J_b)^-1 J_b^T r_b,    H = J^T J + R^T R

    Source: Quenouille (1956), "Notes on bias in estimation" (the jackknife).

    Args:
        z: the minimum with all parts, ``(P,)``.
        slopes, errors, root: see :func:`block_scores`.
        parts: true for the residuals of each part, ``(K,)`` each.
    """
    precision, fits = slopes.T @ slopes + root.T @ root, []
    for part in parts:
        rows = slopes[part]
        fits.append(z + torch.linalg.solve(precision - rows.T @ rows, rows.T @ errors[part]))
    return torch.stack(fits)


def _whitened(information: Tensor, root: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return R^-1, and the eigenvalues and eigenvectors of R^-T I R^-1."""
    back = torch.linalg.inv(root)
    values, vectors = torch.linalg.eigh(back.T @ information @ back)
    return back, values.clamp(min=0), vectors


def doubtful_units(ratio: Tensor, largest: float, unexplained: Tensor) -> str | None:
    """Describe data whose units or signs are probably wrong, or return None.

    Args:
        ratio: fitted over initial force of each input, ``(M,)``.
        largest: ratio of the median input that right units do not exceed.
        unexplained: spread of the force errors of the fit over that of the input, ``(N,)``.
    """
    middle, share = float(ratio.median()), float(unexplained.median())
    if len(ratio) and not 1 / largest < middle < largest:
        return (
            f"the fitted forces are {middle:.3g} times those of the initial bodies, expected less "
            f"than {largest:g} times more or fewer: check the units of u (Nm, N, or the drive "
            "gain) and of q and v (rad, m)"
        )
    if share > _UNEXPLAINED:
        return (
            f"the errors of the fit have {share:.0%} of the spread of the "
            f"{'inputs' if len(ratio) else 'accelerations'}: check the signs, the order and the "
            "units of the columns of q, v and u"
        )
    return None
