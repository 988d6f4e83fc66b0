"""Compile a control law into one file that needs PyTorch alone, and call it at 1 kHz.

python examples/export_and_call.py runs/own_log [--file law.pt2]    needs a C++ compiler
"""

import argparse
import time

import torch

import pinn_dyn
from pinn_dyn.control import Tracking, export_law, load_law

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("run", help="a run folder of model=lnn or hnn")
parser.add_argument("--file", default="law.pt2", help="where the law goes")
args = parser.parse_args()

model = pinn_dyn.load(args.run)
eager = Tracking(model.system, position_gain=2.0, velocity_gain=0.2)
law = load_law(export_law(eager, args.file))

q, v, q_ref, v_ref, a_ref = torch.zeros(5, model.system.num_coordinates, dtype=torch.float64)
q_ref = q_ref + 0.1
u = law(q, v, q_ref, v_ref, a_ref)
print("u:", dict(zip(model.input_labels, u.numpy().round(4), strict=True)))
print("the same as before the export:", torch.allclose(u, eager.law(q, v, q_ref, v_ref, a_ref)))

start = time.perf_counter()
for _ in range(1000):
    law(q, v, q_ref, v_ref, a_ref)
print(f"{1e3 * (time.perf_counter() - start):.0f} µs a call")
