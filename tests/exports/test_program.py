"""Programs repeat the functions that they were traced from, at states that they never saw."""

import pytest
import torch

from pinn_dyn.control import ComputedTorque, Pipeline
from pinn_dyn.exports.decompositions import cholesky, pseudo_inverse, qr, solve_triangular
from pinn_dyn.exports.program import trace
from pinn_dyn.systems import SoftArm
from tests.models.builders import VARIANTS, make_structured, random_batch

MODELS = {
    "over-actuated": lambda: make_structured("lnn", **VARIANTS["silu-fixed-input-2x4"]),
    "soft-arm": lambda: SoftArm(segments=1),
}


@pytest.mark.parametrize("case", MODELS)
def test_a_program_repeats_a_law(case):
    model = MODELS[case]().requires_grad_(False)
    law = Pipeline(ComputedTorque(model, 3.0, 0.4))
    arguments = ["q", "v", "q_ref", "v_ref", "a_ref", "memory_in"]
    memory = torch.rand(5, law.memory_size).double()
    q, v, a, _ = random_batch(model.num_coordinates, model.num_inputs, batch=5, seed=3)
    example, *states = zip(q, v, q + a, v - a, a, memory, strict=True)
    program = trace(law, dict(zip(arguments, example, strict=True)), ["u", "status", "memory"])
    assert list(program.inputs) == arguments
    for state in states:
        torch.testing.assert_close(program(*state), law(*state), rtol=1e-11, atol=1e-13)


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


@pytest.mark.parametrize("shape", [(4, 3), (2, 5)])
def test_the_pseudo_inverse_repeats_lapack_also_without_full_rank(shape):
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(3, *shape, generator=generator, dtype=torch.float64)
    A[0, :, -1] = A[0, :, 0] * (1 + 1e-6)
    A[1] = 0
    expected = torch.linalg.pinv(A, rtol=1e-3)
    torch.testing.assert_close(pseudo_inverse(A, 1e-3), expected, rtol=0, atol=1e-12)
    program = trace(lambda x: torch.linalg.pinv(x, rtol=1e-3), {"x": A[2]}, ["y"])
    torch.testing.assert_close(program(A[0])[0], expected[0], rtol=0, atol=1e-12)
