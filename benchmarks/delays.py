"""Delays found in simulated logs of known delay: python -m benchmarks.delays [draws] [first].

The thresholds were set on the draws 0 to 5. Of the seven joints the kinematics are known.
"""

import sys
from collections.abc import Sequence

import numpy as np

from pinn_dyn.log_check.delay import DelayCurve, input_delays
from tests.support.delayed_robots import log, seven_regressor

SAMPLE = 0.01


def main(draws: int, first: int) -> None:
    """Print, per robot, in how many draws every input's delay is within a sample of the truth."""
    for kind in ("pendulum", "arm", "seven joints", "tendons"):
        numbers = range(first, first + draws)
        delays = [float(np.random.default_rng(1000 + k).uniform(0, 0.1)) for k in numbers]
        logs = [log(kind, k, d) for k, d in zip(numbers, delays, strict=True)]
        rigid = seven_regressor if kind == "seven joints" else None
        curves = [input_delays([item], rigid=rigid) for item in logs]
        print(f"{kind}: {_words(curves, delays)}", flush=True)


def _words(results: Sequence[Sequence[DelayCurve]], delays: Sequence[float]) -> str:
    errors = np.array(
        [
            [np.inf if c.delay is None else abs(c.delay - d) for c in curves]
            for curves, d in zip(results, delays, strict=True)
        ]
    )
    within = int((errors <= SAMPLE).all(axis=1).sum())
    return (
        f"{within} of {len(errors)} within a sample, {int(np.isinf(errors).sum())} of "
        f"{errors.size} without an answer, median error {1e3 * np.median(errors):.1f} ms"
    )


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:]]
    main(*[*numbers, *(50, 0)[len(numbers) :]])
