"""Least squares on systems with constants: the truth is found, and lies in the intervals."""

import pytest
import torch

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.identification.constants import constants_table, undetermined
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.training import LeastSquares
from tests.support.known import known_arm, known_cart_pole, motions

RATE = 100.0  # Hz


def runs_of(truth, seed=0):
    """Two motions."""
    return motions(truth, [10 * seed, 10 * seed + 1], seconds=1.0, rate=RATE)


def noisy(runs, noise=0.01, seed=0):
    """The same with white noise, a part of the spread of q and v."""
    generator = torch.Generator().manual_seed(seed)
    return [
        Trajectory(
            *(
                x + noise * x.std(0) * torch.randn(x.shape, generator=generator).double()
                for x in (run.q, run.v)
            ),
            run.input,
        )
        for run in runs
    ]


@pytest.fixture(scope="module")
def arm_runs():
    """Four pairs of motions of the soft arm."""
    seeds = [10 * seed + k for seed in range(4) for k in range(2)]
    runs = motions(known_arm(), seeds, seconds=1.0, rate=RATE)
    return [runs[2 * seed : 2 * seed + 2] for seed in range(4)]


def fitted(model, runs, steps=1, **settings):
    windows = draw_windows(runs, count=60, steps=steps, stride=1, seed=0)
    fit = LeastSquares(cutoff=20.0, **settings).fit(model, runs, windows)
    return constants_table(model, fit).set_index("name"), fit


def true_values(truth):
    values = torch.cat([item.values for item in truth.physical_constants()])
    return values.detach().numpy()


STARTS = {
    "ten times": {"mass": 5.0, "stiffness": 200.0, "damping": 20.0},
    "mixed": {"mass": 1.5, "stiffness": 4.0, "damping": 10.0},
}


@pytest.mark.parametrize(
    "start",
    ["ten times", pytest.param("mixed", marks=pytest.mark.slow)],
)
def test_a_soft_arm_is_found_from_starts_that_are_far_off(arm_runs, start):
    truth = known_arm()
    table, fit = fitted(known_arm(**STARTS[start]), arm_runs[0])
    assert fit.residual < 1e-6
    assert table.value.to_numpy() == pytest.approx(true_values(truth), rel=1e-5)
    assert (table.known > 0.999).all()
    assert not undetermined(truth, fit)


def test_constants_that_are_not_linear_are_found_with_fewer_inputs_than_coordinates():
    truth, model = known_cart_pole(), known_cart_pole()
    for part in model.learned.values():
        part.start *= 3
    table, _ = fitted(model, runs_of(truth))
    assert table.value.to_numpy() == pytest.approx(true_values(truth), rel=1e-5)


@pytest.mark.parametrize(
    ("rollouts", "fits", "unlikely"),
    [(False, 4, 5), pytest.param(True, 2, 4, marks=pytest.mark.slow)],
    ids=["identification", "rollouts"],
)
def test_the_truth_lies_in_the_intervals(arm_runs, rollouts, fits, unlikely):
    """Of a fit's 7 constants from noisy motions 95 % should; 5 of 28, 4 of 14 outside are not."""
    truth, outside = known_arm(), 0
    for seed, runs in enumerate(arm_runs[:fits]):
        start = known_arm(mass=1.5, stiffness=100.0, damping=0.5)
        table, _ = fitted(start, noisy(runs, seed=seed), steps=2, rollouts=rollouts)
        true = true_values(truth)
        outside += int(((table.low > true) | (table.high < true)).sum())
        # Not by being wide: the intervals are a few per cent.
        assert ((table.high - table.low) / table.value).max() < 0.3
    assert outside < unlikely


def test_data_at_rest_are_refused(arm_runs):
    run = arm_runs[0][0]
    still = Trajectory(run.q[:1].expand_as(run.q), 0 * run.v, run.input)
    with pytest.raises(ValueError, match="no joint moves in the training trajectories"):
        fitted(known_arm(), [still])
