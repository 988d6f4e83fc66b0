"""SOAP with the small matrices of a model taken as batches."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor, nn
from torch.optim import Optimizer

Beta = Annotated[float, Field(ge=0, lt=1)]
"""Decay of a moving average."""

SMALLEST = 32
"""Matrices are filled up with zeros to powers of two from this on: the fewer sizes, the fewer
calls, and each takes longer than the arithmetic of the zeros."""


class SOAP(Optimizer):
    """Adam in the eigenbasis of Shampoo's preconditioner, for each matrix W of weights::

        L <- b L + (1 - b) G G^T        R <- b R + (1 - b) G^T G
        W <- (1 - lr d) (W - lr Q_L Adam(Q_L^T G Q_R) Q_R^T)

    with the gradient G, the weight decay d and the eigenvectors Q_L of L and Q_R of R, brought up
    to date by one power iteration every ``precondition_frequency`` steps. The first step only
    starts them. Vectors take Adam; of a tensor of more dimensions the first is that of the rows.

    A network of ours has some ten matrices of up to 32 rows, and one by one they take a hundred
    calls. Here all of a size go through each product and decomposition as one batch, filled up with
    zeros, which stay zeros: no basis turns them into the rest.

    Source: Vyas et al. 2024, "SOAP: Improving and Stabilizing Shampoo using Adam".

    Args:
        params: the parameters, or groups of them.
        lr: learning rate.
        betas: decay of the first and the second moments; b is the second.
        weight_decay: d.
        precondition_frequency: steps from one power iteration to the next.
        eps: added to the root of the second moments.
    """

    leading = 0
    """Dimensions of a parameter before those of its matrix."""

    def __init__(
        self,
        params: Iterable[nn.Parameter] | Iterable[dict[str, Any]],
        lr: PositiveFloat = 3e-3,
        betas: tuple[Beta, Beta] = (0.95, 0.95),
        weight_decay: NonNegativeFloat = 1e-2,
        precondition_frequency: PositiveInt = 10,
        eps: PositiveFloat = 1e-8,
    ):
        defaults = {
            "lr": lr,
            "betas": tuple(betas),
            "weight_decay": weight_decay,
            "precondition_frequency": precondition_frequency,
            "eps": eps,
        }
        super().__init__(params, defaults)
        self._layouts: dict[int, _Layout] = {}

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step; parameters without a gradient stay where they are."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for number, group in enumerate(self.param_groups):
            moved: list[Tensor] = [p for p in group["params"] if p.grad is not None]
            if moved:
                self._move(number, group, moved)
        return loss

    def _move(self, number: int, group: dict[str, Any], moved: list[Tensor]) -> None:
        if number not in self._layouts:
            self._layouts[number] = _Layout(moved, self.leading)
        layout = self._layouts[number]
        beta1, beta2 = group["betas"]
        gradient = layout.laid_out([p.grad for p in moved])  # type: ignore[misc]
        # One state for all parameters, kept where the checkpoints find it.
        state = self.state[group["params"][0]]
        if not state:
            state["step"] = 0
            state["exp_avg"], state["exp_avg_sq"] = (torch.zeros_like(gradient) for _ in range(2))
            state["averages"] = [batch.averages(gradient, None, beta2) for batch in layout.batches]
            state["bases"] = [
                batch.eigenvectors(pair)
                for batch, pair in zip(layout.batches, state["averages"], strict=True)
            ]
            return
        state["step"] += 1
        step, mean, square = state["step"], state["exp_avg"], state["exp_avg_sq"]
        turned = layout.turned(gradient, state["bases"])
        mean.lerp_(gradient, 1 - beta1)
        square.mul_(beta2).addcmul_(turned, turned, value=1 - beta2)
        update = layout.turned(mean, state["bases"]).div_(square.sqrt().add_(group["eps"]))
        update = layout.turned(update, state["bases"], back=True)
        rate = group["lr"] * (1 - beta2**step) ** 0.5 / (1 - beta1**step)
        decay = group["lr"] * group["weight_decay"]
        # All at once, and each parameter is moved by one call.
        update.mul_(rate * (decay - 1)).sub_(layout.laid_out(moved), alpha=decay)
        torch._foreach_add_(moved, layout.taken_apart(update))
        for k, batch in enumerate(layout.batches):
            state["averages"][k] = batch.averages(gradient, state["averages"][k], beta2)
            if step % group["precondition_frequency"] == 0:
                state["bases"][k] = batch.brought_up_to_date(
                    state["averages"][k], state["bases"][k], square
                )


@dataclass(frozen=True)
class _Batch:
    """Matrices ``(K, rows, columns)`` of one filled-up size, in a vector of numbers.

    Attributes:
        start: where they begin.
        shape: K, rows and columns.
        sizes: true rows and columns of each, ``(K, 2)``.
    """

    start: int
    shape: tuple[int, int, int]
    sizes: Tensor

    def of(self, numbers: Tensor) -> Tensor:
        """The matrices, as a view."""
        count, rows, columns = self.shape
        return numbers[self.start : self.start + count * rows * columns].view(self.shape)

    def averages(
        self, gradient: Tensor, before: tuple[Tensor, Tensor] | None, beta: float
    ) -> tuple[Tensor, Tensor]:
        """L and R after one more gradient; they begin at zero."""
        g = self.of(gradient)
        if before is None:
            return (1 - beta) * (g @ g.mT), (1 - beta) * (g.mT @ g)
        left, right = before
        return (
            left.baddbmm_(g, g.mT, beta=beta, alpha=1 - beta),
            right.baddbmm_(g.mT, g, beta=beta, alpha=1 - beta),
        )

    def eigenvectors(self, averages: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Q_L and Q_R, the largest eigenvalue first; the identity where zeros were filled in."""
        found = []
        for average, sizes in zip(averages, self.sizes.T.tolist(), strict=True):
            basis = torch.eye(average.shape[-1]).to(average).repeat(len(average), 1, 1)
            for k, n in enumerate(sizes):
                basis[k, :n, :n] = torch.linalg.eigh(average[k, :n, :n])[1].flip(-1)
            found.append(basis)
        return found[0], found[1]

    def brought_up_to_date(
        self, averages: tuple[Tensor, Tensor], bases: tuple[Tensor, Tensor], square: Tensor
    ) -> tuple[Tensor, Tensor]:
        """One power iteration of Q_L and Q_R; the second moments follow their new order."""
        found = []
        moments = self.of(square)
        for k, (average, basis) in enumerate(zip(averages, bases, strict=True)):
            product = average @ basis
            size = product.shape[-1]
            filled = torch.arange(size, device=product.device) >= self.sizes[:, k, None]
            values = (basis * product).sum(-2).masked_fill_(filled, -torch.inf)
            order = values.argsort(dim=-1, descending=True)
            along = order.unsqueeze(-1) if k == 0 else order.unsqueeze(-2)
            moments.copy_(moments.take_along_dim(along, dim=k + 1))
            # Columns of zeros, which are last, become those of the identity.
            found.append(torch.linalg.qr(product.take_along_dim(order.unsqueeze(-2), dim=-1))[0])
        return found[0], found[1]


