"""A linear mechanical system and its exact solutions."""

import numpy as np
import torch
from scipy.linalg import expm
from torch import nn

from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import matvec


class LinearSystem(MechanicalSystem):
    """M dv/dt + D v + K q = A u with constant matrices, all of them parameters."""

    def __init__(self, mass, stiffness, damping, inputs, state="qv"):
        inputs = torch.as_tensor(inputs, dtype=torch.float64)
        super().__init__(inputs.shape[0], inputs.shape[1], state)
        self.mass = nn.Parameter(torch.as_tensor(mass, dtype=torch.float64))
        self.stiffness = nn.Parameter(torch.as_tensor(stiffness, dtype=torch.float64))
        self.damping = nn.Parameter(torch.as_tensor(damping, dtype=torch.float64))
        self.inputs = nn.Parameter(inputs)

    def mass_matrix(self, q):
        # Symmetric by construction, so that the gradient by each entry is defined.
        return (0.5 * (self.mass + self.mass.mT)).expand(*q.shape[:-1], -1, -1)

    def potential_energy(self, q):
        return 0.5 * (q * (q @ self.stiffness.mT)).sum(-1)

    def damping_matrix(self, q):
        return self.damping.expand(*q.shape[:-1], -1, -1)

    def input_matrix(self, q):
        return self.inputs.expand(*q.shape[:-1], -1, -1)

    # Closed formulas: M is constant, so that C = 0. Loops of many steps take a fifth of the time.

    def _potential_force(self, q):
        return 0.5 * q @ (self.stiffness + self.stiffness.mT)

    def _inertial_force(self, q, v, a):
        return matvec(self.mass_matrix(q), a)

    def _kinetic_gradient(self, q, v):
        return torch.zeros_like(q)

    def state_space(self):
        """F and B of dx/dt = F x + B u, x = (q, v), as NumPy arrays."""
        mass, stiffness, damping, inputs = (
            matrix.detach().numpy()
            for matrix in (self.mass, self.stiffness, self.damping, self.inputs)
        )
        n, m = inputs.shape
        inverse = np.linalg.inv(mass)
        f = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
        b = np.vstack([np.zeros((n, m)), inverse @ inputs])
        return f, b


def unit_masses(n):
    """n uncoupled unit masses on unit springs and dampers, each with its input: A = I."""
    return LinearSystem(np.eye(n), np.eye(n), np.eye(n), np.eye(n))


def damped_oscillators():
    """Two coupled damped masses, pushed by one input."""
    return LinearSystem(
        mass=[[1.0, 0.2], [0.2, 0.7]],
        stiffness=[[9.0, -2.0], [-2.0, 5.0]],
        damping=[[0.4, 0.1], [0.1, 0.3]],
        inputs=[[1.0], [-0.5]],
    )


def exact_solution(system, x0, t, u, interpolation):
    """States at the times t under samples u, by matrix exponentials (zero or first-order hold).

    ``x0`` is ``(2N,)``, ``t`` ``(T,)`` and ``u`` ``(T, M)``; all in float64.
    """
    f, b = system.state_space()
    n, m = b.shape
    t, u = t.double().numpy(), u.double().numpy()
    # The state (x, u, du/dt) is autonomous between two samples.
    generator = np.zeros((n + 2 * m, n + 2 * m))
    generator[:n, :n], generator[:n, n : n + m] = f, b
    generator[n : n + m, n + m :] = np.eye(m)
    states = [x0.double().numpy()]
    for k, step in enumerate(np.diff(t)):
        rate = (u[k + 1] - u[k]) / step if interpolation == "linear" else np.zeros(m)
        states.append((expm(generator * step) @ np.concatenate([states[-1], u[k], rate]))[:n])
    return torch.from_numpy(np.stack(states))


def exact_solution_under_sine(system, x0, t, frequency):
    """States at the times t under u(t) = sin(frequency t) in each input."""
    f, b = system.state_space()
    n, m = b.shape
    # (sin, cos) is a second linear system that drives the first.
    generator = np.zeros((n + 2, n + 2))
    generator[:n, :n] = f
    generator[:n, n] = b @ np.ones(m)
    generator[n, n + 1], generator[n + 1, n] = frequency, -frequency
    start = np.concatenate([x0.numpy(), [0.0, 1.0]])
    return torch.from_numpy(np.stack([(expm(generator * s) @ start)[:n] for s in t.tolist()]))
