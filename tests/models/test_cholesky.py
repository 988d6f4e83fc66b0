"""The Cholesky heads: their contract, formulas, floors, bounds, starts and refused arguments."""

from functools import partial

import pytest
import torch
import torch.nn.functional as F

from pinn_dyn.models import (
    Bounded,
    ConstantCholesky,
    FixedCholesky,
    NetworkCholesky,
    Positive,
    cholesky,
)
from pinn_dyn.testing import CholeskyHeadContract, assert_near
from tests.models.builders import make_scales, perturb, positive_matrix
from tests.support.contracts import one_case

SIZE = 3
SCALE = torch.tensor([0.5, 2.0, 3.0], dtype=torch.float64)
MEAN = torch.tensor([0.5, -0.25, 0.125], dtype=torch.float64)
STD = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
HEADS = {
    "softplus": partial(NetworkCholesky, hidden=[5], positivity=Positive(0.01)),
    "semidefinite": partial(NetworkCholesky, hidden=[5], positivity=Positive(0.0)),
    "bounded": partial(
        NetworkCholesky, hidden=[5], activation="tanh", positivity=Bounded(1.5, floor=0.01)
    ),
    "constant": partial(ConstantCholesky, positivity=Positive(0.01)),
    "bounded constant": partial(ConstantCholesky, positivity=Bounded(1.5, floor=0.01)),
    "fixed": partial(FixedCholesky, value=positive_matrix(SIZE)),
    "transposed": partial(NetworkCholesky, hidden=[5, 4], activation="silu", transposed=True),
    "chain": partial(NetworkCholesky, hidden=[9], chain=True, transposed=True),
}


def scales(angles=(), value=SCALE):
    return make_scales(SIZE, 1, value, angles, q_mean=MEAN, q_std=STD)


def make(builder, spread=0.6, angles=()):
    torch.manual_seed(3)
    return perturb(builder(scales(angles)).double(), spread=spread)


