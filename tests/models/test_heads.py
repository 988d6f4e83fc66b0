"""The heads: shape, definiteness, bounds, constants and refused arguments."""

from functools import partial

import pytest
import torch
import torch.nn.functional as F

from pinn_dyn.models import (
    ConstantCholesky,
    ConstantInput,
    FixedCholesky,
    FixedInput,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    NonlinearInput,
)
from tests.models.builders import perturb, positive_matrix
from tests.support.finite_differences import assert_near, partial_derivatives, slope

SIZE = 3
SCALES = {
    "scale": torch.tensor([0.5, 2.0, 3.0]),
    "mean": torch.tensor([0.5, -0.25, 0.125]),
    "std": torch.tensor([0.5, 1.0, 2.0]),
}
CHOLESKY = {
    "softplus": partial(NetworkCholesky, hidden=[5], diagonal="softplus", epsilon=0.01),
    "softplus without epsilon": partial(NetworkCholesky, hidden=[5], epsilon=0.0),
    "relu": partial(NetworkCholesky, hidden=[5], activation="silu", diagonal="relu", epsilon=0.01),
    "bound": partial(NetworkCholesky, hidden=[5], activation="tanh", epsilon=0.01, bound=1.5),
    "constant": partial(ConstantCholesky, epsilon=0.01),
    "fixed": partial(FixedCholesky, value=positive_matrix(SIZE)),
}


def make(builder, spread=0.6):
    torch.manual_seed(3)
    return perturb(builder(size=SIZE, **SCALES).double(), spread=spread)


def make_input(builder, inputs=2, spread=0.6):
    torch.manual_seed(3)
    scales = {**SCALES, "scale": torch.tensor([0.5, 3.0, 2.0, 1.5])[:inputs]}
    return perturb(builder(size=SIZE, inputs=inputs, **scales).double(), spread=spread)


@pytest.fixture(params=list(CHOLESKY))
def head(request):
    return make(CHOLESKY[request.param])


@pytest.fixture
def q():
    generator = torch.Generator().manual_seed(4)
    return 2 * torch.randn(40, SIZE, generator=generator, dtype=torch.float64)


def outputs(head, q):
    """Diagonal and off-diagonal outputs of a head's network, by a plain forward pass."""
    network = head.network
    activation = {"softplus": F.softplus, "silu": F.silu, "tanh": torch.tanh}
    name = next(k for k in activation if k in network._activation.__name__)
    h = (q - SCALES["mean"].double()) / SCALES["std"].double()
    h = activation[name](h @ network.layers[0].weight.T + network.layers[0].bias)
    y = h @ network.layers[1].weight.T + network.layers[1].bias
    return y[..., :SIZE], y[..., SIZE:]


# Cholesky heads.


def test_factor_is_lower_triangular_and_its_square_semidefinite(head, q):
    factor = head(q)
    assert factor.shape == (40, SIZE, SIZE)
    assert torch.equal(factor, factor.tril())
    assert float(factor.diagonal(dim1=-2, dim2=-1).min()) >= 0
    matrix = head.matrix(q)
    assert_near(matrix, torch.einsum("bik,bjk->bij", factor, factor), 1e-12)
    assert float(torch.linalg.eigvalsh(matrix).min()) > -1e-12
    assert float(factor.tril(-1).abs().max()) > 0.05


@pytest.mark.parametrize("batch", [(), (2, 20)], ids=["unbatched", "B1xB2"])
def test_any_batch_shape_gives_the_same_factor(head, q, batch):
    part = q[0] if batch == () else q.reshape(*batch, SIZE)
    assert head(part).shape == (*batch, SIZE, SIZE)
    expected = head(q)[0] if batch == () else head(q).reshape(*batch, SIZE, SIZE)
    assert_near(head(part), expected, 1e-12)


