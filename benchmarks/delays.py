"""Delays found in simulated logs of known delay: python -m benchmarks.delays [draws]."""

import sys

import numpy as np

from pinn_dyn.data.logs import input_delays
from tests.support.delayed_robots import log

SAMPLE = 0.01


def main(draws: int) -> None:
    """Print, per robot, in how many draws every input's delay is within a sample of the truth."""
    for kind in ("pendulum", "arm", "tendons"):
        delays = [float(np.random.default_rng(1000 + k).uniform(0, 0.1)) for k in range(draws)]
        found = [input_delays([log(kind, k, d)]) for k, d in enumerate(delays)]
        errors = np.array(
            [
                [np.inf if c.delay is None else abs(c.delay - d) for c in curves]
                for curves, d in zip(found, delays, strict=True)
            ]
        )
        within = int((errors <= SAMPLE).all(axis=1).sum())
        print(
            f"{kind}: {within} of {draws} within a sample, {int(np.isinf(errors).sum())} of "
            f"{errors.size} without an answer, median error "
            f"{1e3 * np.median(errors):.1f} ms",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