@pytest.fixture
def q():
    generator = torch.Generator().manual_seed(4)
    return MEAN + STD * torch.randn(40, SIZE, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("name", HEADS)
@one_case
class TestCholeskyHead(CholeskyHeadContract):
    @pytest.fixture
    def head(self, name):
        return make(HEADS[name])


@one_case
class TestWithAngles(CholeskyHeadContract):
    @pytest.fixture
    def head(self):
        return make(HEADS["softplus"], angles=[1])

    def test_matrix_is_bounded_over_all_configurations(self, head, q):
        """Bounded, but not at rest: the angle turns on."""
        largest = float(head.matrix(1e3 * q).abs().max())
        assert float(head.matrix(1e5 * q).abs().max()) < 2 * largest


@one_case
class TestBeyondTheUnrolled(CholeskyHeadContract):
    """More coordinates are placed by their index; here so few are."""

    @pytest.fixture(autouse=True)
    def by_index(self, monkeypatch):
        monkeypatch.setattr(cholesky, "UNROLLED", SIZE - 1)

    @pytest.fixture
    def head(self):
        return make(HEADS["softplus"])

    def test_the_matrices_are_the_same(self, head, q, monkeypatch):
        found = head(q)
        assert found.is_contiguous()
        monkeypatch.setattr(cholesky, "UNROLLED", SIZE)
        assert torch.equal(found, head(q))


def outputs(head, q):
    """Diagonal and off-diagonal outputs of a head's network, by a plain forward pass."""
    network = head.network
    activation = {"softplus": F.softplus, "tanh": torch.tanh}
    name = next(k for k in activation if k in network._activation.__name__)
    h = (q - MEAN) / STD
    h = activation[name](h @ network.layers[0].weight.T + network.layers[0].bias)
    y = h @ network.layers[1].weight.T + network.layers[1].bias
    return y[..., :SIZE], y[..., SIZE:]


def test_entries_are_those_of_the_documented_formula(q):
    """Within three standard deviations of the data: there the features are as they are."""
    q = MEAN + (q - MEAN).clamp(-3 * STD, 3 * STD)
    rows, columns = (1, 2, 2), (0, 0, 1)
    diagonals = {
        "softplus": lambda y: F.softplus(y) + 0.01,
        "bounded": lambda y: 1.5 * torch.sigmoid(y) + 0.01,
    }
    for name, diagonal in diagonals.items():
        head = make(HEADS[name])
        y, lower = outputs(head, q)
        lower = 1.5 * (2 * torch.sigmoid(lower) - 1) if name == "bounded" else lower
        expected = torch.zeros(40, SIZE, SIZE, dtype=torch.float64)
        for i in range(SIZE):
            expected[:, i, i] = SCALE[i] * diagonal(y)[:, i]
        for k, (i, j) in enumerate(zip(rows, columns, strict=True)):
            expected[:, i, j] = SCALE[i] * lower[:, k]
        assert_near(head(q), expected, 1e-7)


@pytest.mark.parametrize("name", ["softplus", "bounded", "constant"])
def test_the_floor_is_the_smallest_diagonal_entry(name, q):
    head = make(HEADS[name])
    with torch.no_grad():  # drive the diagonal to its lower end
        if name == "constant":
            head.raw_diagonal.fill_(-80.0)
        else:
            head.network.layers[-1].bias[:SIZE] = -80.0
    diagonal = head(q).diagonal(dim1=-2, dim2=-1)
    floor = 0.01 * SCALE
    assert_near(diagonal, floor.expand_as(diagonal), 1e-6)
    # det(L L^T) is the squared product of that diagonal: the matrix stays regular.
    assert_near(torch.linalg.det(head.matrix(q)), floor.prod().square().expand(40), 1e-3)


def test_outputs_far_from_the_data_end_at_the_margin_of_their_kind(q):
    """The margin is 0.2 for the diagonal, and a tenth of the range on the data elsewhere."""
    head = make(partial(NetworkCholesky, hidden=[5], positivity=Positive(0.0)), spread=8.0)
    with torch.no_grad():
        low, high = head.network(q).aminmax(dim=0)
        head.output_limits = head.limits_at(q)
        far = MEAN + 30 * (q.repeat(50, 1) - MEAN) * torch.randn(2000, SIZE)
        factor = head(far) / SCALE[:, None]
    rows, columns = torch.tril_indices(SIZE, SIZE, offset=-1)
    diagonal = factor.diagonal(dim1=-2, dim2=-1).expm1().log()  # the inverse of the softplus
    y = torch.cat([diagonal, factor[:, rows, columns]], dim=-1)
    margin = torch.cat([torch.full((SIZE,), 0.2).double(), 0.1 * (high - low)[SIZE:]])
    beyond = torch.maximum(y.amax(0) - high, low - y.amin(0))
    assert (margin[SIZE:] > 0.4).all()
    assert (beyond <= margin * (1 + 1e-6)).all()
    assert (beyond > 0.9 * margin).all()


def test_the_scale_is_honoured(q):
    """L is proportional to it; a fixed matrix has its own."""
    for name in [name for name in HEADS if name != "fixed"]:
        scaled = make(lambda _, name=name: HEADS[name](scales(value=4.0 * SCALE)))
        assert_near(scaled(q), 4.0 * make(HEADS[name])(q), 1e-6)


@pytest.mark.parametrize(
    "value",
    [
        positive_matrix(3),
        [[0.0, 0.0, 0.0]] * 3,
        [[0.0, 0.0, 0.0], [0.0, 2.0, -1.0], [0.0, -1.0, 1.0]],
        [[4.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 5.0]],
    ],
    ids=["regular", "zero", "zero first row", "rank 2"],
)
def test_a_fixed_matrix_is_reproduced_also_if_singular(value, q):
    head = FixedCholesky(scales(), value=value)
    factor = head(q.float())
    assert torch.isfinite(factor).all()
    assert torch.equal(factor, factor.tril())
    expected = torch.tensor(value).expand(40, 3, 3)
    torch.testing.assert_close(head.matrix(q.float()), expected, rtol=0, atol=3e-6)
