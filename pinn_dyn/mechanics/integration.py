"""Roll-outs: integrate a state derivative under a sampled input."""

from __future__ import annotations

import bisect

import torch
from torch import Tensor
from torchdiffeq import odeint

from pinn_dyn.mechanics.arrays import require_finite
from pinn_dyn.mechanics.steps import Derivative, Scheme, compiled_scheme, rk4, take_steps
from pinn_dyn.mechanics.trajectory import Interpolation


class SampledInput:
    """An input known at sample times, linear or held in between.

    Args:
        t: sample times, ``(K,)``, increasing.
        u: samples, ``(*batch, K, M)``.
        interpolation: ``"linear"``, or ``"hold"`` for piecewise constant.
    """

    def __init__(self, t: Tensor, u: Tensor, interpolation: Interpolation):
        if u.ndim < 2 or u.shape[-2] != t.shape[0]:
            raise ValueError(
                f"u has shape {tuple(u.shape)}, expected (*batch, {t.shape[0]}, M): "
                f"one input for each of the {t.shape[0]} sample times"
            )
        if interpolation not in ("linear", "hold"):
            raise ValueError(f"interpolation is {interpolation!r}, expected 'linear' or 'hold'")
        # Sample index first: one row is one contiguous (*batch, M) block.
        self._u = u.movedim(-2, 0).contiguous()
        self._t = t.to(u.dtype).tolist()
        self._linear = interpolation == "linear"

    def __call__(self, time: Tensor) -> Tensor:
        """The input ``(*batch, M)`` at a time; the end samples hold outside the range."""
        now = float(time)
        last = len(self._t) - 1
        index = min(max(bisect.bisect_right(self._t, now) - 1, 0), last)
        if not self._linear or index == last:
            return self._u[index]
        weight = (now - self._t[index]) / (self._t[index + 1] - self._t[index])
        return torch.lerp(self._u[index], self._u[index + 1], max(weight, 0.0))


def rollout_increments(
    derivative: Derivative,
    x0: Tensor,
    t: Tensor,
    u: Tensor,
    *,
    t_input: Tensor | None = None,
    interpolation: Interpolation = "linear",
    substeps: int = 1,
    scheme: Scheme | None = None,
    compile: bool = False,
) -> Tensor:
    """Integrate dx/dt = f(x, u(t)) and return the increments x(t_k) - x(t_0).

    The increment, not the state, is the integrated variable: with a small step in float32 an
    increment is far below the resolution of the state it is added to.

    The method is torchdiffeq's ``rk4``, the four-stage fourth-order 3/8 rule, one step per
    interval of ``t`` (or ``substeps`` of them). With ``interpolation="hold"`` the stages at the
    ends of a step use the input of that step, not of its neighbours.

    Args:
        derivative: f, maps ``(*batch, S)`` and ``(*batch, M)`` to ``(*batch, S)``.
        x0: initial state, ``(*batch, S)``.
        t: times of the solution, ``(T,)``, s.
        u: input samples, ``(*batch, K, M)``.
        t_input: times of the input samples, ``(K,)``, s; ``t`` if None.
        interpolation: how u moves between its samples.
        substeps: steps of the integrator between two times of ``t``.
        scheme: another method, with f in it, in the place of RK4.
        compile: take the steps by one compiled loop, without gradients; pays for long
            roll-outs.

    Returns:
        Increments, ``(*batch, T, S)``; those at t_0 are zero.

    Raises:
        ValueError: on fewer than 2 times, substeps below 1, shapes that do not match, or a
            non-finite initial state.
    """
    if t.ndim != 1 or t.shape[0] < 2:
        raise ValueError(f"t has shape {tuple(t.shape)}, expected (T,) with at least 2 times")
    for name, grid_times in (("t", t), ("t_input", t if t_input is None else t_input)):
        if not bool((grid_times.diff() > 0).all()):
            raise ValueError(f"{name} must increase strictly; sort it and drop repeated times")
    if substeps < 1:
        raise ValueError(f"substeps is {substeps}, expected at least 1")
    if u.shape[:-2] != x0.shape[:-1]:
        raise ValueError(
            f"u has batch shape {tuple(u.shape[:-2])}, x0 has {tuple(x0.shape[:-1])}: "
            "expected the same batch"
        )
    require_finite("the initial state x0", x0)
    # Times count from the start, in the recording's own precision, and are cast only then.
    t_samples = (t if t_input is None else t_input) - t[0]
    t = t - t[0]

    def increment_rate(time: Tensor, increment: Tensor) -> Tensor:
        return derivative(x0 + increment, signal(time))

    grid = step_grid(t, t_samples, substeps)
    # One dtype throughout, so that the solver's times and the input's times compare exactly.
    t_samples, u, grid = t_samples.to(x0.dtype), u.to(x0.dtype), grid.to(x0.dtype)
    if compile:
        scheme = compiled_scheme(scheme or rk4(derivative), x0, u)
    if scheme is not None:
        increments = take_steps(scheme, x0, grid, t_samples, u, interpolation)
        return increments[::substeps].movedim(0, -2)
    signal = SampledInput(t_samples, u, interpolation)
    solution = odeint(
        increment_rate,
        torch.zeros_like(x0),
        grid,
        method="rk4",
        options={"perturb": interpolation == "hold"},
    )
    return solution[::substeps].movedim(0, -2)


def step_grid(t: Tensor, t_input: Tensor, substeps: int) -> Tensor:
    """Times of the integrator's steps, ``(substeps (T - 1) + 1,)``: ``substeps`` in each interval.

    A step that ends at a sample of the input, within rounding, ends at that very number: "hold"
    tells the sides apart.
    """
    if substeps == 1:
        return t
    fractions = torch.arange(substeps, dtype=t.dtype, device=t.device) / substeps
    inner = t[:-1, None] + (t[1:] - t[:-1])[:, None] * fractions
    grid = torch.cat([inner.flatten(), t[-1:]])
    right = torch.searchsorted(t_input, grid).clamp(1, t_input.shape[0] - 1)
    before, after = t_input[right - 1], t_input[right]
    nearest = torch.where(grid - before < after - grid, before, after)
    close = (grid - nearest).abs() < 1e-6 * (t[1:] - t[:-1]).min() / substeps
    return torch.where(close, nearest, grid)


def rollout(
    derivative: Derivative,
    x0: Tensor,
    t: Tensor,
    u: Tensor,
    *,
    t_input: Tensor | None = None,
    interpolation: Interpolation = "linear",
    substeps: int = 1,
) -> Tensor:
    """States x(t_k), ``(*batch, T, S)``, of dx/dt = f(x, u(t)) from ``x0``.

    The state is (q, v) or (q, p), whichever ``derivative`` takes. Arguments and errors are those
    of :func:`rollout_increments`.
    """
    increments = rollout_increments(
        derivative, x0, t, u, t_input=t_input, interpolation=interpolation, substeps=substeps
    )
    return x0.unsqueeze(-2) + increments
