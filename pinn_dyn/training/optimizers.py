"""The optimizer SOAP and the learning-rate schedule."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated, Any

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import OneCycleLR

Beta = Annotated[float, Field(ge=0, lt=1)]
"""Decay of a moving average."""

SMALLEST = 32
"""Smallest padded size. Matrices are padded to powers of two, which needs fewer calls."""


class SOAP(Optimizer):
    """Adam in the eigenbasis of Shampoo's preconditioner, for each matrix W of weights::

        L <- b L + (1 - b) G G^T        R <- b R + (1 - b) G^T G
        W <- (1 - lr d) (W - lr Q_L Adam(Q_L^T G Q_R) Q_R^T)

    with the gradient G, the weight decay d and the eigenvectors Q_L of L and Q_R of R, which are
    updated by one power iteration every ``precondition_frequency`` steps. The first step only
    initializes them. Vectors use Adam. In a larger tensor, the first dimension is that of the rows.

    Source: Vyas et al. 2024, "SOAP: Improving and Stabilizing Shampoo using Adam".

    Args:
        params: the parameters, or groups of them.
        lr: learning rate.
        betas: decay of the first and the second moments; b is the second.
        weight_decay: d.
        precondition_frequency: steps from one power iteration to the next.
        eps: added to the root of the second moments.
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter] | Iterable[dict[str, Any]],
        lr: PositiveFloat = 3e-3,
        betas: tuple[Beta, Beta] = (0.95, 0.95),
        weight_decay: NonNegativeFloat = 1e-5,
        precondition_frequency: PositiveInt = 10,
        eps: PositiveFloat = 1e-8,
    ):
        defaults: dict[str, Any] = {"lr": lr, "betas": tuple(betas), "weight_decay": weight_decay}
        defaults |= {"precondition_frequency": precondition_frequency, "eps": eps}
        super().__init__(params, defaults)
        self._batches: dict[int, list[_Batch]] = {}

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Take a step. Parameters without a gradient do not change."""
        with torch.enable_grad():
            loss = None if closure is None else closure()
        for number, group in enumerate(self.param_groups):
            if not self._batches.get(number):
                self._batches[number] = _batches([p for p in group["params"] if p.grad is not None])
            for batch in self._batches[number]:
                # The state of all parameters of a batch is stored with the first for checkpoints.
                batch.move(self.state[batch.parameters[0]], group)
        return loss


class _Batch:
    """Parameters that move together: K matrices of one padded size, or all vectors.

    Args:
        parameters: the parameters.
        size: padded numbers of rows and columns; None for vectors, which are matrices of one row.
    """

    def __init__(self, parameters: list[Tensor], size: tuple[int, int] | None):
        self.parameters = parameters
        shapes = [_matrix(p).shape for p in parameters]
        self._sizes = torch.tensor(shapes, device=parameters[0].device)
        self._turns = size is not None
        rows, columns = size or self._sizes.amax(0).tolist()
        self._gradient = parameters[0].new_zeros(len(parameters), rows, columns)
        self._change = torch.zeros_like(self._gradient)
        self._gradients = [x[:m, :n] for x, (m, n) in zip(self._gradient, shapes, strict=True)]
        self._changes = [x[:m, :n] for x, (m, n) in zip(self._change, shapes, strict=True)]

    def move(self, state: dict[str, Any], group: dict[str, Any]) -> None:
        """Take a step with the gradients of the parameters."""
        beta1, beta2 = group["betas"]
        gradient = self._gradient
        gradients: list[Any] = [p.grad for p in self.parameters]
        torch._foreach_copy_(self._gradients, [_matrix(x) for x in gradients])
        sides = [(gradient, gradient.mT), (gradient.mT, gradient)] if self._turns else []
        if not state:
            state["step"] = 0
            state["exp_avg"], state["exp_avg_sq"] = (torch.zeros_like(gradient) for _ in range(2))
            state["averages"] = [(1 - beta2) * (left @ right) for left, right in sides]
            state["bases"] = self._eigenvectors(state["averages"])
            return
        for average, factors in zip(state["averages"], sides, strict=True):
            average.baddbmm_(*factors, beta=beta2, alpha=1 - beta2)
        state["step"] += 1
        step, mean, square, bases = (state[x] for x in ("step", "exp_avg", "exp_avg_sq", "bases"))
        turned = _turned(gradient, bases)
        mean.lerp_(gradient, 1 - beta1)
        square.mul_(beta2).addcmul_(turned, turned, value=1 - beta2)
        update = _turned(mean, bases) / square.sqrt().add_(group["eps"])
        rate = group["lr"] * (1 - beta2**step) ** 0.5 / (1 - beta1**step)
        decay = group["lr"] * group["weight_decay"]
        update = _turned(update, [basis.mT for basis in bases])
        torch.mul(update, rate * (decay - 1), out=self._change)
        changes = zip(self._changes, self.parameters, strict=True)
        torch._foreach_mul_(self.parameters, 1 - decay)
        torch._foreach_add_(self.parameters, [change.reshape(p.shape) for change, p in changes])
        if step % group["precondition_frequency"] == 0:
            state["bases"] = self._updated(state["averages"], bases, square)

    def _eigenvectors(self, averages: list[Tensor]) -> list[Tensor]:
        """Return Q_L and Q_R, the largest eigenvalue first, with the identity in the padding."""
        bases = []
        for average, sizes in zip(averages, self._sizes.T.tolist(), strict=False):
            basis = torch.eye(average.shape[-1]).to(average).repeat(len(average), 1, 1)
            for k, n in enumerate(sizes):
                basis[k, :n, :n] = torch.linalg.eigh(average[k, :n, :n])[1].flip(-1)
            bases.append(basis)
        return bases

    def _updated(self, averages: list[Tensor], bases: list[Tensor], square: Tensor) -> list[Tensor]:
        """Apply a power iteration to Q_L and Q_R, and reorder the second moments."""
        results = []
        for k, (average, basis) in enumerate(zip(averages, bases, strict=True)):
            product = average @ basis
            size = product.shape[-1]
            padding = torch.arange(size, device=product.device) >= self._sizes[:, k, None]
            values = (basis * product).sum(-2).masked_fill_(padding, -torch.inf)
            order = values.argsort(dim=-1, descending=True)
            along = order.unsqueeze(-1) if k == 0 else order.unsqueeze(-2)
            square.copy_(square.take_along_dim(along, dim=k + 1))
            # The zero columns of the padding are last, and become those of the identity.
            results.append(torch.linalg.qr(product.take_along_dim(order.unsqueeze(-2), dim=-1))[0])
        return results


def _batches(parameters: list[Tensor]) -> list[_Batch]:
    by_size: dict[tuple[int, int] | None, list[Tensor]] = {}
    for parameter in parameters:
        rows, columns = _matrix(parameter).shape
        size = None if parameter.ndim < 2 else (_padded(rows), _padded(columns))
        by_size.setdefault(size, []).append(parameter)
    return [_Batch(batch, size) for size, batch in by_size.items()]


def _matrix(value: Tensor) -> Tensor:
    """Return a tensor as a matrix: the first dimension is that of the rows; vectors are a row."""
    return value.flatten(1) if value.ndim > 1 else value.reshape(1, -1)


def _turned(matrices: Tensor, bases: list[Tensor]) -> Tensor:
    """Return Q_L^T X Q_R of matrices X ``(K, rows, columns)``. Vectors have no bases."""
    if not bases:
        return matrices
    left, right = bases
    return left.mT @ matrices @ right


def _padded(size: int) -> int:
    return max(SMALLEST, 1 << (size - 1).bit_length())


def one_cycle(
    optimizer: Optimizer, *, total_steps: int, warm_up: Annotated[float, Field(ge=0, le=1)] = 0.05
) -> OneCycleLR:
    """Build a schedule of half a cosine from 1/25 of the peak, and one to 1/25,000 of the peak.

    Momentum is constant. Source: Smith and Topin (2019), "Super-convergence".

    ``warm_up`` is the share of the steps in which the rate rises to that of the optimizer.
    """
    if warm_up * total_steps == 1:  # the slope of a rise in exactly one step is undefined
        total_steps += 1
    return OneCycleLR(
        optimizer,
        [group["lr"] for group in optimizer.param_groups],
        total_steps=total_steps,
        pct_start=float(warm_up),
        cycle_momentum=False,
        final_div_factor=1000.0,
    )
