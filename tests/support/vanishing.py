"""A robot whose mass matrix stops being positive definite."""

import torch

from pinn_dyn.mechanics import MechanicalSystem


class Vanishing(MechanicalSystem):
    """A free mass 1 - q that is gone at q = 1."""

    def __init__(self):
        super().__init__(num_coordinates=1, num_inputs=1)

    def mass_matrix(self, q):
        return (1 - q).unsqueeze(-1)

    def potential_energy(self, q):
        return 0 * q[..., 0]

    def damping_matrix(self, q):
        return 0 * q.unsqueeze(-1)

    def input_matrix(self, q):
        return torch.ones_like(q).unsqueeze(-1)
