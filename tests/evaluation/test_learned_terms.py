import math

import pytest
import torch

from pinn_dyn.evaluation import compare_terms, terms_figure
from pinn_dyn.evaluation.learned_terms import fit_factor
from pinn_dyn.mechanics import MechanicalSystem, Terms
from pinn_dyn.systems import SoftArm

Q = torch.tensor([[1.2, -0.2, 0.15], [0.8, 0.2, 0.3]], dtype=torch.float64)
P = torch.tensor([[1.6, 0.1, -0.2], [0.3, 2.5, 0.1], [-0.4, 0.2, 3.0]], dtype=torch.float64)
TERMS = ["M", "M_inverse", "D", "G", "A"]


class Transformed(MechanicalSystem):
    """The soft arm with every term multiplied by P from the left."""

    def __init__(self, factor):
        super().__init__(3, 3)
        self.arm = SoftArm()
        self.register_buffer("factor", factor)

    def mass_matrix(self, q):
        return self.factor @ self.arm.mass_matrix(q)

    def potential_energy(self, q):
        raise NotImplementedError("P G is no gradient")

    def _potential_force(self, q):
        return self.arm.potential_force(q) @ self.factor.T

    def damping_matrix(self, q):
        return self.factor @ self.arm.damping_matrix(q)

    def input_matrix(self, q):
        return self.factor @ self.arm.input_matrix(q)


def test_a_constant_factor_is_recovered():
    comparison = compare_terms(Transformed(P), SoftArm(), Q)
    torch.testing.assert_close(comparison.P, P.expand(2, 3, 3))
    frame = comparison.to_frame()
    assert (frame.relative_error_best_P < 1e-9).all()
    assert (frame.relative_error_identity > 0.3).all()


def test_relative_errors_of_one_changed_term():
    comparison = compare_terms(SoftArm(damping=0.12), SoftArm(), Q, names=["bent", "long"])
    frame = comparison.to_frame()
    assert list(frame.columns) == [
        "configuration",
        "term",
        "relative_error_identity",
        "relative_error_best_P",
    ]
    assert list(frame.configuration) == ["bent"] * 5 + ["long"] * 5
    assert list(frame.term) == TERMS * 2
    assert list(frame.relative_error_identity) == pytest.approx([0, 0, 0.2, 0, 0] * 2)


def test_every_block_weighs_the_same_in_the_fit():
    # One coordinate: P minimizes sum (P - X_L / X)^2, whatever the units of X.
    true = Terms(*(torch.tensor(x) for x in ([[1e-3]], [[0.5]], [20.0], [[300.0]])))
    learned = Terms(true.M * 2, true.D * 1, true.G * 4, true.A * 5)
    assert fit_factor(true, learned).item() == pytest.approx(3.0)


def test_a_term_that_vanishes_gives_no_nan():
    comparison = compare_terms(SoftArm(damping=0.1), SoftArm(damping=0.0), Q)
    frame = comparison.to_frame().set_index("term")
    assert (frame.loc["D", "relative_error_identity"] == math.inf).all()
    assert list(frame.loc["D", "relative_error_best_P"]) == pytest.approx([1, 1])
    same = compare_terms(SoftArm(damping=0.0), SoftArm(damping=0.0), Q).to_frame()
    assert list(same.relative_error_identity) == [0] * 10
    assert (same.relative_error_best_P < 1e-9).all()


@pytest.mark.parametrize("state", ["qv", "qp"])
def test_the_inverse_of_m_is_shown_of_a_model_of_momenta(state):
    arm = SoftArm(damping=0.12)
    arm.state = state
    comparison = compare_terms(arm, SoftArm(), Q)
    shown = terms_figure(comparison, configuration=0, title="fake").axes[0].get_title()
    assert ("{-1}" in shown) is (state == "qp")
