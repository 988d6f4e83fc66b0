"""The heads of potential, input matrix and friction: derivatives, scales and refused arguments."""

from functools import partial

import pytest
import torch

from pinn_dyn.models import (
    ConstantInput,
    NetworkInput,
    NetworkPotential,
    NonlinearInput,
)
from pinn_dyn.testing import assert_near
from tests.models.builders import make_scales, perturb

SIZE = 3
MEAN = torch.tensor([0.5, -0.25, 0.125], dtype=torch.float64)
STD = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
COLUMNS = torch.tensor([0.5, 3.0, 2.0, 1.5], dtype=torch.float64)


def make_potential(**settings):
    torch.manual_seed(3)
    scales = make_scales(SIZE, 1, 2.5, q_mean=MEAN, q_std=STD)
    return NetworkPotential(scales, **settings).double()


def make_input(builder, inputs=2, spread=0.6, **statistics):
    torch.manual_seed(3)
    scales = make_scales(SIZE, inputs, COLUMNS[:inputs], q_mean=MEAN, q_std=STD, **statistics)
    return perturb(builder(scales).double(), spread=spread)


@pytest.fixture
def q():
    generator = torch.Generator().manual_seed(4)
    return 2 * torch.randn(40, SIZE, generator=generator, dtype=torch.float64)


# The potential.


def test_the_quadratic_part_is_an_elastic_well(q):
    head = make_potential(hidden=[4])
    with torch.no_grad():
        for parameter in head.network.parameters():
            parameter.zero_()
        head.stiffness_root.copy_(torch.tensor([[1.0, 0.0, 0.5], [0.0, 2.0, 0.0], [1.0, 0.0, 1.0]]))
    z = (q - MEAN) / STD
    stiffness = torch.tensor([[1.25, 0.0, 1.5], [0.0, 4.0, 0.0], [1.5, 0.0, 2.0]]).double()
    assert_near(head(q), 1.25 * torch.einsum("bi,ij,bj->b", z, stiffness, z), 1e-12)
    plain = make_potential(hidden=[4], quadratic=False)
    assert {name.split(".")[0] for name, _ in plain.named_parameters()} == {"network"}


# The input matrix.


@pytest.mark.parametrize("quadratic", [True, False])
def test_a_potential_is_bounded_from_below(quadratic, q):
    """Its network falls along some direction: far out only the well goes on."""
    head = perturb(make_potential(hidden=[5], quadratic=quadratic), spread=3.0)
    with torch.no_grad():
        head.network.linears[-1].weight.copy_(-5.0)
        near = float(head(torch.linspace(-1, 1, 9).double()[:, None] * 8 * STD + MEAN).min())
        assert float(head(1e3 * q).min()) >= min(near, 0.0) * 3
    far, farther = head.gradient(1e3 * q), head.gradient(2e3 * q)
    # At rest without a well; with it the force grows in proportion to q.
    expected = far + 1e3 * (head.gradient(1e3 * q + 1.0 * q) - far) if quadratic else 0 * far
    assert_near(farther, expected, 1e-6, 1 + float(farther.abs().max()))


def test_the_scale_of_an_input_is_that_of_its_column(q):
    start = make_input(ConstantInput, spread=0.0)(q[0])
    expected = torch.tensor([[0.5, 0.0], [0.0, 3.0], [0.0, 0.0]]).double()
    assert_near(start, expected, 1e-6)
    network = make_input(partial(NetworkInput, hidden=[4]))
    doubled = make_input(partial(NetworkInput, hidden=[4]))
    doubled.scale *= torch.tensor([2.0, 3.0])
    assert_near(doubled(q), network(q) * torch.tensor([2.0, 3.0]).double(), 1e-12)


U_MEAN = torch.tensor([0.4, -0.2], dtype=torch.float64)
U_STD = torch.tensor([0.5, 2.0], dtype=torch.float64)


def make_nonlinear():
    builder = partial(NonlinearInput, hidden=[4], activation="tanh")
    return make_input(builder, u_mean=U_MEAN, u_std=U_STD)


def test_a_nonlinear_input_is_a_matrix_that_depends_on_the_input(q):
    head = make_nonlinear()
    u = torch.randn(40, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    values = head.network(torch.cat([q, u], -1)).reshape(40, SIZE, 2)
    matrix = values * torch.tensor([0.5, 3.0]).double()
    assert_near(head.force(q, u), torch.einsum("bij,bj->bi", matrix, u), 1e-12)
    assert float((head.force(q, 2 * u) - 2 * head.force(q, u)).abs().max()) > 0.1


def test_linear_inputs_of_a_nonlinear_input_have_constant_columns(q):
    """Whatever their place among the inputs; the others are as they would be alone."""
    head = make_input(
        partial(NonlinearInput, hidden=[4], activation="tanh", linear=[0]),
        inputs=3,
        u_mean=torch.tensor([5.0, 0.4, -0.2], dtype=torch.float64),
        u_std=torch.tensor([7.0, 0.5, 2.0], dtype=torch.float64),
    )
    with torch.no_grad():
        head.constant.copy_(torch.arange(1.0, SIZE + 1)[:, None])
    u = torch.randn(40, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    values = head.network(torch.cat([q, u[:, 1:]], -1)).reshape(40, SIZE, 2)
    expected = torch.einsum("bij,bj->bi", values * torch.tensor([3.0, 2.0]).double(), u[:, 1:])
    expected = expected + 0.5 * torch.arange(1.0, SIZE + 1).double() * u[:, :1]
    assert_near(head.force(q, u), expected, 1e-12)
