import importlib.util
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from pinn_dyn.evaluation.learned_terms import fit_factor
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.testing import LinearSystem
from tests.support.linear import double

_path = Path(__file__).parents[2] / "examples" / "paper" / "proposition_1.py"
_spec = importlib.util.spec_from_file_location("proposition_1", _path)
paper = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(paper)
certify, factor_bounds = paper.certify, paper.factor_bounds
predict_steady_state, required_gain = paper.predict_steady_state, paper.required_gain
stability_report = paper.stability_report

P = torch.tensor([[2.0, 0.3], [-0.1, 1.5]], dtype=torch.float64)
EYE = torch.eye(2, dtype=torch.float64)


def draw(seed, *shape, scale=0.5):
    generator = torch.Generator().manual_seed(seed)
    return scale * (2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1)


class Arm(MechanicalSystem):
    """Two nonlinear coordinates; the learned one is left @ its terms, plus a constant force."""

    def __init__(self, weight=3.0, tilt=0.3, left=EYE, extra=(0.0, 0.0), turn=None):
        super().__init__(2, 2)
        self.weight, self.tilt = weight, tilt
        self.register_buffer("left", left)
        self.register_buffer("extra", double(extra))
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


def matched_factor(true, learned):
    """P = A_L A^-1, which makes Delta_A vanish."""
    return learned.A @ torch.linalg.inv(true.A)


def test_a_model_that_is_a_factor_times_the_truth_leaves_no_force_and_no_error():
    q = draw(0, 7, 2)
    true, learned = Arm().terms(q), Arm(left=P).terms(q)
    torch.testing.assert_close(fit_factor(true, learned), P.expand(7, 2, 2))
    names = ["condition_2", "delta_A", "delta_G", "delta_I", "delta_all_bound"]
    names += ["delta_all", "rest_error"]
    assert certify(Arm(left=P), Arm(), q, 4.0, 2.0)[names].abs().to_numpy().max() < 1e-12
    prediction = predict_steady_state(Arm(left=P), Arm(), q, 4.0, 2.0)
    assert prediction[["bound", "error"]].to_numpy().max() < 1e-12
    assert prediction["holds"].all()


@pytest.mark.parametrize("factor", [P, EYE, 0.01 * EYE])
def test_a_constant_error_of_the_force_gives_the_closed_form(factor):
    q, extra, K_P = draw(1, 5, 2), double([0.2, -0.1]), double([3.0, 8.0])
    model, truth = Arm(left=factor, extra=(0.2, -0.1)), Arm()
    table = certify(model, truth, q, K_P, 2.0)
    # A A_L^-1 (P G + extra) - G = P^-1 extra, and A A_L^T = A A^T P^T.
    remainder = torch.linalg.inv(factor) @ extra
    A = truth.input_matrix(q)
    stiffness = A @ A.mT @ factor.mT @ torch.diag(K_P)
    error = torch.linalg.inv(stiffness) @ remainder
    np.testing.assert_allclose(table["delta_all"], float(remainder.norm()))
    np.testing.assert_allclose(table["rest_error"], error.norm(dim=-1))
    eigenvalue = torch.linalg.eigvalsh((stiffness + stiffness.mT) / 2)[:, 0]
    np.testing.assert_allclose(table["position_eigenvalue"], eigenvalue)


def test_the_papers_bounds_are_never_exceeded():
    q, truth = draw(4, 40, 2), Arm()
    model = Arm(3.4, 0.6, turn=EYE + 0.15 * draw(5, 2, 2))
    true, learned = truth.terms(q), model.terms(q)
    delta_all = torch.tensor(certify(model, truth, q, 1.0, 1.0)["delta_all"].to_numpy())
    for factor in (fit_factor(true, learned), matched_factor(true, learned), EYE.expand(40, 2, 2)):
        bounds = factor_bounds(factor, true, learned)
        assert (bounds["condition_2"] < 1).all()
        assert (bounds["delta_I"] <= bounds["delta_I_bound"] + 1e-12).all()
        assert (delta_all <= bounds["delta_all_bound"] + 1e-12).all()


def test_the_neumann_bound_is_sharp_for_one_coordinate():
    # A = 1, A_L = 0.6, P = 1: |X Delta_A X| / (1 - |X Delta_A|) = 0.4 / 0.6 = 1 / 0.6 - 1.
    one = LinearSystem([[1.0]], [[2.0]], [[0.1]], [[1.0]])
    learned = LinearSystem([[1.0]], [[2.0]], [[0.1]], [[0.6]])
    q = double([[0.7]])
    bounds = factor_bounds(double([[[1.0]]]), one.terms(q), learned.terms(q))
    assert bounds["condition_2"].item() == pytest.approx(0.4)
    assert bounds["delta_I_bound"].item() == pytest.approx(2 / 3)
    assert bounds["delta_I"].item() == pytest.approx(2 / 3)
    far = LinearSystem([[1.0]], [[2.0]], [[0.1]], [[-0.6]])
    bounds = factor_bounds(double([[[1.0]]]), one.terms(q), far.terms(q))
    assert bounds["condition_2"].item() == pytest.approx(1.6)
    assert bounds["delta_I_bound"].item() == math.inf


