"""CasADi functions of models, and their derivatives, against PyTorch."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pinn_dyn.exports.casadi_function import casadi_function, write_casadi
from pinn_dyn.exports.program import trace
from pinn_dyn.systems import SoftArm
from tests.models.builders import CHAIN, NONLINEAR, VARIANTS, make_structured, random_batch

MODELS = {
    "networks": lambda: make_structured("lnn", **VARIANTS["networks-softplus-3x3"]),
    "friction": lambda: make_structured("hnn", **VARIANTS["friction-all-angles-2x1"]),
    "wide-input": lambda: make_structured("lnn", **VARIANTS["silu-fixed-input-2x4"]),
    "chain": lambda: make_structured("hnn", **CHAIN["hnn"]),
    "nonlinear-input": lambda: make_structured("lnn", **NONLINEAR),
    "two-segments": lambda: SoftArm(segments=2),
}


def arrays(tensors):
    return [x.numpy() for x in tensors]


@pytest.mark.parametrize("case", MODELS)
def test_value_and_jacobian_repeat_the_model(case):
    model = MODELS[case]().requires_grad_(False) if case != "two-segments" else MODELS[case]()
    states = zip(*random_batch(model.num_coordinates, model.num_inputs, batch=2), strict=True)
    example, (q, v, _, u) = states
    inputs = dict(q=example[0], v=example[1], u=example[3])
    function = casadi_function(trace(model.forward_dynamics, inputs, ["a"]), "forward_dynamics")
    expected = model.forward_dynamics(q, v, u)
    np.testing.assert_allclose(np.array(function(*arrays((q, v, u))))[:, 0], expected, 1e-9)
    blocks = function.jacobian()(*arrays((q, v, u)), 0)
    jacobian = torch.func.jacrev(model.forward_dynamics, (0, 1, 2))(q, v, u)
    for block, reference in zip(blocks, jacobian, strict=True):
        smallest = 1e-9 * float(reference.abs().max())
        np.testing.assert_allclose(np.array(block), reference, 1e-9, smallest)


def test_terms_are_matrices_and_survive_a_file(tmp_path):
    casadi = pytest.importorskip("casadi")
    model = make_structured("lnn", **VARIANTS["silu-fixed-input-2x4"]).requires_grad_(False)
    example, q = random_batch(2, 4, batch=2)[0]
    terms = trace(lambda q: tuple(model.terms(q)), {"q": example}, list("MDGA"))
    exported = SimpleNamespace(name="terms", program=terms)
    path = tmp_path / "terms.casadi"
    calls = write_casadi([exported], path, "", "double")
    loaded = casadi.Function.load(str(path))(q.numpy())
    for matrix, again, term in zip(loaded, calls["terms"](q.numpy()), model.terms(q), strict=True):
        np.testing.assert_allclose(np.array(matrix).reshape(term.shape), term, 1e-9)
        np.testing.assert_array_equal(np.array(matrix), again)


def test_an_operation_without_counterpart_is_named():
    program = trace(lambda q: torch.special.bessel_j0(q), {"q": torch.ones(2).double()}, ["y"])
    with pytest.raises(TypeError, match="bessel_j0"):
        casadi_function(program, "f")
