"""The paper's training in JAX: its networks, its loss, second derivatives by autodiff.

From the text and the first table of the paper: M, V, D and A from softplus networks of 32 x 3,
5 x 3, 16 x 2 and 16 x 2 (width x depth) of the raw q, M = L L^T with a small shift in L_ii::

    Lagrangian    a = (d2L/dv2)^-1 (dL/dq - (d2L/dv dq) v + A u - D v),   L = v^T M v / 2 - V
    Hamiltonian   dq/dt = dH/dp,  dp/dt = -dH/dq - D dH/dp + A u,   H = p^T M^-1 p / 2 + V

one RK4 step over a pair of neighbouring samples, the squared error of v (of q and p) as it is,
AdamW. The paper gives neither batch size nor learning rate: they are arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax_networks import Parameters, mlp

EPSILON = 1e-3
Derivative = Callable[[Parameters, Array, Array], Array]


def initial(size: int, inputs: int, seed: int) -> Parameters:
    """Glorot-normal weights, zero biases."""
    key = jax.random.key(seed)
    triangle = size * (size + 1) // 2
    shapes = {
        "mass": (32, 32, 32, triangle),
        "potential": (5, 5, 5, 1),
        "damping": (16, 16, triangle),
        "input": (16, 16, size * inputs),
    }
    parameters: Parameters = {}
    for name, widths in shapes.items():
        parameters[name] = []
        for rows, columns in zip((size, *widths), widths, strict=False):
            key, draw = jax.random.split(key)
            weight = jax.nn.initializers.glorot_normal()(draw, (rows, columns))
            parameters[name].append((weight, jnp.zeros(columns)))
    return parameters


def _positive(layers: Any, q: Array) -> Array:
    """L L^T for one sample."""
    size, y = q.shape[0], mlp(layers, q)
    factor = jnp.diag(jax.nn.softplus(y[:size]) + EPSILON)
    factor = factor.at[jnp.tril_indices(size, -1)].set(y[size:])
    return factor @ factor.T


def _outer_force(p: Parameters, q: Array, v: Array, u: Array) -> Array:
    matrix = mlp(p["input"], q).reshape(q.shape[0], u.shape[0])
    return matrix @ u - _positive(p["damping"], q) @ v


def lagrangian(p: Parameters, x: Array, u: Array) -> Array:
    """d(q, v)/dt of one sample."""

    def function(q: Array, v: Array) -> Array:
        return 0.5 * v @ _positive(p["mass"], q) @ v - mlp(p["potential"], q)[0]

    q, v = jnp.split(x, 2)
    mass = jax.hessian(function, 1)(q, v)
    mixed = jax.jacfwd(jax.grad(function, 1), 0)(q, v)
    force = jax.grad(function, 0)(q, v) - mixed @ v + _outer_force(p, q, v, u)
    return jnp.concatenate([v, jnp.linalg.inv(mass) @ force])


def hamiltonian(p: Parameters, x: Array, u: Array) -> Array:
    """d(q, p)/dt of one sample."""

    def function(q: Array, momentum: Array) -> Array:
        inverse = jnp.linalg.inv(_positive(p["mass"], q))
        return 0.5 * momentum @ inverse @ momentum + mlp(p["potential"], q)[0]

    q, momentum = jnp.split(x, 2)
    rate, slope = jax.grad(function, 1)(q, momentum), jax.grad(function, 0)(q, momentum)
    return jnp.concatenate([rate, _outer_force(p, q, rate, u) - slope])


def step(f: Derivative, p: Parameters, x: Array, first: Array, last: Array, h: float) -> Array:
    """x after a classic RK4 step, for a batch; u goes from first to last."""
    rate = jax.vmap(lambda x, u: f(p, x, u))
    half = 0.5 * (first + last)
    k1 = rate(x, first)
    k2 = rate(x + h / 2 * k1, half)
    k3 = rate(x + h / 2 * k2, half)
    k4 = rate(x + h * k3, last)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def make_update(f: Derivative, h: float, exact: int, rate: float) -> Callable[..., Any]:
    """One jitted step of AdamW (optax's defaults); the first ``exact`` entries are not compared."""

    def loss(p: Parameters, batch: Sequence[Array]) -> Array:
        x, first, last, after = batch
        residual = step(f, p, x, first, last, h) - after
        return jnp.mean((residual[:, exact:] ** 2).sum(-1))

    @jax.jit
    def update(p: Any, state: Any, data: Sequence[Array], index: Array) -> Any:
        gradient = jax.grad(loss)(p, [values[index] for values in data])
        mean, square, count = state
        count = count + 1
        mean = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, mean, gradient)
        square = jax.tree.map(lambda s, g: 0.999 * s + 0.001 * g * g, square, gradient)

        def moved(w: Array, m: Array, s: Array) -> Array:
            scaled = m / (1 - 0.9**count) / (jnp.sqrt(s / (1 - 0.999**count)) + 1e-8)
            return w - rate * (scaled + 1e-4 * w)

        return jax.tree.map(moved, p, mean, square), (mean, square, count)

    return update


def adam_state(p: Parameters) -> Any:
    """Moments and count before the first step."""
    zero = jax.tree.map(jnp.zeros_like, p)
    return zero, zero, jnp.zeros((), jnp.int32)


def make_roll_out(f: Derivative, h: float) -> Callable[..., Array]:
    """States ``(T, K, 2N)`` from x0 ``(K, 2N)`` under u ``(T, K, M)``, jitted."""

    @jax.jit
    def roll_out(p: Parameters, x0: Array, u: Array) -> Array:
        def advance(x: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            after = step(f, p, x, *ends, h)
            return after, after

        path = jax.lax.scan(advance, x0, (u[:-1], u[1:]))[1]
        return jnp.concatenate([x0[None], path])

    return roll_out
