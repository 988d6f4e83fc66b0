"""The pipeline: loop and file are one function, from the first call on."""

import numpy as np
import pytest
import torch

from pinn_dyn.control import (
    Actuator,
    AdaptiveTracking,
    ComputedTorque,
    DataRegion,
    DisturbanceObserver,
    Guarded,
    Motion,
    MotorPID,
    Pipeline,
    PointToPoint,
    PredictiveControl,
    Regulation,
    Stage,
    Step,
    SystemPlant,
    Tracking,
    export_law,
)
from pinn_dyn.mechanics import InputSolver
from pinn_dyn.systems import RigidChain, TendonArm
from tests.support.c_code import function_of
from tests.support.closed_loops import PD
from tests.support.linear import Pendulums
from tests.support.pipelines import (
    DAMPING,
    GRAVITY,
    INPUTS,
    MASS,
    REFERENCE,
    URDF,
    Case,
    Combination,
    cases,
    combinations,
    compared,
    limited_and_free,
    pendulums,
)

pytestmark = pytest.mark.usefixtures("few_states")

PERIOD = 0.01
SOME = [
    Combination("Tracking", True, True, 1.4, "value and rate", 1.0),
    Combination("AdaptiveTracking", True, False, 1.4, "value and rate", 1.0),
    Combination("LatentLaw", False, True, 1.4, "value and rate", 1.0),
    Combination("MotorPID", False, False, 1.0, "value and rate", 0.4),
]


@pytest.fixture(scope="module")
def laws():
    return cases()


@pytest.mark.parametrize("combination", SOME, ids=lambda x: x.law)
def test_the_file_gives_the_inputs_of_the_loop(laws, tmp_path, combination):
    row = compared(combination, laws[combination.law], tmp_path)
    assert row["difference"] < 1e-9
    assert row["stopped"] is None
    assert {0, 1} <= set(row["status"])


@pytest.mark.slow
@pytest.mark.parametrize("law", cases())
def test_combinations_give_the_inputs_of_the_loop_or_are_refused(laws, tmp_path, law):
    """Every 23rd combination has all settings; benchmarks/loop_and_file.py has the others."""
    chosen = [x for x in combinations() if x.law == law][::23]
    assert all(len(set(values)) > 1 for values in [*zip(*chosen, strict=True)][1:])
    rows = [compared(x, laws[law], tmp_path) for x in chosen]
    refused = [row for row in rows if "refused" in row]
    for row in rows:
        assert "refused" in row or row["difference"] < 1e-9, row
    observed = sum(row["observer"] for row in rows)
    expected = {"PredictiveControl": len(rows), "LatentLaw": observed}
    assert len(refused) == expected.get(law, 0)


def stiff_pid():
    """PID on damped pendulums, from rest at zero to a set point."""
    model = Pendulums(MASS, GRAVITY, 10 * DAMPING, INPUTS).requires_grad_(False)
    case = Case(MotorPID(model, 0.5, 0.0, 8.0), SystemPlant(model), PERIOD, 0.0)
    return case, PointToPoint([0.0, 0.0], [0.5, -0.3], duration=0.1)


def observed():
    law = DisturbanceObserver(Tracking(pendulums(), 25.0, 4.0), 20.0)
    return Case(law, SystemPlant(pendulums(1.3)), PERIOD, 0.0), REFERENCE


def adaptive():
    model = RigidChain(URDF, damping=0.1)
    law = AdaptiveTracking(model, 8.0, 1.0, rate=20.0, adapt=["payload", "friction"])
    return Case(law, cases()["AdaptiveTracking"].plant, 0.005, 0.0), REFERENCE


@pytest.mark.parametrize("setting", [observed, adaptive, stiff_pid])
def test_no_law_winds_up_at_limits(setting):
    """Within 5 % of the error without limits, or 2 % of the largest, 1 s after limits of 1 s."""
    case, reference = setting()
    limited, free = limited_and_free(case, reference, round(1.0 / case.period))
    late = slice(-round(1.0 / case.period), None)
    assert limited.max() > 1.2 * free.max() or setting is stiff_pid
    rms = [np.sqrt(np.mean(x[late] ** 2)) for x in (limited, free)]
    assert rms[0] < 1.05 * rms[1] + 0.02 * limited.max()


