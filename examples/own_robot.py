"""A pendulum with a motor as a robot of your own: write its four terms, simulate it, learn it.

python examples/own_robot.py [--steps 2000]
"""

import argparse
from functools import partial

import torch

import pinn_dyn
from pinn_dyn.data import DynamicsData, InitialStates, MultiSine, SimulatedSource
from pinn_dyn.models import FixedInput, LagrangianNetwork
from pinn_dyn.training import MidpointLoss

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=2000, help="steps of the optimizer")
args = parser.parse_args()


class Pendulum(pinn_dyn.MechanicalSystem):
    """1 kg on a rod of 0.5 m; q is the angle from hanging, rad, and u the torque, Nm."""

    def mass_matrix(self, q):
        return torch.full_like(q, 0.25).unsqueeze(-1)

    def potential_energy(self, q):
        return -9.81 * 0.5 * torch.cos(q[..., 0])

    def damping_matrix(self, q):
        return torch.full_like(q, 0.1).unsqueeze(-1)

    def input_matrix(self, q):
        return torch.ones_like(q).unsqueeze(-1)


source = SimulatedSource(
    name="pendulum",
    system=Pendulum(num_coordinates=1, num_inputs=1),
    excitation=MultiSine([0.0], [3.0], frequency=[0.1, 1.5], harmonics=4),
    initial_states=InitialStates(q_low=[-2.0], q_high=[2.0], v_max=[2.0]),
    duration=4.0,
    step=0.01,
    train_initial_states=5,
    train_inputs=4,
    validation=2,
    test=2,
    labels=["angle [rad]"],
    input_labels=["torque [Nm]"],
)
# A motor in the joint: A = I, so that M, D and G are found in their own units.
model = pinn_dyn.train(
    source,
    partial(LagrangianNetwork, input=FixedInput, angles=[0]),
    loss=MidpointLoss,
    data=partial(DynamicsData, pairs=2000, stride=1),
    steps=args.steps,
)

learned, true = model.terms([1.0]), source.system.double().terms(torch.ones(1).double())
for name in ("M", "D", "G"):
    found, value = getattr(learned, name).item(), getattr(true, name).item()
    print(f"{name} learned {found:.3f}, true {value:.3f}")
