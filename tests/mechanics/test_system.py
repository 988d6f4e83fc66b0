"""What the base class promises beyond the contract suite."""

import torch

from pinn_dyn.testing import damped_oscillators
from tests.support.cart_pole import CartPole


def test_forward_dynamics_solves_the_linear_equation_of_motion():
    system = damped_oscillators().requires_grad_(False)
    f, b = (torch.from_numpy(matrix) for matrix in system.state_space())
    x = torch.tensor([0.5, -0.3, 0.2, 0.8], dtype=torch.float64)
    u = torch.tensor([1.7], dtype=torch.float64)
    expected = f @ x + b @ u
    torch.testing.assert_close(system.velocity_derivative(x, u), expected)
    torch.testing.assert_close(system.forward_dynamics(x[:2], x[2:], u), expected[2:])


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
