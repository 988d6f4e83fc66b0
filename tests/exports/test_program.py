"""Programs repeat the functions that they were traced from, at states that they never saw."""

import pytest
import torch

from pinn_dyn.control import ComputedTorque
from pinn_dyn.exports.decompositions import cholesky, qr, solve_triangular
from pinn_dyn.exports.program import trace
from pinn_dyn.systems import SoftArm
from tests.models.builders import CHAIN, VARIANTS, make_structured, random_batch

MODELS = {
    "over-actuated": ("lnn", VARIANTS["silu-fixed-input-2x4"]),
    "chain": ("hnn", CHAIN["hnn"]),
}


def functions_of(model):
    names = {
        "forward_dynamics": (model.forward_dynamics, "qvu"),
        "inverse_dynamics": (model.inverse_dynamics, "qva"),
        "terms": (lambda q: tuple(model.terms(q)), "q"),
    }
    law = ComputedTorque(model, 3.0, 0.4).law
    return {**names, "law": (law, ["q", "v", "q_ref", "v_ref", "a_ref"])}


def assert_repeats(model):
    n, m = model.num_coordinates, model.num_inputs
    batches = [random_batch(n, m, batch=4, seed=seed) for seed in (3, 4)]
    for name, (function, arguments) in functions_of(model.requires_grad_(False)).items():
        (example, *_), states = (
            [
                dict(zip(arguments, [q, v, u if "u" in arguments else a, q + a, a], strict=False))
                for q, v, a, u in zip(*batch, strict=True)
            ]
            for batch in batches
        )
        outputs = list("MDGA") if name == "terms" else ["result"]
        program = trace(function, example, outputs)
        assert list(program.inputs) == list(arguments)
        for state in states:
            expected = function(*state.values())
            expected = expected if isinstance(expected, tuple) else (expected,)
            for x, y in zip(program(*state.values()), expected, strict=True):
                torch.testing.assert_close(x, y, rtol=1e-11, atol=1e-13, msg=name)


@pytest.mark.parametrize("case", MODELS)
def test_a_program_repeats_a_network(case):
    kind, variant = MODELS[case]
    assert_repeats(make_structured(kind, **variant))


@pytest.mark.slow
def test_a_program_repeats_a_soft_arm():
    assert_repeats(SoftArm(segments=1))


@pytest.mark.parametrize("size", [1, 2, 5])
def test_the_factorizations_repeat_lapack(size):
    generator = torch.Generator().manual_seed(size)
    A = torch.randn(3, size + 2, size, generator=generator, dtype=torch.float64)
    Q, R = qr(A)
    torch.testing.assert_close(Q @ R, A)
    torch.testing.assert_close(Q.mT @ Q, torch.eye(size).double().expand(3, size, size))
    matrix = A.mT @ A
    torch.testing.assert_close(cholesky(matrix), torch.linalg.cholesky(matrix))
    right = torch.randn(3, size, 2, generator=generator, dtype=torch.float64)
    for upper in (False, True):
        factor = R if upper else R.mT
        expected = torch.linalg.solve_triangular(factor, right, upper=upper)
        torch.testing.assert_close(solve_triangular(factor, right, upper), expected)


def test_a_matrix_without_a_cholesky_factor_gives_nan():
    assert cholesky(torch.tensor([[1.0, 2.0], [2.0, 1.0]])).isnan().any()
