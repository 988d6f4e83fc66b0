import dataclasses
import math

import pytest
import torch
from scipy.integrate import quad

from pinn_dyn.control.closed_loop import ClosedLoopRecord
from pinn_dyn.control.contracts import Motion
from pinn_dyn.evaluation.control_metrics import (
    closed_loop_metrics,
    stopped_runs,
)
from tests.support.linear import double


def make_record(t, q, q_ref, u=None, stopped=None):
    u = torch.zeros_like(q) if u is None else u
    q_ref = q_ref.expand_as(q)
    zero = torch.zeros_like(q)
    return ClosedLoopRecord(t, q, zero, u, u, Motion(q_ref, zero, zero), stopped or [None] * len(q))


def clock(end=4.0, step=1e-3):
    return step * torch.arange(round(end / step) + 1, dtype=torch.float64)


def spiral(t, decay, start, goal):
    """The error of each run turns while its norm shrinks as exp(-decay t)."""
    turn = 3.0 * t
    rotation = torch.stack(
        [torch.stack([turn.cos(), -turn.sin()], -1), torch.stack([turn.sin(), turn.cos()], -1)], -2
    )
    step = goal - start
    shrink = torch.exp(-double(decay)[:, None] * t)[..., None]
    return goal[:, None] - shrink * torch.einsum("tij,kj->kti", rotation, step)


def stop(record, run, sample, reason="0.5 s: q left its range"):
    """The same record with one run stopped at a sample."""
    names = ("q", "v", "u", "u_wanted")
    values = {name: getattr(record, name).clone() for name in names}
    reference = Motion(*(x.clone() for x in record.reference))
    for value in (*values.values(), *reference):
        value[run, sample:] = torch.nan
    stopped = list(record.stopped)
    stopped[run] = reason
    return dataclasses.replace(record, reference=reference, stopped=stopped, **values)


@pytest.fixture
def spirals():
    t = clock()
    start = double([[0.1, 0.0], [0.0, -0.3]])
    goal = double([[0.5, 0.3], [0.4, 0.2]])
    q = spiral(t, [2.5, 4.0], start, goal)
    return make_record(t, q, goal[:, None])


def test_errors_of_exponential_decays_meet_their_integrals(spirals):
    found = closed_loop_metrics(spirals)
    sizes = (0.5, math.sqrt(0.41))  # |q_ref - q(0)|
    squares = [
        s**2 * quad(lambda x, a=a: math.exp(-2 * a * x), 0, 4)[0] / 4
        for a, s in zip((2.5, 4.0), sizes, strict=True)
    ]
    norms = [
        s * quad(lambda x, a=a: math.exp(-a * x), 0, 4)[0] / 4
        for a, s in zip((2.5, 4.0), sizes, strict=True)
    ]
    assert found.summary["runs"] == 2
    assert found.summary["stopped"] == 0
    # Means over samples, ends included, are within half a step of the integrals.
    assert found.summary["rms_error"] == pytest.approx(math.sqrt(sum(squares) / 2 / 2), rel=2e-3)
    assert found.summary["mean_error"] == pytest.approx(sum(norms) / 2, rel=2e-3)
    assert found.summary["max_error"] == pytest.approx(sizes[1])
    of_coordinates = sum(e**2 for e in found.coordinates["rms_error"]) / 2
    assert found.summary["rms_error"] == pytest.approx(math.sqrt(of_coordinates))


def test_settling_and_step_error_of_exponential_decays(spirals):
    found = closed_loop_metrics(spirals, settled_after=1.0)
    settled = [math.log(50) / a for a in (2.5, 4.0)]
    assert found.summary["settling_time_worst_s"] == pytest.approx(settled[0], abs=1.01e-3)
    assert found.summary["settling_time_median_s"] == pytest.approx(sum(settled) / 2, abs=1.01e-3)
    assert found.summary["never_settled"] == 0
    assert found.summary["step_error_after_1_s_worst_percent"] == pytest.approx(
        100 * math.exp(-2.5)
    )
    assert found.summary["step_error_after_1_s_mean_percent"] == pytest.approx(
        50 * (math.exp(-2.5) + math.exp(-4.0))
    )
    assert not [
        name for name in closed_loop_metrics(spirals, settled_after=5).summary if "after" in name
    ]
    # The last tenth of 4 s, relative to the step.
    expected = [100 * quad(lambda x, a=a: math.exp(-a * x), 3.6, 4)[0] / 0.4 for a in (2.5, 4.0)]
    assert found.summary["steady_state_error_percent"] == pytest.approx(sum(expected) / 2, rel=1e-3)
    sizes = (0.5, math.sqrt(0.41))
    absolute = sum(s * e / 100 for s, e in zip(sizes, expected, strict=True)) / 2
    assert found.summary["steady_state_error"] == pytest.approx(absolute, rel=1e-3)


