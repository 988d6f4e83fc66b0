"""The heads of a serial chain, against a chain of rigid bodies that is written out here."""

import pytest
import torch

from pinn_dyn.models import MLP, ChainPotential, NetworkCholesky
from pinn_dyn.testing import assert_near
from tests.models.builders import make_scales, perturb

GRAVITY = torch.tensor([0.3, -0.4, 9.7], dtype=torch.float64)
JOINTS = 4


def scales(value=(1.0,) * JOINTS, angles=()):
    """Of a head of the chain."""
    return make_scales(JOINTS, 1, value, angles)


def _constants(*shape, seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


# Of each body: how its joint is mounted on the body before, where, and three point masses.
MOUNTS = torch.linalg.matrix_exp(
    _constants(JOINTS, 3, 3, seed=1) - _constants(JOINTS, 3, 3, seed=1).mT
)
ORIGINS = 0.4 * _constants(JOINTS, 3, seed=2)
POINTS = 0.3 * _constants(JOINTS, 3, 3, seed=3)
MASSES = 0.5 + _constants(JOINTS, 3, seed=4).abs()

GENERATOR = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]], dtype=torch.float64)


def turn(angle):
    """The rotation by an angle about the z axis."""
    along = torch.diag(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    return along + torch.sin(angle) * GENERATOR - torch.cos(angle) * (GENERATOR @ GENERATOR)


def places(q):
    """Where the point masses of a chain are, ``(JOINTS, 3, 3)``, at one q ``(JOINTS,)``."""
    rotation, origin = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    found = []
    for k in range(JOINTS):
        origin = origin + rotation @ ORIGINS[k]
        rotation = rotation @ MOUNTS[k] @ turn(q[k])
        found.append(origin + POINTS[k] @ rotation.T)
    return torch.stack(found)


def true_mass_matrix(q):
    """sum m J^T J over the point masses."""
    jacobian = torch.func.jacfwd(places)(q)
    return torch.einsum("kp,kpci,kpcj->ij", MASSES, jacobian, jacobian)


def true_potential(q):
    """sum m g . x over the point masses."""
    return torch.einsum("kp,c,kpc->", MASSES, GRAVITY, places(q))


def transposed_factor(matrix):
    """The lower triangular L with L^T L = matrix."""
    flipped = torch.linalg.cholesky(torch.flip(matrix, (0, 1)))
    return torch.flip(flipped, (0, 1)).T


def dependence(factor, q):
    """Whether entry (i, j) of a matrix depends on coordinate k, ``(N, N, N)``."""
    return torch.func.jacfwd(factor)(q).abs() > 1e-9


def rule():
    """Entry (i, j) of the lower triangle and coordinate k: whether k > j."""
    i, j, k = torch.meshgrid(*[torch.arange(JOINTS)] * 3, indexing="ij")
    return (i >= j) & (k > j)


@pytest.fixture
def q():
    return 2 * _constants(20, JOINTS, seed=5)


@pytest.mark.parametrize(
    "factor",
    [
        lambda q: transposed_factor(true_mass_matrix(q)),
        lambda q: torch.linalg.cholesky(torch.linalg.inv(true_mass_matrix(q))),
    ],
    ids=["M = L^T L", "M^-1 = L L^T"],
)
def test_in_a_true_chain_a_column_depends_on_the_joints_after_it(factor, q):
    assert torch.equal(dependence(factor, q[0]), rule())


def test_the_head_for_a_chain_depends_on_what_a_true_chain_depends_on(q):
    torch.manual_seed(3)
    head = NetworkCholesky(scales(angles=range(JOINTS)), hidden=[12, 9], chain=True)
    assert torch.equal(dependence(perturb(head.double()), q[0]), rule())
    free = NetworkCholesky(scales(angles=range(JOINTS)), hidden=[12, 9])
    assert int(dependence(perturb(free.double()), q[0]).sum()) > int(rule().sum())


@pytest.mark.parametrize("angles", [(), (1,)], ids=["lengths", "mixed"])
def test_the_masked_passes_are_those_of_automatic_differentiation(angles):
    torch.manual_seed(3)
    network = perturb(MLP(3, 4, [7, 6], angles=angles, after=[0, 1, 2, 0]).double())
    x, dx = _constants(5, 3, seed=1), _constants(5, 3, seed=2)
    dy = _constants(5, 4, seed=3)
    value, tape = network.linearize(x)
    assert_near(value, network(x), 1e-12)
    tangent = torch.func.jvp(network, (x,), (dx,))[1]
    assert_near(network.linearize_along(x, dx)[1], tangent, 1e-12)
    assert_near(network.pullback(tape, dy), torch.func.vjp(network, x)[1](dy)[0], 1e-12)


# The potential.


def make_potential(rank):
    torch.manual_seed(3)
    return ChainPotential(scales(2.0, range(JOINTS)), rank=rank).double()


def test_three_rows_hold_the_potential_of_a_true_chain(q):
    """w_k is the first moment of the masses beyond joint k: set by hand, the head is the truth."""
    head = make_potential(3)
    with torch.no_grad():
        for k in range(JOINTS):
            after = ORIGINS[k + 1] * MASSES[k + 1 :].sum() if k + 1 < JOINTS else 0.0
            own = (MASSES[k, :, None] * POINTS[k]).sum(0) + after
            still = torch.diag(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
            parts = [still, GENERATOR, -GENERATOR @ GENERATOR]
            head.turns[k].copy_(torch.cat([MOUNTS[k] @ part for part in parts]))
            # The body's own moment is turned by its joint as well: it enters below the turn.
            head.offsets[k + 1][:, 0] = own
        head.offsets[0][:, 0] = ORIGINS[0] * MASSES.sum()
        head.base[:, 0] = GRAVITY / 2.0
    expected = torch.stack([true_potential(row) for row in q])
    assert_near(head(q), expected, 1e-12)
    force = torch.stack([torch.func.grad(true_potential)(row) for row in q])
    assert_near(head.gradient(q), force, 1e-12)
