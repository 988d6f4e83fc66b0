"""Control laws against NumPy, against the closed loop that they promise, and their errors."""

from functools import partial

import numpy as np
import pytest
import torch

from pinn_dyn.control import Motion, Pipeline
from pinn_dyn.control.laws import (
    ComputedTorque,
    ProportionalDerivative,
    Regulation,
    Tracking,
    condition_number,
)
from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import ControllerContract, LinearSystem, assert_near
from pinn_dyn.testing.controller import input_of, states
from tests.models.builders import make_structured
from tests.support.cart_pole import CartPole
from tests.support.contracts import one_case
from tests.support.linear import double


def linear_system(n, m, seed=0):
    """Random M, D > 0, K and a random N x M input matrix, all full."""
    random = np.random.default_rng(seed)
    mass, damping, stiffness = (
        x @ x.T + 0.5 * np.eye(n) for x in (random.normal(size=(n, n)) for _ in range(3))
    )
    return LinearSystem(mass, stiffness, damping, random.normal(size=(n, m)))


# Against NumPy.


@pytest.mark.parametrize(("n", "m"), [(4, 4), (2, 4), (4, 2)])
def test_regulation_of_a_linear_system_is_the_formula(n, m):
    system = linear_system(n, m)
    kp, kd = np.arange(1.0, n + 1), 0.5 * np.arange(1.0, n + 1)
    law = Regulation(system, kp.tolist(), kd.tolist())
    q, v, motion = states(n)
    A, K = system.inputs.detach().numpy(), system.stiffness.detach().numpy()
    inverse = np.linalg.pinv(A)
    expected = [
        inverse @ K @ q_k + A.T @ (kp * (r_k - q_k) + kd * (s_k - v_k))
        for q_k, v_k, r_k, s_k in zip(*(x.numpy() for x in (q, v, motion.q, motion.v)), strict=True)
    ]
    u = input_of(law, q, v, motion)
    assert_near(u, torch.tensor(np.array(expected)), 1e-12)


@pytest.mark.parametrize("law", [Regulation, Tracking, ComputedTorque])
def test_laws_on_the_cart_pole_are_their_formulas(law):
    """By its terms, written by hand; the one input reaches the first coordinate."""
    q, v, motion = states(2)
    pd = double([3.0, 5.0]) * (motion.q - q) + double([1.0, 2.0]) * (motion.v - v)
    zero = torch.zeros_like(q)
    at = {
        Regulation: (q, zero, zero),
        Tracking: motion,
        ComputedTorque: (q, v, motion.a + pd),
    }[law]
    (x, angle), (speed, rate), (a, alpha) = (value.unbind(-1) for value in at)
    coupling = 0.4 * 0.6
    force = 1.9 * a + coupling * (angle.cos() * alpha - angle.sin() * rate**2) + 0.3 * speed + 4 * x
    expected = force if law is ComputedTorque else force + pd[:, 0]
    u = input_of(law(CartPole(), [3.0, 5.0], [1.0, 2.0]), q, v, motion)
    assert_near(u[:, 0], expected, 1e-12)


# The closed loop that the laws promise.


@pytest.fixture(
    params=[
        partial(SoftArm, 2),
        partial(linear_system, 3, 3),
        partial(linear_system, 2, 4),
        partial(make_structured, "lnn"),
        partial(make_structured, "hnn"),
    ],
    ids=["soft arm", "linear", "over-actuated", "lnn", "hnn"],
)
def system(request):
    """A system that its inputs can give any acceleration."""
    return request.param()


def test_regulation_on_the_truth_holds_the_robot_where_it_should_be(system):
    q, v, _ = states(system.num_coordinates)
    u = input_of(Regulation(system, 10.0, 1.0), q, 0 * v, Motion(q, 0 * v, 0 * v))
    unheld = system.forward_dynamics(q, 0 * v, 0 * u).detach()
    a = system.forward_dynamics(q, 0 * v, u).detach()
    assert float(unheld.abs().max()) > 1e-2
    assert_near(a, 0 * a, 1e-9, scale=unheld.abs().max())


def test_tracking_on_the_truth_gives_the_acceleration_of_the_reference(system):
    *_, motion = states(system.num_coordinates)
    u = input_of(Tracking(system, 10.0, 1.0), motion.q, motion.v, motion)
    a = system.forward_dynamics(motion.q, motion.v, u).detach()
    assert_near(a, motion.a, 1e-9)


def test_computed_torque_on_the_truth_gives_the_linear_error_dynamics(system):
    q, v, motion = states(system.num_coordinates)
    kp = torch.linspace(4.0, 9.0, system.num_coordinates, dtype=torch.float64)
    kd = 2 * kp.sqrt()
    u = input_of(ComputedTorque(system, kp, kd.tolist()), q, v, motion)
    error_acceleration = motion.a - system.forward_dynamics(q, v, u).detach()
    assert_near(error_acceleration, -kd * (motion.v - v) - kp * (motion.q - q), 1e-9)


# Singular input matrices.


class HalfSingular(CartPole):
    """A(q) = diag(1, q_0): singular at q_0 = 0."""

    def __init__(self):
        super().__init__()
        self.num_inputs = 2

    def input_matrix(self, q):
        return torch.diag_embed(torch.stack([torch.ones_like(q[..., 0]), q[..., 0]], -1))


def test_a_singular_input_matrix_is_a_fault_of_its_row_only():
    q, v, motion = states(2)
    expected = input_of(Regulation(HalfSingular(), 1.0, 1.0), q, v, motion)
    q = q.clone()
    q[1, 0], q[4, 0] = 0.0, 1e-4
    pipeline = Pipeline(Regulation(HalfSingular(), 1.0, 1.0, max_condition=1e3))
    result = pipeline.call(q, v, motion, torch.zeros(len(q), pipeline.memory_size).double())
    assert result.status.tolist() == [0, 8 + 4, 0, 0, 8, 0]
    assert (result.u[1] == 0).all()  # the input before the first call
    assert_near(result.u[[0, 2, 3, 5]], expected[[0, 2, 3, 5]], 1e-12)


def test_the_condition_number_is_the_ratio_of_singular_values_up_to_the_rank():
    generator = torch.Generator().manual_seed(0)
    for shape in ((3, 3), (2, 4), (4, 2)):
        A = torch.randn(20, *shape, generator=generator).double()
        ratio = torch.linalg.cond(A)
        found = condition_number(A)
        assert (found <= ratio * (1 + 1e-9)).all()
        assert (found >= ratio / min(shape)).all()
    assert_near(condition_number(3 * torch.eye(4).double()), torch.ones(()).double(), 1e-12)
    lost = torch.tensor([[[1.0, 2.0], [2.0, 4.0]], [[1.0, torch.nan], [0.0, 1.0]]]).double()
    assert not (condition_number(lost) < 1e6).any()


# Deployment.


# Errors.


# The contract.


@pytest.mark.parametrize(
    ("law", "model"),
    [
        (ProportionalDerivative, CartPole),
        (Regulation, partial(linear_system, 2, 4)),
        (Tracking, partial(make_structured, "lnn", 2, 4)),
        (ComputedTorque, partial(make_structured, "hnn")),
    ],
)
@one_case
class TestModelBasedLaw(ControllerContract):
    @pytest.fixture
    def controller(self, law, model):
        return law(model(), 5.0, 1.0)
