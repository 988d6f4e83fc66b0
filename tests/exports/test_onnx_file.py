"""Models and laws as ONNX files, in ONNX Runtime."""

import json

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from pinn_dyn.control import Actuator, Pipeline, Tracking, export_law
from pinn_dyn.exports.exported_function import ExportedFunction, write
from pinn_dyn.exports.model_functions import model_functions
from pinn_dyn.run.export import export
from tests.exports.test_c_file import Bessel
from tests.exports.test_formats import CONSTANT, MODELS
from tests.models.builders import random_batch


def session_of(path):
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


@pytest.mark.parametrize("real", ["double", "float"])
def test_the_files_of_black_boxes_repeat_them(real, tmp_path):
    model = MODELS["acceleration"]().double().eval().requires_grad_(False)
    q, v, a, u = random_batch(model.num_coordinates, model.num_inputs, 3, seed=11)
    h = torch.tensor([2e-3, 1e-3, 0.0]).double()
    dtype, tolerance = (np.float64, 1e-9) if real == "double" else (np.float32, 1e-4)
    for function in model_functions(model):
        path = export(model, tmp_path / f"{function.name}.onnx", function.name, real=real)
        values = {"q": q, "v": v, "a": a, "u": u, "u_next": 0.5 * u, "h": h}
        values = {name: values[name] for name in function.inputs}
        session = session_of(path)
        assert [x.name for x in session.get_outputs()] == list(function.outputs)
        results = session.run(None, {name: x.numpy().astype(dtype) for name, x in values.items()})
        rows = [function.function(*state) for state in zip(*values.values(), strict=True)]
        rows = [[row] if isinstance(row, torch.Tensor) else row for row in rows]
        for x, *parts in zip(results, *rows, strict=True):
            y = torch.stack(parts)
            assert (x.shape, x.dtype) == (tuple(y.shape), dtype)
            np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * float(y.abs().max()))


def test_a_law_keeps_its_memory_between_calls_and_says_what_it_is(tmp_path):
    model = MODELS[CONSTANT]()  # with parameters that require gradients
    law = Tracking(model, 3.0, 0.5)
    about = {"q": ["a (rad)", "b (rad)", "c (rad)"]}
    path = export_law(
        law, tmp_path / "law.onnx", actuator=Actuator(rate=20.0), period=0.01, about=about
    )
    pipeline = Pipeline(law, 0.01, actuator=Actuator(rate=20.0))
    session, memory = session_of(path), np.zeros((1, pipeline.memory_size))
    names = [x.name for x in session.get_inputs()]
    assert names == ["q", "v", "q_ref", "v_ref", "a_ref", "memory_in"]
    for k in range(10):
        state = [torch.sin(k + torch.arange(3.0).double() + i) for i in range(5)]
        inputs = dict(zip(names, [*(x.numpy()[None] for x in state), memory], strict=True))
        expected, changed, _ = pipeline(*state, torch.from_numpy(memory[0]))
        u, status, memory = session.run(["u", "status", "memory_out"], inputs)
        np.testing.assert_allclose(u[0], expected, rtol=1e-9)
        assert status == [int(changed)]
    fields = {item.key: item.value for item in onnx.load(path).metadata_props}
    assert json.loads(fields["q"]) == about["q"]
    assert json.loads(fields["position_gain"]) == [3.0] * 3
    assert len(fields["sha256"]) == 64


def test_operations_that_the_format_or_the_runtime_lacks_are_named(tmp_path):
    x = {"x": torch.linspace(-0.9, 0.9, 200).double()[:, None]}
    with pytest.raises(TypeError, match=r"bessel_j1.*test_c_file\.py.*ONNX has no such operation"):
        write([ExportedFunction("wave", Bessel(), x, "y")], tmp_path / "f.onnx", {})
    function = ExportedFunction("angle", torch.tan, x, "y")
    with pytest.raises(RuntimeError, match=r"double numbers.*Tan.*export with real='float'"):
        write([function], tmp_path / "f.onnx", {})
    assert not list(tmp_path.iterdir())
    write([function], tmp_path / "f.onnx", {}, "float")
