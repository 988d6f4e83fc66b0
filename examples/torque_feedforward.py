"""The inputs that move a robot along a planned path: its learned inverse dynamics.

python examples/torque_feedforward.py runs/own_log    the folder of own_log.py, or of train.py
"""

import argparse
import sys

import numpy as np

import pinn_dyn

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument(
    "run", help="a run folder of model=lnn or hnn, with as many inputs as coordinates"
)
model = pinn_dyn.load(parser.parse_args().run)

# From one configuration of the training data to another, at rest at both ends, in a second.
scales = model.statistics
low, high = (np.asarray(scales.q_mean) + s * np.asarray(scales.q_std) for s in (-0.5, 0.5))
t = np.linspace(0, 1, 101)
x = t[:, None]
q = low + (10 * x**3 - 15 * x**4 + 6 * x**5) * (high - low)
v = (30 * x**2 - 60 * x**3 + 30 * x**4) * (high - low)
a = (60 * x - 180 * x**2 + 120 * x**3) * (high - low)

u = model.input_for(q, v, a)
print("inputs at the start:", dict(zip(model.input_labels, u[0].round(3), strict=True)))
print("inputs at the end:  ", dict(zip(model.input_labels, u[-1].round(3), strict=True)))

# The model itself, under these inputs, goes along the path.
followed = model.predict(np.concatenate([q[0], v[0]]), u, t)[:, : q.shape[1]]
distance = np.abs(followed - q).max(axis=0)
print("largest distance from the path:", distance.round(5))
if not (distance < np.ptp(q, axis=0)).all():  # also true where the prediction is NaN
    sys.exit("the model leaves the path: train it for longer, or on a log of all inputs")
