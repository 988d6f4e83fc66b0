"""Multilayer perceptron with explicit tangent and reverse passes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Literal, cast

import torch
import torch.nn.functional as F
from pydantic import NonNegativeInt, PositiveInt
from torch import Tensor, nn

Tape = tuple[Tensor, ...]
"""Slopes of the features and of the hidden activations, for the reverse pass."""


def _softplus(z: Tensor) -> tuple[Tensor, Tensor]:
    return F.softplus(z), torch.sigmoid(z)


def _tanh(z: Tensor) -> tuple[Tensor, Tensor]:
    y = torch.tanh(z)
    return y, 1 - y * y


def _silu(z: Tensor) -> tuple[Tensor, Tensor]:
    s = torch.sigmoid(z)
    return z * s, s * (1 + z * (1 - s))


Activation = Literal["softplus", "tanh", "silu"]
"""Name of a smooth activation. ReLU is excluded, since training needs two derivatives."""

ACTIVATIONS: dict[Activation, Callable[[Tensor], tuple[Tensor, Tensor]]] = {
    "softplus": _softplus,
    "tanh": _tanh,
    "silu": _silu,
}
"""Functions that return the value and slope of each activation."""


class MLP(nn.Module):
    """y = W_n s(... s(W_1 z + b_1) ...) + b_n, with z = (x - mean)/std.

    The features of an angle x_i are sin(x_i) and cos(x_i). With ``limits``, the features of all
    other entries are z = (c - mean)/std + tanh((x - c)/std), with c = x clipped to its limits. They
    are at most one standard deviation beyond the limits, and twice continuously differentiable.

    With ``after``, masked weights W_k make the output y_o depend only on the entries x_i with
    i > after_o (Germain et al. 2015, "MADE").

    With J = dy/dx, :meth:`linearize_along` returns y and J dx, and :meth:`pullback` returns J^T dy.
    Both are differentiable.

    Args:
        inputs, outputs: sizes of x and y.
        hidden, activation: widths and activation of the hidden layers.
        mean, std: normalization of x, ``(inputs,)``. The default is no normalization.
        angles: positions of the angles in x.
        after: a position per output, see above. By default, all outputs depend on all inputs.
        limits: smallest and largest x in the data, ``(inputs,)`` each. The default is no limits.

    Raises:
        ValueError: if ``after`` needs wider hidden layers.
    """

    mean: Tensor
    std: Tensor
    limits: Tensor | None
    is_angle: Tensor

    def __init__(
        self,
        inputs: int,
        outputs: int,
        hidden: Sequence[PositiveInt],
        activation: Activation = "softplus",
        mean: Tensor | None = None,
        std: Tensor | None = None,
        angles: Sequence[NonNegativeInt] = (),
        after: Sequence[int] | None = None,
        limits: tuple[Tensor, Tensor] | None = None,
    ):
        super().__init__()
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
        self._masked = after is not None
        if after is not None:
            self._mask(inputs, after)
        self.register_buffer("mean", torch.zeros(inputs) if mean is None else mean.float())
        self.register_buffer("std", torch.ones(inputs) if std is None else std.float())
        if len(set(angles)) == inputs:
            limits = None
        self.register_buffer("limits", None if limits is None else torch.stack(limits).float())

    @property
    def linears(self) -> list[nn.Linear]:
        """Layers from input to output."""
        return cast("list[nn.Linear]", list(self.layers))

    def _mask(self, inputs: int, after: Sequence[int]) -> None:
        """Register masks for the weights, and scale the initial weights to compensate."""
        # Each unit reads the entries of x from a first entry on. The number of units with the first
        # entry x_i is proportional to the number of entries from x_i on.
        first = torch.arange(inputs).repeat(2 if self._has_angles else 1)
        share = torch.arange(inputs - 1, 0, -1).cumsum(0).double()
        masks = []
        for layer in self.linears[:-1]:
            width = layer.out_features
            position = (torch.arange(width) + 0.5) / width * inputs * (inputs - 1) / 2
            below, first = first, 1 + torch.searchsorted(share, position.double())
            masks.append(below >= first[:, None])
            if set(first.tolist()) < set(range(1, inputs)):
                raise ValueError(
                    f"hidden has a layer of {width} units, expected at least "
                    f"{inputs * (inputs - 1) // 2} for a chain"
                )
        masks.append(first > torch.tensor(after)[:, None])
        for k, (layer, mask) in enumerate(zip(self.linears, masks, strict=True)):
            self.register_buffer(f"mask_{k}", mask.float(), persistent=False)
            with torch.no_grad():
                read = mask.sum(1, keepdim=True).clamp(min=1)
                layer.weight.mul_((mask.shape[1] / read).sqrt())

    def _layers(self) -> list[tuple[Tensor, Tensor]]:
        """Return weights ``(a, b)``, masked by ``after``, and biases ``(a,)``."""
        layers: list[tuple[Tensor, Tensor]] = [(layer.weight, layer.bias) for layer in self.linears]
        if not self._masked:
            return layers
        return [(w * self.get_buffer(f"mask_{k}"), b) for k, (w, b) in enumerate(layers)]

    def forward(self, x: Tensor) -> Tensor:
        """Return y, ``(*batch, outputs)``, at x ``(*batch, inputs)``."""
        h = rows(self._features(columns(x))[0], x)
        *hidden, last = self._layers()
        for weight, bias in hidden:
            h, _ = self._activation(F.linear(h, weight, bias))
        return F.linear(h, *last)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tape]:
        """Return y and the tape that :meth:`pullback` needs."""
        h, slopes = self._features(columns(x))
        tape = [slopes]
        *hidden, (last, last_bias) = self._layers()
        for weight, bias in hidden:
            h, slope = self._activation(torch.addmm(bias[:, None], weight, h))
            tape.append(slope)
        return rows(torch.addmm(last_bias[:, None], last, h), x), tuple(tape)

    def linearize_along(self, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor, Tape]:
        """Return y, J dx and the tape in one pass."""
        features, slopes = self._features(columns(x))
        tangent = columns(dx).repeat(2 if self._has_angles else 1, 1) * slopes
        tape = [slopes]
        *hidden, (last, last_bias) = self._layers()
        for weight, bias in hidden:
            z, dz = _side_by_side(weight, features, tangent)
            features, slope = self._activation(z + bias[:, None])
            tangent = slope * dz
            tape.append(slope)
        y, dy = _side_by_side(last, features, tangent)
        return rows(y + last_bias[:, None], x), rows(dy, x), tuple(tape)

    def pullback(self, tape: Tape, dy: Tensor) -> Tensor:
        """Return J^T dy, ``(*batch, inputs)``, for a cotangent dy ``(*batch, outputs)``."""
        *hidden, last = (weight for weight, _ in self._layers())
        first, *slopes = tape
        h = columns(dy)
        # Avoid ones(B, 1) @ W, for which Inductor (torch 2.13) compiles a wrong gradient.
        h = last.T * h if last.shape[0] == 1 else last.T @ h
        for weight, slope in zip(reversed(hidden), reversed(slopes), strict=True):
            h = weight.T @ (h * slope)
        h = h * first
        if self._has_angles:
            sine_or_linear, cosine = h.chunk(2)
            h = sine_or_linear + cosine
        return rows(h, dy)

    def _features(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the features of x ``(inputs, B)`` and their slopes in x, each ``(n, B)``."""
        mean, std = self.mean[:, None], self.std[:, None]
        if self.limits is None:
            z, slope = (x - mean) / std, (1 / std).expand_as(x)
        else:
            clipped = x.clamp(*self.limits[..., None])
            beyond = torch.tanh((x - clipped) / std)
            z, slope = (clipped - mean) / std + beyond, (1 - beyond * beyond) / std
        if not self._has_angles:
            return z, slope
        # Without indexing, each entry has two features: z or sin(x), and 0 or cos(x).
        is_angle, zero = self.is_angle[:, None], torch.zeros_like(x)
        sine, cosine = torch.sin(x), torch.cos(x)
        features = [torch.where(is_angle, sine, z), torch.where(is_angle, cosine, zero)]
        slopes = [torch.where(is_angle, cosine, slope), torch.where(is_angle, -sine, zero)]
        return torch.cat(features), torch.cat(slopes)


def _side_by_side(weight: Tensor, h: Tensor, dh: Tensor) -> tuple[Tensor, Tensor]:
    both = weight @ torch.stack([h, dh], dim=1).flatten(1)
    value, tangent = both.unflatten(1, (2, -1)).unbind(1)
    return value, tangent


def columns(x: Tensor) -> Tensor:
    """Return ``(*batch, n)`` as a view ``(n, B)``, for operations along the batch."""
    return x.reshape(-1, x.shape[-1]).T


def rows(column: Tensor, like: Tensor) -> Tensor:
    """Return ``(n, B)`` as a view ``(*batch, n)``, with the batch of ``like`` ``(*batch, k)``."""
    return column.T.reshape(*like.shape[:-1], column.shape[0])
