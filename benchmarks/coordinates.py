"""How the cost of a Lagrangian network grows with its number of coordinates.

    python benchmarks/coordinates.py

Eager accelerations and the gradient of their square by all weights, batch 256, one thread: the
best of five. Networks of one layer of 32 units, so that what is seen is the mechanics.
"""

from __future__ import annotations

import time
from functools import partial

import torch

from pinn_dyn.models import (
    LagrangianNetwork,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    Statistics,
)

BATCH = 256
SIZES = (3, 6, 12, 24, 48)


def make_model(size: int) -> LagrangianNetwork:
    """A network with N inputs on scales that are all one."""
    torch.manual_seed(0)
    one, increment = torch.ones(size), torch.ones(1, 2 * size)
    statistics = Statistics(
        0 * one, one, -3 * one, 3 * one, one, one, 0 * one, one, increment, increment, 1.0
    )
    head = partial(NetworkCholesky, hidden=[32])
    potential, matrix = (partial(kind, hidden=[32]) for kind in (NetworkPotential, NetworkInput))
    return LagrangianNetwork(statistics, head, potential, head, matrix)


def seconds(size: int) -> float:
    """Of one forward and backward pass."""
    model = make_model(size)
    q, v, u = (torch.randn(BATCH, size) for _ in range(3))
    best = float("inf")
    for _ in range(5):
        start = time.perf_counter()
        model.forward_dynamics(q, v, u).square().mean().backward()
        best = min(best, time.perf_counter() - start)
    return best


def main() -> None:
    """Print a row for each number of coordinates."""
    torch.set_num_threads(1)
    for size in SIZES:
        print(f"N = {size:2d}: {1e3 * seconds(size):7.1f} ms")


if __name__ == "__main__":
    main()
