"""What every head of a potential, an input matrix, a friction and a residual force must satisfy.

Inherit the suite of your head in a test class and override its ``head`` fixture: three coordinates,
float64, parameters off their start. Derivatives are checked against finite differences; mass and
damping have :class:`~tests.contracts.cholesky_head.CholeskyHeadContract`.
"""

import copy

import pytest
import torch

from tests.support.finite_differences import assert_near, partial_derivatives

SIZE = 3
COUNT = 24


class _HeadContract:
    """What all of them share."""

    @pytest.fixture
    def head(self):
        """The head, in float64, with parameters off their start."""
        raise NotImplementedError("override the fixture 'head'")

    @pytest.fixture
    def draw(self):
        """Random numbers ``(24, n)``, the same in every test."""
        generator = torch.Generator().manual_seed(4)

        def drawn(columns=SIZE, spread=1.0):
            return spread * torch.randn(COUNT, columns, generator=generator, dtype=torch.float64)

        return drawn

    @pytest.fixture
    def arguments(self, draw):
        """What the head is called with, one row for each of a batch."""
        return (draw(),)

    def all_that_it_says(self, head, arguments):
        return head(*arguments)

    def test_any_batch_shape_gives_the_same_values(self, head, arguments):
        with torch.no_grad():
            values = head(*arguments)
            one = head(*(x[0] for x in arguments))
            blocks = head(*(x.reshape(4, 6, -1) for x in arguments))
        assert_near(one, values[0], 1e-12, 1 + float(values.abs().max()))
        assert_near(blocks.reshape(values.shape), values, 1e-12, 1 + float(values.abs().max()))

    def test_single_precision_is_near_double_precision(self, head, arguments):
        with torch.no_grad():
            values = head(*arguments)
            single = copy.deepcopy(head).float()(*(x.float() for x in arguments))
        assert single.dtype == torch.float32
        assert_near(single.double(), values, 1e-4, 1e-6 + float(values.abs().max()))

    def test_gradients_reach_every_parameter(self, head, arguments):
        parameters = list(head.parameters())
        value = self.all_that_it_says(head, arguments)
        assert value.requires_grad == bool(parameters)
        if parameters:
            value.square().sum().backward()
        for parameter in parameters:
            assert parameter.grad is not None
            assert parameter.grad.isfinite().all()
            assert parameter.grad.any()


class PotentialContract(_HeadContract):
    """V(q) and its slope."""

    def test_it_is_one_number_for_each_configuration(self, head, draw):
        assert head(draw()).shape == (COUNT,)

    def test_its_force_is_its_slope(self, head, draw):
        q = draw()
        with torch.no_grad():
            assert_near(head.gradient(q), partial_derivatives(head, q), 1e-7)


class InputMatrixContract(_HeadContract):
    """A(q), the force A u, and the size of that force."""

    inputs = 2

    def test_it_has_a_row_for_each_coordinate_and_a_column_for_each_input(self, head, draw):
        assert head(draw()).shape == (COUNT, SIZE, self.inputs)

    def test_its_force_is_the_matrix_times_the_input(self, head, draw):
        """Where the matrix does not depend on the input."""
        q, u = draw(), draw(self.inputs)
        with torch.no_grad():
            force = head.force(q, u)
            assert force.shape == (COUNT, SIZE)
            if head.affine:
                assert_near(
                    force,
                    torch.einsum("bij,bj->bi", head(q), u),
                    1e-12,
                    1 + float(force.abs().max()),
                )

    def test_no_input_is_no_force(self, head, draw):
        with torch.no_grad():
            assert not head.force(draw(), torch.zeros(COUNT, self.inputs).double()).any()

    def test_its_typical_force_is_a_positive_number_for_each_coordinate(self, head):
        force = head.typical_force(torch.ones(self.inputs))
        assert force.shape == (SIZE,)
        assert (force > 0).all()


class FrictionContract(_HeadContract):
    """F(v), passive, and what it leaves of a drive's force."""

    def all_that_it_says(self, head, arguments):
        (v,) = arguments
        return torch.cat([head(v), head.transmitted(v, torch.ones_like(v))])

    def test_a_drive_never_gives_more_than_it_has(self, head, draw):
        """Power that arrives is at most the power of the drive, in both directions."""
        v, force = draw(), draw(spread=5.0)
        with torch.no_grad():
            assert (head.transmitted(v, force) * v <= force * v + 1e-12).all()

    def test_it_never_adds_energy(self, head):
        """v_i F_i(v) >= 0 for slow, fast and zero velocities, of either sign."""
        speeds = torch.logspace(-9, 5, COUNT, dtype=torch.float64)[:, None].expand(-1, SIZE)
        with torch.no_grad():
            for v in (speeds, -speeds):
                assert (head(v) * v >= 0).all()
            assert not head(torch.zeros(1, SIZE, dtype=torch.float64)).any()

    def test_each_force_depends_on_its_own_velocity_by_the_slope_that_it_says(self, head, draw):
        v = draw()
        with torch.no_grad():
            slopes = partial_derivatives(head, v, step=1e-4)
            expected = torch.diag_embed(head.slope(v))
        assert_near(slopes, expected, 1e-5, 1e-9 + float(expected.abs().max()))


class ResidualContract(_HeadContract):
    """r(q, v, u) and what it costs."""

    inputs = 2

    @pytest.fixture
    def arguments(self, draw):
        return draw(), draw(), draw(self.inputs)

    def test_it_is_a_force_for_each_coordinate(self, head, arguments):
        assert head(*arguments).shape == (COUNT, SIZE)

    def test_its_penalty_is_a_number_that_grows_with_it(self, head, arguments):
        with torch.no_grad():
            penalty = head.penalty(*arguments)
            assert penalty.shape == ()
            assert (penalty > 0) == bool(head(*arguments).any())

    def test_it_is_bounded(self, head, arguments):
        with torch.no_grad():
            far, farther = (head(*(scale * x for x in arguments)) for scale in (1e3, 1e6))
        assert_near(farther, far, 1e-9, 1 + float(far.abs().max()))