@pytest.mark.parametrize("name", ["softplus", "relu", "bound", "constant"])
def test_epsilon_is_the_smallest_diagonal_entry(name, q):
    head = make(CHOLESKY[name])
    with torch.no_grad():  # drive the diagonal to its lower end
        if name == "constant":
            head.raw_diagonal.fill_(-80.0)
        else:
            head.network.layers[-1].bias[:SIZE] = -80.0
    diagonal = head(q).diagonal(dim1=-2, dim2=-1)
    floor = (0.01 * SCALES["scale"]).double()
    assert_near(diagonal, floor.expand_as(diagonal), 1e-6)
    # det(L L^T) is the squared product of that diagonal: the matrix stays regular.
    assert_near(torch.linalg.det(head.matrix(q)), floor.prod().square().expand(40), 1e-3)


def test_entries_are_those_of_the_documented_formula(q):
    rows, columns = (1, 2, 2), (0, 0, 1)
    diagonals = {
        "softplus": lambda y: F.softplus(y) + 0.01,
        "relu": lambda y: F.relu(y) + 0.01,
        "bound": lambda y: 1.5 * torch.sigmoid(y) + 0.01,
    }
    for name, diagonal in diagonals.items():
        head = make(CHOLESKY[name])
        y, lower = outputs(head, q)
        lower = 1.5 * (2 * torch.sigmoid(lower) - 1) if name == "bound" else lower
        expected = torch.zeros(40, SIZE, SIZE, dtype=torch.float64)
        for i in range(SIZE):
            expected[:, i, i] = SCALES["scale"][i] * diagonal(y)[:, i]
        for k, (i, j) in enumerate(zip(rows, columns, strict=True)):
            expected[:, i, j] = SCALES["scale"][i] * lower[:, k]
        assert_near(head(q), expected, 1e-7)


def test_bounded_entries_stay_in_their_range(q):
    head = make(CHOLESKY["bound"], spread=20.0)
    ratio = head(10 * q) / SCALES["scale"].double()[:, None]
    diagonal = ratio.diagonal(dim1=-2, dim2=-1)
    lower = ratio.tril(-1).abs()
    assert float(diagonal.min()) >= 0.01 - 1e-6
    assert float(diagonal.max()) <= 1.51 + 1e-6
    assert float(lower.max()) <= 1.5 + 1e-6
    # The weights are large enough to reach the ends: an unbounded head would leave the range.
    assert float(diagonal.max()) > 1.5
    assert float(lower.max()) > 1.49


def test_pushforward_is_the_slope_of_the_factor(head, q):
    dq = torch.flip(q, (0,))
    _, tape = head.linearize(q)
    expected = slope(lambda e: head(q + e * dq), 1e-4)
    assert_near(head.pushforward(tape, dq), expected, 1e-6, 1 + float(expected.abs().max()))


def test_pullback_is_the_gradient_of_the_factor(head, q):
    generator = torch.Generator().manual_seed(9)
    cotangent = torch.randn(40, SIZE, SIZE, generator=generator, dtype=torch.float64)
    _, tape = head.linearize(q)
    expected = partial_derivatives(lambda q: (cotangent * head(q)).sum((-2, -1)), q, 1e-4)
    assert_near(head.pullback(tape, cotangent), expected, 1e-6, 1 + float(expected.abs().max()))


def test_a_transposed_head_has_the_scale_in_its_columns(q):
    plain, transposed = (
        make(partial(NetworkCholesky, hidden=[5], epsilon=0.01, transposed=flag))
        for flag in (False, True)
    )
    scale = SCALES["scale"].double()
    unscaled = plain(q) / scale[:, None]
    assert_near(transposed(q), unscaled * scale, 1e-12)
    assert_near(transposed.matrix(q), transposed(q).mT @ transposed(q), 1e-12)


@pytest.mark.parametrize("name", ["constant", "fixed"])
def test_a_constant_does_not_depend_on_q(name, q):
    head = make(CHOLESKY[name])
    assert torch.equal(head(q), head(q[:1]).expand(40, SIZE, SIZE))
    _, tape = head.linearize(q)
    assert not head.pushforward(tape, q).any()
    assert not head.pullback(tape, head(q)).any()
    assert bool(list(head.parameters())) == (name == "constant")


