"""Three sentences on what the demo has shown: python examples/demo_summary.py runs"""

import sys
from pathlib import Path

import pandas as pd


def rows(folder: Path, table: str = "summary") -> dict[str, dict]:
    """A table that evaluate.py or control.py wrote, by its first column."""
    return pd.read_csv(folder / f"{table}.csv", index_col=0).to_dict("index")


def errors(folder: Path) -> str:
    """Mean errors, the models before what they have to beat."""
    found = rows(folder)
    models = {k: row for k, row in found.items() if not row["baseline"]}
    parts = [f"{name} {row['error_mean']:.3g}" for name, row in models.items()]
    baseline = found["constant velocity"]["error_mean"]
    lost = [f"{name} {row['diverged']}" for name, row in models.items() if row["diverged"]]
    return f"{', '.join(parts)}; q + v t {baseline:.3g}" + (
        f" (diverged: {', '.join(lost)})" if lost else ""
    )


def main(runs: Path) -> None:
    """Print them."""
    pairs = {row["pairs"] for row in rows(runs / "demo-evaluation").values() if row["pairs"] > 0}
    control = rows(runs / "demo-control")
    reached = {name: row["step_error_after_1_s_mean_percent"] for name, row in control.items()}
    peak = control["learned"]["input_peak"]
    print(
        f"\n1. Learned from {min(pairs):.0f} pairs of states, mean error of five seconds of unseen "
        f"motion [rad, m]: {errors(runs / 'demo-evaluation')}.\n"
        f"2. A third beyond the range of the training: {errors(runs / 'demo-beyond')}.\n"
        f"3. Only a model with structure has the matrices that a controller needs: with at most "
        f"{peak:.2g} Nm or N the arm is {reached['learned']:.2g} % of its step from the set point "
        f"after a second by the learned matrices, {reached['truth']:.2g} % by the true ones, "
        f"{reached['pd']:.2g} % without a model."
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs"))
