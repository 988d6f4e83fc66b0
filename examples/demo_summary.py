"""Print three results of the demo: python examples/demo_summary.py runs"""

import sys
from pathlib import Path

import pandas as pd


def rows(folder: Path, table: str = "summary") -> dict[str, dict]:
    """Return a table of evaluate.py or control.py by the first column."""
    return pd.read_csv(folder / f"{table}.csv", index_col=0).to_dict("index")


def errors(folder: Path) -> str:
    """Return the mean errors of the models, and of the baseline."""
    table = rows(folder)
    models = {k: row for k, row in table.items() if not row["baseline"]}
    parts = [f"{name} {row['error_mean']:.3g}" for name, row in models.items()]
    baseline = table["constant velocity"]["error_mean"]
    diverged = [f"{name} {row['diverged']}" for name, row in models.items() if row["diverged"]]
    return f"{', '.join(parts)}; q + v t {baseline:.3g}" + (
        f" (diverged: {', '.join(diverged)})" if diverged else ""
    )


def main(runs: Path) -> None:
    """Print the results in the folder ``runs``."""
    pairs = {row["pairs"] for row in rows(runs / "demo-evaluation").values() if row["pairs"] > 0}
    control = rows(runs / "demo-control")
    reached = {name: row["step_error_after_1_s_mean_percent"] for name, row in control.items()}
    peak = control["learned"]["input_peak"]
    print(
        f"\n1. Mean error over 5 s of test motions, from {min(pairs):.0f} pairs [rad, m]: "
        f"{errors(runs / 'demo-evaluation')}.\n"
        "   lnn has no measured momenta, unlike hnn, and needs more steps than the 3000 of this "
        "demo: with trainer.steps=9000, its errors are below those of mlp here and in 2.\n"
        f"2. On motions a third larger than in training: {errors(runs / 'demo-beyond')}.\n"
        f"3. Control with inputs of at most {peak:.2g} Nm or N: 1 s after a step, the arm is "
        f"{reached['learned']:.2g} % of the step from the set point with learned matrices, "
        f"{reached['truth']:.2g} % with true matrices, {reached['pd']:.2g} % without a model."
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs"))
