"""More linear systems and exact solutions."""

import numpy as np
import torch
from scipy.linalg import expm

from pinn_dyn.testing import LinearSystem


def double(values):
    return torch.tensor(values, dtype=torch.float64)


class Pendulums(LinearSystem):
    """Coupled pendulums, M a + D v + K sin q = A u, with a diagonal K."""

    def potential_energy(self, q):
        return -(self.stiffness.diagonal() * q.cos()).sum(-1)

    def _potential_force(self, q):
        return self.stiffness.diagonal() * q.sin()


def unit_masses(n):
    """n uncoupled unit masses on unit springs and dampers, each with its input: A = I."""
    return LinearSystem(np.eye(n), np.eye(n), np.eye(n), np.eye(n))


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
