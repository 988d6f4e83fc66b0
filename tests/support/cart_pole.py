"""A small nonlinear system with fewer inputs than coordinates."""

import torch
from torch import nn

from pinn_dyn.mechanics import MechanicalSystem


class CartPole(MechanicalSystem):
    """A pendulum on a spring-held cart that one force pushes; q = (position, angle).

    It gives only the four terms: everything else is left to the base class.
    """

    gravity = 9.81

    def __init__(self, state="qv"):
        super().__init__(num_coordinates=2, num_inputs=1, state=state)
        self.cart = nn.Parameter(torch.tensor(1.5, dtype=torch.float64))
        self.bob = nn.Parameter(torch.tensor(0.4, dtype=torch.float64))
        self.rod = nn.Parameter(torch.tensor(0.6, dtype=torch.float64))
        self.friction = nn.Parameter(torch.tensor([0.3, 0.05], dtype=torch.float64))

    def mass_matrix(self, q):
        one = torch.ones_like(q[..., 0])
        coupling = self.bob * self.rod * torch.cos(q[..., 1])
        entries = [(self.cart + self.bob) * one, coupling, coupling, self.bob * self.rod**2 * one]
        return torch.stack(entries, -1).unflatten(-1, (2, 2))

    def potential_energy(self, q):
        spring = 2.0 * q[..., 0] ** 2
        return spring - self.bob * self.gravity * self.rod * torch.cos(q[..., 1])

    def damping_matrix(self, q):
        return torch.diag_embed(self.friction).expand(*q.shape[:-1], 2, 2)

    def input_matrix(self, q):
        one = torch.ones_like(q[..., :1])
        return torch.cat([one, 0 * one], -1).unsqueeze(-1)
