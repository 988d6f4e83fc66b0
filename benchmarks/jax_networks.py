"""The rivals in JAX: the same Lagrangian network, and the paper's way to its accelerations.

Written from the equations; only weights and scales come from pinn_dyn. With M = L L^T, V,
D = L_D L_D^T and A from heads of the same sizes::

    structured   M a = A u - D v - G - (dL L^T + L dL^T) v + d(|L^T v|^2 / 2)/dq
    hessian      a = (d2L/dv2)^-1 (dL/dq - (d2L/dv dq) v + A u - D v),   L = v^T M v / 2 - V

The structured one has two spellings, and a benchmark takes the faster: ``autodiff`` gets dL, G and
the last term from jax.linearize and its transpose, ``explicit`` from written-out tangent and
reverse passes on whole batches. In the second line Hessian, mixed derivative and inverse are
jax.hessian, jax.jacfwd and jnp.linalg.inv, sample by sample under jax.vmap, as in the paper and in
Cranmer et al. (2020), Lagrangian Neural Networks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from pinn_dyn.models import LagrangianNetwork, NetworkCholesky, NetworkInput
from pinn_dyn.models.mlp import MLP

Parameters = dict[str, Any]
Acceleration = Callable[[Parameters, Array, Array, Array], Array]
Layers = list[tuple[Array, Array]]


def parameters_of(model: LagrangianNetwork) -> Parameters:
    """Weights of a torch network with softplus heads, ``(inputs, outputs)`` a layer."""

    def layers(network: MLP) -> Layers:
        return [
            (_array(layer.weight).T.copy(), _array(layer.bias).copy()) for layer in network.linears
        ]

    mass, damping = model.mass, model.damping
    assert isinstance(mass, NetworkCholesky)
    assert isinstance(damping, NetworkCholesky)
    assert isinstance(model.input, NetworkInput)
    parameters = {
        "mass": layers(mass.network),
        "damping": layers(damping.network),
        "potential": layers(model.potential.network),
        "input": layers(model.input.network),
    }
    if model.potential.stiffness_root is not None:
        parameters["root"] = _array(model.potential.stiffness_root).copy()
    return jax.tree.map(jnp.asarray, parameters)


def _array(value: Any) -> Any:
    return value.detach().numpy()


class Network:
    """Accelerations of the network ``model``, three ways; each ``(B, N)`` from q, v, u.

    Args:
        model: the torch network that scales, normalization and sizes are taken from.
    """

    def __init__(self, model: LagrangianNetwork):
        mass, damping = model.mass, model.damping
        assert isinstance(mass, NetworkCholesky)
        assert isinstance(damping, NetworkCholesky)
        assert isinstance(model.input, NetworkInput)
        self.size, self.inputs = model.num_coordinates, model.num_inputs
        self.mean, self.std = _array(mass.network.mean), _array(mass.network.std)
        # vec(L) = y S with the scales in S; as a product it is faster than a scatter.
        self.mass_places = _array(mass.placement)
        self.damping_places = _array(damping.placement)
        self.mass_epsilon, self.damping_epsilon = mass.positivity.floor, damping.positivity.floor
        self.potential_scale = _array(model.potential.scale)
        self.input_scale = _array(model.input.scale)

    # The terms, for one sample or for a batch.

    def _cholesky(self, layers: Layers, places: Any, epsilon: float, z: Array) -> Array:
        y = mlp(layers, z)
        diagonal = jax.nn.softplus(y[..., : self.size]) + epsilon
        return self._square(jnp.concatenate([diagonal, y[..., self.size :]], -1), places)

    def _square(self, values: Array, places: Any) -> Array:
        return (values @ places).reshape(*values.shape[:-1], self.size, self.size)

    def _mass_factor(self, p: Parameters, q: Array) -> Array:
        return self._cholesky(p["mass"], self.mass_places, self.mass_epsilon, self._normal(q))

    def _normal(self, q: Array) -> Array:
        return (q - self.mean) / self.std

    def _potential(self, p: Parameters, q: Array) -> Array:
        z = self._normal(q)
        value = mlp(p["potential"], z)[..., 0]
        if "root" in p:
            value = value + 0.5 * ((z @ p["root"]) ** 2).sum(-1)
        return self.potential_scale * value

    def _outer_force(self, p: Parameters, q: Array, v: Array, u: Array) -> Array:
        """A u - D v."""
        z = self._normal(q)
        matrix = mlp(p["input"], z).reshape(*q.shape[:-1], self.size, self.inputs)
        factor = self._cholesky(p["damping"], self.damping_places, self.damping_epsilon, z)
        drive = matvec(matrix * self.input_scale, u)
        return drive - matvec(factor, matvec(factor.mT, v))

    # The accelerations.

    def autodiff(self, p: Parameters, q: Array, v: Array, u: Array) -> Array:
        """Structured, with linearize and its transpose in the place of written-out passes."""

        def sample(q: Array, v: Array, u: Array) -> Array:
            factor, linear = jax.linearize(lambda x: self._mass_factor(p, x), q)
            rate = linear(v)
            w = factor.T @ v
            (gradient,) = jax.linear_transpose(linear, q)(jnp.outer(v, w))
            bias = rate @ w + factor @ (rate.T @ v) - gradient
            force = self._outer_force(p, q, v, u) - jax.grad(self._potential, 1)(p, q) - bias
            return solve(factor, force)

        return jax.vmap(sample)(q, v, u)

    def explicit(self, p: Parameters, q: Array, v: Array, u: Array) -> Array:
        """Structured, with written-out tangent and reverse passes on the whole batch."""
        z = self._normal(q)
        y, tape = linearize(p["mass"], z)
        diagonal = jax.nn.softplus(y[:, : self.size]) + self.mass_epsilon
        slope = jnp.concatenate(
            [jax.nn.sigmoid(y[:, : self.size]), jnp.ones_like(y[:, self.size :])], -1
        )
        values = jnp.concatenate([diagonal, y[:, self.size :]], -1)
        factor = self._square(values, self.mass_places)
        dy = pushforward(p["mass"], tape, v / self.std)
        rate = self._square(slope * dy, self.mass_places)
        w = matvec(factor.mT, v)
        outer = (v[:, :, None] * w[:, None, :]).reshape(q.shape[0], -1)
        gradient = pullback(p["mass"], tape, (outer @ self.mass_places.T) * slope) / self.std
        bias = matvec(rate, w) + matvec(factor, matvec(rate.mT, v)) - gradient

        one, tape = linearize(p["potential"], z)
        well = pullback(p["potential"], tape, jnp.ones_like(one))
        if "root" in p:
            well = well + (z @ p["root"]) @ p["root"].T
        force = self._outer_force(p, q, v, u) - self.potential_scale * well / self.std - bias
        return solve(factor, force)

    def hessian(self, p: Parameters, q: Array, v: Array, u: Array) -> Array:
        """The paper's way: second derivatives of the Lagrangian and an explicit inverse."""

        def lagrangian(q: Array, v: Array) -> Array:
            factor = self._mass_factor(p, q)
            return 0.5 * v @ (factor @ factor.T) @ v - self._potential(p, q)

        def sample(q: Array, v: Array, u: Array) -> Array:
            mass = jax.hessian(lagrangian, 1)(q, v)
            mixed = jax.jacfwd(jax.grad(lagrangian, 1), 0)(q, v)
            force = jax.grad(lagrangian, 0)(q, v) - mixed @ v + self._outer_force(p, q, v, u)
            return jnp.linalg.inv(mass) @ force

        return jax.vmap(sample)(q, v, u)


