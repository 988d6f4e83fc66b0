"""Rollouts as loops in C, beside the loop in Python."""

import importlib
import logging
import sys
from collections import Counter
from functools import partial

import pytest
import torch

from pinn_dyn.ensembles import Ensemble
from pinn_dyn.evaluation.prediction import model_for_rollouts
from pinn_dyn.exports import c_code, c_library, c_loop
from pinn_dyn.mechanics import RK4, Rosenbrock, Signal
from pinn_dyn.models import Servo
from pinn_dyn.testing import LinearSystem
from tests.models.builders import VARIANTS, make_model, make_structured, perturb
from tests.support.arm_urdf import ARM
from tests.support.known import elastic_model, known_model

NETWORK = VARIANTS["constant-mass-fixed-damping-constant-input-3x3"]


@pytest.fixture(autouse=True)
def cached(monkeypatch, tmp_path):
    """Loops for paths of any length, compiled quickly, in a cache folder of the test."""
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path))
    monkeypatch.setattr(c_loop, "STEPS", 1)
    monkeypatch.setattr(c_loop, "QUICK", ("-O0",))
    monkeypatch.setattr(c_loop, "_LOOPS", {})
    monkeypatch.setattr(c_loop, "_WITHOUT", Counter())
    return tmp_path


def make_ensemble(kind):
    return Ensemble([perturb(make_structured(kind, **NETWORK), k, 0.1) for k in range(3)])


MODELS = {
    "known": known_model,
    "elastic": elastic_model,
    "servo": partial(known_model, input=partial(Servo, limit="learned")),
    "rosenbrock": partial(known_model, ARM, locked_joints=(), integrator=Rosenbrock(2)),
    "substeps": partial(make_structured, "lnn", integrator=RK4(3), **NETWORK),
    "momentum": partial(make_structured, "hnn", **NETWORK),
    "acceleration": partial(make_model, "acceleration"),
    "passive": partial(LinearSystem, [[1.0]], [[2.0]], [[0.1]], torch.zeros(1, 0).tolist()),
    "ensemble": partial(make_ensemble, "lnn"),
}


def rolled_out(model, batch=(), count=80, interpolation="linear", scale=1.0):
    """The states of the loop, and those of the loop in Python."""
    model = model.double().eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    n, m = model.num_coordinates, model.num_inputs
    x0 = 0.3 * scale * torch.randn(*batch, 2 * n, generator=generator).double()
    u = scale * torch.randn(*batch, count + 5, m, generator=generator).double()
    k = torch.arange(count + 5).double()
    t = 0.004 * k + 0.001 * k.sin()  # steps of different lengths
    signal = Signal(t, u, interpolation)
    with torch.no_grad():
        found = model_for_rollouts(model).predict(x0, t[5:], signal)
        return found, model.predict(x0, t[5:], signal)


@pytest.mark.parametrize(
    ("kind", "batch"),
    [
        *((kind, (2, 3)) for kind in MODELS if kind != "servo"),
        pytest.param("servo", (2, 3), marks=pytest.mark.slow),
        pytest.param("known", (), marks=pytest.mark.slow),
        ("elastic", ()),
        ("momentum", ()),
        ("ensemble", ()),
    ],
)
def test_the_loop_gives_the_states_of_the_model(kind, batch):
    interpolation = {"known": "hold", "rosenbrock": "cubic"}.get(kind, "linear")
    found, expected = rolled_out(MODELS[kind](), batch, interpolation=interpolation)
    assert [type(loop) for loop in c_loop._LOOPS.values()] == [c_loop.Loop]
    assert (expected[..., -1, :] - expected[..., 0, :]).abs().max() > 1e-3
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "batch"), [("oscillators", ()), ("oscillators", (2, 3)), ("subnet", ())]
)
def test_the_loop_of_a_latent_state_gives_the_states_of_the_model(kind, batch):
    model = make_model(kind).eval().requires_grad_(False)
    generator, n, count = torch.Generator().manual_seed(0), model.num_coordinates, 200
    x0 = 0.3 * torch.randn(*batch, 2 * n, generator=generator).double()
    u = torch.randn(*batch, count, model.num_inputs, generator=generator).double()
    t = model.fixed_step * torch.arange(count).double()
    with torch.no_grad():
        found = model_for_rollouts(model, threads=2).predict(x0, t, Signal(t, u))
        expected = model.predict(x0, t, Signal(t, u))
    assert next(iter(c_loop._LOOPS.values())) is not None
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_trajectories_side_by_side_do_not_mix_and_threads_share_them(monkeypatch):
    """Neither the lane, nor the thread, nor a neighbor that diverges changes a trajectory."""
    model = LinearSystem([[1.0]], [[-16.0]], [[0.0]], [[1.0]]).double()
    copy, t = model_for_rollouts(model, threads=3), 0.1 * torch.arange(2000).double()
    x0 = torch.zeros(21, 2).double()
    x0[:, 0] = 0.01 * torch.arange(21)
    signal = Signal(t, torch.zeros(21, 2000, 1).double())
    with torch.no_grad():
        together = copy.predict(x0, t, signal)
        alone = [copy.predict(x, t, Signal(t, signal.u[0])) for x in x0]
    assert together[0].eq(0).all()
    assert not together[1:, -1].isfinite().any()
    torch.testing.assert_close(together, torch.stack(alone), rtol=1e-9, atol=0, equal_nan=True)
    assert len(c_loop._LOOPS) == 2


