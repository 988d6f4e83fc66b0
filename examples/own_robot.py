"""A pendulum with a motor as a robot of your own: write its four terms, simulate it, learn it."""

import sys

import torch

import pinn_dyn
from pinn_dyn.data import InitialStates, MultiSine, SimulatedSource


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
own = ["model/input=fixed", "model.angles=[0]", "loss=midpoint", "data.stride=1"]
own += ["trainer.steps=2000", "trainer.validations=10"]
model = pinn_dyn.fit(source, model="lnn", overrides=own + sys.argv[1:])

learned, true = model.terms([1.0]), source.system.double().terms(torch.ones(1).double())
for name in ("M", "D", "G"):
    found, value = getattr(learned, name).item(), getattr(true, name).item()
    print(f"{name} learned {found:.3f}, true {value:.3f}")
