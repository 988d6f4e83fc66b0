"""Suite for integrators. Inherit it and override the ``kind`` fixture."""

import copy
import itertools

import pytest
import torch

from pinn_dyn.mechanics import Signal
from pinn_dyn.mechanics.integrators import Wrapped
from pinn_dyn.testing.finite_differences import assert_near, partial_derivatives
from pinn_dyn.testing.linear_system import damped_oscillators, exact_solution

START = torch.tensor([0.5, -0.3, 0.2, 0.8], dtype=torch.float64)


def samples(count, step, seed=0):
    """Return times and an input that jumps to an independent value at every sample."""
    generator = torch.Generator().manual_seed(seed)
    t = step * torch.arange(count, dtype=torch.float64)
    return t, torch.randn(count, 1, generator=generator, dtype=torch.float64)


def increments(system, integrator, x0, t, signal):
    """Return the increments by the integrator."""
    system.integrator = integrator
    return system.increments(x0, t, signal)


class IntegratorContract:
    """Suite for a one-step method, on a linear system with an exact solution."""

    @pytest.fixture
    def kind(self):
        """Return the class of the integrator."""
        raise NotImplementedError("override the fixture 'kind'")

    @pytest.fixture
    def system(self):
        """Return two damped oscillators."""
        return damped_oscillators().requires_grad_(False)

    @pytest.mark.parametrize("interpolation", ["hold", "linear"])
    def test_order_against_matrix_exponentials(self, kind, system, interpolation):
        t, u = samples(count=11, step=0.1)
        expected = exact_solution(system, START, t, u, interpolation) - START
        signal = Signal(t, u, interpolation)
        errors = [
            float((increments(system, kind(n), START, t, signal) - expected).abs().max())
            for n in (4, 8, 16)
        ]
        size = 2 ** kind(1).order
        assert all(0.7 * size < a / b < 1.4 * size for a, b in itertools.pairwise(errors)), errors

    def test_path_equals_the_single_steps(self, kind, system):
        t, u = samples(count=90, step=0.02)
        signal = Signal(t, u)
        path = increments(system, kind(1), START, t, signal)
        steps = increments(system, Wrapped(kind(1)), START, t, signal)
        torch.testing.assert_close(path, steps, rtol=0, atol=1e-12)
        assert torch.equal(path[0], torch.zeros_like(START))

    @pytest.mark.parametrize("interpolation", ["hold", "linear", "cubic"])
    def test_substeps_are_shorter_steps(self, kind, system, interpolation):
        t, u = samples(count=6, step=0.1)
        fine = torch.linspace(0, 0.5, 21, dtype=torch.float64)
        fine[::4] = t  # to the last digit, since a held input jumps at its samples
        signal = Signal(t, u, interpolation)
        divided = increments(system, kind(4), START, t, signal)
        short = increments(system, kind(1), START, fine, signal)[::4]
        torch.testing.assert_close(divided, short, rtol=0, atol=1e-13)

    def test_a_batch_gives_the_path_of_each_trajectory(self, kind, system):
        t, _ = samples(count=6, step=0.1)
        starts = torch.stack([START, -2 * START])
        inputs = torch.stack([samples(count=6, step=0.1, seed=seed)[1] for seed in range(2)])
        both = increments(system, kind(2), starts, t, Signal(t, inputs))
        for row in range(2):
            alone = increments(system, kind(2), starts[row], t, Signal(t, inputs[row]))
            torch.testing.assert_close(both[row], alone, rtol=0, atol=1e-13)

    def test_small_increments_keep_the_precision_of_float32(self, kind, system):
        x0 = torch.tensor([1000.3, -1000.7, 1.5, -2.5])
        t = torch.tensor([0.0, 1e-5], dtype=torch.float64)
        u = torch.ones(2, 1, dtype=torch.float64)
        exact = increments(system, kind(1), x0.double(), t, Signal(t, u))[-1]
        single = copy.deepcopy(system).float()
        rounded = increments(single, kind(1), x0, t, Signal(t, u.float()))[-1]
        assert ((rounded - exact) / exact).abs().max() < 1e-5

    def test_gradient_matches_finite_differences(self, kind, system):
        t, u = samples(count=4, step=0.1)

        def end(x):
            signal = Signal(t, u.expand(*x.shape[:-1], 4, 1))
            return increments(system, kind(1), x, t, signal)[..., -1, :].square().sum(-1)

        x = START.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(end(x), x)
        assert_near(gradient, partial_derivatives(end, START), 1e-6)
