"""A linear mechanical system and its exact solutions."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor, nn

from pinn_dyn.mechanics import Interpolation, MechanicalSystem, State
from pinn_dyn.mechanics.arrays import matvec


class LinearSystem(MechanicalSystem):
    """M dv/dt + D v + K q = A u with constant matrices, which are the parameters."""

    def __init__(self, mass: Any, stiffness: Any, damping: Any, inputs: Any, state: State = "qv"):
        inputs = torch.as_tensor(inputs, dtype=torch.float64)
        super().__init__(inputs.shape[0], inputs.shape[1], state)
        matrices = (torch.as_tensor(x, dtype=torch.float64) for x in (mass, stiffness, damping))
        self.mass, self.stiffness, self.damping = map(nn.Parameter, matrices)
        self.inputs = nn.Parameter(inputs)

    def mass_matrix(self, q: Tensor) -> Tensor:
        # Symmetric by construction, so that the gradient by each entry is defined.
        return (0.5 * (self.mass + self.mass.mT)).expand(*q.shape[:-1], -1, -1)

    def potential_energy(self, q: Tensor) -> Tensor:
        return 0.5 * (q * (q @ self.stiffness.mT)).sum(-1)

    def damping_matrix(self, q: Tensor) -> Tensor:
        return self.damping.expand(*q.shape[:-1], -1, -1)

    def input_matrix(self, q: Tensor) -> Tensor:
        return self.inputs.expand(*q.shape[:-1], -1, -1)

    def _potential_force(self, q: Tensor) -> Tensor:
        return 0.5 * q @ (self.stiffness + self.stiffness.mT)

    def inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        return matvec(self.mass_matrix(q), a)

    def _kinetic_gradient(self, q: Tensor, v: Tensor) -> Tensor:
        return torch.zeros_like(q)

    def state_space(self) -> tuple[np.ndarray, np.ndarray]:
        """Return F and B of dx/dt = F x + B u, with x = (q, v)."""
        matrices = (self.mass, self.stiffness, self.damping, self.inputs)
        mass, stiffness, damping, inputs = (matrix.detach().numpy() for matrix in matrices)
        n, m = inputs.shape
        inverse = np.linalg.inv(mass)
        f = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
        b = np.vstack([np.zeros((n, m)), inverse @ inputs])
        return f, b


def damped_oscillators() -> LinearSystem:
    """Build two coupled damped masses with one input."""
    return LinearSystem(
        mass=[[1.0, 0.2], [0.2, 0.7]],
        stiffness=[[9.0, -2.0], [-2.0, 5.0]],
        damping=[[0.4, 0.1], [0.1, 0.3]],
        inputs=[[1.0], [-0.5]],
    )


def exact_solution(
    system: LinearSystem, x0: Tensor, t: Tensor, u: Tensor, interpolation: Interpolation
) -> Tensor:
    """Return the states ``(T, 2N)`` under samples u by matrix exponentials, in float64.

    ``x0`` is ``(2N,)``, ``t`` ``(T,)`` and ``u`` ``(T, M)``. The input is held or linear.
    """
    f, b = system.state_space()
    n, m = b.shape
    times, samples = t.double().numpy(), u.double().numpy()
    # The state (x, u, du/dt) is autonomous between two samples.
    generator = np.zeros((n + 2 * m, n + 2 * m))
    generator[:n, :n], generator[:n, n : n + m] = f, b
    generator[n : n + m, n + m :] = np.eye(m)
    states = [x0.double().numpy()]
    for k, step in enumerate(np.diff(times)):
        rate = (samples[k + 1] - samples[k]) / step if interpolation == "linear" else np.zeros(m)
        states.append((expm(generator * step) @ np.concatenate([states[-1], samples[k], rate]))[:n])
    return torch.from_numpy(np.stack(states))
