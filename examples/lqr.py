"""Balance a cart-pole at its upright position by LQR on a learned Lagrangian network.

python examples/lqr.py [--steps 3000]
"""

import argparse
from functools import partial

import numpy as np
import torch
from scipy.linalg import solve_discrete_are

import pinn_dyn
from pinn_dyn.control import SetPoint, Stage, SystemPlant, close_loop
from pinn_dyn.data import DynamicsData, InitialStates, MultiSine, SimulatedSource
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.models import FixedInput, LagrangianNetwork
from pinn_dyn.training import MidpointLoss

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=3000, help="steps of the optimizer")
args = parser.parse_args()


class CartPole(pinn_dyn.MechanicalSystem):
    """1 kg cart with a pole, 0.2 kg at 0.5 m; q = (position, angle from upright), u in N."""

    def mass_matrix(self, q):
        coupling = 0.1 * torch.cos(q[..., 1])
        rows = [torch.full_like(coupling, 1.2), coupling, coupling, torch.full_like(coupling, 0.05)]
        return torch.stack(rows, -1).unflatten(-1, (2, 2))

    def potential_energy(self, q):
        return 0.2 * 9.81 * 0.5 * torch.cos(q[..., 1])

    def damping_matrix(self, q):
        return torch.diag_embed(torch.tensor([0.2, 0.005]).to(q).expand_as(q))

    def input_matrix(self, q):
        return torch.tensor([[1.0], [0.0]]).to(q).expand(*q.shape, 1)


class LinearQuadraticRegulator(Stage):
    """u = -K x, with K for the cost sum x^T Q x + u^T R u of the sampled linear model."""

    def __init__(self, A, B, Q, R):
        super().__init__(len(Q) // 2, len(R))
        P = solve_discrete_are(A, B, Q, R)
        self.K = torch.from_numpy(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))

    def step(self, q, v, reference, applied, memory):
        return -torch.cat([q - reference.q, v - reference.v], -1) @ self.K.mT, memory


robot = CartPole(num_coordinates=2, num_inputs=1)
source = SimulatedSource(
    name="cart_pole",
    system=robot,
    excitation=MultiSine([0.0], [4.0], frequency=[0.2, 2.0]),
    initial_states=InitialStates(q_low=[-0.5, -0.6], q_high=[0.5, 0.6], v_max=[0.5, 1.0]),
    duration=1.0,
    step=0.01,
    train_initial_states=40,
    train_inputs=40,
    pairing="matched",
    validation=4,
    test=4,
    labels=["cart [m]", "pole [rad]"],
    input_labels=["force [N]"],
)
run = pinn_dyn.train(
    source,
    partial(LagrangianNetwork, input=partial(FixedInput, value=[[1.0], [0.0]]), angles=[1]),
    loss=MidpointLoss,
    data=partial(DynamicsData, pairs=2000, stride=1),
    steps=args.steps,
    validator=partial(RolloutValidator, horizon=0.5),
)

upright, Q, R = np.zeros(2), np.diag([10.0, 10.0, 1.0, 1.0]), np.eye(1)
A, B = run.linearize(upright, upright, np.zeros(1), sample_time=0.01)
law = LinearQuadraticRegulator(A, B, Q, R)
zero = torch.zeros(2).double()
exact = LinearQuadraticRegulator(
    *(x.numpy() for x in robot.linearize(zero, zero, zero[:1], sample_time=0.01)), Q, R
)
print("K learned", law.K[0].numpy().round(2), " K of the true robot", exact.K[0].numpy().round(2))
start = torch.tensor([[0.3, 0.3]]).double()
record = close_loop(
    SystemPlant(robot), law, SetPoint([0.0, 0.0]), start, 0 * start, duration=4.0, rate=100
)
print("final state:", record.q[0, -1].numpy().round(4), "stopped:", record.stopped[0])
