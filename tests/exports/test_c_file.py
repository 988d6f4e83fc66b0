"""Models as C files: compiled without a warning, and called at states of the test."""

import json
import logging
import re
import subprocess

import numpy as np
import pytest
import torch

from pinn_dyn.exports.c_code import ELEMENTWISE, ConstantArrays
from pinn_dyn.exports.exported_function import ExportedFunction, identifier, write
from pinn_dyn.exports.model_functions import model_functions
from pinn_dyn.run.export import export
from tests.exports.test_formats import CONSTANT, MODELS
from tests.models.builders import VARIANTS, make_structured, random_batch
from tests.support.c_code import STRICT, compiled, function_of


def assert_repeats(model, path, tolerance, names=("forward_dynamics", "step")):
    library = compiled(path)
    q, v, a, u = (x[0] for x in random_batch(model.num_coordinates, model.num_inputs, 1, seed=11))
    h = torch.tensor(2e-3).double()
    for function in (x for x in model_functions(model) if x.name in names):
        values = {"q": q, "v": v, "a": a, "u": u, "u_next": 0.5 * u, "h": h}
        arguments = [values[name] for name in function.inputs]
        expected = function.function(*arguments)
        expected = [expected] if isinstance(expected, torch.Tensor) else expected
        call = function_of(path, f"{identifier(path.stem)}_{function.name}", library)
        for x, y in zip(call(*(x.numpy() for x in arguments)), expected, strict=True):
            scale = np.abs(y.numpy()).max() + 1e-300
            np.testing.assert_allclose(x, y.numpy().ravel(), rtol=0, atol=tolerance * scale)


def test_the_c_code_is_called_as_its_header_says(tmp_path):
    model = MODELS[CONSTANT]().double().eval().requires_grad_(False)
    path = export(model, tmp_path / "new" / "my-arm.2.c", "terms")
    assert_repeats(model, path, 1e-12, ["terms"])


def test_floats_are_repeated_to_their_precision(tmp_path):
    model = MODELS["acceleration"]().eval().requires_grad_(False)
    path = export(model, tmp_path / "arm.c", real="float")
    assert "double" not in path.with_suffix(".h").read_text().replace("double precision", "")
    assert_repeats(model, path, 1e-5)


def test_a_step_integrates_as_the_prediction_does(tmp_path):
    """A step of a Hamiltonian network moves (q, p), and returns v."""
    from pinn_dyn.mechanics import Signal

    model = make_structured("hnn", **VARIANTS[CONSTANT]).requires_grad_(False)
    (step,) = (f for f in model_functions(model) if f.name == "step")
    q, v, _, u = (x[0] for x in random_batch(3, 3, 1))
    times = torch.tensor([0.0, 0.01]).double()
    x = torch.cat([q, model.momentum(q, v)])
    end = model.predict(x, times, Signal(times, u.expand(2, 3), "hold"))[-1]
    q_next, v_next = step.function(q, v, u, times[1])
    torch.testing.assert_close(q_next, end[:3])
    torch.testing.assert_close(v_next, model.velocity(end[:3], end[3:]))


def assert_refused(tmp_path, message):
    with pytest.raises(RuntimeError, match=message):
        write([SINE], tmp_path / "out" / "f.c", {})
    assert list((tmp_path / "out").iterdir()) == []


SINE = ExportedFunction("sine", torch.sin, {"x": torch.linspace(-1, 1, 200).double()[:, None]}, "y")


def test_code_that_computes_something_else_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setitem(ELEMENTWISE, "sin", "cos({0})")
    assert_refused(tmp_path, r"sine: y differs from the original by .* at x = \[")


def test_a_compiler_that_fails_is_quoted(tmp_path, monkeypatch):
    monkeypatch.setitem(ELEMENTWISE, "sin", "{0} +* 1")
    assert_refused(tmp_path, r"cc does not compile f\.c: .*error")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_differs_from_every_number(value):
    """On either side: in the file, or in the original."""
    with pytest.raises(RuntimeError, match="sine: y differs from the original"):
        SINE.compare(lambda x: [np.full((200, 1), value)], "double")

    def half(x):
        return np.where(x > 0, value, x)

    broken = ExportedFunction("broken", lambda x: torch.from_numpy(half(x)), SINE.inputs, "y")
    with pytest.raises(RuntimeError, match="broken: y differs from the original"):
        broken.compare(lambda x: [x], "double")
    broken.compare(lambda x: [half(x)], "double")


def test_a_file_of_another_type_or_without_finite_numbers_is_refused(tmp_path):
    with pytest.raises(RuntimeError, match=r"200 finite .* is float64 in the file, expected float"):
        SINE.compare(lambda x: [np.sin(x)], "float")
    broken = ExportedFunction("broken", lambda x: torch.nan * x, SINE.inputs, "y")
    with pytest.raises(RuntimeError, match="broken: y has 0 finite values of 200"):
        write([broken], tmp_path / "f.c", {})


def test_without_a_compiler_the_file_is_written_and_said_to_be_untested(
    tmp_path, monkeypatch, caplog
):
    monkeypatch.setenv("CC", "/nonexistent")
    path = write([SINE], tmp_path / "f.c", {})
    assert "f.c was not compared with the model: no C compiler" in caplog.text
    monkeypatch.setenv("CC", "cc -DUNUSED")
    np.testing.assert_allclose(function_of(path, "f_sine")(0.3), [[np.sin(0.3)]])
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        write([SINE], tmp_path / "f.c", {})
    assert not caplog.text


class Bessel(torch.nn.Module):
    def forward(self, x):
        return torch.special.bessel_j1(x) * 2