@pytest.mark.parametrize("kind", ["momentum", "ensemble", "passive"])
def test_no_trajectories_give_no_states(kind):
    found, expected = rolled_out(MODELS[kind](), (0,))
    assert found.shape == expected.shape
    assert not found.numel()


def test_long_paths_are_computed_in_blocks_and_end_where_one_diverges(monkeypatch):
    monkeypatch.setattr(c_loop, "NUMBERS", 100)
    found, expected = rolled_out(LinearSystem([[1.0]], [[9.0]], [[0.1]], [[1.0]]), (2,))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    unstable = LinearSystem([[1.0]], [[-1e9]], [[0.0]], [[1.0]])
    found, expected = rolled_out(unstable, (2,), scale=1e300)
    assert not expected[:, -1].isfinite().any()
    same = found.isfinite() == expected.isfinite()
    assert same.all()
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=0, equal_nan=True)


def test_models_of_one_kind_share_the_compiled_code_but_not_its_numbers(cached):
    """Neither a change of the numbers nor an earlier program leaves a loop of old ones."""
    model = make_structured("lnn", **NETWORK)
    before, _ = rolled_out(model)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.data.mul_(1.1)
    found, expected = rolled_out(model)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    assert (found - before).abs().max() > 1e-4
    assert len(c_loop._LOOPS) == 2
    assert len([*cached.glob("compiled/*.so")]) == 1
    assert len([*cached.glob("compiled/*")]) == 3  # and the numbers of both


def test_new_numbers_of_a_model_count_in_its_next_path():
    model = make_structured("lnn", **NETWORK).double().requires_grad_(False)
    copy, t = model_for_rollouts(model), 0.01 * torch.arange(20).double()
    signal = Signal(t, torch.ones(20, 3).double())
    x0 = torch.full((6,), 0.1).double()
    with torch.no_grad():
        copy.predict(x0, t, signal)
        for item in (model, copy):
            for parameter in item.parameters():
                parameter.mul_(1.1)
        found, expected = copy.predict(x0, t, signal), model.predict(x0, t, signal)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)


def next_process(monkeypatch, count=80):
    """Roll out in a process that has no loops yet; return its only one."""
    c_loop._LOOPS.clear()
    c_loop._WITHOUT.clear()
    found, expected = rolled_out(MODELS["momentum"](), count=count)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    return next(iter(c_loop._LOOPS.values()), None)


def test_a_compiled_loop_serves_the_next_process(monkeypatch, cached):
    """It serves short paths, too, and is neither traced nor compiled again."""
    rolled_out(MODELS["momentum"]())
    monkeypatch.setattr(c_library, "compile_c", None)
    monkeypatch.setattr(c_loop, "STEPS", 10**6)
    with monkeypatch.context() as patch:
        patch.setattr(c_loop, "trace", None)
        assert isinstance(next_process(monkeypatch, count=2), c_loop.Loop)
    (known,) = cached.glob("compiled/*.pt")
    known.write_bytes(known.read_bytes()[:-1])  # cut short: not read
    assert next_process(monkeypatch) is None
    monkeypatch.setattr(c_loop, "STEPS", 1)
    assert isinstance(next_process(monkeypatch), c_loop.Loop)
    c_library._target.cache_clear()  # as for another processor
    monkeypatch.setattr(c_library, "_FLAGS", [*c_library._FLAGS, "-mtune=generic"])
    assert next_process(monkeypatch) is None


SPRING = """
from pinn_dyn.testing import LinearSystem

class Spring(LinearSystem):
    def _potential_force(self, q):
        return super()._potential_force(q) + {force} * (q > 0.5)
"""


