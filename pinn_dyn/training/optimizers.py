"""The optimizer SOAP and the learning-rate schedule."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
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
        self._layouts: dict[int, _Layout] = {}

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Take a step. Parameters without a gradient do not change."""
        with torch.enable_grad():
            loss = None if closure is None else closure()
        for number, group in enumerate(self.param_groups):
            moved: list[Tensor] = [p for p in group["params"] if p.grad is not None]
            if moved:
                self._move(number, group, moved)
        return loss

    def _move(self, number: int, group: dict[str, Any], moved: list[Tensor]) -> None:
        if number not in self._layouts:
            self._layouts[number] = _Layout(moved)
        layout = self._layouts[number]
        beta1, beta2 = group["betas"]
        gradient = layout.laid_out([p.grad for p in moved])  # type: ignore[misc]
        # One state for all parameters, stored with the first parameter for checkpoints.
        state = self.state[group["params"][0]]
        if not state:
            state["step"] = 0
            state["exp_avg"], state["exp_avg_sq"] = (torch.zeros_like(gradient) for _ in range(2))
            state["averages"] = [batch.averages(gradient, None, beta2) for batch in layout.batches]
            pairs = zip(layout.batches, state["averages"], strict=True)
            state["bases"] = [batch.eigenvectors(pair) for batch, pair in pairs]
            return
        state["step"] += 1
        step, mean, square = state["step"], state["exp_avg"], state["exp_avg_sq"]
        turned = layout.transformed(gradient, state["bases"])
        mean.lerp_(gradient, 1 - beta1)
        square.mul_(beta2).addcmul_(turned, turned, value=1 - beta2)
        update = layout.transformed(mean, state["bases"]).div_(square.sqrt().add_(group["eps"]))
        update = layout.transformed(update, state["bases"], back=True)
        rate = group["lr"] * (1 - beta2**step) ** 0.5 / (1 - beta1**step)
        decay = group["lr"] * group["weight_decay"]
        update.mul_(rate * (decay - 1)).sub_(layout.laid_out(moved), alpha=decay)
        torch._foreach_add_(moved, layout.unpacked(update))
        for k, batch in enumerate(layout.batches):
            state["averages"][k] = batch.averages(gradient, state["averages"][k], beta2)
            if step % group["precondition_frequency"] == 0:
                state["bases"][k] = batch.updated(state["averages"][k], state["bases"][k], square)


@dataclass(frozen=True)
class _Batch:
    """Matrices ``(K, rows, columns)`` of one padded size, in a vector of numbers."""

    start: int  # position of the first number
    shape: tuple[int, int, int]
    sizes: Tensor  # rows and columns of each matrix without padding, (K, 2)

    def view(self, numbers: Tensor) -> Tensor:
        count, rows, columns = self.shape
        return numbers[self.start : self.start + count * rows * columns].view(self.shape)

    def averages(
        self, gradient: Tensor, before: tuple[Tensor, Tensor] | None, beta: float
    ) -> tuple[Tensor, Tensor]:
        """Return L and R after a gradient. They start at zero."""
        g = self.view(gradient)
        if before is None:
            return (1 - beta) * (g @ g.mT), (1 - beta) * (g.mT @ g)
        for average, factors in zip(before, ((g, g.mT), (g.mT, g)), strict=True):
            average.baddbmm_(*factors, beta=beta, alpha=1 - beta)
        return before

    def eigenvectors(self, averages: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Return Q_L and Q_R, the largest eigenvalue first, with the identity in the padding."""
        results = []
        for average, sizes in zip(averages, self.sizes.T.tolist(), strict=True):
            basis = torch.eye(average.shape[-1]).to(average).repeat(len(average), 1, 1)
            for k, n in enumerate(sizes):
                basis[k, :n, :n] = torch.linalg.eigh(average[k, :n, :n])[1].flip(-1)
            results.append(basis)
        return results[0], results[1]

    def updated(
        self, averages: tuple[Tensor, Tensor], bases: tuple[Tensor, Tensor], square: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Apply a power iteration to Q_L and Q_R, and reorder the second moments."""
        results, moments = [], self.view(square)
        for k, (average, basis) in enumerate(zip(averages, bases, strict=True)):
            product = average @ basis
            size = product.shape[-1]
            padding = torch.arange(size, device=product.device) >= self.sizes[:, k, None]
            values = (basis * product).sum(-2).masked_fill_(padding, -torch.inf)
            order = values.argsort(dim=-1, descending=True)
            along = order.unsqueeze(-1) if k == 0 else order.unsqueeze(-2)
            moments.copy_(moments.take_along_dim(along, dim=k + 1))
            # The zero columns of the padding are last, and become those of the identity.
            results.append(torch.linalg.qr(product.take_along_dim(order.unsqueeze(-2), dim=-1))[0])
        return results[0], results[1]


class _Layout:
    """Positions of the numbers of all parameters in a vector: batches of matrices, then vectors."""

    def __init__(self, parameters: list[Tensor]):
        device = parameters[0].device
        sizes = [p.numel() for p in parameters]
        total = sum(sizes)
        by_size: dict[tuple[int, int], list[Tensor]] = {}
        vectors = []
        for p, numbers in zip(parameters, torch.arange(total).split(sizes), strict=True):
            if p.ndim < 2:
                vectors.append(numbers)
                continue
            rows, columns = p.shape[0], p.shape[1:].numel()
            padded = _padded(rows), _padded(columns)
            by_size.setdefault(padded, []).append(numbers.view(rows, columns))
        self.batches: list[_Batch] = []
        positions: list[Tensor] = []  # in the parameters; the last one is a zero
        start = 0
        for (rows, columns), matrices in by_size.items():
            shape = (len(matrices), rows, columns)
            block = torch.full(shape, total)
            for padded_matrix, matrix in zip(block, matrices, strict=True):
                padded_matrix[: matrix.shape[0], : matrix.shape[1]] = matrix
            true_sizes = torch.tensor([matrix.shape for matrix in matrices], device=device)
            self.batches.append(_Batch(start, shape, true_sizes))
            positions.append(block.flatten())
            start += block.numel()
        positions += vectors
        self._vectors = slice(start, None)
        self._positions = torch.cat(positions).to(device)
        back = self._positions.new_empty(total + 1)
        back[self._positions] = torch.arange(len(self._positions), device=device)
        self._back = back[:-1]
        self._zero = parameters[0].new_zeros(1)
        self._apart = parameters[0].new_empty(total)
        parts = zip(self._apart.split(sizes), parameters, strict=True)
        self._parts = [part.view(p.shape) for part, p in parts]

    def laid_out(self, values: list[Tensor]) -> Tensor:
        """Return the numbers of tensors in the shapes of the parameters, with padding."""
        numbers = torch.cat([*(value.flatten() for value in values), self._zero])
        return numbers.index_select(0, self._positions)

    def unpacked(self, numbers: Tensor) -> list[Tensor]:
        """Return tensors in the shapes of the parameters. The next call overwrites them."""
        torch.index_select(numbers, 0, self._back, out=self._apart)
        return self._parts

    def transformed(self, numbers: Tensor, bases: list[Any], back: bool = False) -> Tensor:
        """Transform the matrices to their bases, or back. Vectors do not change."""
        result = torch.empty_like(numbers)
        result[self._vectors] = numbers[self._vectors]
        for batch, (left, right) in zip(self.batches, bases, strict=True):
            if back:
                left, right = left.mT, right.mT
            torch.bmm(left.mT @ batch.view(numbers), right, out=batch.view(result))
        return result


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
