"""The equations of motion by per-sample automatic differentiation of one scalar function.

These share with the models only the values of the terms, none of their derivative formulas.
"""

import torch
from torch.func import grad, hessian, jacrev, vmap

from pinn_dyn.models import CoulombFriction


def dissipation(model, q, v):
    """D v, and where the model has it the Coulomb law, written out anew."""
    force = model.damping_matrix(q) @ v
    head = model.friction
    if not isinstance(head, CoulombFriction):
        return force
    level = head.level.scale * torch.log(1 + torch.exp(head.level.z))
    width = head.width.scale * (torch.log(1 + torch.exp(head.width.z)) + 0.01)
    return force + level * (1 - 2 / (torch.exp(2 * v / width) + 1))


def lagrangian_derivative(model, x, u):
    """d(q, v)/dt from the Hessian of L(q, v) = v^T M v / 2 - V, paper eq. (armdynamics)."""

    def lagrangian(q, v):
        return 0.5 * v @ model.mass_matrix(q) @ v - model.potential_energy(q)

    def acceleration(q, v, u):
        force = model.input_matrix(q) @ u - dissipation(model, q, v)
        mixed = jacrev(grad(lagrangian, 1), 0)(q, v)
        return torch.linalg.solve(
            hessian(lagrangian, 1)(q, v), force + grad(lagrangian, 0)(q, v) - mixed @ v
        )

    q, v = x.chunk(2, -1)
    return torch.cat([v, vmap(acceleration)(q, v, u)], -1)


def hamiltonian_derivative(model, x, u):
    """d(q, p)/dt from the gradient of H(q, p) = p^T W p / 2 + V, paper eq. (hamiltonian_dyn)."""

    def hamiltonian(q, p):
        return 0.5 * p @ model.inverse_mass_matrix(q) @ p + model.potential_energy(q)

    def rates(q, p, u):
        v = grad(hamiltonian, 1)(q, p)
        force = model.input_matrix(q) @ u - dissipation(model, q, v)
        return torch.cat([v, force - grad(hamiltonian, 0)(q, p)])

    return vmap(rates)(*x.chunk(2, -1), u)


def autodiff_derivative(model, x, u):
    """dx/dt in the model's own coordinates."""
    momentum = model.state == "qp"
    return (hamiltonian_derivative if momentum else lagrangian_derivative)(model, x, u)


def rk4_increment(derivative, x, u_start, u_end, step):
    """One step of the four-stage 3/8 rule, the input linear in between."""

    def rate(fraction, increment):
        return derivative(x + increment, u_start + fraction * (u_end - u_start))

    k1 = rate(0, 0)
    k2 = rate(1 / 3, step * k1 / 3)
    k3 = rate(2 / 3, step * (k2 - k1 / 3))
    k4 = rate(1, step * (k1 - k2 + k3))
    return step * (k1 + 3 * k2 + 3 * k3 + k4) / 8
