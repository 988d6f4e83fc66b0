"""A user's robot of a few methods: it follows a helix, and steps by itself."""

import numpy as np
import torch

from pinn_dyn.control import Helix, SimulatorPlant
from pinn_dyn.mechanics import MechanicalSystem


class Crane(MechanicalSystem):
    """A turning column, a boom and a jib, with a point mass at the tip of each."""

    def __init__(self):
        super().__init__(3, 3)

    def tip_position(self, q):
        turn, boom, jib = q.unbind(-1)
        radius = torch.stack([0 * turn, 0.4 * boom.cos(), 0.3 * (boom + jib).cos()], -1)
        height = torch.stack([0.5 + 0 * turn, 0.4 * boom.sin(), 0.3 * (boom + jib).sin()], -1)
        r, z = radius.cumsum(-1), height.cumsum(-1)
        points = torch.stack([r * turn.cos()[..., None], r * turn.sin()[..., None], z], -1)
        return points[..., -1, :]

    def mass_matrix(self, q):
        return torch.eye(3, dtype=q.dtype).expand(*q.shape, 3)

    def potential_energy(self, q):
        return 0 * q.sum(-1)

    def damping_matrix(self, q):
        return self.mass_matrix(q)

    def input_matrix(self, q):
        return self.mass_matrix(q)


POSTURE = [0.0, 1.0, -1.2]


def test_the_tip_of_a_robot_of_ones_own_runs_along_the_helix():
    crane = Crane()
    helix = Helix(crane, POSTURE, radius=0.05, pitch=0.02, period=2.0, turns=1.0)
    start = [0.4 * np.cos(1.0) + 0.3 * np.cos(0.2), 0.0, 0.5 + 0.4 * np.sin(1) - 0.3 * np.sin(0.2)]
    np.testing.assert_allclose(helix.path(0.0), start, rtol=0, atol=1e-14)
    for t in np.linspace(0, helix.duration, 9):
        turn, boom, jib = helix(t).q.tolist()
        reach = 0.4 * np.cos(boom) + 0.3 * np.cos(boom + jib)
        height = 0.5 + 0.4 * np.sin(boom) + 0.3 * np.sin(boom + jib)
        tip = [reach * np.cos(turn), reach * np.sin(turn), height]
        np.testing.assert_allclose(tip, helix.path(t), rtol=0, atol=1e-6)


class Hopping:
    """Stands in for a simulator: q moves by the input, v counts the steps."""

    num_coordinates = num_inputs = 1

    def set_state(self, q, v):
        self.q, self.v = q, v

    def step(self, torque, step):
        self.q, self.v = self.q + step * torque, self.v + 1
        return self.q, self.v


def test_a_robot_that_steps_by_itself_is_a_plant():
    plant = SimulatorPlant(Hopping(), step=0.01)
    start = torch.zeros(2, 1, dtype=torch.float64)
    plant.start(start, start)
    q, v = plant.advance(torch.tensor([[1.0], [2.0]], dtype=torch.float64), 0.05)
    torch.testing.assert_close(q[:, 0], torch.tensor([0.05, 0.1], dtype=torch.float64))
    assert v.tolist() == [[5.0], [5.0]]
