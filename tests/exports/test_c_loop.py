"""Rollouts as loops in C, beside the loop in Python."""

import logging
import threading
from functools import partial

import pytest
import torch

from pinn_dyn.ensembles import Ensemble
from pinn_dyn.evaluation.prediction import model_for_rollouts
from pinn_dyn.exports import c_code, c_library, c_loop, compiled
from pinn_dyn.exports.compiled import Compiled
from pinn_dyn.mechanics import RK4, Rosenbrock, Signal
from pinn_dyn.mechanics.compilation import integrated_by
from pinn_dyn.models import Servo
from pinn_dyn.testing import LinearSystem
from tests.models.builders import VARIANTS, make_model, make_structured, perturb
from tests.support.arm_urdf import ARM
from tests.support.code_in_c import build_at_once, codes, loop_of, next_process
from tests.support.known import elastic_model, known_model

NETWORK = VARIANTS["constant-mass-fixed-damping-constant-input-3x3"]


@pytest.fixture(autouse=True)
def cached(monkeypatch, tmp_path):
    """Loops for paths of any length, compiled quickly, in a cache folder of the test."""
    build_at_once(monkeypatch, tmp_path)
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
    assert len(codes()) == 1
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
    assert len(codes()) == 1
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
    assert len(codes()) == 2


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


def test_code_that_is_wrong_under_inputs_alone_is_refused():
    model = MODELS["momentum"]().double().requires_grad_(False)
    x = torch.zeros(1, 2 * model.num_coordinates).double()
    u = torch.zeros(1, 2, 4, model.num_inputs).double()
    steps = c_loop.Steps(model, x, u, torch.full((2,), 0.01).double())
    loop = loop_of(model, x[0], u[0, 0], torch.tensor(0.01).double(), several=False)
    assert steps.agrees(loop)
    assert not steps.agrees(lambda increment, x, u, h: loop(increment, x, 2 * u, h))


def changed_by_data(model):
    for parameter in model.parameters():
        parameter.data.mul_(1.1)


def changed_by_array(model):
    for parameter in model.parameters():
        parameter.detach().numpy()[...] *= 1.1


def changed_by_state(model):
    model.load_state_dict({name: 1.1 * x for name, x in model.state_dict().items()}, assign=True)


@pytest.mark.parametrize("change", [changed_by_data, changed_by_array, changed_by_state])
def test_new_numbers_count_in_the_next_path_and_build_nothing(monkeypatch, change):
    model = make_structured("lnn", **NETWORK).double().requires_grad_(False)
    copy, t = model_for_rollouts(model), 0.01 * torch.arange(20).double()
    signal, x0 = Signal(t, torch.ones(20, 3).double()), torch.full((6,), 0.1).double()
    with torch.no_grad():
        before = copy.predict(x0, t, signal)
        monkeypatch.setattr(c_loop, "programs", None)
        monkeypatch.setattr(c_library, "compile_c", None)
        change(model)
        change(copy)
        found, expected = copy.predict(x0, t, signal), model.predict(x0, t, signal)
    assert (found - before).abs().max() > 1e-4
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    assert len(codes()) == 1


class Link(LinearSystem):
    """A system with numbers in all places that Python knows."""

    share = 1.0

    def __init__(self, *matrices):
        super().__init__(*matrices)
        self.force, self.table = 1.0, {"factor": [1.0]}
        self.law = lambda q: q

    def _potential_force(self, q):
        factor = self.force * self.share * self.table["factor"][0] * FACTOR
        return factor * self.law(super()._potential_force(q))


