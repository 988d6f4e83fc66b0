"""Coverage of the intervals of constants on 50 arms that stick: python -m benchmarks.intervals."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.evaluation.identification import constants_table
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.support.sticking_arms import Arms, logs, random_arms, simulated

RESULTS = Path(__file__).parent / "results" / "intervals.csv"
COUNTS = {2: 17, 3: 17, 4: 16}  # arms of each number of joints
RATES = (100.0, 200.0, 500.0)  # Hz
INERTIAL = 10  # parameters of a body, in the first rows of the table


def table_of(arms: Arms, q: np.ndarray, u: np.ndarray, arm: int) -> pd.DataFrame:
    """Fit an arm by its inverse dynamics, and add the truth and the kind of each constant."""
    joints = q.shape[-1]
    generator = np.random.default_rng(1000 * joints + arm)
    noise = np.exp(generator.uniform(np.log(1e-4), np.log(1e-3))), generator.uniform(0.005, 0.03)
    rate = RATES[arm % len(RATES)]
    runs = logs(q[:, :, arm], u[:, :, arm], rate, generator, noise)
    stride = max(round(0.02 * rate), 1)
    windows = draw_windows(runs, count=150, steps=10, stride=stride, seed=arm)
    chain = RigidChain(arms.urdf(arm))
    model = KnownMechanics(
        windows.statistics(), chain, start="generic", friction=CoulombFriction
    ).double()
    model.structure = RigidChain(arms.urdf(arm))
    fit = LeastSquares(cutoff=6.0, rollouts=False).fit(model, runs)
    table = constants_table(model, fit)
    drives = [arms.armature, arms.viscous, arms.offset, arms.dry, 0 * arms.dry]
    truth = [arms.inertial(arm).T.flatten(), *(values[arm] for values in drives)]
    kind = table.name.str.replace(" of .*", "", regex=True)
    kind[: INERTIAL * joints] = "inertial"
    return table.assign(joints=joints, arm=arm, truth=np.concatenate(truth), kind=kind)


def main(joints: list[int]) -> None:
    """Print the coverage of each kind of constant, and write it to ``results/``."""
    torch.set_num_threads(1)
    tables = []
    for number in joints:
        generator = np.random.default_rng(number)
        arms = random_arms(COUNTS[number], number, generator)
        q, u = simulated(arms, 2, 10.0, generator)
        tables += [table_of(arms, q, u, arm) for arm in range(COUNTS[number])]
    table = pd.concat(tables)
    table["inside"] = (table.low <= table.truth) & (table.truth <= table.high)
    kinds = table.groupby("kind").inside.agg(["mean", "size"])
    kinds.to_csv(RESULTS, float_format="%.4g")
    print(kinds.round(3).to_string())
    print(f"all constants: {table.inside.mean():.1%} of {len(table)}")
    measured = table[table.known > 0.9]
    print(f"constants with known > 0.9: {measured.inside.mean():.1%} of {len(measured)}")


if __name__ == "__main__":
    main([int(x) for x in sys.argv[1:]] or list(COUNTS))
