"""One-step methods: RK4, and one that stays stable where damping outweighs inertia."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from pinn_dyn.mechanics.compilation import compile_loop
from pinn_dyn.mechanics.trajectory import Interpolation

Integrator = Literal["rk4", "rosenbrock"]
Derivative = Callable[[Tensor, Tensor], Tensor]
"""Maps a state ``(*batch, S)`` and an input ``(*batch, M)`` to dx/dt ``(*batch, S)``."""

# Steps whose inputs are laid out at once: bounds the memory of large batches. A compiled loop
# takes so many.
_BLOCK = 64


@dataclass(frozen=True)
class Scheme:
    """A one-step method for increments: the step itself, and where in it the input is needed.

    Attributes:
        nodes: times of the stages in a step, from 0 to 1.
        step: the increment after a step, ``(*batch, S)``, from the one before, the initial state,
            the inputs at the nodes ``(stages, *batch, M)`` and the length h, s.
        mean_input: shift the inputs at the nodes of a step so that their mean is that of the input
            over the step, for a method whose steps are longer than a sample.
    """

    nodes: tuple[float, ...]
    step: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
    mean_input: bool = field(default=False, kw_only=True)

    def steps(self, increment: Tensor, start: Tensor, inputs: Tensor, lengths: Tensor) -> Tensor:
        """Increments after each of T steps, ``(T, *batch, S)``.

        Args:
            increment: the one before, ``(*batch, S)``.
            start: the initial state, ``(*batch, S)``.
            inputs: the inputs at the nodes, ``(T, stages, *batch, M)``.
            lengths: of the steps, ``(T,)``, s.
        """
        increments = []
        for stages, h in zip(inputs, lengths, strict=True):
            increment = self.step(increment, start, stages, h)
            increments.append(increment)
        return torch.stack(increments)


@dataclass(frozen=True)
class CompiledScheme(Scheme):
    """A method whose steps are one compiled loop.

    Attributes:
        loop: ``_BLOCK`` steps, from the arguments of :meth:`steps`.
    """

    loop: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]

    def steps(self, increment: Tensor, start: Tensor, inputs: Tensor, lengths: Tensor) -> Tensor:
        """Increments after each of at most ``_BLOCK`` steps; those that lack have no length."""
        taken = lengths.shape[0]
        last = inputs[-1:].expand(_BLOCK - taken, *inputs.shape[1:])
        lengths = F.pad(lengths, (0, _BLOCK - taken))
        return self.loop(increment, start, torch.cat([inputs, last]), lengths)[:taken]


def rk4(derivative: Derivative) -> Scheme:
    """The four-stage, fourth-order 3/8 rule::

        k1 = f(x, u(t))                       k2 = f(x + h k1/3, u(t + h/3))
        k3 = f(x + h (k2 - k1/3), u(t + 2h/3))   k4 = f(x + h (k1 - k2 + k3), u(t + h))
        x(t + h) = x + h (k1 + 3 k2 + 3 k3 + k4)/8

    It has the same numbers as torchdiffeq's ``rk4``, up to rounding.
    """

    def step(increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor) -> Tensor:
        first = derivative(start + increment, inputs[0])
        second = derivative(start + (increment + h * first / 3), inputs[1])
        third = derivative(start + (increment + h * (second - first / 3)), inputs[2])
        fourth = derivative(start + (increment + h * (first - second + third)), inputs[3])
        return increment + h * (first + 3 * (second + third) + fourth) / 8

    return Scheme((0.0, 1 / 3, 2 / 3, 1.0), step)


def rosenbrock(
    derivative: Derivative, implicit_solver: Callable[[Tensor, Tensor], Callable[[Tensor], Tensor]]
) -> Scheme:
    """The linearly implicit, second-order method ROS2 with g = 1 - 1/sqrt(2)::

        (1 - g h J) k1 = f(x, u(t))
        (1 - g h J) k2 = f(x + h k1, u(t + h)) - 2 k1
        x(t + h) = x + h (3 k1 + k2)/2

    It has its order for any J, and with J = df/dx it is L-stable: what decays far faster than a
    step lasts is damped, where an explicit method would blow up. J only has to hold what is
    stiff. Two evaluations of f and two linear solves a step. Verwer, Spee, Blom and Hundsdorfer
    (1999), "A second-order Rosenbrock method applied to photochemical dispersion problems".

    A step may span many samples of u. With m the mean of u over the step, both stages take
    ``u + m - (u(t) + u(t + h))/2``, so that no impulse of the input is lost between them: a motion
    that follows the rates of motors adds up to where the motors went. The shift is of order h^2,
    and zero where u is linear over the step.

    Args:
        derivative: f.
        implicit_solver: from x ``(*batch, S)`` and s a function, of r ``(*batch, S)`` the k that
            solves (1 - s J(x)) k = r.
    """
    gamma = 1 - 1 / math.sqrt(2)

    def step(increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor) -> Tensor:
        x = start + increment
        solve = implicit_solver(x, gamma * h)
        first = solve(derivative(x, inputs[0]))
        ahead = derivative(start + (increment + h * first), inputs[1])
        second = solve(ahead - 2 * first)
        return increment + h * (1.5 * first + 0.5 * second)

    return Scheme((0.0, 1.0), step, mean_input=True)


def take_steps(
    scheme: Scheme,
    x0: Tensor,
    grid: Tensor,
    t_input: Tensor,
    u: Tensor,
    interpolation: Interpolation,
) -> Tensor:
    """Increments x(t_k) - x(t_0), ``(T, *batch, S)``, one step per interval of the grid.

    Args:
        scheme: the method, with the system in it.
        x0: initial state, ``(*batch, S)``.
        grid: times of the steps, ``(T,)``, s.
        t_input: times of the input samples, ``(K,)``, s.
        u: input samples, ``(*batch, K, M)``.
        interpolation: how u moves between its samples.
    """
    samples = u.movedim(-2, 0)
    lengths = grid.diff()
    if scheme.mean_input:
        means = input_means(grid, t_input, samples, interpolation)
    blocks = [torch.zeros_like(x0)[None]]
    for begin in range(0, grid.shape[0] - 1, _BLOCK):
        block = grid[begin : begin + _BLOCK + 1]
        inputs = stage_inputs(block, t_input, samples, interpolation, scheme.nodes)
        if scheme.mean_input:
            inputs = inputs + (means[begin : begin + _BLOCK] - inputs.mean(1)).unsqueeze(1)
        some = lengths[begin : begin + _BLOCK]
        blocks.append(scheme.steps(blocks[-1][-1], x0, inputs, some))
    return torch.cat(blocks)


def compiled_scheme(scheme: Scheme, x0: Tensor, u: Tensor) -> CompiledScheme:
    """The scheme with its steps as one compiled loop, without gradients, in C++ throughout.

    Without the thousands of small operations of a long roll-out. Compiling takes half a minute to a
    minute for a new model, some 15 s for one of the same shape (the compiler's cache on disk).

    Args:
        scheme: the method, with the system in it.
        x0, u: a state ``(*batch, S)`` and input samples ``(*batch, K, M)`` of the shapes to come.
    """
    inputs = u[..., 0, :].expand(_BLOCK, len(scheme.nodes), *u.shape[:-2], u.shape[-1])
    arguments = (inputs.contiguous(), x0.new_zeros(_BLOCK))
    loop = compile_loop(scheme.step, torch.zeros_like(x0), x0, arguments)
    return CompiledScheme(scheme.nodes, scheme.step, loop, mean_input=scheme.mean_input)


def stage_inputs(
    grid: Tensor,
    t_input: Tensor,
    samples: Tensor,
    interpolation: Interpolation,
    nodes: tuple[float, ...],
) -> Tensor:
    """The inputs at the stages of each step, ``(T - 1, stages, *batch, M)``.

    With ``"hold"`` a stage at the end of a step still has the input of the step, not the one that
    begins there.

    Args:
        grid: times of the steps, ``(T,)``, s.
        t_input: times of the input samples, ``(K,)``, s.
        samples: input samples, ``(K, *batch, M)``.
        interpolation: how u moves between its samples.
        nodes: times of the stages in a step, from 0 to 1; the last is 1.
    """
    start, end = grid[:-1], grid[1:]
    inner = [torch.lerp(start, end, node) for node in nodes[:-1]]
    times = torch.stack([*inner, end], dim=-1)
    last = t_input.shape[0] - 1
    index = torch.searchsorted(t_input, times, right=True) - 1
    if interpolation == "hold":
        index[:, -1] = torch.searchsorted(t_input, end) - 1
        return samples[index.clamp(0, last)]
    index = index.clamp(0, max(last - 1, 0))
    following = (index + 1).clamp(max=last)
    span = t_input[following] - t_input[index]
    weight = ((times - t_input[index]) / span).clamp(0, 1) if last else torch.zeros_like(times)
    shape = (*weight.shape, *[1] * (samples.ndim - 1))
    return torch.lerp(samples[index], samples[following], weight.reshape(shape).to(samples))


def input_means(
    grid: Tensor, t_input: Tensor, samples: Tensor, interpolation: Interpolation
) -> Tensor:
    """The mean of the input over each step, ``(T - 1, *batch, M)``.

    Args:
        grid: times of the steps, ``(T,)``, s.
        t_input: times of the input samples, ``(K,)``, s.
        samples: input samples, ``(K, *batch, M)``; the first and the last hold beyond the ends.
        interpolation: how u moves between its samples.
    """

    def beside(times: Tensor) -> Tensor:
        return times.reshape(-1, *[1] * (samples.ndim - 1)).to(samples)

    # The integral up to each time of the grid: whole intervals of samples, and a part of one.
    index = (torch.searchsorted(t_input, grid, right=True) - 1).clamp(min=0)
    elapsed = grid - t_input[index]
    if interpolation == "hold":
        areas, height = samples[:-1], samples[index]
    else:
        areas = (samples[:-1] + samples[1:]) / 2
        following = (index + 1).clamp(max=t_input.shape[0] - 1)
        span = t_input[following] - t_input[index]
        share = torch.where(span > 0, elapsed.clamp(min=0) / span, 0.0)
        height = torch.lerp(samples[index], samples[following], beside(share) / 2)
    whole = torch.cat([torch.zeros_like(samples[:1]), areas * beside(t_input.diff())]).cumsum(0)
    integral = whole[index] + height * beside(elapsed)
    return integral.diff(dim=0) / beside(grid.diff())