def test_an_input_matrix_of_the_wrong_sign_fails_condition_1_and_says_so():
    q = draw(6, 5, 2)
    table = certify(Arm(turn=-EYE), Arm(), q, 4.0, 2.0)
    A = Arm().input_matrix(q)
    np.testing.assert_allclose(table["condition_1"], -torch.linalg.eigvalsh(A @ A.mT)[:, 1])
    prediction = predict_steady_state(Arm(turn=-EYE), Arm(), q, 40.0, 2.0)
    assert not prediction["holds"].any()
    assert not (prediction["slowest_pole"] < 0).any()
    # A finite radius alone is no claim: nothing is counted where the conditions fail.
    assert np.isfinite(prediction["bound"]).any()
    text = stability_report("Stability", table, prediction, torch.full((5,), 100.0), {})
    assert re.search(r"condition 1, .* \| 0 of 5 \|", text)
    assert "| conditions hold | 0 of 5 |" in text
    assert "measured above the bound | 0 of 0 |" in text, text


def test_the_predicted_steady_state_is_where_a_simulation_comes_to_rest():
    truth, model = Arm(), Arm(3.6, 0.6, left=P)
    q_ref, K_P, K_D = double([[0.3, -0.4]]), double([5.0, 8.0]), double([4.0, 3.0])
    (state,) = predict_steady_state(model, truth, q_ref, K_P, K_D).itertuples()
    slope = closed_loop(model, truth, q_ref[0], K_P, K_D)
    end = solve_ivp(slope, (0, 12), np.zeros(4), "LSODA", rtol=1e-5, atol=1e-8).y[:, -1]
    assert np.abs(end[2:]).max() < 1e-6
    np.testing.assert_allclose([state.rest1, state.rest2], end[:2], rtol=0, atol=1e-6)
    assert 1e-3 < state.error <= state.bound < 1.5 * state.error
    # The poles are those of the linearized closed loop.
    rest = np.array([state.rest1, state.rest2, 0, 0])
    assert np.abs(slope(0, rest)).max() < 1e-9
    columns = [(slope(0, rest + e) - slope(0, rest - e)) / 2e-5 for e in 1e-5 * np.eye(4)]
    poles = np.linalg.eigvals(np.stack(columns, -1))
    assert state.slowest_pole == pytest.approx(poles.real.max(), rel=1e-6)
    assert state.fastest_pole == pytest.approx(np.abs(poles).max(), rel=1e-6)


def static_force(q, model, truth, q_ref, position_gain):
    q = torch.from_numpy(q)
    u = law(model, q, torch.zeros(2), q_ref, position_gain, 1.0)
    return (truth.input_matrix(q) @ u - truth.potential_force(q)).numpy()


def test_no_equilibrium_lies_outside_its_bound():
    bounded, steep = 0, 0
    for seed in range(20):
        turn, extra = EYE + draw(seed, 2, 2), draw(seed, 2).tolist()
        model = Arm(3 + float(draw(seed, 1)), 0.6, left=P, turn=P @ turn, extra=extra)
        q_ref = draw(seed + 100, 10, 2, scale=1.0)
        prediction = predict_steady_state(model, Arm(), q_ref, 2.5, 1.0)
        for k in np.flatnonzero(np.isfinite(prediction["bound"])):
            arguments = (model, Arm(), q_ref[k], 2.5)
            q, _, status, _ = fsolve(static_force, q_ref[k].numpy(), arguments, full_output=True)
            assert status == 1
            assert np.linalg.norm(q - q_ref[k].numpy()) <= prediction["bound"][k]
            bounded += 1
            steep += int(prediction["slope"][k] > 0.3)
    assert bounded >= 100
    assert steep >= 20


def test_the_required_gain_meets_the_wanted_error_and_no_smaller_one_does():
    model, truth, q_ref = Arm(3.6, 0.6, left=P), Arm(), draw(7, 6, 2)
    gains = required_gain(model, truth, q_ref, error=0.02)
    for k, gain in enumerate(gains.tolist()):
        met = predict_steady_state(model, truth, q_ref[k : k + 1], 1.0001 * gain, 1.0)
        assert met["bound"].item() <= 0.02
        missed = predict_steady_state(model, truth, q_ref[k : k + 1], 0.9 * gain, 1.0)
        assert missed["bound"].item() > 0.02
