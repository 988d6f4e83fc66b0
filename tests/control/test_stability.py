import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from pinn_dyn.control.factor import factor_bounds, fit_factor
from pinn_dyn.control.stability import certify
from pinn_dyn.control.stability_report import check_without_truth, model_report, stability_report
from pinn_dyn.control.steady_state import predict_steady_state, required_gain
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import LinearSystem
from tests.support.cart_pole import CartPole

P = torch.tensor([[2.0, 0.3], [-0.1, 1.5]], dtype=torch.float64)
EYE = torch.eye(2, dtype=torch.float64)


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


def draw(seed, *shape, scale=0.5):
    generator = torch.Generator().manual_seed(seed)
    return scale * (2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1)


class Arm(MechanicalSystem):
    """Two nonlinear coordinates; the learned one is left @ its terms, plus a constant force."""

    def __init__(self, weight=3.0, tilt=0.3, left=EYE, extra=(0.0, 0.0), turn=None):
        super().__init__(2, 2)
        self.weight, self.tilt = weight, tilt
        self.register_buffer("left", left)
        self.register_buffer("extra", tensor(extra))
        self.register_buffer("turn", left if turn is None else turn)

    def mass_matrix(self, q):
        one, bend = torch.ones_like(q[..., 0]), 0.2 * torch.cos(q[..., 1])
        entries = torch.stack([one + 2 * bend, bend, bend, 0.5 * one], -1)
        return self.left @ entries.unflatten(-1, (2, 2))

    def potential_energy(self, q):
        raise NotImplementedError("left @ G need not be a gradient")

    def _potential_force(self, q):
        first, second = q.unbind(-1)
        force = torch.stack([self.weight * torch.sin(first + second), torch.sin(second)], -1)
        return force @ self.left.mT + q @ self.left.mT + self.extra

    def damping_matrix(self, q):
        return self.left @ (0.3 * EYE).expand(*q.shape[:-1], 2, 2)

    def input_matrix(self, q):
        first, second = q.unbind(-1)
        entries = [2 + torch.sin(first), self.tilt * second, 0.1 + 0 * first, 1 + 0.3 * first**2]
        return self.turn @ torch.stack(entries, -1).unflatten(-1, (2, 2))


def law(model, q, v, q_ref, position_gain, velocity_gain):
    A_L = model.input_matrix(q)
    feedback = position_gain * (q_ref - q) - velocity_gain * v
    return torch.linalg.inv(A_L) @ model.potential_force(q) + A_L.T @ feedback


def closed_loop(model, truth, q_ref, position_gain, velocity_gain):
    def slope(_, x):
        q, v = torch.from_numpy(x).chunk(2)
        u = law(model, q, v, q_ref, position_gain, velocity_gain)
        return torch.cat([v, truth.forward_dynamics(q, v, u)]).detach().numpy()

    return slope


def test_a_model_that_is_a_factor_times_the_truth_leaves_no_force_and_no_error():
    q = draw(0, 7, 2)
    certificate = certify(Arm(left=P), Arm(), q, 4.0, 2.0, region="box")
    for bounds in (certificate.fitted, certificate.matched):
        torch.testing.assert_close(bounds.P, P.expand(7, 2, 2))
        for name in ("condition_2", "delta_A", "delta_G", "delta_I", "delta_all_bound"):
            assert getattr(bounds, name).max() < 1e-12
    assert certificate.delta_all.max() < 1e-12
    assert certificate.rest_error.max() < 1e-12
    prediction = predict_steady_state(Arm(left=P), Arm(), q, 4.0, 2.0)
    assert prediction.bound.max() < 1e-12
    assert prediction.error.max() < 1e-12
    assert prediction.holds.all()


@pytest.mark.parametrize("factor", [P, EYE, 0.01 * EYE])
def test_a_constant_error_of_the_force_gives_the_closed_form(factor):
    q, extra, K_P = draw(1, 5, 2), tensor([0.2, -0.1]), tensor([3.0, 8.0])
    model, truth = Arm(left=factor, extra=(0.2, -0.1)), Arm()
    certificate = certify(model, truth, q, K_P, 2.0, region="box")
    # A A_L^-1 (P G + extra) - G = P^-1 extra, and A A_L^T = A A^T P^T.
    left_over = torch.linalg.inv(factor) @ extra
    A = truth.input_matrix(q)
    stiffness = A @ A.mT @ factor.mT @ torch.diag(K_P)
    rest = torch.linalg.inv(stiffness) @ left_over
    torch.testing.assert_close(certificate.delta_all, left_over.norm().expand(5))
    torch.testing.assert_close(certificate.matched.delta_G, extra.norm().expand(5))
    torch.testing.assert_close(certificate.rest_error, rest.norm(dim=-1))
    expected = torch.linalg.eigvalsh((stiffness + stiffness.mT) / 2)[:, 0]
    torch.testing.assert_close(certificate.position_eigenvalue, expected)
    assert (certificate.rest_error <= certificate.rest_error_bound).all()


