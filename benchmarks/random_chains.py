"""Random chains of bodies, fitted from generic ones: python -m benchmarks.random_chains [count]."""

import sys
from pathlib import Path

import pandas as pd
import torch

from tests.support.random_chains import fit_of_a_random_chain

RESULTS = Path(__file__).parent / "results" / "random_chains.csv"


def main(count: int) -> None:
    """Fit so many chains, print a line for each, and write all to ``results/``."""
    torch.set_num_threads(1)
    rows = []
    for seed in range(count):
        outcome = fit_of_a_random_chain(seed)
        rows.append({"seed": seed, **outcome._asdict()})
        words = ", ".join(f"{key} {value:.3g}" for key, value in rows[-1].items())
        print(words, flush=True)
    table = pd.DataFrame(rows)
    table.to_csv(RESULTS, index=False, float_format="%.4g")
    physical = ((table.smallest_mass > 0) & (table.smallest_slack > 0)).sum()
    print(f"physical: {physical} of {count}")
    print(f"deviation within three standard deviations: {(table.deviation < 3).sum()} of {count}")
    share = (table.inside * table.determined).sum() / table.determined.sum()
    print(f"constants in their 95 % intervals: {share:.1%}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
