"""Rollouts far beyond the training data: python -m benchmarks.far_rollouts <run>..."""

import sys

import torch

import pinn_dyn
from pinn_dyn.mechanics import Signal, double_copy

COUNT, LONGER, LARGER = 20, 10, 1.5  # rollouts, and factors of the longest motion and the inputs
HOLD = 1.0  # s between two drawn inputs, which lines connect


def main(folders: list[str]) -> None:
    """Print the largest distance of q from the middle of its training range, in half ranges.

    The rollouts start at the first training state. The last tenth shows whether q still grows.
    """
    for folder in folders:
        run = pinn_dyn.load(folder)
        model, training = double_copy(run.model).requires_grad_(False), run.source.load().train
        duration = LONGER * max(item.duration for item in training)
        q, u = (torch.cat([getattr(item, name) for item in training]) for name in "qu")
        generator = torch.Generator().manual_seed(0)
        shape = COUNT, int(duration / HOLD) + 2, u.shape[-1]
        drawn = LARGER * (2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1)
        levels = (u.amax(0) + u.amin(0)) / 2 + drawn * (u.amax(0) - u.amin(0)) / 2
        input = Signal(HOLD * torch.arange(shape[1]).double(), levels)
        t = run.statistics.step * torch.arange(int(duration / run.statistics.step)).double()
        start = torch.cat([training[0].q[0], training[0].v[0]]).double().expand(COUNT, -1)
        with torch.no_grad():
            path = model.predict(start, t, input)[..., : model.num_coordinates]
        distance = (2 * path - q.amax(0) - q.amin(0)).abs() / (q.amax(0) - q.amin(0))
        last = distance[:, -len(t) // 10 :]
        print(
            f"{folder}: {COUNT} rollouts of {duration:.0f} s, largest distance "
            f"{float(distance.max()):.3g}, in the last tenth {float(last.max()):.3g}"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
