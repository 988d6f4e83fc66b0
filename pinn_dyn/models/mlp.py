"""A multilayer perceptron with explicit tangent and reverse passes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Tape = tuple[Tensor, ...]
"""Slopes of the hidden activations at one input, kept for the tangent and reverse passes."""


def _softplus(z: Tensor) -> tuple[Tensor, Tensor]:
    return F.softplus(z), torch.sigmoid(z)


def _tanh(z: Tensor) -> tuple[Tensor, Tensor]:
    y = torch.tanh(z)
    return y, 1 - y * y


def _silu(z: Tensor) -> tuple[Tensor, Tensor]:
    s = torch.sigmoid(z)
    return z * s, s * (1 + z * (1 - s))


ACTIVATIONS: dict[str, Callable[[Tensor], tuple[Tensor, Tensor]]] = {
    "softplus": _softplus,
    "tanh": _tanh,
    "silu": _silu,
}
"""Smooth activations, each as (value, slope); dynamics need two derivatives, so no ReLU here."""


class MLP(nn.Module):
    """y = W_n s(... s(W_1 z + b_1) ...) + b_n, with z = (x - mean)/std.

    An entry x_i that is an angle goes in as sin(x_i) and cos(x_i) instead, so that y has its
    period of 2 pi.

    :meth:`linearize` runs the network once and keeps the slopes of its activations; from these
    :meth:`pushforward` gives J dx (tangent pass) and :meth:`pullback` J^T dy (reverse pass), as
    ordinary tensor operations: they can be differentiated again and compiled.

    Args:
        inputs: size of x.
        outputs: size of y.
        hidden: widths of the hidden layers.
        activation: one of softplus, tanh, silu.
        mean, std: normalization of x, ``(inputs,)``; none if left out.
        angles: positions of the angles in x.

    Raises:
        ValueError: on an unknown activation, widths below 1, or a position that x does not have.
    """

    mean: Tensor
    std: Tensor
    is_angle: Tensor

    def __init__(
        self,
        inputs: int,
        outputs: int,
        hidden: Sequence[int],
        activation: str = "softplus",
        mean: Tensor | None = None,
        std: Tensor | None = None,
        angles: Sequence[int] = (),
    ):
        super().__init__()
        if activation not in ACTIVATIONS:
            raise ValueError(
                f"activation is {activation!r}, expected one of {', '.join(ACTIVATIONS)}"
            )
        if any(width < 1 for width in hidden):
            raise ValueError(f"hidden is {list(hidden)}, expected widths of at least 1")
        if any(not 0 <= index < inputs for index in angles):
            raise ValueError(f"angles is {list(angles)}, expected positions from 0 to {inputs - 1}")
        self._activation = ACTIVATIONS[activation]
        self._has_angles = len(angles) > 0
        is_angle = torch.zeros(inputs, dtype=torch.bool)
        is_angle[list(angles)] = True
        self.register_buffer("is_angle", is_angle, persistent=False)
        sizes = [2 * inputs if angles else inputs, *hidden, outputs]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        for layer in self.linears:
            nn.init.xavier_normal_(layer.weight)
            nn.init.zeros_(layer.bias)
        self.register_buffer("mean", torch.zeros(inputs) if mean is None else mean.float())
        self.register_buffer("std", torch.ones(inputs) if std is None else std.float())

    @property
    def linears(self) -> list[nn.Linear]:
        """The layers, from input to output."""
        return cast("list[nn.Linear]", list(self.layers))

    def forward(self, x: Tensor) -> Tensor:
        """y, ``(*batch, outputs)``, at x ``(*batch, inputs)``."""
        h = (x - self.mean) / self.std
        if self._has_angles:
            cosine = torch.cos(x).masked_fill(~self.is_angle, 0.0)
            h = torch.cat([torch.where(self.is_angle, torch.sin(x), h), cosine], dim=-1)
        *hidden, last = self.linears
        for layer in hidden:
            h, _ = self._activation(layer(h))
        return last(h)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tape]:
        """y and the tape that :meth:`pushforward` and :meth:`pullback` need."""
        h, slopes = self._features(columns(x))
        tape = [slopes] if slopes is not None else []
        *hidden, last = self.linears
        for layer in hidden:
            h, slope = self._activation(torch.addmm(layer.bias[:, None], layer.weight, h))
            tape.append(slope)
        return rows(torch.addmm(last.bias[:, None], last.weight, h), x), tuple(tape)

    def linearize_along(self, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor, Tape]:
        """y, J dx and the tape: :meth:`linearize` and :meth:`pushforward` in one pass.

        Both meet every layer side by side, as one product of twice as many columns.
        """
        features, slopes = self._features(columns(x))
        tangent = self._tangent(columns(dx), slopes)
        tape = [slopes] if slopes is not None else []
        *hidden, last = self.linears
        for layer in hidden:
            z, dz = _side_by_side(layer.weight, features, tangent)
            features, slope = self._activation(z + layer.bias[:, None])
            tangent = slope * dz
            tape.append(slope)
        y, dy = _side_by_side(last.weight, features, tangent)
        return rows(y + last.bias[:, None], x), rows(dy, x), tuple(tape)

    def pushforward(self, tape: Tape, dx: Tensor) -> Tensor:
        """J dx, ``(*batch, outputs)``, for a tangent dx ``(*batch, inputs)``."""
        *hidden, last = self.linears
        slopes, tape = (tape[0], tape[1:]) if self._has_angles else (None, tape)
        h = self._tangent(columns(dx), slopes)
        for layer, slope in zip(hidden, tape, strict=True):
            h = (layer.weight @ h) * slope
        return rows(last.weight @ h, dx)

    def pullback(self, tape: Tape, dy: Tensor) -> Tensor:
        """J^T dy, ``(*batch, inputs)``, for a cotangent dy ``(*batch, outputs)``."""
        *hidden, last = self.linears
        first, rest = (tape[0], tape[1:]) if self._has_angles else (None, tape)
        h = columns(dy)
        # One output: a product of columns, not of matrices. Inductor (torch 2.13) compiles
        # ones(B, 1) @ W to a wrong gradient at some small sizes.
        h = last.weight.T * h if last.out_features == 1 else last.weight.T @ h
        for layer, slope in zip(reversed(hidden), reversed(rest), strict=True):
            h = layer.weight.T @ (h * slope)
        if first is None:
            return rows(h / self.std[:, None], dy)
        sine_or_linear, cosine = (h * first).chunk(2)
        return rows(sine_or_linear + cosine, dy)

    def _features(self, column: Tensor) -> tuple[Tensor, Tensor | None]:
        """What the first layer sees of x, ``(n, B)``, and its slopes in x where x has angles."""
        z = (column - self.mean[:, None]) / self.std[:, None]
        if not self._has_angles:
            return z, None
        # Twice as many features as entries: z or sin(x), and 0 or cos(x); no indexing.
        is_angle, zero = self.is_angle[:, None], torch.zeros_like(column)
        sine, cosine = torch.sin(column), torch.cos(column)
        slope = (1 / self.std[:, None]).expand_as(column)
        features = [torch.where(is_angle, sine, z), torch.where(is_angle, cosine, zero)]
        slopes = [torch.where(is_angle, cosine, slope), torch.where(is_angle, -sine, zero)]
        return torch.cat(features), torch.cat(slopes)

    def _tangent(self, dx: Tensor, slopes: Tensor | None) -> Tensor:
        """What the first layer sees of a tangent dx, ``(n, B)``."""
        return dx / self.std[:, None] if slopes is None else torch.cat([dx, dx]) * slopes


def _side_by_side(weight: Tensor, h: Tensor, dh: Tensor) -> tuple[Tensor, Tensor]:
    """W h and W dh, each ``(n, B)``, by one product."""
    both = weight @ torch.stack([h, dh], dim=1).flatten(1)
    value, tangent = both.unflatten(1, (2, -1)).unbind(1)
    return value, tangent


def columns(x: Tensor) -> Tensor:
    """``(*batch, n)`` as ``(n, B)``, a view: the layout in which the passes compute.

    With the batch along memory every product of small matrices and every triangular solve becomes
    a few operations on long vectors.
    """
    return x.reshape(-1, x.shape[-1]).T


def rows(column: Tensor, like: Tensor) -> Tensor:
    """``(n, B)`` as ``(*batch, n)``, a view; the batch is that of ``like`` ``(*batch, k)``."""
    return column.T.reshape(*like.shape[:-1], column.shape[0])