# What is a call.


class Counting(Stage):
    """Return the number of the call, and NaN or infinity at some of them."""

    memory_size = 1

    def __init__(self, bad=(), after=()):
        super().__init__(2, 2)
        self.bad, self.after = dict(bad), dict(after)

    def start(self, q, v, u):
        return q[..., :1] + u[..., 1:]

    def step(self, q, v, reference, applied, memory):
        k = int(memory[0])
        u = torch.tensor(self.bad.get(k, [k, applied[1] + 1])).double()
        return Step(u, torch.tensor([self.after.get(k, k + 1)]).double())


def called(pipeline, count):
    """The inputs, statuses and memories of some calls at one state."""
    rows, memory = [], torch.zeros(pipeline.memory_size).double()
    q = torch.tensor([5.0, 0.0]).double()
    for _ in range(count):
        u, status, memory = pipeline(q, 0 * q, q, q, q, memory)
        rows.append((u.tolist(), int(status), memory.tolist()))
    return zip(*rows, strict=True)


def test_the_first_call_takes_its_memory_from_the_measurement_and_the_first_input():
    inputs, statuses, memories = called(Pipeline(Counting(), first_input=[1.0, 2.0]), 3)
    assert inputs == ([7.0, 3.0], [8.0, 4.0], [9.0, 5.0])  # 5 + 2, and 2 + 1
    assert statuses == (0, 0, 0)
    assert memories[0] == [1.0, 7.0, 3.0, 8.0]


def test_limits_of_the_rate_count_from_the_first_input():
    actuator = Actuator(rate=100.0)
    pipeline = Pipeline(Counting(), PERIOD, actuator=actuator, first_input=[1.0, 2.0])
    inputs, statuses, _ = called(pipeline, 3)
    assert inputs == ([2.0, 3.0], [3.0, 4.0], [4.0, 5.0])
    assert statuses == (1, 1, 1)


def test_limits_may_be_tensors(tmp_path):
    limits = {"low": [-1.0, -2.0], "high": [6.5, 2.5], "rate": 700.0}
    given = {name: torch.tensor(value) for name, value in limits.items()}
    inputs = [
        next(iter(called(Pipeline(Counting(), PERIOD, actuator=Actuator(**x)), 4)))
        for x in (limits, given)
    ]
    assert inputs[0] == inputs[1]
    assert inputs[0][-1] == [6.5, 2.5]
    law = Tracking(pendulums(), 3.0, 0.5)
    path = export_law(law, tmp_path / "law.c", period=PERIOD, actuator=Actuator(**given))
    assert "limits" in path.with_suffix(".h").read_text()


@pytest.mark.parametrize("bad", [[-np.inf, 0.0], [np.inf, -np.inf], [0.0, np.nan]])
def test_an_input_that_is_not_finite_gives_the_last_whatever_its_sum(bad):
    inputs, statuses, memories = called(Pipeline(Counting({6: bad}), first_input=[0.0, 0.0]), 3)
    assert inputs == ([5.0, 1.0], [5.0, 1.0], [5.0, 1.0])
    assert statuses == (0, 4, 4)
    assert memories[0] == memories[1] == [1.0, 5.0, 1.0, 6.0]


@pytest.mark.parametrize("bad", [-np.inf, np.nan])
def test_a_memory_that_is_not_finite_is_kept(bad):
    inputs, statuses, memories = called(Pipeline(Counting(after={6: bad})), 3)
    assert inputs == ([5.0, 1.0], [6.0, 2.0], [6.0, 3.0])
    assert statuses == (0, 0, 0)
    assert memories[1][-1] == 6.0


