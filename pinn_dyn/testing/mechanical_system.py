"""Suite for mechanical systems, analytic or learned. Inherit it and override ``system``."""

import copy
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from pinn_dyn.mechanics import MechanicalSystem, Signal
from pinn_dyn.testing.finite_differences import (
    assert_near,
    largest,
    partial_derivatives,
    product,
    slope,
)


class Configurations(NamedTuple):
    """A batch of eight states to test at: q, v, a ``(8, N)`` and u ``(8, M)``, float64."""

    q: Tensor
    v: Tensor
    a: Tensor
    u: Tensor


OF_Q = ("mass_matrix", "damping_matrix", "input_matrix", "potential_energy", "potential_force")
OF_QV = ("coriolis_matrix", "dissipative_force", "momentum", "kinetic_energy", "total_energy")
FUNCTIONS = {
    **dict.fromkeys(OF_Q, "q"),
    **dict.fromkeys(OF_QV, "qv"),
    **{"forward_dynamics": "qvu", "power": "qvu", "inverse_dynamics": "qva", "velocity": "qp"},
}
"""Arguments of the functions of a mechanical system."""


def values_of(system, at):
    """Return the value of every function by name."""
    arguments = {**at._asdict(), "p": at.a}
    values = {name: getattr(system, name)(*map(arguments.get, k)) for name, k in FUNCTIONS.items()}
    for name in ("velocity_derivative", "momentum_derivative"):
        values[name] = getattr(system, name)(torch.cat([at.q, at.v], -1), at.u)
    return values


