"""What the base class promises beyond the contract suite."""

import numpy as np
import pytest
import torch

from pinn_dyn.mechanics import Sum
from pinn_dyn.testing import LinearSystem, damped_oscillators
from tests.support.cart_pole import CartPole


def test_forward_dynamics_solves_the_linear_equation_of_motion():
    system = damped_oscillators().requires_grad_(False)
    f, b = (torch.from_numpy(matrix) for matrix in system.state_space())
    x = torch.tensor([0.5, -0.3, 0.2, 0.8], dtype=torch.float64)
    u = torch.tensor([1.7], dtype=torch.float64)
    expected = f @ x + b @ u
    torch.testing.assert_close(system.velocity_derivative(x, u), expected)
    torch.testing.assert_close(system.forward_dynamics(x[:2], x[2:], u), expected[2:])


class Pushed(LinearSystem):
    """Masses with the residual force -0.3 q."""

    has_residual = True

    def _residual_force(self, q, v, u):
        return -0.3 * q


def test_a_sum_has_the_residual_of_any_part():
    """Two equal masses on two equal springs move as one, the residual halved."""
    plain = damped_oscillators()
    pushed = Pushed(plain.mass, plain.stiffness, plain.damping, plain.inputs)
    q, v, u = (torch.tensor(x).double() for x in ([0.5, -0.3], [0.2, 0.8], [1.7]))
    for parts in ((plain, pushed), (pushed, plain)):
        total = Sum(dict(zip("ab", parts, strict=True)))
        assert total.has_residual
        residual = torch.linalg.solve(2 * plain.mass, -0.3 * q)
        expected = plain.forward_dynamics(q, v, u) + residual
        torch.testing.assert_close(total.forward_dynamics(q, v, u), expected)


def test_forward_dynamics_matches_the_cart_poles_textbook_equations():
    """Barto, Sutton and Anderson 1983 in Lagrangian form, angle from the hanging position."""
    system = CartPole().requires_grad_(False)
    q = torch.tensor([0.3, 0.7], dtype=torch.float64)
    v = torch.tensor([-0.5, 1.1], dtype=torch.float64)
    cart, bob, rod, g = 1.5, 0.4, 0.6, 9.81
    sin, cos = torch.sin(q[1]), torch.cos(q[1])
    ax, turn = system.forward_dynamics(q, v, torch.tensor([2.0], dtype=torch.float64))
    push = 2.0 - 4.0 * q[0] - 0.3 * v[0]
    on_cart = (cart + bob) * ax + bob * rod * (cos * turn - sin * v[1] ** 2)
    on_bob = bob * rod * cos * ax + bob * rod**2 * turn + bob * g * rod * sin + 0.05 * v[1]
    torch.testing.assert_close(on_cart, push, rtol=1e-12, atol=0)
    torch.testing.assert_close(on_bob, torch.zeros_like(on_bob), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("n", "m"), [(2, 2), (2, 4), (3, 1)])
def test_input_for_is_the_least_squares_solution_of_numpy(n, m):
    """Square and over-actuated: exact, of least norm. Under-actuated: least residual."""
    random = np.random.default_rng(n * m)
    mass, stiffness, damping = (np.diag(random.uniform(1, 2, n)) for _ in range(3))
    A, (q, v, a) = random.normal(size=(n, m)), random.normal(size=(3, 2, 5, n))
    system = LinearSystem(mass, stiffness, damping, A)
    with torch.no_grad():
        u = system.input_for(*map(torch.from_numpy, (q, v, a)))
        u_of_tau = system.forward_dynamics(*map(torch.from_numpy, (q, v)), u).numpy()
    tau = a @ mass + v @ damping + q @ stiffness
    expected, *_ = np.linalg.lstsq(A, tau.reshape(-1, n).T, rcond=None)
    np.testing.assert_allclose(u.numpy(), expected.T.reshape(2, 5, m), atol=1e-12)
    residual = np.linalg.norm(u.numpy() @ A.T - tau, axis=-1)
    assert (residual < 1e-12).all() if m >= n else (residual > 0.1).any()
    assert m < n or np.allclose(u_of_tau, a)  # the robot moves as planned


def test_input_for_refuses_forces_that_it_cannot_invert():
    class WithResidual(LinearSystem):
        has_residual = True

    eye, x = torch.eye(1), torch.zeros(1)
    with pytest.raises(ValueError, match=r"residual force.*train with ~model/residual"):
        WithResidual(eye, eye, eye, eye).input_for(x, x, x)
