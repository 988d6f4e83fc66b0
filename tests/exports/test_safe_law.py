"""Laws with limits, guard and observer: the C file against the loop in Python."""

import functools

import numpy as np
import pytest
import torch

from pinn_dyn.control import (
    Actuator,
    ComputedTorque,
    DataRegion,
    DisturbanceObserver,
    Guarded,
    Motion,
    Regulation,
    Tracking,
    export_law,
)
from pinn_dyn.control.region import FallBack
from pinn_dyn.control.safe_law import SafeLaw
from pinn_dyn.mechanics import InputSolver
from pinn_dyn.systems import TendonArm
from tests.models.builders import VARIANTS, make_structured
from tests.support.c_code import function_of
from tests.support.contracts import slow_except

pytestmark = pytest.mark.usefixtures("few_states")

PERIOD = 0.01
LIMITS = dict(low=[-20.0, -9.0, -3.0], high=15.0, rate=400.0)
FALL_BACKS = [None, "hold", "regulation"]


@pytest.fixture(scope="module")
def law():
    variant = VARIANTS["constant-mass-fixed-damping-constant-input-3x3"]
    model = make_structured("lnn", **variant).requires_grad_(False)
    return Tracking(model, 3.0, 0.5)


def motion(steps):
    """Measurements and references along a path, different at each instant."""
    t = PERIOD * torch.arange(steps).double()[:, None] + torch.arange(3.0)
    return [f(t + k) for k, f in enumerate((torch.sin, torch.cos, torch.sin, torch.cos, torch.sin))]


def in_file(law, path, **options):
    """The function of the file of a law."""
    return function_of(export_law(law, path, period=PERIOD, **options), "law_control")


def with_memory(call, size=3):
    """The law of a file with its memory, as a loop calls it."""
    memory = [np.zeros(size)]

    def control(*state):
        u, memory[0], status = call(*state, memory[0])
        return u, status

    return control


@pytest.fixture(scope="module")
def limited(law, tmp_path_factory):
    """An observer with limits, and the function of its file."""
    options = dict(bandwidth=20.0, max_rate=50.0, actuator=Actuator(**LIMITS))
    observer = DisturbanceObserver(law, **options)
    path = tmp_path_factory.mktemp("limited") / "law.c"
    return observer, in_file(observer, path, actuator=Actuator(**LIMITS))


@pytest.fixture(scope="module")
def guarded_observer(law, tmp_path_factory):
    """Return a guard over an observer, and the function of its file."""
    x = motion(100)
    region = DataRegion(x[0].split(50), x[1].split(50), samples=77)

    @functools.cache
    def exported(fallback):
        guarded = Guarded(DisturbanceObserver(law, 20.0), region, threshold=1.5, fallback=fallback)
        return guarded, in_file(guarded, tmp_path_factory.mktemp("guarded") / "law.c")

    return exported


def test_an_observer_with_limits_gives_the_inputs_of_the_loop(limited):
    observer, call = limited
    actuator, control = Actuator(**LIMITS), with_memory(call, 13)
    statuses = set()
    for k, state in enumerate(zip(*motion(50), strict=True)):
        u = observer(k * PERIOD, *state[:2], Motion(*state[2:]))
        expected, changed = actuator(u, PERIOD)
        result, status = control(*(x.numpy() for x in state))
        np.testing.assert_allclose(result, expected, rtol=1e-9, atol=1e-12)
        assert status == int(changed.any())
        statuses.add(status)
    assert statuses == {0, 1}
    assert observer.residual.abs().min() > 0.01


@pytest.mark.parametrize("fallback", slow_except(FALL_BACKS, [None, "regulation"]))
def test_a_guard_falls_back_in_the_file_as_in_the_loop(law, tmp_path, fallback):
    data = motion(100)
    parts = [x.split(50) for x in data[:2]]
    region = DataRegion(*parts, angles=[1], samples=77)
    guarded = Guarded(law, region, threshold=1.5, fallback=fallback)
    control = with_memory(in_file(guarded, tmp_path / "law.c"))
    outside = []
    for k, state in enumerate(zip(*motion(20), strict=True)):
        far = (k % 5 == 4) * torch.tensor([0.0, 2 * torch.pi, 6.0 if k == 9 else 0.0])
        q, v = state[0] + far, state[1]
        expected = guarded(k * PERIOD, q, v, Motion(*state[2:]))
        result, status = control(q.numpy(), v.numpy(), *(x.numpy() for x in state[2:]))
        np.testing.assert_allclose(result, expected, rtol=1e-9, atol=1e-12)
        outside.append(status)
        assert region.nearest(q, v) == pytest.approx(float(region.distance(q, v)), rel=1e-9)
    assert outside == [2 * (k == 9) for k in range(20)]


