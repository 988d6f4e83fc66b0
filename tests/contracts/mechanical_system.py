"""What every mechanical system must satisfy, analytic or learned.

Inherit :class:`MechanicalSystemContract` in a test class and override the ``system`` fixture.
Derivatives are checked against finite differences of M and V, in float64, and the dynamics
against the balance of energy; no check repeats the computation that it tests.
"""

import copy
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from pinn_dyn.mechanics import MechanicalSystem, Signal
from tests.contracts.mechanical_motion import MotionContract, product
from tests.support.finite_differences import assert_near, partial_derivatives, slope


class Configurations(NamedTuple):
    """A batch of eight points to test at, float64."""

    q: Tensor  # (8, N)
    v: Tensor  # (8, N)
    a: Tensor  # (8, N)
    u: Tensor  # (8, M)


def quantities(system, at):
    """Everything that the contract computes: value and the shape of one sample, by name."""
    q, v, a, u = at
    n, m = system.num_coordinates, system.num_inputs
    terms = system.terms(q)
    return {
        "mass_matrix": (system.mass_matrix(q), (n, n)),
        "damping_matrix": (system.damping_matrix(q), (n, n)),
        "input_matrix": (system.input_matrix(q), (n, m)),
        "potential_energy": (system.potential_energy(q), ()),
        "potential_force": (system.potential_force(q), (n,)),
        "terms.M": (terms.M, (n, n)),
        "terms.D": (terms.D, (n, n)),
        "terms.G": (terms.G, (n,)),
        "terms.A": (terms.A, (n, m)),
        "coriolis_matrix": (system.coriolis_matrix(q, v), (n, n)),
        "forward_dynamics": (system.forward_dynamics(q, v, u), (n,)),
        "inverse_dynamics": (system.inverse_dynamics(q, v, a), (n,)),
        "momentum": (system.momentum(q, v), (n,)),
        "velocity": (system.velocity(q, a), (n,)),
        "kinetic_energy": (system.kinetic_energy(q, v), ()),
        "total_energy": (system.total_energy(q, v), ()),
        "power": (system.power(q, v, u), ()),
        "velocity_derivative": (system.velocity_derivative(torch.cat([q, v], -1), u), (2 * n,)),
        "momentum_derivative": (system.momentum_derivative(torch.cat([q, a], -1), u), (2 * n,)),
    }


