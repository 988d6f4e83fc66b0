"""SOAP for the stacked parameters of an ensemble."""

from __future__ import annotations

from typing import Any

import torch
from pytorch_optimizer import SOAP
from torch import Tensor


class MemberSOAP(SOAP):
    """SOAP on parameters ``(E, ...)``: each of the E members has preconditioners of its own.

    The library's SOAP would take E as a dimension of the weights, and turn the gradients of the
    members into each other. Here every slice k of a parameter moves as the library moves a
    parameter of that slice's shape alone::

        L_k <- b L_k + (1 - b) G_k G_k^T        R_k <- b R_k + (1 - b) G_k^T G_k
        W_k <- W_k - lr Q_L Adam(Q_L^T G_k Q_R) Q_R^T

    with the eigenvectors Q_L of L_k and Q_R of R_k, brought up to date every
    ``precondition_frequency`` steps, and Adam's moments in that basis. Vectors take Adam. The
    products and decompositions of all members are taken as one batch: the many small calls of
    SOAP, which are most of its time on small networks, are made once for all members.

    Where a gradient leaves directions open, as the first one of a matrix that is not square does,
    rounding chooses the basis there: a member's training is then another one than that of a single
    model of its seed, and as good.

    Source: Vyas et al. 2024, "SOAP: Improving and Stabilizing Shampoo using Adam".

    Args:
        optimizer: SOAP as it was built for the stacked parameters, before its first step.

    Raises:
        ValueError: on options of the library that this class does not have: ``merge_dims``,
            ``precondition_1d`` and ``normalize_gradient``.
    """

    def __init__(self, optimizer: SOAP):
        chosen = optimizer.defaults
        for option in ("merge_dims", "precondition_1d", "normalize_gradient"):
            if chosen[option]:
                raise ValueError(
                    f"optimizer.{option} is true, which an ensemble does not know: leave it out, "
                    "or train the seeds one by one (train.py -m seed=0,1,2)"
                )
        groups = [dict(group) for group in optimizer.param_groups]
        super().__init__(groups, maximize=optimizer.maximize, **chosen)

    # The library's step calls these, each with all of its options.

    def init_pre_conditioner(
        self,
        grad: Tensor,
        state: dict[str, Any],
        precondition_frequency: int = 10,
        shampoo_beta: float = 0.95,
        max_precondition_dim: int = 10000,
        precondition_1d: bool = False,
        merge_dims: bool = False,
    ) -> None:
        """Zeros ``(E, n, n)`` for each dimension n of a member's matrix; none for a vector."""
        sizes, matrix = grad.shape[1:], grad.ndim > 2
        state["GG"] = [
            grad.new_zeros(len(grad), n, n) if matrix and n <= max_precondition_dim else []
            for n in sizes
        ]
        state["Q"] = None
        state["precondition_frequency"] = precondition_frequency
        state["shampoo_beta"] = shampoo_beta

    def update_pre_conditioner(
        self,
        grad: Tensor,
        state: dict[str, Any],
        step: int,
        max_precondition_dim: int = 10000,
        precondition_1d: bool = False,
        merge_dims: bool = False,
    ) -> None:
        """Take in G_k G_k^T along each dimension, and turn the bases when it is time."""
        beta = state["shampoo_beta"]
        for k, average in enumerate(state["GG"]):
            if len(average):
                rows = grad.movedim(k + 1, 1).flatten(2)
                average.baddbmm_(rows, rows.mT, beta=beta, alpha=1 - beta)
        if state["Q"] is None:
            state["Q"] = [_eigenvectors(average) if len(average) else [] for average in state["GG"]]
        if step > 0 and step % state["precondition_frequency"] == 0:
            self._turn(state)

    def project(
        self,
        grad: Tensor,
        state: dict[str, Any],
        merge_dims: bool = False,
        max_precondition_dim: int = 10000,
        project_type: str = "forward",
    ) -> Tensor:
        """The gradient in the basis of each dimension, or back from there."""
        if grad.ndim < 3:
            return grad
        for basis in state["Q"]:
            # Takes the first dimension to the last place, so that the next one is first.
            grad = grad.movedim(1, -1)
            if len(basis):
                turn = basis if project_type == "forward" else basis.mT
                grad = torch.bmm(grad.flatten(1, -2), turn).view(grad.shape)
        return grad

    @staticmethod
    def _turn(state: dict[str, Any]) -> None:
        """One power iteration of every basis; the second moments follow its new order."""
        for k, (average, basis) in enumerate(zip(state["GG"], state["Q"], strict=True)):
            if not len(average):
                continue
            product = average @ basis
            order = (basis * product).sum(-2).argsort(dim=-1, descending=True)
            moments = state["exp_avg_sq"]
            places = order.reshape(len(order), *[1] * k, -1, *[1] * (moments.ndim - k - 2))
            state["exp_avg_sq"] = moments.take_along_dim(places, dim=k + 1)
            product = product.take_along_dim(order.unsqueeze(-2), dim=-1)
            state["Q"][k] = torch.linalg.qr(product.float())[0].to(product)


def _eigenvectors(matrix: Tensor) -> Tensor:
    """Those of symmetric matrices ``(E, n, n)``, the largest eigenvalue first."""
    return torch.linalg.eigh(matrix)[1].flip(-1)