def test_the_three_terms_of_the_paper_telescope_whatever_the_factor():
    q, model, truth = draw(2, 9, 2), Arm(3.4, 0.5, turn=P), Arm()
    true, learned = truth.terms(q), model.terms(q)
    A, A_L, G, G_L = true.A, learned.A, true.G.unsqueeze(-1), learned.G.unsqueeze(-1)
    certificate = certify(model, truth, q, 1.0, 1.0, region="box")
    some_P = EYE + draw(3, 9, 2, 2)
    for factor in (some_P, certificate.fitted.P, certificate.matched.P):
        inverse = torch.linalg.inv(factor)
        delta_G = G_L - factor @ G
        delta_I = torch.linalg.inv(A_L) - torch.linalg.inv(A) @ inverse
        terms = inverse @ delta_G + A @ delta_I @ factor @ G + A @ delta_I @ delta_G
        whole = A @ torch.linalg.inv(A_L) @ G_L - G
        torch.testing.assert_close(terms, whole, rtol=0, atol=1e-12)
        # Condition 1 does not depend on the factor either.
        sum_1 = A @ (A_L - factor @ A).mT + A @ A.mT @ factor.mT
        torch.testing.assert_close(sum_1, A @ A_L.mT, rtol=0, atol=1e-12)
    symmetric = A @ A_L.mT + A_L @ A.mT
    torch.testing.assert_close(certificate.condition_1, torch.linalg.eigvalsh(symmetric)[:, 0] / 2)
    torch.testing.assert_close(
        certificate.delta_all, torch.linalg.vector_norm(whole.squeeze(-1), dim=-1)
    )


def test_the_papers_bounds_are_never_exceeded():
    q, truth = draw(4, 40, 2), Arm()
    model = Arm(3.4, 0.6, turn=EYE + 0.15 * draw(5, 2, 2))
    true, learned = truth.terms(q), model.terms(q)
    certificate = certify(model, truth, q, 1.0, 1.0, region="box")
    for factor in (fit_factor(true, learned), certificate.matched.P, EYE.expand(40, 2, 2)):
        bounds = factor_bounds(factor, true, learned)
        assert (bounds.condition_2 < 1).all()
        assert (bounds.delta_I <= bounds.delta_I_bound + 1e-12).all()
        assert (certificate.delta_all <= bounds.delta_all_bound + 1e-12).all()
    assert (certificate.matched.delta_all_bound <= certificate.fitted.delta_all_bound).all()


def test_the_neumann_bound_is_sharp_for_one_coordinate():
    # A = 1, A_L = 0.6, P = 1: |X Delta_A X| / (1 - |X Delta_A|) = 0.4 / 0.6 = 1 / 0.6 - 1.
    one = LinearSystem([[1.0]], [[2.0]], [[0.1]], [[1.0]])
    learned = LinearSystem([[1.0]], [[2.0]], [[0.1]], [[0.6]])
    q = tensor([[0.7]])
    bounds = factor_bounds(tensor([[[1.0]]]), one.terms(q), learned.terms(q))
    assert bounds.condition_2.item() == pytest.approx(0.4)
    assert bounds.delta_I_bound.item() == pytest.approx(2 / 3)
    assert bounds.delta_I.item() == pytest.approx(2 / 3)
    far = LinearSystem([[1.0]], [[2.0]], [[0.1]], [[-0.6]])
    bounds = factor_bounds(tensor([[[1.0]]]), one.terms(q), far.terms(q))
    assert bounds.condition_2.item() == pytest.approx(1.6)
    assert bounds.delta_I_bound.item() == math.inf


def test_an_input_matrix_of_the_wrong_sign_fails_condition_1_and_says_so():
    q = draw(6, 5, 2)
    certificate = certify(Arm(turn=-EYE), Arm(), q, 4.0, 2.0, region="the box")
    A = Arm().input_matrix(q)
    torch.testing.assert_close(certificate.condition_1, -torch.linalg.eigvalsh(A @ A.mT)[:, 1])
    assert certificate.rest_error_bound.min() == math.inf
    prediction = predict_steady_state(Arm(turn=-EYE), Arm(), q, 40.0, 2.0)
    assert not prediction.holds.any()
    assert not prediction.stable.any()
    # A finite radius alone is no claim: nothing is counted where the conditions fail.
    assert torch.isfinite(prediction.bound).any()
    text = stability_report(certificate, [prediction], [torch.full((5,), 100.0)])
    assert "| 0 of 5 | - | - | - | 0 of 0 | 0 |" in text
    assert "**It fails at 5 of 5 configurations.**" in text
    assert "weakest stiffness of the region it would be inf." in text
    assert "no stable equilibrium found at 5" in text