class MechanicalSystemContract(MotionContract):
    """The suite. Tolerances are relative to the largest entry of what is compared."""

    exact_tolerance = 1e-9
    """Between two float64 computations of the same quantity."""
    float32_tolerance = 1e-3
    """Between float32 and float64; the accelerations lose the condition number of M."""

    @pytest.fixture
    def system(self) -> MechanicalSystem:
        """The implementation, in float64."""
        raise NotImplementedError("override the fixture 'system'")

    @pytest.fixture
    def configurations(self, system) -> Configurations:
        """Where to test; override if the system lives in another range than [-1, 1]."""
        generator = torch.Generator().manual_seed(0)
        n, m = system.num_coordinates, system.num_inputs
        values = (
            2 * torch.rand(8, size, generator=generator, dtype=torch.float64) - 1
            for size in (n, n, n, m)
        )
        return Configurations(*values)

    @pytest.fixture(autouse=True)
    def _values_only(self):
        """No graph is recorded, as in a deployed controller; gradients are tested on their own."""
        with torch.no_grad():
            yield

    # Shapes and types.

    def test_any_batch_shape_gives_the_same_numbers(self, system, configurations):
        """As one batch of eight, two by four, and the first and the last alone."""
        expected = quantities(system, configurations)

        def assert_same(batch, at, part):
            for name, (value, shape) in quantities(system, at).items():
                assert value.shape == (*batch, *shape), (name, batch)
                one = part(expected[name][0])
                scale = 1e-12 + one.abs().max()
                assert_near(value.reshape(one.shape), one, self.exact_tolerance, scale)

        for name, (value, shape) in expected.items():
            assert value.shape == (8, *shape), name
        rows = Configurations(*(x.reshape(2, 4, -1) for x in configurations))
        assert_same((2, 4), rows, lambda value: value)
        for i in (0, 7):
            one = Configurations(*(x[i] for x in configurations))
            assert_same((), one, lambda value, i=i: value[i])

    def test_float32_in_gives_float32_out_close_to_float64(self, system, configurations):
        exact = quantities(system, configurations)
        at = Configurations(*(x.float() for x in configurations))
        for name, (value, _) in quantities(copy.deepcopy(system).float(), at).items():
            assert value.dtype == torch.float32, name
            scale = max(1e-6, float(exact[name][0].abs().max()))
            assert_near(value.double(), exact[name][0], self.float32_tolerance, scale)

    def test_a_wrong_shape_is_refused_by_name(self, system, configurations):
        values = dict(configurations._asdict(), p=configurations.a)
        for call, names, wrongs in [
            ("terms", "q", "q"),
            ("potential_force", "q", "q"),
            ("coriolis_matrix", "qv", "qv"),
            ("forward_dynamics", "qvu", "qvu"),
            ("inverse_dynamics", "qva", "qva"),
            ("momentum", "qv", "qv"),
            ("velocity", "qp", "qp"),
            ("kinetic_energy", "qv", "v"),
            ("total_energy", "qv", "q"),
            ("power", "qvu", "qvu"),
        ]:
            for wrong in wrongs:
                longer = torch.cat([values[wrong], values[wrong][..., :1]], -1)
                given = [longer if name == wrong else values[name] for name in names]
                with pytest.raises(ValueError, match=rf"^{wrong} has shape"):
                    getattr(system, call)(*given)

    def test_prediction_refuses_a_wrong_shape_by_name(self, system, configurations):
        q, v, _, u = configurations
        x0, u = torch.cat([q, v], -1), torch.stack([u, u], -2)
        t = torch.tensor([0.0, 0.1], dtype=torch.float64)
        with pytest.raises(ValueError, match=r"^x0 has shape"):
            system.predict(x0[..., :-1], t, Signal(t, u))
        with pytest.raises(ValueError, match=r"^u has shape"):
            system.predict(x0, t, Signal(t, u[..., :-1]))

    # The four terms.

    def test_mass_matrix_is_symmetric_positive_definite(self, system, configurations):
        mass = system.mass_matrix(configurations.q)
        assert_near(mass, mass.mT, self.exact_tolerance)
        assert torch.linalg.eigvalsh(mass).min() > 0

    def test_damping_matrix_is_symmetric_positive_semidefinite(self, system, configurations):
        damping = system.damping_matrix(configurations.q)
        scale = 1e-12 + damping.abs().max()
        assert_near(damping, damping.mT, self.exact_tolerance, scale)
        assert torch.linalg.eigvalsh(damping).min() >= -self.exact_tolerance * scale

    def test_terms_agree_with_the_single_functions(self, system, configurations):
        q = configurations.q
        mass, damping, force, inputs = system.terms(q)
        assert_near(mass, system.mass_matrix(q), self.exact_tolerance)
        assert_near(damping, system.damping_matrix(q), self.exact_tolerance, scale=1)
        assert_near(force, system.potential_force(q), self.exact_tolerance)
        assert_near(inputs, system.input_matrix(q), self.exact_tolerance)

    def test_potential_force_is_the_slope_of_the_potential_energy(self, system, configurations):
        q = configurations.q
        expected = partial_derivatives(system.potential_energy, q, self.difference_step)
        assert_near(system.potential_force(q), expected, self.difference_tolerance)

    # The Coriolis terms.

    def test_dissipation_is_viscous_damping_and_a_passive_friction(self, system, configurations):
        q, v, _, _ = configurations
        friction = system.dissipative_force(q, v) - product(system.damping_matrix(q), v)
        power = (friction * v).sum(-1)
        assert (power >= -self.exact_tolerance * (1 + power.abs().max())).all()
        assert_near(system.dissipative_force(q, 0 * v), 0 * v, self.exact_tolerance, scale=1)

    def test_mass_rate_minus_twice_coriolis_is_skew_symmetric(self, system, configurations):
        q, v, _, _ = configurations
        mass_rate = slope(lambda e: system.mass_matrix(q + e * v), self.difference_step)
        rest = mass_rate - 2 * system.coriolis_matrix(q, v)
        scale = self._coriolis_scale(system, configurations)
        assert_near(rest, -rest.mT, self.difference_tolerance, scale)

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
        rest = system.inverse_dynamics(q, v, 0 * v) - system.potential_force(q) - lost
        assert_near(rest, expected, self.difference_tolerance, scale + lost.abs().max())

    def _coriolis_scale(self, system, configurations):
        """Magnitude of (dM/dq) v v if M changes by its own size over one unit of q."""
        speed = configurations.v.abs().max()
        return system.mass_matrix(configurations.q).abs().max() * (speed + speed**2)

    # The dynamics.

    def test_inverse_dynamics_undoes_forward_dynamics(self, system, configurations):
        q, v, _, u = configurations
        a = system.forward_dynamics(q, v, u)
        tau = product(system.input_matrix(q), u)
        assert_near(system.inverse_dynamics(q, v, a), tau, self.exact_tolerance)

    def test_velocity_undoes_momentum(self, system, configurations):
        q, v, _, _ = configurations
        assert_near(system.velocity(q, system.momentum(q, v)), v, self.exact_tolerance)

    def test_momentum_and_kinetic_energy_are_those_of_the_mass_matrix(self, system, configurations):
        q, v, _, _ = configurations
        p = product(system.mass_matrix(q), v)
        assert_near(system.momentum(q, v), p, self.exact_tolerance)
        assert_near(system.kinetic_energy(q, v), 0.5 * (p * v).sum(-1), self.exact_tolerance)

    def test_hamiltonian_and_lagrangian_form_agree(self, system, configurations):
        q, v, _, u = configurations
        mass = system.mass_matrix(q)
        mass_rate = slope(lambda e: system.mass_matrix(q + e * v), self.difference_step)
        a = system.forward_dynamics(q, v, u)
        expected = product(mass_rate, v) + product(mass, a)
        derivative = system.momentum_derivative(torch.cat([q, product(mass, v)], -1), u)
        q_rate, p_rate = derivative.chunk(2, -1)
        assert_near(q_rate, v, self.exact_tolerance)
        assert_near(p_rate, expected, self.difference_tolerance)

    def test_state_derivative_is_that_of_the_systems_own_coordinates(self, system, configurations):
        q, v, _, u = configurations
        x = torch.cat([q, v], -1)
        own = system.momentum_derivative if system.state == "qp" else None
        expected = (own or system.velocity_derivative)(x, u)
        assert_near(system.state_derivative(x, u), expected, self.exact_tolerance)

    def test_the_implicit_solver_solves_for_the_dissipation(self, system, configurations):
        """(1 - s J) k = r, with J put together from M and the slope of the dissipative force."""
        q, v, _, _ = configurations
        n = q.shape[-1]
        generator = torch.Generator().manual_seed(2)
        rate = torch.randn(*q.shape[:-1], 2 * n, generator=generator, dtype=q.dtype)
        mass = system.mass_matrix(q)
        # By autograd, one column of the slope by v_i at a time.
        ones = torch.eye(n, dtype=q.dtype)
        columns = [
            torch.func.jvp(lambda x: system.dissipative_force(q, x), (v,), (one.expand_as(v),))[1]
            for one in ones
        ]
        damping = torch.stack(columns, dim=-1)
        inverse = torch.linalg.inv(mass)
        one, zero = ones.expand_as(mass), torch.zeros_like(mass)
        if system.state == "qv":
            upper, lower = one, inverse @ damping
        else:
            upper, lower = inverse, damping @ inverse
        jacobian = torch.cat([torch.cat([zero, upper], -1), torch.cat([zero, -lower], -1)], -2)
        step = torch.tensor(0.01, dtype=q.dtype)
        second = system.momentum(q, v) if system.state == "qp" else v
        found = system.implicit_solver(torch.cat([q, second], -1), step)(rate)
        back = found - step * (jacobian @ found.unsqueeze(-1)).squeeze(-1)
        assert_near(back, rate, self.exact_tolerance)

    def test_closed_formulas_agree_with_automatic_differentiation(self, system, configurations):
        q, v, a, _ = configurations
        arguments = {
            "_potential_force": (q,),
            "_inertial_force": (q, v, a),
            "_acceleration": (q, v, a),
            "_hamiltonian_gradient": (q, a),
            "_momentum": (q, v),
            "_velocity": (q, a),
            "_kinetic_gradient": (q, v),
        }
        for name, values in arguments.items():
            own = getattr(system, name)(*values)
            base = getattr(MechanicalSystem, name)(system, *values)
            pairs = zip(own, base, strict=True) if isinstance(own, tuple) else [(own, base)]
            for actual, expected in pairs:
                scale = max(1e-12, float(expected.abs().max()))
                assert_near(actual, expected, self.exact_tolerance, scale)
