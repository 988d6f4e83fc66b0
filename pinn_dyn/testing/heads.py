"""Suites for heads of three coordinates. Inherit the suite of your head and override ``head``."""

import copy

import pytest
import torch

from pinn_dyn.testing.finite_differences import assert_near, partial_derivatives, product, slope

SIZE = 3
COUNT = 24


class HeadContract:
    """The tests that all suites of this module share."""

    @pytest.fixture
    def head(self):
        """Return the head, in float64, with parameters off their initial values."""
        raise NotImplementedError("override the fixture 'head'")

    @pytest.fixture
    def draw(self):
        """Return a function that draws random numbers ``(24, n)``."""
        generator = torch.Generator().manual_seed(4)

        return lambda columns=SIZE, spread=1.0: (
            spread * torch.randn(COUNT, columns, generator=generator, dtype=torch.float64)
        )

    @pytest.fixture
    def arguments(self, draw):
        """Return the arguments of the head."""
        return (draw(),)

    def test_any_batch_shape_gives_the_same_values(self, head, arguments):
        with torch.no_grad():
            values = head(*arguments)
            first = head(*(x[0] for x in arguments))
            blocks = head(*(x.reshape(4, 6, -1) for x in arguments))
        scale = 1 + float(values.abs().max())
        assert_near(first, values[0], 1e-12, scale)
        assert_near(blocks.reshape(values.shape), values, 1e-12, scale)

    def test_float32_is_close_to_float64(self, head, arguments):
        with torch.no_grad():
            values = head(*arguments)
            single = copy.deepcopy(head).float()(*(x.float() for x in arguments))
        assert single.dtype == torch.float32
        assert_near(single.double(), values, 1e-4, 1e-6 + float(values.abs().max()))

    def test_gradients_reach_every_parameter(self, head, arguments):
        parameters = list(head.parameters())
        value = head(*arguments)
        assert value.requires_grad == bool(parameters)
        if parameters:
            value.square().sum().backward()
        for parameter in parameters:
            assert parameter.grad.isfinite().all()
            assert parameter.grad.any()


class CholeskyHeadContract(HeadContract):
    """Suite for the triangular factor of a mass or damping matrix."""

    std = 1.0
    """Standard deviation of the configurations that the head was scaled to, around zero."""

    @pytest.fixture
    def q(self, draw):
        return draw(spread=2 * self.std)  # partly outside the data

    @pytest.fixture
    def arguments(self, q):
        return (q,)

    def test_matrix_is_the_square_of_a_lower_triangular_factor(self, head, q):
        factor = head(q).detach()
        assert factor.shape == (COUNT, SIZE, SIZE)
        assert torch.equal(factor, factor.tril())
        assert float(factor.diagonal(dim1=-2, dim2=-1).min()) >= 0
        root = factor.mT if head.transposed else factor
        matrix = head.matrix(q).detach()
        assert_near(matrix, root @ root.mT, 1e-12)
        x = torch.flip(q, (0, 1))
        assert_near(head.product(q, x).detach(), product(matrix, x), 1e-12)

    def test_passes_are_the_derivatives_of_the_factor(self, head, q, draw):
        dq, cotangent = torch.flip(q, (0,)), draw(SIZE * SIZE).unflatten(-1, (SIZE, SIZE))
        with torch.no_grad():
            value, rate, first = head.linearize_along(q, dq)
            expected = slope(lambda e: head(q + e * dq), 1e-4)
            assert_near(rate, expected, 1e-6, 1 + float(expected.abs().max()))
            assert_near(value, head(q), 1e-12)
            expected = partial_derivatives(lambda q: (cotangent * head(q)).sum((-2, -1)), q, 1e-4)
            for tape in (first, head.linearize(q)[1]):
                gradient = head.pullback(tape, cotangent)
                assert_near(gradient, expected, 1e-6, 1 + float(expected.abs().max()))

    def test_attribute_constant_is_true_for_constant_factors_only(self, head, q):
        spread = float((head(q) - head(q[:1])).abs().max().detach())
        assert (spread == 0) == head.constant

    def test_matrix_is_bounded_over_all_configurations(self, head, q):
        with torch.no_grad():
            far = head.matrix(1e3 * q)
            assert torch.isfinite(far).all()
            assert_near(head.matrix(1e5 * q), far, 1e-9)


class PotentialContract(HeadContract):
    """Suite for the potential V(q) and its gradient."""

    def test_gradient_is_the_slope_of_the_potential(self, head, draw):
        q = draw()
        with torch.no_grad():
            assert head(q).shape == (COUNT,)
            assert_near(head.gradient(q), partial_derivatives(head, q), 1e-7)


class InputMatrixContract(HeadContract):
    """Suite for the input matrix A(q), the force A u, and its typical size."""

    inputs = 2

    def test_force_is_the_matrix_times_the_input(self, head, draw):
        q, u = draw(), draw(self.inputs)
        with torch.no_grad():
            assert head(q).shape == (COUNT, SIZE, self.inputs)
            force = head.force(q, u)
            assert force.shape == (COUNT, SIZE)
            if head.affine:
                assert_near(force, product(head(q), u), 1e-12, 1 + float(force.abs().max()))
            assert not head.force(q, 0 * u).any()

        typical = head.typical_force(torch.ones(self.inputs))
        assert typical.shape == (SIZE,)
        assert (typical > 0).all()


class FrictionContract(HeadContract):
    """Suite for dry friction F(v), which is passive."""

    def test_friction_never_adds_power(self, head):
        speeds = torch.logspace(-9, 5, COUNT, dtype=torch.float64)[:, None].expand(-1, SIZE)
        with torch.no_grad():
            for v in (speeds, -speeds):
                assert (head(v) * v >= 0).all()
            assert not head(torch.zeros(1, SIZE, dtype=torch.float64)).any()

    def test_slope_is_the_derivative_by_the_velocity_of_the_same_coordinate(self, head, draw):
        v = draw()
        with torch.no_grad():
            slopes = partial_derivatives(head, v, step=1e-4)
            expected = torch.diag_embed(head.slope(v))
        assert_near(slopes, expected, 1e-5, 1e-9 + float(expected.abs().max()))


class ResidualContract(HeadContract):
    """Suite for the residual force r(q, v, u) and its penalty."""

    inputs = 2

    @pytest.fixture
    def arguments(self, draw):
        return draw(), draw(), draw(self.inputs)

    def test_force_is_bounded_and_penalized(self, head, arguments):
        with torch.no_grad():
            assert head(*arguments).shape == (COUNT, SIZE)
            penalty = head.penalty(*arguments)
            assert penalty.shape == ()
            assert (penalty > 0) == bool(head(*arguments).any())
            far, farther = (head(*(scale * x for x in arguments)) for scale in (1e3, 1e6))
        assert_near(farther, far, 1e-9, 1 + float(far.abs().max()))
