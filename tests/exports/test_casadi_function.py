"""CasADi functions of models, and their derivatives, against PyTorch."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pinn_dyn.exports.casadi_function import casadi_function, write_casadi
from pinn_dyn.exports.program import trace
from tests.models.builders import VARIANTS, make_structured, random_batch


def test_terms_are_matrices_and_survive_a_file(tmp_path):
    casadi = pytest.importorskip("casadi")
    model = make_structured("lnn", **VARIANTS["silu-fixed-input-2x4"]).requires_grad_(False)
    example, q = random_batch(2, 4, batch=2)[0]
    terms = trace(lambda q: tuple(model.terms(q)), {"q": example}, list("MDGA"))
    exported = SimpleNamespace(name="terms", program=terms)
    path = tmp_path / "terms.casadi"
    calls = write_casadi([exported], path, "", "double")
    loaded = casadi.Function.load(str(path))(q.numpy())
    for matrix, again, term in zip(
        loaded, calls["terms"](q[None].numpy()), model.terms(q), strict=True
    ):
        np.testing.assert_allclose(np.array(matrix).reshape(term.shape), term, 1e-9)
        np.testing.assert_array_equal(np.array(matrix), again[0])


def test_an_operation_without_counterpart_is_named():
    program = trace(lambda q: torch.special.bessel_j0(q), {"q": torch.ones(2).double()}, ["y"])
    with pytest.raises(TypeError, match="bessel_j0"):
        casadi_function(program, "f")


def test_limits_and_extremes_are_those_of_pytorch():
    pytest.importorskip("casadi")

    def function(x, y):
        columns = torch.stack([x, y])
        limited = x.clamp(-1, 1), torch.relu(x), x.maximum(y), x.minimum(y)
        return torch.cat([*limited, columns.amax(0), columns.amin(0)])

    values = torch.tensor([-torch.inf, torch.inf, -2.0, 2.0]).double()
    x, y = torch.cartesian_prod(values, values).T.contiguous()
    exported = casadi_function(trace(function, {"x": x, "y": y}, ["z"]), "f")
    np.testing.assert_array_equal(np.array(exported(x.numpy(), y.numpy()))[:, 0], function(x, y))
