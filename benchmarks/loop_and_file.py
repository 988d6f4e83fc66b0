"""Compare closed loops with C files: every law with every stage around it.

    python -m benchmarks.loop_and_file [LAW ...]

The stages are an observer, a guard, a dead time of 0, 1 and 1.4 periods, limits of value and rate,
and two periods. The largest difference of an input over 200 periods, from the first call on, is
relative to the largest input. The table is in benchmarks/results/loop_and_file.csv.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd

from pinn_dyn.exports import c_file
from tests.support.pipelines import cases, combinations, compared

RESULTS = Path(__file__).parent / "results" / "loop_and_file.csv"


def main() -> None:
    """Write the rows of the table, and print a summary of each law."""
    c_file._compiled = lambda *_: None  # the comparison of the export itself takes long
    laws, wanted, rows = cases(), sys.argv[1:], []
    for combination in combinations():
        if wanted and combination.law not in wanted:
            continue
        with TemporaryDirectory() as folder:
            rows.append(compared(combination, laws[combination.law], Path(folder)))
        print(*rows[-1].values(), flush=True)
    table = pd.DataFrame(rows)
    table.to_csv(RESULTS, index=False, float_format="%.1e")
    groups = table.groupby("law", sort=False)
    summary = groups.agg(
        combinations=("law", "size"), refused=("refused", "count"), largest=("difference", "max")
    )
    print(summary.to_string())
    for law, message in table.groupby("law")["refused"].unique().explode().dropna().items():
        print(f"{law}: {message}")


if __name__ == "__main__":
    main()
