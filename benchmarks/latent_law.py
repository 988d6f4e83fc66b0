"""Close the loop of the law on oscillators at several gains and rates.

    python -m benchmarks.latent_law RUN

RUN is a run of model=oscillators on dataset=soft_arm_tendon. Prints the largest error from 1 s to
1.5 s after the step, in percent of the step: the mean and the worst of 20 set points, and the
number of stopped runs. The gains are factors of those of experiment=soft_arm_tendon/latent.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd

POSITION, VELOCITY, INTEGRAL = 0.3, 0.03, 10.0  # without a unit, s, 1/s
DEAD_TIME = 0.01  # s
COLUMNS = {
    "step_error_after_1_s_mean_percent": "mean [%]",
    "step_error_after_1_s_worst_percent": "worst [%]",
    "stopped": "stopped",
}
ROOT = Path(__file__).resolve().parents[1]


def closed_loop(run: str, factor: float, rate: float) -> dict[str, float]:
    """Return the row of a table for a factor of all gains and a rate in 1/s."""
    with TemporaryDirectory() as folder:
        overrides = [
            "experiment=soft_arm_tendon/latent",
            f"run='{Path(run).resolve()}'",
            "runs=20",
            "animate=false",
            "~controllers.pid",
            "~controllers.truth",
            f"rate={rate:g}",
            f"dead_time={DEAD_TIME:g}",
            f"gains.position={POSITION * factor:g}",
            f"gains.velocity={VELOCITY * factor:g}",
            f"controllers.learned.law.integral_gain={INTEGRAL * factor:g}",
            f"hydra.run.dir='{folder}'",
        ]
        command = [sys.executable, str(ROOT / "control.py"), *overrides]
        # A run that was stopped ends the command with an error, after the tables are written.
        subprocess.run(command, capture_output=True, check=False)
        table = pd.read_csv(Path(folder) / "summary.csv")
    row = table[list(COLUMNS)].rename(columns=COLUMNS).iloc[0]
    return {"gains": factor, "rate [1/s]": rate, **row}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", help="folder of a training run")
    parser.add_argument("--gains", type=float, nargs="+", default=[0.25, 0.5, 1.0, 2.0, 4.0])
    parser.add_argument("--rates", type=float, nargs="+", default=[50.0, 100.0, 200.0, 400.0])
    options = parser.parse_args()
    pairs = [(factor, rate) for factor in options.gains for rate in options.rates]
    rows = [closed_loop(options.run, *pair) for pair in pairs]
    print(pd.DataFrame(rows).to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":
    main()