def test_gains_that_differ_can_break_the_product_that_the_proof_relies_on():
    # sym([[1, .9], [.9, 1]] diag(1, 100)) has the determinant 100 - 45.45^2 < 0.
    factor = tensor([[1.0, 0.9], [0.9, 1.0]])
    truth = LinearSystem(EYE, EYE, EYE, EYE)
    model = LinearSystem(EYE, EYE, EYE, factor)
    q = tensor([[0.1, 0.2]])
    certificate = certify(model, truth, q, [1.0, 100.0], 1.0, region="point")
    assert certificate.condition_1.item() == pytest.approx(0.1)
    assert certificate.velocity_eigenvalue.item() == pytest.approx(0.1)
    expected = 50.5 - math.sqrt(49.5**2 + 45.45**2)
    assert certificate.position_eigenvalue.item() == pytest.approx(expected)
    assert "| A A_L^T K_P | -16.7 | -16.7 | 0 of 1 |" in stability_report(certificate)
    # The crude bound needs condition 1 only.
    assert certificate.rest_error.item() <= certificate.rest_error_bound.item() < math.inf


def test_the_predicted_rest_is_where_a_simulation_comes_to_rest():
    truth, model = Arm(), Arm(3.6, 0.6, left=P)
    q_ref, K_P, K_D = tensor([[0.3, -0.4]]), tensor([5.0, 8.0]), tensor([4.0, 3.0])
    prediction = predict_steady_state(model, truth, q_ref, K_P, K_D)
    slope = closed_loop(model, truth, q_ref[0], K_P, K_D)
    end = solve_ivp(slope, (0, 12), np.zeros(4), "LSODA", rtol=1e-5, atol=1e-8).y[:, -1]
    assert np.abs(end[2:]).max() < 1e-6
    np.testing.assert_allclose(prediction.q_ss[0].numpy(), end[:2], rtol=0, atol=1e-6)
    assert prediction.error.min() > 1e-3
    assert (prediction.error <= prediction.bound).all()
    assert (prediction.bound < 1.5 * prediction.error).all()