class _Layout:
    """Where the numbers of parameters are in one vector: batches of matrices, then the rest.

    Args:
        parameters: the parameters, with gradients.
        leading: dimensions of a parameter before those of its matrix.
    """

    def __init__(self, parameters: list[Tensor], leading: int):
        device = parameters[0].device
        sizes = [p.numel() for p in parameters]
        total = sum(sizes)
        by_size: dict[tuple[int, int], list[Tensor]] = {}
        rest = []
        for p, numbers in zip(parameters, torch.arange(total).split(sizes), strict=True):
            if p.ndim < leading + 2:
                rest.append(numbers)
                continue
            rows, columns = p.shape[leading], p.shape[leading + 1 :].numel()
            matrices = numbers.view(-1, rows, columns)
            filled = _filled(rows), _filled(columns)
            by_size.setdefault(filled, []).extend(matrices)
        self.batches: list[_Batch] = []
        places: list[Tensor] = []  # of each number in the parameters; the last is a zero
        start = 0
        for (rows, columns), several in by_size.items():
            shape = (len(several), rows, columns)
            block = torch.full(shape, total)
            for filled_up, matrix in zip(block, several, strict=True):
                filled_up[: matrix.shape[0], : matrix.shape[1]] = matrix
            true = torch.tensor([matrix.shape for matrix in several], device=device)
            self.batches.append(_Batch(start, shape, true))
            places.append(block.flatten())
            start += block.numel()
        places += rest
        self._rest = slice(start, None)
        self._places = torch.cat(places).to(device)
        back = self._places.new_empty(total + 1)
        back[self._places] = torch.arange(len(self._places), device=device)
        self._back = back[:-1]
        self._zero = parameters[0].new_zeros(1)
        self._apart = parameters[0].new_empty(total)
        parts = zip(self._apart.split(sizes), parameters, strict=True)
        self._parts = [part.view(p.shape) for part, p in parts]

    def laid_out(self, values: list[Tensor]) -> Tensor:
        """The numbers of tensors of the parameters' shapes, laid out, with the zeros."""
        numbers = torch.cat([*(value.flatten() for value in values), self._zero])
        return numbers.index_select(0, self._places)

    def taken_apart(self, numbers: Tensor) -> list[Tensor]:
        """The tensors of the parameters' shapes, in memory that the next call takes again."""
        torch.index_select(numbers, 0, self._back, out=self._apart)
        return self._parts

    def turned(self, numbers: Tensor, bases: list[Any], back: bool = False) -> Tensor:
        """The matrices in their bases, or back from there; the rest as it is."""
        found = torch.empty_like(numbers)
        found[self._rest] = numbers[self._rest]
        for batch, (left, right) in zip(self.batches, bases, strict=True):
            if back:
                left, right = left.mT, right.mT
            torch.bmm(left.mT @ batch.of(numbers), right, out=batch.of(found))
        return found


def _filled(size: int) -> int:
    """The next power of two, from the smallest on."""
    return max(SMALLEST, 1 << (size - 1).bit_length())
