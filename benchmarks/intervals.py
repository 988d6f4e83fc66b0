"""Coverage of the intervals of constants on 50 arms that stick.

python -m benchmarks.intervals [currents]

With ``currents`` the inputs of 50 two-link arms are currents of unknown gain. Gains are drawn from
their prior. All constants are also compared per gain: those of a drive by its own gain, those of
bodies by that of the first joint.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.identification.constants import constants_covariance, constants_table
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import Fit, LeastSquares
from tests.support.sticking_arms import Arms, logs, random_arms, simulated

RESULTS = Path(__file__).parent / "results"
COUNTS = {2: 17, 3: 17, 4: 16}  # arms of each number of joints
RATES = (100.0, 200.0, 500.0)  # Hz
INERTIAL = 10  # parameters of a body, in the first rows of the table
GAIN, GAIN_SPREAD = 10.0, 0.5  # prior of the gains, Nm/A


def table_of(
    arms: Arms, q: np.ndarray, u: np.ndarray, arm: int, currents: bool = False
) -> pd.DataFrame:
    """Fit an arm by its inverse dynamics, and add the truth and the kind of each constant."""
    joints = q.shape[-1]
    generator = np.random.default_rng(1000 * joints + arm)
    noise = np.exp(generator.uniform(np.log(1e-4), np.log(1e-3))), generator.uniform(0.005, 0.03)
    rate = RATES[arm % len(RATES)]
    gains, settings = np.ones(joints), {}
    if currents:
        gains = GAIN * np.exp(GAIN_SPREAD * generator.normal(size=joints))
        settings = {"drive_gain": GAIN, "gain_spread": GAIN_SPREAD}
    runs = logs(q[:, :, arm], u[:, :, arm] / gains, rate, generator, noise)
    stride = max(round(0.02 * rate), 1)
    windows = draw_windows(runs, count=150, steps=10, stride=stride, seed=arm)
    chain = RigidChain(arms.urdf(arm))
    build = partial(KnownMechanics, start="generic", friction=CoulombFriction, **settings)
    model = build(windows.statistics(), chain).double()
    model.structure = RigidChain(arms.urdf(arm))
    fit = LeastSquares(cutoff=6.0, rollouts=False, samples=500 if currents else 2000)
    result = fit.fit(model, runs)
    table = constants_table(model, result)
    drives = [arms.armature, arms.viscous, arms.offset, arms.dry, 0 * arms.dry]
    truth = [arms.inertial(arm).T.flatten(), *(values[arm] for values in drives)]
    truth += [gains] if currents else []
    kind = table.name.str.replace(" of .*", "", regex=True)
    kind[: INERTIAL * joints] = "inertial"
    table = table.assign(joints=joints, arm=arm, truth=np.concatenate(truth), kind=kind)
    return per_gain(table, model, result) if currents else table


def per_gain(table: pd.DataFrame, model: KnownMechanics, fit: Fit) -> pd.DataFrame:
    """Divide constants, truths and intervals by a gain, without widths and gains themselves."""
    joints, c = model.num_coordinates, table.value.to_numpy()
    first, index = len(c) - joints, np.arange(len(c))
    gain = first + np.array(
        [0] * INERTIAL * joints + (index[INERTIAL * joints :] % joints).tolist()
    )
    slope = np.eye(len(c)) / c[gain, None]
    slope[index, gain] -= c / c[gain] ** 2
    after, before = (
        np.einsum("ij,jk,ik->i", slope, x.numpy(), slope) for x in constants_covariance(model, fit)
    )
    ratio, truth = c / c[gain], table.truth.to_numpy() / table.truth.to_numpy()[gain]
    width = 1.96 * np.sqrt(after.clip(0))
    lower = np.where(table.low == 0, 0.0, -np.inf)
    ratios = table.assign(value=ratio, truth=truth, low=np.maximum(ratio - width, lower))
    ratios = ratios.assign(high=ratio + width, known=1 - after / before.clip(1e-300))
    ratios = ratios[~table.kind.isin(["drive gain", "friction width"])]
    return pd.concat([table, ratios.assign(kind=ratios.kind + " per gain")])


def main(currents: bool) -> None:
    """Print the coverage of each kind of constant, and write it to ``results/``."""
    torch.set_num_threads(1)
    tables = []
    for number, count in ({2: 50} if currents else COUNTS).items():
        generator = np.random.default_rng(number)
        arms = random_arms(count, number, generator)
        q, u = simulated(arms, 1 if currents else 2, 10.0, generator)
        tables += [table_of(arms, q, u, arm, currents) for arm in range(count)]
    table = pd.concat(tables)
    table["inside"] = (table.low <= table.truth) & (table.truth <= table.high)
    kinds = table.groupby("kind").inside.agg(["mean", "size"])
    measured = table[table.known > 0.9]
    kinds["mean_if_known"] = measured.groupby("kind").inside.mean()
    kinds["size_if_known"] = measured.groupby("kind").size()
    name = "intervals_currents.csv" if currents else "intervals.csv"
    kinds.to_csv(RESULTS / name, float_format="%.4g")
    print(kinds.round(3).to_string())
    print(f"all constants: {table.inside.mean():.1%} of {len(table)}")
    print(f"constants with known > 0.9: {measured.inside.mean():.1%} of {len(measured)}")


if __name__ == "__main__":
    main("currents" in sys.argv[1:])