def test_a_network_depends_on_q(q):
    assert float(make(CHOLESKY["softplus"])(q).std(0).diagonal().min()) > 0.01


@pytest.mark.parametrize(
    "value",
    [
        positive_matrix(3),
        [[0.0, 0.0, 0.0]] * 3,
        [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [3.0, 6.0, 9.0]],
        [[0.0, 0.0, 0.0], [0.0, 2.0, -1.0], [0.0, -1.0, 1.0]],
        [[4.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 5.0]],
    ],
    ids=["regular", "zero", "rank 1", "zero first row", "rank 2"],
)
def test_a_fixed_matrix_is_reproduced_also_if_singular(value, q):
    head = FixedCholesky(size=3, **SCALES, value=value)
    factor = head(q.float())
    assert torch.isfinite(factor).all()
    assert torch.equal(factor, factor.tril())
    expected = torch.tensor(value).expand(40, 3, 3)
    torch.testing.assert_close(head.matrix(q.float()), expected, rtol=0, atol=3e-6)


def test_a_constant_starts_like_a_network_of_zero_weights(q):
    scales = {**SCALES, "scale": torch.tensor([0.5, 2.0, 3.0])}
    constant = ConstantCholesky(size=3, **scales).double()
    expected = torch.diag(scales["scale"].double() * (1 + 1e-3))
    assert_near(constant(q[0]), expected, 1e-6)