def test_the_poles_are_those_of_the_linearized_closed_loop():
    truth, model = Arm(), Arm(3.6, 0.6, left=P)
    q_ref, gains = tensor([[0.3, -0.4]]), (tensor([5.0, 8.0]), tensor([4.0, 3.0]))
    prediction = predict_steady_state(model, truth, q_ref, *gains)
    slope = closed_loop(model, truth, q_ref[0], *gains)
    rest = np.concatenate([prediction.q_ss[0].numpy(), np.zeros(2)])
    assert np.abs(slope(0, rest)).max() < 1e-9
    columns = [(slope(0, rest + e) - slope(0, rest - e)) / 2e-5 for e in 1e-5 * np.eye(4)]
    expected = np.sort_complex(np.linalg.eigvals(np.stack(columns, -1)))
    found = np.sort_complex(prediction.poles[0].numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def static_force(q, model, truth, q_ref, position_gain):
    q = torch.from_numpy(q)
    u = law(model, q, torch.zeros(2), q_ref, position_gain, 1.0)
    return (truth.input_matrix(q) @ u - truth.potential_force(q)).numpy()


def test_no_equilibrium_lies_outside_its_bound():
    found, steep = 0, 0
    for seed in range(20):
        turn, extra = EYE + draw(seed, 2, 2), draw(seed, 2).tolist()
        model = Arm(3 + float(draw(seed, 1)), 0.6, left=P, turn=P @ turn, extra=extra)
        q_ref = draw(seed + 100, 10, 2, scale=1.0)
        prediction = predict_steady_state(model, Arm(), q_ref, 2.5, 1.0)
        for k in torch.isfinite(prediction.bound).nonzero().flatten().tolist():
            arguments = (model, Arm(), q_ref[k], 2.5)
            q, _, status, _ = fsolve(static_force, q_ref[k].numpy(), arguments, full_output=True)
            assert status == 1
            assert np.linalg.norm(q - q_ref[k].numpy()) <= prediction.bound[k]
            found += 1
            steep += int(prediction.slope[k] > 0.3)
    assert found >= 100
    assert steep >= 20


def test_a_slope_above_one_gives_no_bound():
    # One coordinate, A = A_L = 1, G_L - G = 3 q - 1: h = (3 q - 1) / K_P has the slope 3 / K_P.
    truth = LinearSystem([[1.0]], [[2.0]], [[0.1]], [[1.0]])
    model = LinearSystem([[1.0]], [[5.0]], [[0.1]], [[1.0]])
    q_ref = tensor([[0.4]])
    weak = predict_steady_state(model, truth, q_ref, 2.0, 1.0)
    assert weak.slope.item() == pytest.approx(1.5)
    assert weak.bound.item() == math.inf
    assert not weak.stable.item()
    # K_P = 4: L = 3/4, |h| = 0.3, bound 1.2, and the rest is where 4 (q_ref - q) + 3 q = 0.
    strong = predict_steady_state(model, truth, q_ref, 4.0, 1.0)
    assert strong.slope.item() == pytest.approx(0.75)
    assert strong.bound.item() == pytest.approx(1.2)
    assert strong.q_ss.item() == pytest.approx(1.6)
    # |w| = 1.2 and L_w = 3: an error of 0.1 needs K_P = 3 + 12.
    assert required_gain(model, truth, q_ref, error=0.1).item() == pytest.approx(15.0)


def test_the_required_gain_meets_the_wanted_error_and_no_smaller_one_does():
    model, truth, q_ref = Arm(3.6, 0.6, left=P), Arm(), draw(7, 6, 2)
    gains = required_gain(model, truth, q_ref, error=0.02)
    for k, gain in enumerate(gains.tolist()):
        met = predict_steady_state(model, truth, q_ref[k : k + 1], 1.0001 * gain, 1.0)
        assert met.bound.item() <= 0.02
        missed = predict_steady_state(model, truth, q_ref[k : k + 1], 0.9 * gain, 1.0)
        assert missed.bound.item() > 0.02


def test_the_report_counts_measured_errors_above_the_bound():
    model, truth, q_ref = Arm(3.6, 0.6, left=P), Arm(), draw(8, 4, 2)
    certificate = certify(model, truth, q_ref, 5.0, 3.0, region="box")
    prediction = predict_steady_state(model, truth, q_ref, 5.0, 3.0)
    measured = prediction.error.clone()
    measured[1], measured[2] = 2 * prediction.bound[1], math.nan
    text = stability_report(certificate, [prediction], [measured], {0.01: tensor([3.0, 7.0])})
    assert "| 1 of 3 | 1 |" in text
    assert "| 0.01 | 3 | 7 |" in text
    with pytest.raises(ValueError, match=r"measured has 1 entries of lengths \[3\]"):
        stability_report(certificate, [prediction], [measured[:3]])
    assert list(certificate.to_frame().columns[:3]) == ["q1", "q2", "condition_1"]
    assert len(prediction.to_frame()) == 4
    for line in text.splitlines():
        if line.startswith("|"):
            assert line.count("|") in (4, 5, 12)


def test_a_model_without_truth_gets_a_shorter_report():
    q = draw(9, 3, 2)
    check = check_without_truth(Arm(), q, region="the log")
    A, M = Arm().input_matrix(q), Arm().mass_matrix(q)
    torch.testing.assert_close(check.input_condition, torch.linalg.cond(A))
    torch.testing.assert_close(check.mass_condition, torch.linalg.cond(M))
    torch.testing.assert_close(check.damping_eigenvalue, tensor([0.3] * 3))
    assert "N = M, as Proposition 1 needs" in model_report(check)
    assert "at 3 of 3" in model_report(check)
    under = check_without_truth(CartPole(), q, region="the log")
    assert "Proposition 1 says nothing" in model_report(under)
    assert len(under.to_frame()) == 3


def test_bad_input_is_named():
    q = draw(10, 3, 2)
    with pytest.raises(ValueError, match=r"truth has N = 2 coordinates and M = 1"):
        certify(CartPole(), CartPole(), q, 1.0, 1.0, region="box")
    with pytest.raises(ValueError, match=r"model has \(N, M\) = \(3, 3\), truth \(2, 2\)"):
        certify(SoftArm(), Arm(), q, 1.0, 1.0, region="box")
    with pytest.raises(TypeError, match="model is a Linear, expected a MechanicalSystem"):
        certify(torch.nn.Linear(2, 2), Arm(), q, 1.0, 1.0, region="box")
    with pytest.raises(ValueError, match=r"position_gain is"):
        certify(Arm(), Arm(), q, -1.0, 1.0, region="box")
    with pytest.raises(ValueError, match=r"q_ref has shape \(2,\)"):
        predict_steady_state(Arm(), Arm(), q[0], 1.0, 1.0)
    with pytest.raises(ValueError, match=r"A_L is singular at q\[0\]"):
        certify(Arm(turn=0 * EYE), Arm(), q, 1.0, 1.0, region="box")
    with pytest.raises(ValueError, match="error is 0"):
        required_gain(Arm(), Arm(), q, error=0.0)