def test_a_run_starts_anew_with_a_memory_of_zeros(laws):
    """No stage keeps anything of a run: limits of the rate, and inputs on their way."""
    model = pendulums()
    pipeline = Pipeline(
        DisturbanceObserver(Tracking(model, 25.0, 4.0), 20.0),
        PERIOD,
        actuator=Actuator(rate=50.0),
        dead_time=0.016,
    )
    runs = [list(called(pipeline, 5)) for _ in range(2)]
    assert runs[0] == runs[1]


# Guards, statuses and refusals.


@pytest.fixture(scope="module")
def region():
    t = torch.linspace(0, 6, 600).double()[:, None] + torch.arange(2.0)
    return DataRegion(torch.sin(t).split(60), torch.cos(t).split(60), angles=[1], samples=77)


@pytest.mark.parametrize("fallback", [None, "hold", "regulation"])
def test_a_guard_falls_back_outside_the_data(region, fallback):
    law = Tracking(pendulums(), 3.0, 0.5)
    pipeline = Pipeline(Guarded(law, region, threshold=1.5, fallback=fallback))
    q, zero = torch.tensor([0.3, 0.4]).double(), torch.zeros(2).double()
    goal = Motion(q + 0.1, zero, zero + 1.0)
    first = pipeline.call(q, 0 * q, goal, torch.zeros(pipeline.memory_size).double())
    far = q + torch.tensor([6.0, 2 * torch.pi]).double()
    result = pipeline.call(far, zero, goal, first.memory)
    assert (first.status, result.status) == (0, 2)
    of_fallback = {"hold": first.u}
    for name, other in ((None, law), ("regulation", Regulation(law.model, 3.0, 0.5))):
        of_fallback[name] = other.step(far, zero, goal, first.u, zero[:0]).u
    torch.testing.assert_close(result.u, of_fallback[fallback])
    turned = q + torch.tensor([0.0, 2 * torch.pi]).double()
    assert pipeline.call(turned, zero, goal, first.memory).status == 0
    assert region.nearest(far, q) == pytest.approx(float(region.distance(far, q)), rel=1e-9)


def test_a_guard_without_stiffness_refuses_the_fall_back_to_regulation(region):
    with pytest.raises(ValueError, match="ComputedTorque have other units: use fallback=hold"):
        Guarded(ComputedTorque(pendulums(), 1.0, 1.0), region, fallback="regulation")


def test_an_observer_inside_a_guard_keeps_its_memory_where_it_would_not_be_finite(region):
    observer = DisturbanceObserver(Tracking(pendulums(), 3.0, 0.5), 20.0)
    pipeline = Pipeline(Guarded(observer, region, fallback="hold"), PERIOD)
    q, zero = torch.tensor([0.3, 0.4]).double(), torch.zeros(2).double()
    first = pipeline.call(
        q, zero, Motion(q, zero, zero), torch.zeros(pipeline.memory_size).double()
    )
    lost = pipeline.call(q, zero + np.inf, Motion(q, zero, zero), first.memory)
    torch.testing.assert_close(lost.memory, first.memory)
    assert torch.equal(lost.u, first.u)


def test_casadi_and_onnx_files_guard_against_far_and_missing_measurements(region, tmp_path):
    casadi, onnxruntime = pytest.importorskip("casadi"), pytest.importorskip("onnxruntime")
    pipeline = Pipeline(Guarded(Tracking(pendulums(), 3.0, 0.5), region, fallback="hold"))
    near = [x * np.ones(2) for x in (0.3, 0.5, 0.4, 0.5, 0.0)]
    far, missing = [near[0] + 20.0, *near[1:]], [near[0] * np.nan, *near[1:]]
    function = casadi.Function.load(str(export_law(pipeline, tmp_path / "law.casadi")))
    session = onnxruntime.InferenceSession(export_law(pipeline, tmp_path / "law.onnx"))
    names = [item.name for item in session.get_inputs()]
    memory = np.array([1.0, 0.2, 0.2])
    for state, expected_status in ((near, 0), (far, 2), (missing, 4)):
        values = [*state, memory]
        batch = {name: x[None] for name, x in zip(names, values, strict=True)}
        for call in (function.call, lambda _, batch=batch: session.run(None, batch)):
            u, status, _ = (np.array(x).ravel() for x in call(values))
            good, _, _ = pipeline(*map(torch.from_numpy, values))
            np.testing.assert_allclose(u, memory[1:] if expected_status else good, rtol=1e-9)
            assert status == expected_status