def test_a_class_that_has_changed_gets_a_loop_of_its_own(monkeypatch, tmp_path):
    """The change acts beyond the first step only. A class without a file gets no loop."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for force in (0.0, -9.5):
        (tmp_path / "springs_of_a_user.py").write_text(SPRING.format(force=force))
        sys.modules.pop("springs_of_a_user", None)
        module = importlib.import_module("springs_of_a_user")
        c_loop._LOOPS.clear()
        c_loop._WITHOUT.clear()
        model = module.Spring([[1.0]], [[2.0]], [[0.1]], [[1.0]])
        t = 0.01 * torch.arange(100).double()
        start = torch.tensor([0.3, 2.0]).double()
        signal = Signal(t, torch.zeros(100, 1).double())
        with torch.no_grad():
            found = model_for_rollouts(model).predict(start, t, signal)
            expected = model.double().predict(start, t, signal)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
        assert expected[:, 0].max() > 0.6
        assert isinstance(*c_loop._LOOPS.values(), c_loop.Loop)
    monkeypatch.delattr(module, "__file__")
    c_loop._origin.cache_clear()
    copy = model_for_rollouts(model)
    with pytest.raises(TypeError, match="has no file"):
        c_loop._key_of(copy, copy.integrator)


def test_code_of_an_earlier_class_is_replaced(monkeypatch, cached):
    rolled_out(MODELS["momentum"]())
    code = c_loop.LOOP.replace("lengths[k]", "2 * lengths[k]")
    with monkeypatch.context() as patch:
        patch.setattr(c_loop, "LOOP", code)
        patch.setattr(torch, "allclose", lambda *_, **__: True)
        c_loop._LOOPS.clear()
        c_loop._WITHOUT.clear()
        for path in cached.glob("compiled/*.pt"):
            path.unlink()
        rolled_out(MODELS["momentum"]())  # writes the numbers with wrong code
    assert isinstance(next_process(monkeypatch), c_loop.Loop)
    (known,) = cached.glob("compiled/*.pt")
    assert "2 * lengths" not in torch.load(known, weights_only=True)[0]


class Bessel(LinearSystem):
    """A potential without C code."""

    def _potential_force(self, q):
        return super()._potential_force(q) + torch.special.bessel_j1(q)


class Branching(LinearSystem):
    """A force that Python selects by the state."""

    def _potential_force(self, q):
        return super()._potential_force(q) * (2.0 if float(q.sum()) > 0 else 1.0)


@pytest.mark.parametrize("cause", ["compiler", "operation", "branch", "folder", "wrong"])
def test_without_a_loop_the_states_are_those_of_the_model(monkeypatch, cached, caplog, cause):
    kind = {"operation": Bessel, "branch": Branching}.get(cause, LinearSystem)
    model = kind([[1.0]], [[2.0]], [[0.1]], [[1.0]])
    if cause == "compiler":
        monkeypatch.setenv("CC", "/nonexistent")
    if cause == "folder":
        (cached / "compiled").write_text("a file")
    if cause == "wrong":
        monkeypatch.setitem(c_code.ELEMENTWISE, "add", "{0}")
    with caplog.at_level(logging.INFO):
        found, expected = rolled_out(model)
    assert torch.equal(found, expected)
    assert not any(c_loop._LOOPS.values())
    assert not caplog.text


def test_short_paths_and_gradients_do_not_build_a_loop(monkeypatch):
    monkeypatch.setattr(c_loop, "STEPS", 100)
    model = make_structured("lnn", **NETWORK)
    rolled_out(model, count=60)
    assert not c_loop._LOOPS
    rolled_out(model, count=60)  # together long enough
    assert len(c_loop._LOOPS) == 1
    copy = model_for_rollouts(model)
    x0 = torch.full((6,), 0.1).double().requires_grad_()
    t = 0.01 * torch.arange(200).double()
    signal = Signal(t, torch.zeros(200, 3).double())
    slopes = [torch.autograd.grad(x.predict(x0, t, signal)[-1].sum(), x0)[0] for x in (copy, model)]
    torch.testing.assert_close(*slopes)


def test_rows_of_a_model_are_compiled_once_for_all_processes(monkeypatch, cached):
    """From enough rows on, for its own numbers, and without a trace in the next process."""
    model = make_structured("lnn", **NETWORK).double().eval().requires_grad_(False)
    rows = torch.rand(4, 9, generator=torch.Generator().manual_seed(2)).double()

    def function(x):
        return model.forward_dynamics(*x.chunk(3, dim=-1))

    monkeypatch.setattr(c_loop, "STEPS", 2)
    monkeypatch.setattr(c_loop, "_ROWS", {})
    assert c_loop.rows_in_c(model, "a", function, rows) is function
    fast = c_loop.rows_in_c(model, "a", function, rows)
    assert fast is not function
    torch.testing.assert_close(fast(rows), function(rows), rtol=1e-10, atol=1e-12)
    with pytest.raises(ValueError, match=r"shape|expected"):
        fast(rows[:, :8])
    c_loop._ROWS.clear()
    c_loop._WITHOUT.clear()
    monkeypatch.setattr(c_library, "trace", None)
    again = c_loop.rows_in_c(model, "a", function, rows)
    assert torch.equal(again(rows), fast(rows))
    with torch.no_grad():
        next(model.parameters()).add_(0.1)
    assert c_loop.rows_in_c(model, "a", function, rows) is function


def test_code_of_rows_is_built_at_once_for_many_expected_calls(monkeypatch):
    monkeypatch.setattr(c_loop, "STEPS", 10**6)
    monkeypatch.setattr(c_loop, "_ROWS", {})
    model = make_structured("lnn", **NETWORK).double().eval().requires_grad_(False)
    rows = torch.rand(4, 9, generator=torch.Generator().manual_seed(2)).double()

    def function(x):
        return model.forward_dynamics(*x.chunk(3, dim=-1))

    def is_built(name):
        return c_loop.rows_in_c(model, name, function, rows) is not function

    with c_loop.expected_calls(1000):
        monkeypatch.setattr(c_loop, "BUILD_SECONDS", 1e3)
        assert not is_built("slow")
        monkeypatch.setattr(c_loop, "BUILD_SECONDS", 1e-3)
        assert is_built("fast")
        assert not is_built("slow")  # the time of calls in Python was measured once
    assert not is_built("other")