@pytest.mark.parametrize(
    ("builder", "message"),
    [
        (partial(NetworkCholesky, hidden=[4], diagonal="abs"), "diagonal is 'abs'"),
        (partial(NetworkCholesky, hidden=[4], epsilon=-1e-3), "epsilon is -0.001"),
        (partial(NetworkCholesky, hidden=[4], bound=-1.0), "bound is -1.0"),
        (partial(NetworkCholesky, hidden=[4], bound=0.0), "bound is 0.0"),
        (partial(NetworkCholesky, hidden=[4], bound=float("nan")), "bound is nan"),
        (partial(NetworkCholesky, hidden=[4], activation="relu"), "activation is 'relu'"),
        (partial(NetworkCholesky, hidden=[0]), r"hidden is \[0\]"),
        (partial(FixedCholesky, value=[[1.0, 0.0], [0.0, 1.0]]), r"shape \(2, 2\)"),
        (partial(FixedCholesky, value=[1.0, 1.0, 1.0]), r"shape \(3,\)"),
        (
            partial(FixedCholesky, value=[[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
            "expected a symmetric",
        ),
        (
            partial(FixedCholesky, value=[[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
            "eigenvalue -1, expected a positive semi-definite",
        ),
        (
            partial(FixedCholesky, value=[[-2.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]]),
            "eigenvalue -2, expected a positive semi-definite",
        ),
    ],
)
def test_a_wrong_argument_of_a_cholesky_head_is_refused(builder, message):
    with pytest.raises(ValueError, match=message):
        builder(size=3, **SCALES)


# The potential.


@pytest.mark.parametrize("quadratic", [True, False])
@pytest.mark.parametrize("activation", ["softplus", "tanh", "silu"])
def test_potential_force_is_the_gradient_of_the_potential(quadratic, activation, q):
    torch.manual_seed(3)
    scales = {**SCALES, "scale": 2.5}
    head = NetworkPotential(
        size=3, **scales, hidden=[5, 4], activation=activation, quadratic=quadratic
    )
    perturb(head.double())
    assert head(q).shape == (40,)
    expected = torch.func.vjp(lambda q: head(q).sum(), q)[1](torch.tensor(1.0).double())[0]
    assert_near(head.gradient(q), expected, 1e-12)
    assert_near(head.gradient(q[0]), expected[0], 1e-12)


def test_the_quadratic_part_is_an_elastic_well(q):
    head = NetworkPotential(size=3, **{**SCALES, "scale": 2.5}, hidden=[4]).double()
    with torch.no_grad():
        for parameter in head.network.parameters():
            parameter.zero_()
        head.stiffness_root.copy_(torch.tensor([[1.0, 0.0, 0.5], [0.0, 2.0, 0.0], [1.0, 0.0, 1.0]]))
    z = (q - SCALES["mean"].double()) / SCALES["std"].double()
    stiffness = torch.tensor([[1.25, 0.0, 1.5], [0.0, 4.0, 0.0], [1.5, 0.0, 2.0]]).double()
    assert_near(head(q), 1.25 * torch.einsum("bi,ij,bj->b", z, stiffness, z), 1e-12)
    assert NetworkPotential(size=3, **SCALES | {"scale": 1.0}, hidden=[4], quadratic=False)
    plain = NetworkPotential(size=3, **{**SCALES, "scale": 2.5}, hidden=[4], quadratic=False)
    assert {name.split(".")[0] for name, _ in plain.named_parameters()} == {"network"}


@pytest.mark.parametrize("initial", [0.05, 1.0, 3.0])
@pytest.mark.parametrize(
    "builder",
    [
        partial(NetworkCholesky, hidden=[5], epsilon=0.01),
        partial(NetworkCholesky, hidden=[5], diagonal="relu", epsilon=0.01),
        partial(ConstantCholesky, epsilon=0.01),
    ],
    ids=["softplus", "relu", "constant"],
)
def test_the_diagonal_starts_where_it_is_told(builder, initial):
    """A network's own part, a tenth of its usual size, comes on top."""
    head = make(partial(builder, initial=initial), spread=0.0)
    if hasattr(head, "network"):
        head.network.linears[-1].weight.data.zero_()
    diagonal = head(torch.zeros(SIZE).double()).diagonal()
    assert_near(diagonal, (initial + 0.01) * SCALES["scale"].double(), 1e-6)


@pytest.mark.parametrize(
    ("builder", "message"),
    [
        (partial(NetworkCholesky, hidden=[5], initial=0.0), "initial is 0.0, expected a positive"),
        (partial(ConstantCholesky, initial=-1.0), "initial is -1.0, expected a positive"),
        (partial(NetworkCholesky, hidden=[5], initial=0.5, bound=1.0), "expected one of them"),
    ],
)
def test_a_start_that_cannot_be_is_refused(builder, message):
    with pytest.raises(ValueError, match=message):
        make(builder)


# The input matrix.


@pytest.mark.parametrize("inputs", [1, 3, 4])
@pytest.mark.parametrize(
    "builder",
    [
        partial(NetworkInput, hidden=[4]),
        partial(NetworkInput, hidden=[4], bound=1.5),
        ConstantInput,
    ],
    ids=["network", "bound", "constant"],
)
def test_input_matrix_has_one_column_per_input(builder, inputs, q):
    head = make_input(builder, inputs)
    assert head(q).shape == (40, SIZE, inputs)
    assert head(q[0]).shape == (SIZE, inputs)
    assert_near(head(q.reshape(4, 10, SIZE)), head(q).reshape(4, 10, SIZE, inputs), 1e-12)
    assert_near(head(q[0]), head(q)[0], 1e-12)


def test_bounded_inputs_stay_in_their_range(q):
    head = make_input(partial(NetworkInput, hidden=[4], bound=1.5), spread=20.0)
    largest = (head(10 * q).abs() / torch.tensor([0.5, 3.0]).double()).amax((0, 1))
    assert float(largest.max()) <= 1.5 + 1e-6
    assert float(largest.min()) > 1.49


def test_the_scale_of_an_input_is_that_of_its_column(q):
    start = make_input(ConstantInput, spread=0.0)(q[0])
    expected = torch.tensor([[0.5, 0.0], [0.0, 3.0], [0.0, 0.0]]).double()
    assert_near(start, expected, 1e-6)
    network = make_input(partial(NetworkInput, hidden=[4]))
    doubled = make_input(partial(NetworkInput, hidden=[4]))
    doubled.scale *= torch.tensor([2.0, 3.0])
    assert_near(doubled(q), network(q) * torch.tensor([2.0, 3.0]).double(), 1e-12)


@pytest.mark.parametrize("builder", [ConstantInput, FixedInput], ids=["constant", "fixed"])
def test_a_constant_input_matrix_does_not_depend_on_q(builder, q):
    head = make_input(builder, inputs=3)
    assert torch.equal(head(q), head(q[:1]).expand(40, SIZE, 3))
    assert float(head(q).abs().max()) > 0.5


def test_a_fixed_input_matrix_is_the_given_one(q):
    value = [[1.0, 0.5], [0.0, -2.0], [3.0, 0.0]]
    head = make_input(partial(FixedInput, value=value))
    assert head(q)[5].tolist() == value
    assert make_input(FixedInput, inputs=3)(q)[5].tolist() == torch.eye(3).tolist()


@pytest.mark.parametrize(
    ("builder", "message"),
    [
        (partial(NetworkInput, hidden=[4], bound=-2.0), "bound is -2.0"),
        (partial(NetworkInput, hidden=[4], activation="step"), "activation is 'step'"),
        (FixedInput, r"shape \(2, 2\), expected \(3, 2\)"),
        (partial(FixedInput, value=[[1.0, 0.0, 0.0]]), r"shape \(1, 3\), expected \(3, 2\)"),
    ],
)
def test_a_wrong_argument_of_an_input_head_is_refused(builder, message):
    with pytest.raises(ValueError, match=message):
        make_input(builder)


def make_nonlinear():
    scales = {"u_mean": torch.tensor([0.4, -0.2]), "u_std": torch.tensor([0.5, 2.0])}
    return make_input(partial(NonlinearInput, hidden=[4], activation="tanh", **scales))


def test_a_nonlinear_input_is_a_matrix_that_depends_on_the_input(q):
    head = make_nonlinear()
    u = torch.randn(40, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    values = head.network(torch.cat([q, u], -1)).reshape(40, SIZE, 2)
    matrix = values * torch.tensor([0.5, 3.0]).double()
    assert_near(head.force(q, u), torch.einsum("bij,bj->bi", matrix, u), 1e-12)
    assert float((head.force(q, 2 * u) - 2 * head.force(q, u)).abs().max()) > 0.1


def test_linear_inputs_of_a_nonlinear_input_have_constant_columns(q):
    """Whatever their place among the inputs; the others are as they would be alone."""
    means = torch.tensor([5.0, 0.4, -0.2])
    builder = partial(NonlinearInput, u_mean=means, u_std=torch.tensor([7.0, 0.5, 2.0]))
    head = make_input(partial(builder, hidden=[4], activation="tanh", linear=[0]), inputs=3)
    with torch.no_grad():
        head.constant.copy_(torch.arange(1.0, SIZE + 1)[:, None])
    u = torch.randn(40, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    values = head.network(torch.cat([q, u[:, 1:]], -1)).reshape(40, SIZE, 2)
    expected = torch.einsum("bij,bj->bi", values * torch.tensor([3.0, 2.0]).double(), u[:, 1:])
    expected = expected + 0.5 * torch.arange(1.0, SIZE + 1).double() * u[:, :1]
    assert_near(head.force(q, u), expected, 1e-12)


@pytest.mark.parametrize("linear", [[0, 1], [2], [1, 1]])
def test_a_nonlinear_input_refuses_linear_inputs_that_are_not_there(linear):
    scales = {"u_mean": torch.zeros(2), "u_std": torch.ones(2)}
    with pytest.raises(ValueError, match=r"linear is .*expected some but not all of the 2 inputs"):
        make_input(partial(NonlinearInput, hidden=[4], linear=linear, **scales))


def test_the_matrix_of_a_nonlinear_input_is_that_at_the_mean_input(q):
    head = make_nonlinear()
    mean = torch.tensor([0.4, -0.2]).double().expand(40, 2)
    assert head(q).shape == (40, SIZE, 2)
    assert_near((head(q) @ mean.unsqueeze(-1)).squeeze(-1), head.force(q, mean), 1e-6)
    assert not head.affine
    assert make_input(partial(NetworkInput, hidden=[4])).affine
