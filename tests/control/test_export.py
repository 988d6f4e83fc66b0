"""Compiled laws: against the eager law, and from a process that has PyTorch only."""

import json
import subprocess
import sys
from functools import partial

import pytest
import torch

from pinn_dyn.control.export import export_law, load_law
from pinn_dyn.control.laws import Regulation, Tracking
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.models import NetworkCholesky, NetworkInput, NetworkPotential, Positive
from pinn_dyn.systems import TendonArm
from tests.models.builders import make_structured

needs_compiler = pytest.mark.skipif(not has_cpp_compiler(), reason="there is no C++ compiler")

# What a user runs on the robot: PyTorch and a file.
LOADER = """
import json, sys, torch
law = torch._inductor.aoti_load_package(sys.argv[1], run_single_threaded=True).loader
states = torch.tensor(json.loads(sys.stdin.read()), dtype=torch.float64)
u = [law.run([x.clone() for x in state])[0].tolist() for state in states]
rooms = {name.split(".")[0] for name in sys.modules}
imported = sorted(rooms & {"pinn_dyn", "lightning", "hydra"})
print(json.dumps({"u": u, "imported": imported}))
"""


def make_law():
    model = make_structured(
        "lnn",
        2,
        2,
        mass=partial(NetworkCholesky, hidden=[4]),
        potential=partial(NetworkPotential, hidden=[4]),
        damping=partial(NetworkCholesky, hidden=[3], positivity=Positive(floor=0.0)),
        input=partial(NetworkInput, hidden=[3]),
        angles=[0],
    )
    return Tracking(model.eval(), [40.0, 30.0], [4.0, 3.0])


def states(count=50):
    """(q, v, q_ref, v_ref, a_ref), none of which the export has seen."""
    generator = torch.Generator().manual_seed(5)
    return 3 * torch.rand(count, 5, 2, generator=generator, dtype=torch.float64) - 1.5


def assert_same(found, law, at):
    with torch.no_grad():
        expected = torch.stack([law.law(*state) for state in at])
    error = (found - expected).norm(dim=-1) / expected.norm(dim=-1)
    assert error.max() < 1e-5


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    law = make_law()
    return law, export_law(law, tmp_path_factory.mktemp("export") / "new" / "law.pt2")


@needs_compiler
@pytest.mark.slow
def test_a_process_with_pytorch_alone_computes_the_eager_law(exported, tmp_path):
    law, path = exported
    at = states()
    result = subprocess.run(
        [sys.executable, "-I", "-c", LOADER, str(path)],
        input=json.dumps(at.tolist()),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    answer = json.loads(result.stdout)
    assert answer["imported"] == []
    assert_same(torch.tensor(answer["u"], dtype=torch.float64), law, at)


@needs_compiler
@pytest.mark.slow
def test_a_loaded_law_is_the_eager_law_and_says_what_it_is(exported):
    law, path = exported
    loaded = load_law(path)
    at = states()
    assert_same(torch.stack([loaded(*state) for state in at]), law, at)
    assert loaded.info["law"] == "Tracking"
    assert (loaded.info["num_coordinates"], loaded.info["num_inputs"]) == (2, 2)
    assert loaded.info["position_gain"] == [40.0, 30.0]
    assert loaded.info["velocity_gain"] == [4.0, 3.0]
    check = loaded.info["check"]
    assert_same(torch.tensor(check["u"]).double(), law, torch.tensor(check["states"]).double())


@needs_compiler
@pytest.mark.slow
def test_a_loaded_law_refuses_what_compiled_code_would_misread(exported):
    loaded = load_law(exported[1])
    good = list(states(1)[0])
    strided = torch.zeros(2, 2, dtype=torch.float64)[:, 0]
    for position, bad, message in [
        (0, torch.zeros(3, dtype=torch.float64), r"q has shape \(3,\).*expected .*\(2,\)"),
        (3, torch.zeros(2), r"v_ref .*float32.*expected .*float64"),
        (4, strided, r"a_ref .*strides \(2,\).*expected contiguous"),
    ]:
        with pytest.raises(ValueError, match=message):
            loaded(*good[:position], bad, *good[position + 1 :])


@needs_compiler
@pytest.mark.slow
def test_a_law_that_gives_other_inputs_than_its_export_is_refused(exported, monkeypatch):
    monkeypatch.setattr("pinn_dyn.control.export.TOLERANCE", -1.0)
    with pytest.raises(RuntimeError, match=r"law\.pt2 misses the law it was exported from by"):
        load_law(exported[1])


def test_another_checksum_is_refused_before_the_file_is_loaded(tmp_path):
    path = tmp_path / "law.pt2"
    path.write_bytes(b"no law")
    with pytest.raises(ValueError, match=r"law\.pt2 has the SHA-256 \w{64}, expected 0{64}"):
        load_law(path, sha256="0" * 64)


def test_a_law_that_solves_for_its_input_has_no_package(tmp_path):
    law = Regulation(TendonArm(), 1.0, 0.1)
    with pytest.raises(TypeError, match=r"has a memory: export it to \.c or \.onnx"):
        export_law(law, tmp_path / "law.pt2")
