"""Learn a double pendulum with a motor in the shoulder alone; swing it up by predictive control.

python examples/swing_up.py [--steps 6000] [--starts 50]
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
import torch

import pinn_dyn
from pinn_dyn.control import Actuator, PredictiveControl, SetPoint, SystemPlant, close_loop
from pinn_dyn.data import DynamicsData, InitialStates, MultiSine, SimulatedSource
from pinn_dyn.mechanics import double_copy
from pinn_dyn.models import ConstantCholesky, FixedInput, LagrangianNetwork
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import MidpointLoss

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=6000, help="steps of the optimizer")
parser.add_argument("--starts", type=int, default=50, help="number of swing-ups")
parser.add_argument("--duration", type=float, default=6.0, help="length of a swing-up, s")
args = parser.parse_args()
TORQUE = 2.0  # Nm; gravity takes up to 2.9 Nm


class Pendubot(RigidChain):
    """The chain with a motor in the first joint alone: A = (1, 0)."""

    def __init__(self):
        super().__init__(str(Path(__file__).with_name("double_pendulum.urdf")), damping=0.01)
        self.num_inputs = 1

    def input_matrix(self, q):
        return super().input_matrix(q)[..., :1]

    def input_force(self, q, u):
        return torch.cat([u, torch.zeros_like(u)], -1)


robot = Pendubot()
source = SimulatedSource(
    name="pendubot",
    system=robot,
    excitation=MultiSine([0.0], [2.5], frequency=[0.2, 2.0], harmonics=4),
    initial_states=InitialStates(q_low=[-3.2, -3.2], q_high=[3.2, 3.2], v_max=[6.0, 6.0]),
    duration=4.0,
    step=0.005,
    train_initial_states=8,
    train_inputs=8,
    validation=4,
    test=4,
    labels=["shoulder [rad]", "elbow [rad]"],
    input_labels=["torque [Nm]"],
)
learned = pinn_dyn.train(
    source,
    partial(
        LagrangianNetwork,
        input=partial(FixedInput, value=[[1.0], [0.0]]),
        damping=ConstantCholesky,
        angles=[0, 1],
    ),
    loss=MidpointLoss,
    data=partial(DynamicsData, pairs=16000, stride=1, batch_size=512),
    steps=args.steps,
)
print(learned)

upright = SetPoint([np.pi, 0.0])
law = PredictiveControl(
    double_copy(learned.system),
    horizon=2.0,
    step=0.05,
    position_weight=[10.0, 5.0],
    velocity_weight=[0.3, 0.1],
    input_weight=1.0,
    actuator=Actuator(-TORQUE, TORQUE),
    iterations=3,
)
rng = np.random.default_rng(0)
q0, v0 = (torch.from_numpy(rng.uniform(-1, 1, (args.starts, 2))) for _ in range(2))
record = close_loop(
    SystemPlant(robot), law, upright, q0, v0, duration=args.duration, rate=1 / law.step_size
)
error = (record.q - record.reference.q)[:, record.t >= args.duration - 0.5].abs().amax((1, 2))
failed = record.diagnostics["solver_failed"].nansum()
print(f"upright within 0.05 rad: {int((error < 0.05).sum())} of {args.starts} starts")
milliseconds = 1e3 * record.diagnostics["solve_time"].nanquantile(
    torch.tensor([0.5, 0.99]).double()
)
print("solve time, median and 99 %: {:.0f}, {:.0f} ms".format(*milliseconds.tolist()))
print(f"solver failures: {int(failed)}, largest |u|: {float(record.u.abs().max()):.2f} Nm")