def test_casadi_and_onnx_files_guard_against_far_and_missing_measurements(law, tmp_path):
    casadi, onnxruntime = pytest.importorskip("casadi"), pytest.importorskip("onnxruntime")
    x = motion(100)
    guarded = Guarded(law, DataRegion(x[0].split(50), x[1].split(50)), fallback="hold")
    near = [part[1].numpy() for part in motion(2)]
    far, missing = [near[0] + 20.0, *near[1:]], [near[0] * np.nan, *near[1:]]
    function = casadi.Function.load(str(export_law(guarded, tmp_path / "law.casadi")))
    session = onnxruntime.InferenceSession(export_law(guarded, tmp_path / "law.onnx"))
    names = [item.name for item in session.get_inputs()]
    for state, expected_status in ((near, 0), (far, 2), (missing, 4)):
        values = [*state, np.full(3, 0.2)]
        batch = {name: x[None] for name, x in zip(names, values, strict=True)}
        for call in (function.call, lambda _, batch=batch: session.run(None, batch)):
            u, status, _ = (np.array(x).ravel() for x in call(values))
            good = law.law(*map(torch.from_numpy, state))
            expected = values[-1] if expected_status else good
            np.testing.assert_allclose(u, expected, rtol=1e-9)
            assert status == expected_status


def test_gains_of_another_unit_do_not_fall_back(law):
    x = motion(50)
    region = DataRegion([x[0]], [x[1]])
    with pytest.raises(ValueError, match="ComputedTorque have other units: use the fallback hold"):
        Guarded(ComputedTorque(law.model, 1.0, 1.0), region, fallback="regulation")
    assert "hold" in FallBack.__args__


def test_numbers_that_are_not_finite_give_the_last_input(limited):
    control = with_memory(limited[1], 13)
    good = [x[1].numpy() for x in motion(2)]
    last, _ = control(*good)
    for bad in (np.nan, np.inf):
        for position in range(5):
            state = [x.copy() for x in good]
            state[position][1] = bad
            u, status = control(*state)
            np.testing.assert_array_equal(u, last)
            assert status == 4
    u, status = control(*good)
    assert np.isfinite(u).all()
    assert not status & 4


NOT_FINITE = [[-np.inf, 0, 0], [np.inf, -np.inf, 0], [0, np.nan, 0]]


@pytest.mark.parametrize("bad", NOT_FINITE)
def test_an_input_that_is_not_finite_gives_the_last_whatever_its_sum(law, monkeypatch, bad):
    """The sum of minus infinity is less than every number."""
    safe = SafeLaw(law)
    u, last = torch.tensor(bad).double(), torch.tensor([1.0, 2.0, 3.0]).double()
    monkeypatch.setattr(law, "law", lambda *state: u)
    result, status, memory = safe(*[torch.zeros(3).double()] * 5, last)
    assert status == 4
    assert torch.equal(result, last)
    assert torch.equal(memory, last)


@pytest.mark.parametrize("bad", NOT_FINITE)
def test_an_observer_keeps_its_memory_whatever_the_sum_of_the_next(law, monkeypatch, bad):
    observer = DisturbanceObserver(law, 20.0)
    safe = SafeLaw(observer, period=PERIOD)
    u, before = torch.tensor([1.0, 2.0, 3.0]).double(), torch.linspace(1, 2, safe.memory_size)
    after = torch.zeros(observer.memory_size).double()
    after[:3] = torch.tensor(bad)
    monkeypatch.setattr(observer, "correct", lambda *_: (u, lambda applied: after))
    _, status, memory = safe(*[torch.zeros(3).double()] * 5, before.double())
    assert status == 0
    assert torch.equal(memory, torch.cat([u, before.double()[3:]]))


