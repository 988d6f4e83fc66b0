"""Compiled laws: against the eager law, from a process that has PyTorch only, and bad files."""

import json
import subprocess
import sys
import zipfile
from functools import partial

import pytest
import torch

from pinn_dyn.control.contracts import Controller
from pinn_dyn.control.export import export_law, load_law
from pinn_dyn.control.laws import ProportionalDerivative, Tracking
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.models import NetworkCholesky, NetworkInput, NetworkPotential, Positive
from tests.models.builders import make_structured
from tests.support.linear import unit_masses

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
    assert loaded.info["inputs"] == ["q", "v", "q_ref", "v_ref", "a_ref"]
    check = loaded.info["check"]
    assert_same(torch.tensor(check["u"]).double(), law, torch.tensor(check["states"]).double())


@needs_compiler
@pytest.mark.slow
def test_a_loaded_law_refuses_what_compiled_code_would_misread(exported):
    loaded = load_law(exported[1])
    good = list(states(1)[0])
    strided = torch.zeros(2, 2, dtype=torch.float64)[:, 0]
    for position, bad, message in [
        (0, torch.zeros(3, dtype=torch.float64), r"q is .*\(3,\).*expected .*\(2,\)"),
        (1, torch.zeros(1, 2, dtype=torch.float64), r"v is .*\(1, 2\)"),
        (3, torch.zeros(2), r"v_ref is .*float32.*expected .*float64"),
        (4, strided, "a_ref is strided.*expected contiguous"),
    ]:
        with pytest.raises(ValueError, match=message):
            loaded(*good[:position], bad, *good[position + 1 :])


def rewritten(path, to, **changes):
    """A copy of an exported file that says something else about itself."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(to, "w") as new:
        for item in old.infolist():
            content = old.read(item)
            if item.filename.endswith("_metadata.json"):
                metadata = json.loads(content)
                if "pinn_dyn_law" in metadata:
                    info = json.loads(metadata["pinn_dyn_law"])
                    metadata["pinn_dyn_law"] = json.dumps({**info, **changes})
                content = json.dumps(metadata).encode()
            new.writestr(item, content)
    return to


@needs_compiler
@pytest.mark.slow
def test_a_file_of_another_pytorch_or_another_law_is_refused(exported, tmp_path):
    _, path = exported
    check = load_law(path).info["check"]
    u = [[1.001 * x for x in row] for row in check["u"]]
    assert load_law(rewritten(path, tmp_path / "same.pt2")).info["law"] == "Tracking"
    with pytest.raises(RuntimeError, match=r"exported with torch 2\.1\.0, this is torch .*again"):
        load_law(rewritten(path, tmp_path / "old.pt2", torch="2.1.0"))
    with pytest.raises(RuntimeError, match=r"misses the law .* by 1\.0e-03"):
        load_law(rewritten(path, tmp_path / "wrong.pt2", check={**check, "u": u}))


def test_a_file_that_is_no_exported_law_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.pt2"):
        load_law(tmp_path / "nothing.pt2")
    (tmp_path / "cut.pt2").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(ValueError, match=r"cut\.pt2 is no exported law"):
        load_law(tmp_path / "cut.pt2")
    with zipfile.ZipFile(tmp_path / "other.pt2", "w") as archive:
        archive.writestr("model/metadata.json", "{}")
    with pytest.raises(ValueError, match=r"other\.pt2 is a package, but no law"):
        load_law(tmp_path / "other.pt2")


class Silent(Controller):
    def __call__(self, t, q, v, reference):
        return torch.zeros_like(q)


@needs_compiler
def test_a_law_without_finite_inputs_is_not_exported(tmp_path):
    law = ProportionalDerivative(unit_masses(2), 10.0, 1.0)
    law.position_gain[0] = float("nan")
    with pytest.raises(ValueError, match=r"u of the ProportionalDerivative law has 20 non-finite"):
        export_law(law, tmp_path / "law.pt2")


def test_bad_arguments_are_named_before_anything_is_compiled(tmp_path):
    law = ProportionalDerivative(unit_masses(2), 10.0, 1.0)
    with pytest.raises(ValueError, match=r"path is .*law\.onnx.*\.pt2"):
        export_law(law, tmp_path / "law.onnx")
    with pytest.raises(TypeError, match=r"controller is a Silent, expected a law"):
        export_law(Silent(2, 2), tmp_path / "law.pt2")


def test_without_a_compiler_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match=r"needs a C\+\+ compiler .* apt install g\+\+"):
        export_law(ProportionalDerivative(unit_masses(2), 10.0, 1.0), tmp_path / "law.pt2")


@needs_compiler
def test_a_law_that_cannot_be_traced_is_named(tmp_path):
    class Branching(ProportionalDerivative):
        def law(self, q, v, q_ref, v_ref, a_ref):
            u = super().law(q, v, q_ref, v_ref, a_ref)
            return u if float(u.sum()) > 0 else -u

    with pytest.raises(ValueError, match="the Branching law cannot be exported"):
        export_law(Branching(unit_masses(2), 10.0, 1.0), tmp_path / "law.pt2")
    assert not list(tmp_path.iterdir())
