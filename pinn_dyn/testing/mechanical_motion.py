"""Suite for motions of mechanical systems: the balance of energy, and gradients."""

import torch
from scipy.integrate import simpson

from pinn_dyn.mechanics import Signal, rollout
from pinn_dyn.testing.finite_differences import assert_near, partial_derivatives, product, slope


class MotionContract:
    """The part of :class:`~.mechanical_system.MechanicalSystemContract` about motions."""

    difference_tolerance = 1e-7  # of a derivative by the five-point stencil
    difference_step = 1e-3
    gradient_tolerance = 5e-9  # of a gradient through a step
    steps = 10  # of a roll-out, even
    step_times_rate = 0.02  # step times the largest eigenvalue of the dynamics at its start
    rollout_tolerance = 1e-5

    def test_power_is_the_rate_of_the_total_energy(self, system, configurations):
        q, v, _, u = configurations
        a = system.forward_dynamics(q, v, u)
        # A time step in which the velocity does not change by more than about one unit.
        step = self.difference_step / max(1.0, float(a.abs().max()))
        energy = lambda e: system.total_energy(q + e * v + 0.5 * e * e * a, v + e * a)  # noqa: E731
        expected = slope(energy, step)
        assert_near(system.power(q, v, u), expected, self.difference_tolerance)

    def test_rollouts_balance_the_energy_and_agree_in_both_forms(self, system, configurations):
        """E(T) - E(0) is the integral of v^T A u - v^T (D v + F), under a linear input."""
        end = self.steps * self._step(system, configurations)
        t = torch.linspace(0, end, self.steps + 1, dtype=torch.float64)
        q, v = self._rollout(system, configurations, system.velocity_derivative, t).chunk(2, -1)
        hamiltonian = self._rollout(system, configurations, system.momentum_derivative, t)
        q_hamiltonian, p = hamiltonian.chunk(2, -1)
        moved = (q - q[..., :1, :]).abs().max()
        assert_near(q_hamiltonian, q, self.rollout_tolerance, scale=moved)
        assert_near(system.velocity(q_hamiltonian, p), v, self.rollout_tolerance)
        u = self._input(configurations, t)
        supplied = (product(system.input_matrix(q), u) * v).sum(-1)
        lost = (system.dissipative_force(q, v) * v).sum(-1)
        work = torch.from_numpy(simpson((supplied - lost).numpy(), x=t.numpy(), axis=-1))
        energy = system.total_energy(q, v)
        turnover = simpson((supplied.abs() + lost.abs()).numpy(), x=t.numpy(), axis=-1).max()
        change = energy[..., -1] - energy[..., 0]
        assert_near(change, work, self.rollout_tolerance, scale=turnover)

    def _step(self, system, configurations):
        q, v, _, u = configurations
        x = torch.cat([q, v], -1)
        rate = lambda x: system.velocity_derivative(x, u.expand(*x.shape[:-1], -1))  # noqa: E731
        jacobian = partial_derivatives(rate, x, self.difference_step)
        return self.step_times_rate / float(torch.linalg.eigvals(jacobian).abs().max())

    def _input(self, configurations, t):
        """Return an input from u to -u, ``(8, T, M)``."""
        return (1 - 2 * t / t[-1])[:, None] * configurations.u[:, None, :]

    def _rollout(self, system, configurations, derivative, t):
        q, v, _, _ = configurations
        second = v if derivative == system.velocity_derivative else system.momentum(q, v)
        u = self._input(configurations, t[[0, -1]])
        return rollout(derivative, torch.cat([q, second], -1), t, Signal(t[[0, -1]], u))

    def test_gradients_through_an_rk4_step_match_finite_differences(self, system, configurations):
        """Compare slopes along random directions in the initial state, input and parameters."""
        q, v, a, u = configurations
        second = v if system.state == "qv" else system.momentum(q, v)
        x0, u = torch.cat([q, second], -1), torch.stack([u, -u], -2)
        t = torch.tensor([0.0, self._step(system, configurations)], dtype=torch.float64)
        weights = torch.cat([a, v], -1) / t[-1]

        def loss():
            return (weights * system.increments(x0, t, Signal(t, u))[..., -1, :]).sum()

        groups = {"x0": [x0], "u": [u], "parameters": list(system.parameters())}
        leaves = [leaf for group in groups.values() for leaf in group]
        with torch.enable_grad():
            for leaf in leaves:
                leaf.requires_grad_(True)
            value = loss()
            slopes = torch.autograd.grad(value, leaves, materialize_grads=True)
        gradients = dict(zip(leaves, slopes, strict=True))
        generator = torch.Generator().manual_seed(1)
        for name, group in groups.items():
            directions = [torch.randn(leaf.shape, generator=generator).double() for leaf in group]
            directions = [direction / direction.norm() for direction in directions]
            starts = [leaf.detach().clone() for leaf in group]

            def shifted(e, group=group, starts=starts, directions=directions):
                for leaf, start, direction in zip(group, starts, directions, strict=True):
                    leaf.copy_(start + e * direction)
                return loss()

            expected = slope(shifted, self.difference_step)
            for leaf, start in zip(group, starts, strict=True):
                leaf.copy_(start)
            pairs = [(gradients[leaf], d) for leaf, d in zip(group, directions, strict=True)]
            actual = sum((gradient * direction).sum() for gradient, direction in pairs)
            error = float(abs(actual - expected))
            norm = sum(float(gradient.square().sum()) for gradient, _ in pairs) ** 0.5
            assert error <= self.gradient_tolerance * (norm + float(value.abs())), name
