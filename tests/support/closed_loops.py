"""Three copies of two coupled springs under PD control, for tests of closed loops."""

import numpy as np
import torch

from pinn_dyn.control import Motion, Reference, Stage, Step
from pinn_dyn.control.closed_loop import close_loop
from pinn_dyn.control.plants import SystemPlant
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.testing import LinearSystem
from tests.support.linear import double

K_P, K_D = 30.0, 4.0


Q0, V0 = double([[0.5, -0.2], [1.0, 0.4], [-0.3, 0.0]]), double([[0.0, 1.0], [-1.0, 0.3], [2, 0]])


class Wave(Reference):
    def __init__(self, amplitude):
        self.amplitude = amplitude
        self.num_coordinates = amplitude.shape[-1]

    def __call__(self, t):
        a = self.amplitude
        return Motion(a * np.sin(2 * t), 2 * a * np.cos(2 * t), -4 * a * np.sin(2 * t))


class PD(Stage):
    """PD whose input is NaN for the copies with ``bad(q)``, with |q| in its report."""

    def __init__(self, size=2, k_p=K_P, k_d=K_D, bad=None):
        super().__init__(size, size)
        self.k_p, self.k_d, self.bad = k_p, k_d, bad

    def step(self, q, v, reference, applied, memory):
        u = self.k_p * (reference.q - q) + self.k_d * (reference.v - v)
        if self.bad is not None:
            u = torch.where(self.bad(q)[:, None], torch.nan, u)
        return Step(u, memory, {"distance": q.norm(dim=-1)})


def spring(inputs=((1.0, 0.0), (0.3, 0.8))):
    return LinearSystem(
        mass=[[1.0, 0.2], [0.2, 0.7]],
        stiffness=[[9.0, -2.0], [-2.0, 5.0]],
        damping=[[0.4, 0.1], [0.1, 0.3]],
        inputs=inputs,
    )


def sampled(plant=None, controller=None, reference=None, q0=Q0, v0=V0, **changes):
    plant = plant or SystemPlant(spring(), rtol=1e-9, atol=1e-11)
    reference = reference or Wave(double([0.5, -1.0]))
    settings = {"duration": 0.4, "rate": 50.0} | changes
    return close_loop(plant, controller or PD(), reference, q0, v0, **settings)


class Vanishing(MechanicalSystem):
    """A free mass m(q), by default 1 - q, which is gone at q = 1."""

    def __init__(self, mass=lambda q: 1 - q):
        super().__init__(num_coordinates=1, num_inputs=1)
        self.mass = mass

    def mass_matrix(self, q):
        return self.mass(q).unsqueeze(-1)

    def potential_energy(self, q):
        return 0 * q[..., 0]

    def damping_matrix(self, q):
        return 0 * q.unsqueeze(-1)

    def input_matrix(self, q):
        return torch.ones_like(q).unsqueeze(-1)
