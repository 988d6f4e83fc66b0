"""Hold a robot at a set point by the paper's regulator, on the learned terms.

python examples/regulator_in_a_loop.py runs/own_log    the folder of own_log.py

The plant is the simulated arm that the example log is of; on a robot, your own loop calls the law.
"""

import argparse
import sys

import torch

import pinn_dyn
from pinn_dyn.control import Regulation, SetPoint, SystemPlant, close_loop

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("run", help="a run folder, of a one-segment soft arm")
parser.add_argument("--duration", type=float, default=2.0, help="s")
parser.add_argument("--gains", type=float, nargs=2, default=[2.0, 0.4], help="K_P and K_D")
args = parser.parse_args()

# u = A^+(q) G(q) + A(q)^T (K_P (q_ref - q) - K_D v)
law = Regulation(pinn_dyn.load(args.run).system, *args.gains)
q_ref = torch.tensor([0.4, -0.3, 0.35])
record = close_loop(
    SystemPlant(pinn_dyn.SoftArm(segments=1).double()),
    law,
    SetPoint(q_ref),
    q0=torch.tensor([[0.0, 0.0, 0.3]], dtype=torch.float64),
    v0=torch.zeros(1, 3, dtype=torch.float64),
    duration=args.duration,
    rate=200,
)
for k in range(0, len(record.t), len(record.t) // 5):
    print(f"t = {record.t[k]:.2f} s   q = {record.q[0, k].numpy().round(4)}")
if record.stopped[0]:
    sys.exit(f"{record.stopped[0]}: train on a log that moves all inputs, or reduce the gains")
print("final error:", (record.q[0, -1] - q_ref).abs().numpy().round(4))