def test_a_held_input_does_not_spoil_the_memory_of_the_observer(guarded_observer):
    """An infinite velocity is outside the data, so the guard holds a finite input."""
    _, call = guarded_observer("hold")
    good = [part[1].numpy() for part in motion(2)]
    _, before, _ = call(*good, np.zeros(13))
    _, after, status = call(good[0], np.full(3, np.inf), *good[2:], before)
    np.testing.assert_array_equal(after, before)
    assert status == 2
    assert np.isfinite(call(*good, after)[1]).all()


@pytest.mark.parametrize("fallback", slow_except(FALL_BACKS, ["hold"]))
def test_a_guard_over_an_observer_acts_in_the_loop_as_in_the_file(guarded_observer, fallback):
    """The observer of the loop counts the input of the guard."""
    guarded, call = guarded_observer(fallback)
    memory = np.zeros(13)
    for k, state in enumerate(zip(*motion(12), strict=True)):
        q = state[0] + 6.0 * (k in (5, 6))
        expected = guarded(k * PERIOD, q, state[1], Motion(*state[2:]))
        u, memory, status = call(q.numpy(), *(x.numpy() for x in state[1:]), memory)
        np.testing.assert_allclose(u, expected, rtol=1e-9, atol=1e-12)
        assert status == 2 * (k in (5, 6))


@pytest.mark.parametrize("kind", [np.array, functools.partial(torch.tensor, dtype=torch.float64)])
def test_limits_may_be_arrays_and_tensors(law, tmp_path, kind):
    limits = {"low": [-0.1, -0.2, -0.3], "high": [0.1, 0.2, 0.3], "rate": 10.0}
    given = {name: kind(value) for name, value in limits.items()}
    path = tmp_path / "law.c"
    calls = [with_memory(in_file(law, path, actuator=Actuator(**x))) for x in (limits, given)]
    states = [[x.numpy() for x in state] for state in zip(*motion(20), strict=True)]
    inputs = [[call(*state)[0] for state in states] for call in calls]
    assert np.array_equal(*inputs)
    assert np.abs(inputs[0]).max(axis=0) == pytest.approx(limits["high"])
    assert "limits" in path.with_suffix(".h").read_text()


def test_the_first_input_is_limited_from_zero(law, tmp_path):
    control = with_memory(in_file(law, tmp_path / "law.c", actuator=Actuator(rate=10.0)))
    u, status = control(*[10 * np.ones(3), *[np.zeros(3)] * 4])
    np.testing.assert_allclose(np.abs(u), 0.1)
    assert status == 1


def test_what_a_file_cannot_hold_is_refused(law, tmp_path, caplog):
    for controller, options, message in (
        (DisturbanceObserver(law, 20.0), {}, "needs a fixed period"),
        (law, {"actuator": Actuator(rate=1.0)}, "needs a fixed period"),
    ):
        with pytest.raises(ValueError, match=message):
            export_law(controller, tmp_path / "law.c", **options)
    with pytest.raises(ValueError, match=r"ends in '.so', expected one of .c, .onnx"):
        export_law(law, tmp_path / "law.so")
    with pytest.raises(ValueError, match=r"ends in '.pt2', expected one of .c, "):
        export_law(law, tmp_path / "law.pt2")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_law_that_solves_for_its_input_starts_from_the_last(tmp_path):
    arm = TendonArm()
    law = Regulation(arm, [3.0, 3.0, 0.3], [0.1, 0.1, 0.003], solver=InputSolver(steps=2))
    call = function_of(export_law(law, tmp_path / "law.c"), "law_control")
    q, zero = torch.tensor([0.05, -0.1, -0.02]).double(), torch.zeros(3).double()
    previous = 0.95 * arm.input_for(q, zero, zero)
    for q_ref, status in ((1.05 * q, 0), (torch.nan * q, 4)):
        u, memory, flags = call(*(x.numpy() for x in (q, zero, q_ref, zero, zero, previous)))
        expected = previous if status else law.law(q, zero, q_ref, zero, zero, previous)
        np.testing.assert_allclose(u, expected, rtol=1e-9)
        assert flags == status
        np.testing.assert_array_equal(memory, u)
    law = Regulation(arm, 3.0, 0.1, solver=InputSolver(low=5.0, high=5.1))
    assert law.law(q, zero, q, zero, zero, previous).isnan().all()  # no input gives the force
