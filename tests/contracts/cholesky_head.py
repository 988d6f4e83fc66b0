"""What every Cholesky head must satisfy, learned, fixed or a user's own.

Inherit :class:`CholeskyHeadContract` in a test class and override the ``head`` fixture, in float64.
Derivatives are checked against finite differences of L, definiteness by eigenvalues.
"""

import pytest
import torch

from tests.support.finite_differences import assert_near, partial_derivatives, slope


class CholeskyHeadContract:
    """The suite."""

    std = 1.0
    """Standard deviation of the configurations that the head was scaled to, around zero."""

    @pytest.fixture
    def head(self):
        """The head, in float64, with parameters off their start."""
        raise NotImplementedError("override the fixture 'head'")

    @pytest.fixture
    def size(self, head):
        """N."""
        return 3

    @pytest.fixture
    def q(self, size):
        """Forty configurations, some of them outside the data."""
        generator = torch.Generator().manual_seed(4)
        return 2 * self.std * torch.randn(40, size, generator=generator, dtype=torch.float64)

    @pytest.fixture(autouse=True)
    def _values_only(self):
        with torch.no_grad():
            yield

    def test_the_factor_is_lower_triangular_and_its_diagonal_not_negative(self, head, q, size):
        factor = head(q)
        assert factor.shape == (40, size, size)
        assert torch.equal(factor, factor.tril())
        assert float(factor.diagonal(dim1=-2, dim2=-1).min()) >= 0

    def test_the_matrix_is_the_square_of_the_factor_and_semidefinite(self, head, q):
        factor = head(q)
        root = factor.mT if head.transposed else factor
        matrix = head.matrix(q)
        assert_near(matrix, torch.einsum("bik,bjk->bij", root, root), 1e-12)
        largest = float(matrix.abs().max())
        assert float(torch.linalg.eigvalsh(matrix).min()) > -1e-12 * largest

    def test_a_product_by_the_factor_is_that_of_the_matrix(self, head, q):
        x = torch.flip(q, (0, 1))
        assert_near(head.product(q, x), torch.einsum("bij,bj->bi", head.matrix(q), x), 1e-12)

    @pytest.mark.parametrize("batch", [(), (2, 20)], ids=["unbatched", "B1xB2"])
    def test_any_batch_shape_gives_the_same_factor(self, head, q, size, batch):
        part = q[0] if batch == () else q.reshape(*batch, size)
        expected = head(q)[0] if batch == () else head(q).reshape(*batch, size, size)
        assert_near(head(part), expected, 1e-12)

    def test_pushforward_is_the_slope_of_the_factor(self, head, q):
        dq = torch.flip(q, (0,))
        _, tape = head.linearize(q)
        expected = slope(lambda e: head(q + e * dq), 1e-4)
        scale = 1 + float(expected.abs().max())
        assert_near(head.pushforward(tape, dq), expected, 1e-6, scale)
        value, rate, _ = head.linearize_along(q, dq)
        assert_near(rate, expected, 1e-6, scale)
        assert_near(value, head(q), 1e-12)

    def test_pullback_is_the_gradient_of_the_factor(self, head, q, size):
        generator = torch.Generator().manual_seed(9)
        cotangent = torch.randn(40, size, size, generator=generator, dtype=torch.float64)
        _, tape = head.linearize(q)
        expected = partial_derivatives(lambda q: (cotangent * head(q)).sum((-2, -1)), q, 1e-4)
        assert_near(head.pullback(tape, cotangent), expected, 1e-6, 1 + float(expected.abs().max()))

    def test_it_is_constant_if_it_says_so(self, head, q):
        spread = float((head(q) - head(q[:1])).abs().max())
        assert (spread == 0) == head.constant

    def test_far_outside_the_data_it_is_as_large_as_near_them(self, head, q):
        """Bounded over all q: a hundred times farther out nothing grows any more."""
        far = head.matrix(1e3 * q)
        assert torch.isfinite(far).all()
        assert_near(head.matrix(1e5 * q), far, 1e-9)

    def test_float32_is_close_to_float64(self, head, q):
        expected = head.matrix(q)
        assert_near(head.float().matrix(q.float()).double(), expected, 1e-4)
