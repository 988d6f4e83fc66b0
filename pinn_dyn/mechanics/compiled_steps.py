"""Long roll-outs without gradients: RK4 by one compiled function per step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from pinn_dyn.mechanics.trajectory import Interpolation

# Steps whose inputs are laid out at once: bounds the memory of large batches.
_BLOCK = 64


def compiled_rk4(
    derivative: Callable[[Tensor, Tensor], Tensor],
    x0: Tensor,
    grid: Tensor,
    t_input: Tensor,
    u: Tensor,
    interpolation: Interpolation,
) -> Tensor:
    """Increments x(t_k) - x(t_0), ``(T, *batch, S)``, by the 3/8 rule::

        k1 = f(x, u(t))                       k2 = f(x + h k1/3, u(t + h/3))
        k3 = f(x + h (k2 - k1/3), u(t + 2h/3))   k4 = f(x + h (k1 - k2 + k3), u(t + h))
        x(t + h) = x + h (k1 + 3 k2 + 3 k3 + k4)/8

    The same numbers as torchdiffeq's ``rk4``, up to rounding, without its thousands of small
    operations: the four evaluations of f are one compiled function, in C++ throughout. Compiling
    takes some 20 s for a new model, a few seconds for one of the same shape (the compiler's cache
    on disk).

    Args:
        derivative: f, maps ``(*batch, S)`` and ``(*batch, M)`` to ``(*batch, S)``.
        x0: initial state, ``(*batch, S)``.
        grid: times of the steps, ``(T,)``, s.
        t_input: times of the input samples, ``(K,)``, s.
        u: input samples, ``(*batch, K, M)``.
        interpolation: how u moves between its samples.
    """

    def step(increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor) -> Tensor:
        first = derivative(start + increment, inputs[0])
        second = derivative(start + (increment + h * first / 3), inputs[1])
        third = derivative(start + (increment + h * (second - first / 3)), inputs[2])
        fourth = derivative(start + (increment + h * (first - second + third)), inputs[3])
        return increment + h * (first + 3 * (second + third) + fourth) / 8

    samples = u.movedim(-2, 0)
    lengths = grid.diff()
    increments = x0.new_zeros((grid.shape[0], *x0.shape))
    increment = torch.zeros_like(x0)
    with torch.no_grad():
        first = stage_inputs(grid[:2], t_input, samples, interpolation)[0]
        compiled = _compile(step, (increment, x0, first, lengths[0]))
        for begin in range(0, grid.shape[0] - 1, _BLOCK):
            inputs = stage_inputs(grid[begin : begin + _BLOCK + 1], t_input, samples, interpolation)
            for k, (stages, h) in enumerate(zip(inputs, lengths[begin:], strict=False), begin + 1):
                increment = compiled(increment, x0, stages, h)
                increments[k] = increment
    return increments


def _compile(
    function: Callable[..., Tensor], arguments: tuple[Tensor, ...]
) -> Callable[..., Tensor]:
    """The function, compiled for arguments of these shapes alone."""
    graph = make_fx(function, _COLUMNS_AS_ROWS)(*arguments)
    options: dict[str, Any] = {
        # Shapes and model stay the same within a roll-out: nothing to check at each step.
        "guard_filter_fn": torch.compiler.skip_all_guards_unsafe,
        "cpp_wrapper": True,
        "post_grad_fusion_options": {"decompose_mm_pass": {}},
    }
    # graph.forward is code of its own: nothing compiled for another model is taken for it.
    return torch.compile(graph.forward, dynamic=False, options=options)


def _mm(a: Tensor, b: Tensor) -> Tensor:
    """W h of a single column h as (h^T W^T)^T."""
    if b.shape[1] > 1 or a.shape[0] == 1:
        return NotImplemented
    return (b.T @ a.T).T


def _addmm(bias: Tensor, a: Tensor, b: Tensor) -> Tensor:
    product = _mm(a, b)
    return product if product is NotImplemented else bias + product


# The compiler turns products with a single row into loops that it fuses with their neighbours.
_COLUMNS_AS_ROWS: dict[Any, Callable[..., Any]] = {
    torch.ops.aten.mm.default: _mm,
    torch.ops.aten.addmm.default: _addmm,
}


def stage_inputs(
    grid: Tensor, t_input: Tensor, samples: Tensor, interpolation: Interpolation
) -> Tensor:
    """The inputs at the four stages of each step of the 3/8 rule, ``(T - 1, 4, *batch, M)``.

    The stages are at t, t + h/3, t + 2h/3 and t + h. With ``"hold"`` the last of them still has
    the input of the step, not the one that begins there.

    Args:
        grid: times of the steps, ``(T,)``, s.
        t_input: times of the input samples, ``(K,)``, s.
        samples: input samples, ``(K, *batch, M)``.
        interpolation: how u moves between its samples.
    """
    start, end = grid[:-1], grid[1:]
    h = end - start
    times = torch.stack([start, start + h / 3, start + 2 * h / 3, end], dim=-1)
    last = t_input.shape[0] - 1
    index = torch.searchsorted(t_input, times, right=True) - 1
    if interpolation == "hold":
        index[:, 3] = torch.searchsorted(t_input, end) - 1
        return samples[index.clamp(0, last)]
    index = index.clamp(0, max(last - 1, 0))
    following = (index + 1).clamp(max=last)
    span = t_input[following] - t_input[index]
    weight = ((times - t_input[index]) / span).clamp(0, 1) if last else torch.zeros_like(times)
    shape = (*weight.shape, *[1] * (samples.ndim - 1))
    return torch.lerp(samples[index], samples[following], weight.reshape(shape).to(samples))