FACTOR = 1.0
CHANGES = {
    "attribute": lambda patch, x: setattr(x, "force", 3.0),
    "container": lambda patch, x: x.table["factor"].__setitem__(0, 3.0),
    "function": lambda patch, x: setattr(x, "law", torch.sin),
    "class": lambda patch, x: patch.setattr(Link, "share", 3.0),
    "global": lambda patch, x: patch.setitem(Link._potential_force.__globals__, "FACTOR", 3.0),
    "integrator": lambda patch, x: setattr(x, "integrator", c_loop.CLoop(Rosenbrock(2))),
    "method": lambda patch, x: patch.setattr(Link, "_potential_force", lambda self, q: 2 * q),
    "zero": lambda patch, x: x.damping.data.zero_(),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_attribute_or_function_counts_in_the_next_path(monkeypatch, name):
    model = model_for_rollouts(Link([[1.0]], [[9.0]], [[0.1]], [[1.0]]))
    t = 0.1 * torch.arange(40).double()
    start, signal = torch.tensor([0.3, 2.0]).double(), Signal(t, torch.zeros(40, 1).double())
    with torch.no_grad():
        before = model.predict(start, t, signal)
        CHANGES[name](monkeypatch, model)
        found = model.predict(start, t, signal)
        with integrated_by(model, model.integrator.inner):
            expected = model.predict(start, t, signal)
    assert (before - expected).abs().max() > 1e-6
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    assert len(codes()) == 2


def test_threads_see_the_model_while_another_thread_builds_its_loop(monkeypatch):
    model = known_model(ARM, locked_joints=()).double().eval().requires_grad_(False)
    copy, t = model_for_rollouts(model), 0.01 * torch.arange(3).double()
    x0 = torch.full((2 * model.num_coordinates,), 0.1).double()
    signal = Signal(t, torch.ones(3, model.num_inputs).double())
    results, threads = [], []

    def predict():
        with torch.no_grad():
            results.append(copy.predict(x0, t, signal))

    for _ in range(2):
        threads.append(threading.Thread(target=predict))
        threads[-1].start()
    while any(thread.is_alive() for thread in threads):
        predict()
    with torch.no_grad():
        expected = model.predict(x0, t, signal)
    assert len(results) > 3
    for found in results:
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def next_states(monkeypatch, count=80):
    """Roll out in a process that has no code yet; return the number of codes after it."""
    next_process(monkeypatch)
    found, expected = rolled_out(MODELS["momentum"](), count=count)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    return len(codes())


def test_code_serves_the_next_process_also_with_other_numbers(monkeypatch, cached):
    """It serves short paths, too, and is neither traced nor compiled again."""
    rolled_out(MODELS["momentum"]())
    monkeypatch.setattr(c_library, "compile_c", None)
    monkeypatch.setattr(compiled, "BUILD_SECONDS", 1e6)
    with monkeypatch.context() as patch:
        patch.setattr(c_loop, "programs", None)
        assert next_states(monkeypatch, count=2) == 1
        next_process(monkeypatch)
        model = MODELS["momentum"]()
        changed_by_data(model)
        found, expected = rolled_out(model)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
        assert len(codes()) == 1
    (known,) = cached.glob("compiled/*.pt")
    known.write_bytes(known.read_bytes()[:-1])  # cut short: not read
    assert next_states(monkeypatch) == 0
    monkeypatch.setattr(compiled, "BUILD_SECONDS", 0.0)
    assert next_states(monkeypatch) == 1
    c_library._target.cache_clear()  # as for another processor
    monkeypatch.setattr(c_library, "_FLAGS", [*c_library._FLAGS, "-mtune=generic"])
    assert next_states(monkeypatch) == 0


def test_code_that_disagrees_beyond_the_first_state_is_replaced(monkeypatch, cached):
    """What a key does not see: a force that the cached code does not have, far from rest."""
    monkeypatch.setattr(compiled.Watch, "digest", lambda self: "the same")
    for limit in (1e6, 0.4):
        next_process(monkeypatch)
        model = LinearSystem([[1.0]], [[2.0]], [[0.1]], [[1.0]])
        force = model._potential_force
        model._potential_force = lambda q, force=force, limit=limit: torch.where(
            q > limit, 9 * q, force(q)
        )
        found, expected = rolled_out(model, count=150)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
        assert len(codes()) == 1
    assert expected[..., 0].max() > 0.4


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
    assert not codes()
    assert not caplog.text


def test_python_computes_until_it_has_taken_as_long_as_a_build_and_for_gradients(monkeypatch):
    monkeypatch.setattr(compiled, "BUILD_SECONDS", 1.0)
    ticks = iter(0.3 * k for k in range(100))
    monkeypatch.setattr(compiled.time, "thread_time", lambda: next(ticks))
    model = make_structured("lnn", **NETWORK)
    built = [bool(rolled_out(model, count=20) and codes()) for _ in range(5)]
    assert built == [False] * 4 + [True]
    copy = model_for_rollouts(model)
    x0 = torch.full((6,), 0.1).double().requires_grad_()
    t = 0.01 * torch.arange(200).double()
    signal = Signal(t, torch.zeros(200, 3).double())
    slopes = [torch.autograd.grad(x.predict(x0, t, signal)[-1].sum(), x0)[0] for x in (copy, model)]
    torch.testing.assert_close(*slopes)


def test_rows_of_a_model_are_compiled_once_for_all_processes(monkeypatch, cached):
    """For its own numbers, and without a trace in the next process."""
    model = make_structured("lnn", **NETWORK).double().eval().requires_grad_(False)
    rows = torch.rand(4, 9, generator=torch.Generator().manual_seed(2)).double()

    def function(x):
        return model.forward_dynamics(*x.chunk(3, dim=-1))

    code = Compiled(model)
    for _ in range(2):
        found = code.rows("a", function, rows)
        torch.testing.assert_close(found, function(rows), rtol=1e-10, atol=1e-12)
        assert len(codes()) == 1
        with pytest.raises(ValueError, match=r"shape|expected"):
            code.rows("a", function, rows[:, :8])
        next_process(monkeypatch)
        monkeypatch.setattr("pinn_dyn.exports.program.trace", None)
        with torch.no_grad():
            next(model.parameters()).add_(0.1)


def test_rows_are_those_of_the_function_also_where_they_are_not_finite():
    x = 20 * torch.randn(5, 4, 3, dtype=torch.float64)
    x[1, 2, 0], x[3, 0, 2] = torch.nan, torch.inf
    for scale in (1.0, 0.5):
        weights = scale * torch.rand(30, 3, dtype=torch.float64)

        def function(x, weights=weights):
            y = torch.nn.functional.softplus(x @ weights.T)
            return torch.tanh(y / 50) * torch.exp(-y) + torch.relu(y - 3)

        code = Compiled(weights)
        found = code.rows("f", function, x)
        torch.testing.assert_close(found, function(x), rtol=1e-12, atol=0, equal_nan=True)
        columns = x.mT.contiguous().mT
        torch.testing.assert_close(code.rows("f", function, columns), found, equal_nan=True)
    assert len(codes()) == 1  # other numbers need no other code
