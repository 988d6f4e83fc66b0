"""Load a trained model and predict what it was not trained on.

python examples/load_and_predict.py runs/own_log    the folder of own_log.py, or of train.py
"""

import argparse

import numpy as np

import pinn_dyn

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("run", help="a run folder")
model = pinn_dyn.load(parser.parse_args().run)
print(model)

# From rest in the middle of the training data, under a slow sine on the first input.
scales = model.statistics
N, M = model.model.num_coordinates, model.model.num_inputs
t = np.arange(101) * scales.step
u = np.tile(np.asarray(scales.u_mean), (len(t), 1))
u[:, 0] += np.asarray(scales.u_std)[0] * np.sin(2 * np.pi * t / t[-1])
start = np.concatenate([np.asarray(scales.q_mean), np.zeros(N)])

states = model.predict(start, u, t)
print(f"after {t[-1]:.3g} s:", dict(zip(model.labels, states[-1, :N].round(3), strict=True)))

# Many at once: twenty starts that differ a little show how errors of a start grow.
starts = start + 0.01 * np.random.default_rng(0).normal(size=(20, 2 * N))
spread = model.predict(starts, u, t)[..., :N].std(axis=0)
print("spread of twenty starts, first and last:", spread[0].round(4), spread[-1].round(4))