def test_an_operation_without_c_code_is_named_with_its_head(tmp_path):
    function = ExportedFunction("wave", Bessel(), SINE.inputs, "y")
    with pytest.raises(TypeError, match=r"bessel_j1.*test_c_file\.py\", line \d+, in forward"):
        write([function], tmp_path / "f.c", {})


def test_the_compiler_sees_wrong_sizes_and_the_caller_the_version(tmp_path):
    model = MODELS["acceleration"]().eval().requires_grad_(False)
    export(model, tmp_path / "arm.c", about={"q": ["elbow (rad)", 'a "quoted" µ']})
    program = '#include <stdio.h>\n#include "arm.h"\nint main(void) { double q[2] = {0}, a[%d];\n'
    program += "#if arm_NUM_COORDINATES != 2 || arm_NUM_INPUTS != 2\n#error sizes\n#endif\n"
    program += "arm_forward_dynamics(q, q, q, a); puts(arm_info()); return a[0] != a[0]; }\n"
    command = ["cc", *STRICT, "-O1", "main.c", "arm.c", "-lm", "-o", "main"]
    for size, accepted in ((2, True), (1, False)):
        (tmp_path / "main.c").write_text(program % size)
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert (result.returncode == 0) == accepted, result.stderr
        assert accepted or "region of size 8" in result.stderr
    text = subprocess.run(tmp_path / "main", capture_output=True, text=True, check=True).stdout
    info = json.loads(text)
    assert info["q"][1] == 'a "quoted" µ'
    assert (len(info["sha256"]), info["model"]) == (64, "AccelerationMLP")


def powers_of(x):
    return 0.1 * torch.cat([x**3, x**2, x.abs() ** 0.5, x.exp() ** -1.5])


WEIGHTS = torch.rand(4, 20, generator=torch.Generator().manual_seed(0)).double()


@pytest.mark.parametrize(
    "function",
    [powers_of, lambda x: (WEIGHTS.to(x) @ powers_of(x.expand(5))[:, None])[:, 0]],
    ids=["numbers", "loops"],
)
def test_powers_are_powers_and_constants_of_floats_are_floats(tmp_path, function):
    """A constant without f would make the compiler compute with doubles."""
    powers = ExportedFunction("powers", function, SINE.inputs, "y")
    write([powers], tmp_path / "f.c", {})
    assert ("for (int" in (tmp_path / "f.c").read_text()) == (function is not powers_of)
    path = write([powers], tmp_path / "f.c", {}, "float")
    command = ["cc", *STRICT, "-Wdouble-promotion", "-c", path.name, "-o", "f.o"]
    subprocess.run(command, cwd=tmp_path, check=True)


def test_the_stack_of_the_header_suffices(tmp_path):
    model = MODELS[CONSTANT]().double().eval().requires_grad_(False)
    path = export(model, tmp_path / "arm.c")
    header = path.with_suffix(".h").read_text()
    stated = re.findall(r"Stack: at most (\d+) bytes. \*/\n\w+ (\w+)\(", header)
    for level in ("-O1", "-O3"):
        command = ["gcc", *STRICT, level, "-fstack-usage", "-c", path.name]
        subprocess.run(command, cwd=tmp_path, check=True)
        lines = (tmp_path / "arm.su").read_text().splitlines()
        sizes = {line.split(":")[-1].split()[0]: int(line.split("\t")[1]) for line in lines}
        assert len(stated) == 4
        assert all(sizes[name] <= int(size) for size, name in stated)


# Operations that the models of this package do not use.


@pytest.mark.parametrize(
    "function",
    [
        lambda x: (x.sinh() - x.cosh().rsqrt()).clamp(-0.5, 2).sum(-1),
        lambda x: torch.stack([x.amax(0), x.amin(0), x.mean(0), x.mean() + 0 * x[0]]),
        lambda x: torch.linalg.inv(x[:5] @ x[:5].mT + torch.eye(5)) @ x[:5],
        lambda x: torch.where((x > 0.3) & ~(x < 0.9), x, x.floor()).maximum(-x).tanh(),
        lambda x: x.flip(0)[:, [2, 0, 1]] + x[[1]],
        lambda x: torch.nn.functional.pad(
            torch.cat([x[:0, :2], x[:, :2], x[:0, :2]]), (1, 0, 2, 0)
        ),
        lambda x: torch.nn.functional.pad(x[:0], (0, 0, 2, 0), value=3.0),
        lambda x: torch.cross(x, x.roll(1, -1), dim=-1) + torch.softmax(x, -1),
    ],
)
def test_operations_of_other_robots(function, tmp_path):
    generator = torch.Generator().manual_seed(0)
    x = 4 * torch.rand(200, 40, 3, generator=generator, dtype=torch.float64) - 2
    write([ExportedFunction("f", function, {"x": x}, "y")], tmp_path / "f.c", {})


def test_entries_that_are_assigned_are_in_the_code(tmp_path):
    def function(x):
        y = x.clone()
        y[1:3, 0] = 2 * x[0, :2]
        y[0] = -y[2]
        return y

    x = torch.rand(200, 4, 3, generator=torch.Generator().manual_seed(0)).double()
    write([ExportedFunction("f", function, {"x": x}, "y")], tmp_path / "f.c", {})


def test_numbers_are_written_exactly():
    constants = ConstantArrays("double")
    values = [0.1, -1e-300, 1 / 3, float("inf"), float("-inf"), float("nan"), -0.0]
    texts = [constants.number(x) for x in values]
    assert texts[3:6] == ["INFINITY", "(-INFINITY)", "NAN"]
    assert [float(texts[k].strip("()")) for k in (0, 1, 2)] == values[:3]
    assert identifier("7 arm-é") == "_7_arm__"
