"""Errors of windows in which the robot rests: python -m benchmarks.rest <run>..."""

import sys

import torch

import pinn_dyn
from pinn_dyn.evaluation.prediction import predict_trajectories
from pinn_dyn.mechanics import samples_of, stack_until

WINDOW, HORIZON = 1.0, 2.0  # s
SLOW = 0.01  # largest speed of a joint at rest, rad/s or m/s


def main(folders: list[str]) -> None:
    """Print the mean error at the end of test windows of 1 s, at rest and in motion.

    A window is at rest if no joint is faster than 0.01 rad/s. The first two seconds of the test
    trajectories are used, as in the tables.
    """
    for folder in folders:
        run = pinn_dyn.load(folder)
        truth = stack_until(run.source.load().test, HORIZON)
        step = run.statistics.step
        prediction = predict_trajectories(run.model, truth, window=WINDOW, step=step)
        samples, steps = (samples_of("window", WINDOW, t) for t in (truth.t, prediction.t))
        count = (len(prediction.t) - 1) // steps
        fast = truth.v.abs().amax(-1)
        pieces = [fast[:, k * samples : (k + 1) * samples + 1].amax(1) for k in range(count)]
        at_rest = torch.stack(pieces, dim=1) < SLOW
        error = prediction.error()[:, steps::steps][:, :count]
        print(
            f"{folder}: {int(at_rest.sum())} of {at_rest.numel()} windows at rest, error after 1 s "
            f"{float(error[at_rest].mean()):.2g}, in motion {float(error[~at_rest].mean()):.2g}"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
