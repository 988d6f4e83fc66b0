"""Read an export of OptiTrack Motive by the names of its markers, and learn a swinging mass.

python examples/motion_capture.py [--steps 300]    writes take.csv
"""

import argparse
from pathlib import Path

import numpy as np

import pinn_dyn

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=300, help="optimizer steps")
args = parser.parse_args()

# What Motive exports: one row for each of type, name, ID, quantity and axis of a column.
head = """Format Version,1.23,Take Name,swing,Export Frame Rate,100,Length Units,Millimeters

,Type,Marker,Marker,Marker
,Name,mass,mass,mass
,ID,a:1,a:1,a:1
,,Position,Position,Position
Frame,Time (Seconds),X,Y,Z
"""
t = np.arange(0, 20, 0.01)
x = 80 * np.exp(-0.02 * t) * np.cos(4 * t)
z = 50 * np.exp(-0.03 * t) * np.sin(4 * t)
rows = [f"{k},{t[k]:.4f},{x[k]:.4f},800.0,{z[k]:.4f}\n" for k in range(len(t))]
Path("take.csv").write_text(head + "".join(rows))

run = pinn_dyn.fit(
    "take.csv",
    time={"columns": "Time (Seconds)", "unit": "s"},
    q={"columns": ["mass:X", "mass:Z"], "unit": "mm"},
    u=None,
    steps=args.steps,
)
print(run)