def test_numbers_that_are_not_finite_give_the_last_input(tmp_path):
    observer = DisturbanceObserver(Tracking(pendulums(), 3.0, 0.5), 20.0)
    call = function_of(export_law(observer, tmp_path / "law.c", period=PERIOD), "law_control")
    good = [x * np.ones(2) for x in (0.3, 0.5, 0.4, 0.5, 0.0)]
    last, memory, _ = call(*good, np.zeros(Pipeline(observer, PERIOD).memory_size))
    for bad in (np.nan, np.inf):
        for position in range(5):
            state = [x.copy() for x in good]
            state[position][1] = bad
            u, after, status = call(*state, memory)
            np.testing.assert_array_equal(u, last)
            np.testing.assert_array_equal(after, memory)
            assert status == 4
    u, _, status = call(*good, memory)
    assert np.isfinite(u).all()
    assert not status & 4


def test_what_a_file_cannot_hold_is_refused(tmp_path):
    law = Tracking(pendulums(), 3.0, 0.5)
    for controller, options in (
        (DisturbanceObserver(law, 20.0), {}),
        (law, {"actuator": Actuator(rate=1.0)}),
    ):
        with pytest.raises(ValueError, match="needs a fixed period"):
            export_law(controller, tmp_path / "law.c", **options)
    with pytest.raises(ValueError, match=r"ends in '.so', expected one of .c, .onnx"):
        export_law(law, tmp_path / "law.so")
    pytest.importorskip("casadi")
    with pytest.raises(TypeError, match="PredictiveControl runs in Python and cannot be exported"):
        export_law(PredictiveControl(pendulums(), 0.2, 0.02), tmp_path / "law.c", period=PERIOD)
    assert not list(tmp_path.iterdir())


def test_the_dead_time_of_the_run_of_a_model_is_compensated(tmp_path):
    model = pendulums()
    model.dead_time = np.array([0.02, 0.02])
    assert Pipeline(Tracking(model, 3.0, 0.5), PERIOD).ahead == (0.02,)
    path = export_law(Tracking(model, 3.0, 0.5), tmp_path / "law.c", period=PERIOD)
    assert "0.02 s ahead" in path.with_suffix(".h").read_text()
    assert Pipeline(PD(), PERIOD).ahead == (0.0,)


@pytest.mark.slow
def test_a_law_that_solves_for_its_input_starts_from_the_last(tmp_path):
    arm = TendonArm()
    law = Regulation(arm, [3.0, 3.0, 0.3], [0.1, 0.1, 0.003], solver=InputSolver(steps=2))
    # Far away, tendons are slack: two steps do not converge there, and rounding decides the mark.
    high = torch.tensor([0.1, 0.1, 0.01]).double()
    ranges = {name: (-high, high) for name in "qva"}
    call = function_of(export_law(law, tmp_path / "law.c", ranges=ranges), "law_control")
    q, zero = torch.tensor([0.05, -0.1, -0.02]).double(), torch.zeros(3).double()
    previous = 0.95 * arm.input_for(q, zero, zero)
    memory_in = torch.cat([torch.ones(1).double(), previous])
    for q_ref, status in ((1.05 * q, 0), (torch.nan * q, 4)):
        u, memory, flags = call(*(x.numpy() for x in (q, zero, q_ref, zero, zero, memory_in)))
        expected, _, _ = Pipeline(law)(q, zero, q_ref, zero, zero, memory_in)
        np.testing.assert_allclose(u, expected, rtol=1e-9)
        assert flags == status
        np.testing.assert_array_equal(memory[1:], u)
    law = Regulation(arm, 3.0, 0.1, solver=InputSolver(low=5.0, high=5.1))
    _, status, _ = Pipeline(law)(q, zero, q, zero, zero, memory_in)
    assert status.long() & 16  # no input gives the force
