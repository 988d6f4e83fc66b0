"""Write a control law as C code, compile it, and compare it with the law in Python.

python examples/export_and_call.py runs/own_log [--file law.c]    needs a C compiler
"""

import argparse
import ctypes
import subprocess
import time
from pathlib import Path

import numpy as np
import torch

import pinn_dyn
from pinn_dyn.control import Actuator, Pipeline, Tracking, export_law

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("run", help="a run folder of model=lnn or hnn")
parser.add_argument("--file", type=Path, default=Path("law.c"), help="where the law goes")
args = parser.parse_args()

run = pinn_dyn.load(args.run)
law = Tracking(run.system, position_gain=2.0, velocity_gain=0.2)
pipeline = Pipeline(law, period=0.001, actuator=Actuator(low=-100.0, high=100.0))
export_law(pipeline, args.file)
library = args.file.resolve().with_suffix(".so")
subprocess.run(["cc", "-O3", "-fPIC", "-shared", "-o", library, args.file, "-lm"], check=True)
call = getattr(ctypes.CDLL(str(library)), f"{args.file.stem}_control")

state = np.zeros((5, run.system.num_coordinates))  # q, v, q_ref, v_ref, a_ref
state[2] = 0.1
u, memory = np.zeros(run.system.num_inputs), np.zeros(pipeline.memory_size)
pointers = [ctypes.c_void_p(x.ctypes.data) for x in (*state, memory, u, memory)]
status = call(*pointers)
print("u:", dict(zip(run.input_labels, u.round(4), strict=True)), "status:", status)
expected, _, _ = pipeline(*torch.from_numpy(state), torch.zeros(len(memory)).double())
print("the same as before the export:", np.allclose(u, expected, rtol=1e-9))

start = time.perf_counter()
for _ in range(1000):
    call(*pointers)
print(f"{1e3 * (time.perf_counter() - start):.0f} µs a call")