class MechanicalSystemContract:
    """Suite for M, V, D, A and the dynamics. Tolerances are relative to the largest entry."""

    exact_tolerance = 1e-9
    """Tolerance between two float64 computations of the same quantity."""
    float32_tolerance = 1e-3
    """Tolerance of float32."""
    difference_tolerance = 1e-7  # of a derivative by the five-point stencil
    difference_step = 1e-3
    gradient_tolerance = 5e-9  # of a gradient through a step
    step_times_rate = 0.02  # step times the largest eigenvalue of the dynamics at its start

    @pytest.fixture
    def system(self) -> MechanicalSystem:
        """Return the implementation, in float64."""
        raise NotImplementedError("override the fixture 'system'")

    @pytest.fixture
    def configurations(self, system) -> Configurations:
        """Return the states to test at, in [-1, 1]."""
        generator = torch.Generator().manual_seed(0)
        n, m = system.num_coordinates, system.num_inputs
        rows = (torch.rand(8, k, generator=generator, dtype=torch.float64) for k in (n, n, n, m))
        return Configurations(*(2 * x - 1 for x in rows))

    @pytest.fixture(autouse=True)
    def _no_graph(self):
        with torch.no_grad():
            yield

    def test_any_batch_shape_gives_the_same_numbers(self, system, configurations):
        expected = values_of(system, configurations)
        n, m = system.num_coordinates, system.num_inputs
        assert expected["mass_matrix"].shape == expected["damping_matrix"].shape == (8, n, n)
        assert expected["input_matrix"].shape == (8, n, m)
        assert expected["potential_energy"].shape == expected["power"].shape == (8,)
        assert expected["forward_dynamics"].shape == (8, n)
        blocks = Configurations(*(x.reshape(2, 4, -1) for x in configurations))
        last = Configurations(*(x[7] for x in configurations))
        for at, batch, index in ((blocks, (2, 4), slice(None)), (last, (), 7)):
            for name, value in values_of(system, at).items():
                part = expected[name][index]
                assert value.shape == (*batch, *expected[name].shape[1:]), (name, batch)
                scale = 1e-12 + largest(part)
                assert_near(value.reshape(part.shape), part, self.exact_tolerance, scale)

    def test_float32_is_close_to_float64(self, system, configurations):
        exact = values_of(system, configurations)
        at = Configurations(*(x.float() for x in configurations))
        for name, value in values_of(copy.deepcopy(system).float(), at).items():
            assert value.dtype == torch.float32, name
            scale = max(1e-6, largest(exact[name]))
            assert_near(value.double(), exact[name], self.float32_tolerance, scale)

    def test_a_wrong_shape_is_refused_by_name(self, system, configurations):
        arguments = {**configurations._asdict(), "p": configurations.a}
        for function in ("potential_force", "forward_dynamics", "inverse_dynamics", "velocity"):
            for name in FUNCTIONS[function]:
                changed = {**arguments, name: torch.nn.functional.pad(arguments[name], (0, 1))}
                with pytest.raises(ValueError, match=rf"^{name} has shape"):
                    getattr(system, function)(*(changed[key] for key in FUNCTIONS[function]))
        q, v, _, u = configurations
        t = torch.tensor([0.0, 0.1], dtype=torch.float64)
        with pytest.raises(ValueError, match=r"^x0 has shape"):
            system.predict(torch.cat([q, v, v], -1), t, Signal(t, torch.stack([u, u], -2)))

    def test_mass_matrix_is_symmetric_positive_definite(self, system, configurations):
        mass = system.mass_matrix(configurations.q)
        assert_near(mass, mass.mT, self.exact_tolerance)
        assert torch.linalg.eigvalsh(mass).min() > 0

    def test_damping_matrix_is_symmetric_positive_semidefinite(self, system, configurations):
        damping = system.damping_matrix(configurations.q)
        scale = 1e-12 + damping.abs().max()
        assert_near(damping, damping.mT, self.exact_tolerance, scale)
        assert torch.linalg.eigvalsh(damping).min() >= -self.exact_tolerance * scale

    def test_potential_force_is_the_slope_of_the_potential_energy(self, system, configurations):
        q = configurations.q
        expected = partial_derivatives(system.potential_energy, q, self.difference_step)
        assert_near(system.potential_force(q), expected, self.difference_tolerance)
        assert_near(system.terms(q).G, expected, self.difference_tolerance)

    def test_dissipation_is_viscous_damping_and_a_passive_friction(self, system, configurations):
        q, v, _, _ = configurations
        friction = system.dissipative_force(q, v) - product(system.damping_matrix(q), v)
        power = (friction * v).sum(-1)
        assert (power >= -self.exact_tolerance * (1 + power.abs().max())).all()
        assert_near(system.dissipative_force(q, 0 * v), 0 * v, self.exact_tolerance, scale=1)

    def test_mass_rate_minus_twice_coriolis_is_skew_symmetric(self, system, configurations):
        q, v, _, _ = configurations
        mass_rate = slope(lambda e: system.mass_matrix(q + e * v), self.difference_step)
        difference = mass_rate - 2 * system.coriolis_matrix(q, v)
        scale = self._coriolis_scale(system, configurations)
        assert_near(difference, -difference.mT, self.difference_tolerance, scale)

    def test_coriolis_force_is_that_of_the_lagrangian(self, system, configurations):
        q, v, _, _ = configurations
        slopes = partial_derivatives(system.mass_matrix, q, self.difference_step)
        # d/dt (dT/dv) - dT/dq at a = 0, with slopes[i, j, k] = dM_ij / dq_k.
        expected = torch.einsum("bijk,bk,bj->bi", slopes, v, v)
        expected -= 0.5 * torch.einsum("bjki,bj,bk->bi", slopes, v, v)
        scale = self._coriolis_scale(system, configurations)
        force = product(system.coriolis_matrix(q, v), v)
        assert_near(force, expected, self.difference_tolerance, scale)
        lost = system.dissipative_force(q, v)
        force = system.inverse_dynamics(q, v, 0 * v) - system.potential_force(q) - lost
        assert_near(force, expected, self.difference_tolerance, scale + lost.abs().max())

    def _coriolis_scale(self, system, configurations):
        speed = configurations.v.abs().max()
        return system.mass_matrix(configurations.q).abs().max() * (speed + speed**2)

    def test_inverse_dynamics_undoes_forward_dynamics(self, system, configurations):
        q, v, _, u = configurations
        a = system.forward_dynamics(q, v, u)
        tau = system.applied_force(q, v, u)
        if system.input_affine:
            assert_near(tau, product(system.input_matrix(q), u), self.exact_tolerance)
        scale = max(largest(tau), largest(system.potential_force(q)))
        assert_near(system.inverse_dynamics(q, v, a), tau, self.exact_tolerance, scale)

    def test_momentum_and_kinetic_energy_are_those_of_the_mass_matrix(self, system, configurations):
        q, v, _, _ = configurations
        p = product(system.mass_matrix(q), v)
        assert_near(system.momentum(q, v), p, self.exact_tolerance)
        assert_near(system.velocity(q, p), v, self.exact_tolerance)
        assert_near(system.kinetic_energy(q, v), 0.5 * (p * v).sum(-1), self.exact_tolerance)

    def test_hamiltonian_and_lagrangian_form_agree(self, system, configurations):
        q, v, _, u = configurations
        mass = system.mass_matrix(q)
        mass_rate = slope(lambda e: system.mass_matrix(q + e * v), self.difference_step)
        a = system.forward_dynamics(q, v, u)
        x = torch.cat([q, product(mass, v)], -1)
        q_rate, p_rate = system.momentum_derivative(x, u).chunk(2, -1)
        assert_near(q_rate, v, self.exact_tolerance)
        expected = product(mass_rate, v) + product(mass, a)
        assert_near(p_rate, expected, self.difference_tolerance)
        expected = torch.cat([q_rate, p_rate], -1)
        if system.state == "qv":
            x, expected = torch.cat([q, v], -1), torch.cat([v, a], -1)
        assert_near(system.state_derivative(x, u), expected, self.exact_tolerance)

    def test_implicit_solver_solves_for_the_dissipation(self, system, configurations):
        """(1 - s J) k = r, with J from M, stiff springs and the slope of the dissipative force."""
        q, v, _, _ = configurations
        n = q.shape[-1]
        generator = torch.Generator().manual_seed(2)
        rate = torch.randn(8, 2 * n, generator=generator, dtype=q.dtype)
        mass = system.mass_matrix(q)
        unit, lost = torch.eye(n, dtype=q.dtype), lambda x: system.dissipative_force(q, x)
        columns = [torch.func.jvp(lost, (v,), (e.expand_as(v),))[1] for e in unit]
        damping, inverse = torch.stack(columns, dim=-1), torch.linalg.inv(mass)
        if system.state == "qv":
            second, upper, lower = v, unit.expand_as(mass), inverse @ damping
        else:
            second, upper, lower = system.momentum(q, v), inverse, damping @ inverse
        zero = torch.zeros_like(mass)
        springs = zero + (0.0 if (stiffness := system.stiffness_matrix(q)) is None else stiffness)
        springs = inverse @ springs if system.state == "qv" else springs
        jacobian = torch.cat([torch.cat([zero, upper], -1), torch.cat([-springs, -lower], -1)], -2)
        step = torch.tensor(0.01, dtype=q.dtype)
        k = system.implicit_solver(torch.cat([q, second], -1), step)(rate)
        assert_near(k - step * product(jacobian, k), rate, self.exact_tolerance)

    def test_power_is_the_rate_of_the_total_energy(self, system, configurations):
        q, v, _, u = configurations
        a = system.forward_dynamics(q, v, u)
        # A time step in which the velocity does not change by more than about one unit.
        step = self.difference_step / max(1.0, float(a.abs().max()))
        energy = lambda e: system.total_energy(q + e * v + 0.5 * e * e * a, v + e * a)  # noqa: E731
        expected = slope(energy, step)
        assert_near(system.power(q, v, u), expected, self.difference_tolerance)

    def _step(self, system, configurations):
        q, v, _, u = configurations
        x = torch.cat([q, v], -1)
        rate = lambda x: system.velocity_derivative(x, u.expand(*x.shape[:-1], -1))  # noqa: E731
        jacobian = partial_derivatives(rate, x, self.difference_step)
        return self.step_times_rate / float(torch.linalg.eigvals(jacobian).abs().max())

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