def test_settling_counts_the_last_time_outside():
    t = double([2.0, 3.0, 4.0, 5.0, 6.0])  # times count from the first
    error = double([[1.0, 0.01, 0.5, 0.01, 0.01], [1.0, 0.0, 0.0, 0.0, 0.5]])
    record = make_record(t, 1 - error[..., None], torch.ones(1))
    found = closed_loop_metrics(record, settled_after=2.0)
    assert found.summary["never_settled"] == 1
    assert (
        found.summary["settling_time_worst_s"]
        == found.summary["settling_time_median_s"]
        == math.inf
    )
    assert found.summary["step_error_after_2_s_worst_percent"] == 50
    alone = closed_loop_metrics(make_record(t, 1 - error[:1, :, None], torch.ones(1)))
    assert alone.summary["settling_time_worst_s"] == 3.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_overshoot_of_second_order_responses(sign):
    t = clock(10.0)
    damping, frequency = double([0.2, 0.5, 0.8]), 4.0
    damped = (1 - damping**2).sqrt()
    decay = torch.exp(-damping * frequency * t[:, None])
    phase = frequency * damped * t[:, None]
    error = decay * (phase.cos() + damping / damped * phase.sin())
    steps = sign * double([1.0, 0.3, 0.06])
    record = make_record(t, (steps * (1 - error))[None], steps)
    found = closed_loop_metrics(record)
    expected = (100 * torch.exp(-math.pi * damping / damped)).tolist()
    assert found.coordinates["overshoot_worst_percent"].tolist() == pytest.approx(
        expected, abs=1e-3
    )
    assert found.coordinates["overshoot_mean_percent"].tolist() == pytest.approx(expected, abs=1e-3)
    assert found.summary["overshoot_mean_percent"] == pytest.approx(sum(expected) / 3, abs=1e-3)
    assert found.summary["overshoot_worst_percent"] == pytest.approx(expected[0], abs=1e-3)
    assert found.coordinates["coordinate"].tolist() == ["q1", "q2", "q3"]


def test_effort_of_an_input_computed_by_hand():
    t = double([0.0, 1.0, 3.0, 4.0])
    u = double([[[1.0, 0.0], [-2.0, 0.0], [4.0, 3.0], [99.0, 99.0]]])  # the last is not obeyed
    found = closed_loop_metrics(make_record(t, torch.zeros_like(u), double([1.0, 1.0]), u))
    # Held for 1, 2 and 1 s.
    assert found.summary["input_square_integral"] == pytest.approx(1 + 8 + 16 + 9)
    assert found.summary["input_rms"] == pytest.approx(math.sqrt(34 / 4 / 2))
    assert found.summary["input_peak"] == 4
    assert found.summary["input_variation_per_s"] == pytest.approx((3 + math.hypot(6, 3)) / 4)
    assert "saturated_samples" not in found.summary


@pytest.mark.parametrize(
    ("low", "high", "count"),
    [(None, 4.0, 1), (-2.0, [4.0, 0.0], 3), (double([-9, -9]), 9.0, 0)],
)
def test_saturated_instants_are_counted_once(low, high, count):
    t = double([0.0, 1.0, 3.0, 4.0])
    u = double([[[1.0, 0.0], [-2.0, -1.0], [4.0, 3.0], [99.0, 99.0]]])
    record = make_record(t, torch.zeros_like(u), double([1.0, 1.0]), u)
    found = closed_loop_metrics(record, u_low=low, u_high=high)
    assert found.summary["saturated_samples"] == count
    assert found.summary["saturated_percent"] == pytest.approx(100 * count / 3)


def test_a_stopped_run_is_counted_and_left_out(spirals):
    record = stop(spirals, run=1, sample=500)
    assert stopped_runs(record).tolist() == [False, True]
    found = closed_loop_metrics(record, settled_after=1.0, u_high=0.0)
    first = make_record(spirals.t, spirals.q[:1], spirals.reference.q[:1])
    alone = closed_loop_metrics(first, settled_after=1.0)
    assert (found.summary["runs"], found.summary["stopped"], found.summary["never_settled"]) == (
        2,
        1,
        1,
    )
    for name in (
        "rms_error",
        "mean_error",
        "step_error_after_1_s_mean_percent",
        "overshoot_mean_percent",
        "steady_state_error",
        "steady_state_error_percent",
        "input_rms",
        "input_peak",
    ):
        assert found.summary[name] == alone.summary[name], name
    assert found.summary["saturated_percent"] == 100  # of the instants before the stop
    for name in ("max_error", "settling_time_worst_s", "overshoot_worst_percent"):
        assert found.summary[name] == math.inf, name
    assert not any(math.isnan(value) for value in found.summary.values())


def test_all_stopped_gives_infinity_and_never_nan(spirals):
    record = stop(stop(spirals, 0, 1), 1, 300)
    found = closed_loop_metrics(record, settled_after=1.0, u_low=-1.0)
    row = found.summary
    assert not any(math.isnan(value) for value in row.values())
    assert found.summary["stopped"] == found.summary["never_settled"] == 2
    for name in ("rms_error", "overshoot_mean_percent", "settling_time_median_s", "input_peak"):
        assert row[name] == math.inf, name


def test_a_moving_reference_has_no_step():
    t = clock(1.0, 0.01)
    q_ref = t.sin()[None, :, None]
    found = closed_loop_metrics(make_record(t, q_ref + 0.1, q_ref))
    assert not {"settling_time_worst_s", "overshoot_worst_percent"} & set(found.summary)
    assert found.summary["rms_error"] == pytest.approx(0.1)
    assert "overshoot_worst_percent" not in found.coordinates