def mlp(layers: Layers, h: Array) -> Array:
    """W_n s(... s(W_1 h + b_1) ...) + b_n with s = softplus."""
    *hidden, (last, bias) = layers
    for weight, shift in hidden:
        h = jax.nn.softplus(h @ weight + shift)
    return h @ last + bias


def linearize(layers: Layers, h: Array) -> tuple[Array, list[Array]]:
    """The output and the slopes of the hidden activations."""
    *hidden, (last, bias) = layers
    tape = []
    for weight, shift in hidden:
        z = h @ weight + shift
        h = jax.nn.softplus(z)
        tape.append(jax.nn.sigmoid(z))
    return h @ last + bias, tape


def pushforward(layers: Layers, tape: list[Array], h: Array) -> Array:
    """J h."""
    for (weight, _), slope in zip(layers[:-1], tape, strict=True):
        h = (h @ weight) * slope
    return h @ layers[-1][0]


def pullback(layers: Layers, tape: list[Array], h: Array) -> Array:
    """J^T h."""
    h = h @ layers[-1][0].T
    for (weight, _), slope in zip(reversed(layers[:-1]), reversed(tape), strict=True):
        h = (h * slope) @ weight.T
    return h


def matvec(matrix: Array, vector: Array) -> Array:
    """Product of a matrix and a vector, batched or not."""
    return (matrix * vector[..., None, :]).sum(-1)


