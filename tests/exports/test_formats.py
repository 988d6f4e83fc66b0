"""Files in C, ONNX and CasADi for all kinds of heads, from one trace of each function."""

import numpy as np
import pytest
import torch

from pinn_dyn.exports.casadi_function import casadi_function
from pinn_dyn.exports.exported_function import write
from pinn_dyn.exports.model_functions import model_functions
from pinn_dyn.run.export import _within_domain
from pinn_dyn.systems import RigidChain, SoftArm
from tests.models.builders import CHAIN, NONLINEAR, VARIANTS, make_model, make_structured
from tests.support.arm_urdf import ARM
from tests.support.c_code import STRICT

HEADS = {name: ("lnn", VARIANTS[name]) for name in VARIANTS} | {
    "hnn": ("hnn", VARIANTS["friction-angle-and-length-3x3"]),
    "lnn-chain": ("lnn", CHAIN["lnn"]),
    "hnn-chain": ("hnn", CHAIN["hnn"]),
    "nonlinear": ("lnn", NONLINEAR),
}
MODELS = {
    **{
        case: lambda kind=kind, options=options: make_structured(kind, **options)
        for case, (kind, options) in HEADS.items()
    },
    "soft-arm": lambda: SoftArm(segments=2),
    "rigid-chain": lambda: RigidChain(ARM),
    "acceleration": lambda: make_model("acceleration"),
    "next_state": lambda: make_model("next_state"),
    "subnet": lambda: make_model("subnet"),
    "oscillators": lambda: make_model("oscillators"),
    "oscillators_of_the_past": lambda: make_model("oscillators_of_the_past"),
}
CONSTANT = "constant-mass-fixed-damping-constant-input-3x3"
FAST = (CONSTANT, "acceleration", "next_state", "oscillators", "oscillators_of_the_past")
CASES = [pytest.param(x, marks=() if x in FAST else pytest.mark.slow, id=x) for x in MODELS]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.usefixtures("few_states")
def test_the_files_of_a_model_repeat_it(case, tmp_path, monkeypatch):
    """The writers compare their files with the model."""
    onnx, onnxruntime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    monkeypatch.setenv("CC", " ".join(["cc", *STRICT]))
    model = MODELS[case]().double().eval().requires_grad_(False)
    # A step repeats forward dynamics four times.
    functions = model_functions(model, _within_domain(model))
    functions = [x for x in functions if x.name != "step" or case in FAST]
    write(functions, tmp_path / "arm.c", {})
    for function in functions:
        path = write([function], tmp_path / f"{function.name}.onnx", {})
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        graph = onnx.load(path).graph.node[0].attribute[0].g
        assert {x.name for x in graph.initializer} <= {x for node in graph.node for x in node.input}
        assert [x.name for x in session.get_outputs()] == function.outputs
        shapes = [torch.Size(x.shape[1:]) for x in session.get_outputs()]
        assert shapes == [*function.program.outputs.values()]
        write([function], tmp_path / f"{function.name}.casadi", {})
    assert_derivatives(functions[0])


def assert_derivatives(function):
    """CasADi differentiates as PyTorch does."""
    state = [x[1] for x in function.inputs.values()]
    derivative = casadi_function(function.program, function.name).jacobian()
    arguments = [x.numpy() for x in state]
    blocks = derivative(*arguments, *[0] * len(function.outputs))
    blocks = blocks if isinstance(blocks, tuple) else (blocks,)
    jacobian = torch.func.jacrev(lambda *x: function.function(*x), tuple(range(len(state))))(*state)
    parts = jacobian if len(function.outputs) > 1 else (jacobian,)
    for block, reference in zip(blocks, (x for part in parts for x in part), strict=True):
        smallest = 1e-9 * float(reference.abs().max())
        np.testing.assert_allclose(np.array(block), reference, 1e-9, smallest)
