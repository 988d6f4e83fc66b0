"""Gauss-Newton steps against SciPy, with outliers and far from the solution."""

import numpy as np
import pytest
import scipy
import torch

from pinn_dyn.training.constants_fit import Prior
from pinn_dyn.training.gauss_newton import GaussNewton

TRUTH = np.array([1.0, -2.0, 0.5])


def exponential_problem(outliers):
    """Residuals of ``exp(X z) - y`` and their derivatives, with 10 % of outliers."""
    generator = np.random.default_rng(0)
    rows = generator.normal(size=(400, 3))
    y = np.exp(rows @ TRUTH) + 0.1 * generator.normal(size=400)
    y[: outliers * 40] += 5.0

    def residuals(z):
        return np.exp(rows @ z) - y

    def evaluate(z, derivative):
        values = np.exp(rows @ z.numpy())
        return torch.from_numpy(values[:, None] * rows if derivative else values - y)

    return residuals, evaluate


@pytest.mark.parametrize("robust", [False, True])
def test_the_minimum_is_that_of_scipy(robust):
    residuals, evaluate = exponential_problem(outliers=1)
    zero = torch.zeros(3, dtype=torch.float64)
    prior = Prior(zero, 1e-3 * torch.eye(3, dtype=torch.float64))
    problem = GaussNewton(evaluate, zero, prior, 1.0, robust)
    reports = []
    assert problem.minimize(100, 1e-9, lambda: reports.append(problem.noise))
    loss = {"loss": "soft_l1", "f_scale": problem.scale} if robust else {}
    expected = scipy.optimize.least_squares(residuals, TRUTH, xtol=1e-12, ftol=1e-12, **loss)
    np.testing.assert_allclose(problem.z, expected.x, rtol=1e-3)
    assert np.abs(problem.z.numpy() - TRUTH).max() < (0.02 if robust else np.inf)
    assert len(reports) == problem.evaluations - 1 < 100
    gradient = problem.slopes.T @ problem.data
    assert float(gradient.norm()) < 1e-2 * float(problem.slopes.norm() * problem.data.norm())


def test_the_limit_of_evaluations_ends_with_the_best_z():
    _, evaluate = exponential_problem(outliers=0)
    zero = torch.zeros(3, dtype=torch.float64)
    problem = GaussNewton(evaluate, zero, Prior(zero, torch.eye(3).double()), 1.0, True)
    before = problem.noise
    assert not problem.minimize(3, 1e-9, lambda: None)
    assert problem.evaluations == 3
    assert float(evaluate(problem.z, False).square().mean()) == pytest.approx(problem.noise**2)
    assert problem.noise < before


def test_the_end_does_not_depend_on_the_number_of_equal_residuals():
    """A cost of 40,000 residuals at the noise floor hides steps of many standard deviations."""
    _, evaluate = exponential_problem(outliers=0)
    zero = torch.zeros(3, dtype=torch.float64)
    prior = Prior(zero, 1e-3 * torch.eye(3, dtype=torch.float64))

    def repeated(z, derivative):
        return evaluate(z, derivative).repeat_interleave(100, dim=0)

    one, many, exact = (
        GaussNewton(*x, robust=False)
        for x in (
            (evaluate, zero, prior, 1.0),
            (repeated, zero, prior, 100.0),
            (repeated, zero, prior, 1.0),
        )
    )
    for problem in (one, many, exact):
        problem.minimize(100, 2.0, lambda: None)
    torch.testing.assert_close(many.z, one.z)
    best = GaussNewton(evaluate, exact.z, prior, 1.0, robust=False)
    best.minimize(100, 1e-12, lambda: None)
    deviations = (exact.slopes @ (exact.z - best.z)).square().sum()
    assert float(deviations) < 2.0


@pytest.mark.parametrize("robust", [False, True])
def test_the_weight_of_the_data_never_decreases(robust):
    """Larger residuals, as after a step to less likely constants, do not favor the prior."""
    _, evaluate = exponential_problem(outliers=0)
    zero = torch.zeros(3, dtype=torch.float64)
    problem = GaussNewton(evaluate, zero, Prior(zero, torch.eye(3).double()), 1.0, robust)
    problem.minimize(100, 1e-9, lambda: None)
    weight, errors = problem._weight, evaluate(problem.z, False)
    problem._move(problem.z, 10 * errors, torch.inf)
    assert problem._weight == weight
    problem._move(problem.z, errors / 10, torch.inf)
    assert problem._weight == pytest.approx(10 * weight, rel=0.05)