def solve(factor: Array, b: Array) -> Array:
    """x with L L^T x = b, unrolled: faster than a batched LAPACK call for a few coordinates."""
    size = b.shape[-1]
    w: list[Array] = []
    for i in range(size):
        rest = b[..., i] - sum(factor[..., i, j] * w[j] for j in range(i))
        w.append(rest / factor[..., i, i])
    x = list(w)
    for i in reversed(range(size)):
        rest = w[i] - sum(factor[..., j, i] * x[j] for j in range(i + 1, size))
        x[i] = rest / factor[..., i, i]
    return jnp.stack(x, -1)


def increment_loss(
    acceleration: Acceleration, p: Parameters, batch: dict[str, Array], step: float, scale: Any
) -> Array:
    """Mean squared error of the velocity's increment over one RK4 step (3/8 rule), scaled.

    ``batch`` holds x0 ``(B, 2N)``, u at both ends ``(B, 2, M)`` and the measured ``(B, 2N)``.
    """
    x0, size = batch["x0"], batch["x0"].shape[-1] // 2
    first, last = batch["u"][:, 0], batch["u"][:, 1]

    def rate(x: Array, u: Array) -> Array:
        q, v = x[:, :size], x[:, size:]
        return jnp.concatenate([v, acceleration(p, q, v, u)], -1)

    k1 = rate(x0, first)
    k2 = rate(x0 + step * k1 / 3, first + (last - first) / 3)
    k3 = rate(x0 + step * (k2 - k1 / 3), first + (last - first) * 2 / 3)
    k4 = rate(x0 + step * (k1 - k2 + k3), last)
    increment = step * (k1 + 3 * (k2 + k3) + k4) / 8
    residual = (increment - batch["measured"]) / scale
    return jnp.mean(residual[:, size:] ** 2)


def midpoint_loss(
    acceleration: Acceleration, p: Parameters, batch: dict[str, Array], step: float, scale: Any
) -> Array:
    """Mean squared error of the velocity's increment, by its rate in the middle of the step."""
    q, v = jnp.split(batch["x0"], 2, -1)
    dq, dv = jnp.split(batch["measured"], 2, -1)
    middle = q + 0.5 * dq - step * dv / 8, 1.5 * dq / step - 0.5 * v - 0.25 * dv
    increment = step * acceleration(p, *middle, batch["u"].mean(1))
    return jnp.mean(((increment - dv) / scale) ** 2)


LOSSES = {"increment": increment_loss, "midpoint": midpoint_loss}


def training_step(
    acceleration: Acceleration, step: float, scale: Any
) -> Callable[[Parameters, dict[str, Array]], tuple[Array, Parameters]]:
    """Loss and gradient of a batch, jitted as one."""

    def loss(p: Parameters, batch: dict[str, Array]) -> Array:
        return increment_loss(acceleration, p, batch, step, scale)

    return jax.jit(jax.value_and_grad(loss))


def to_jax(values: dict[str, Any]) -> dict[str, Array]:
    """A batch of torch tensors as JAX arrays."""
    return {name: jnp.asarray(np.array(value)) for name, value in values.items()}
