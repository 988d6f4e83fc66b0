"""What stops a copy of a closed loop, and only that one."""

import pytest
import torch

from pinn_dyn.control.closed_loop import LoopRun
from pinn_dyn.control.continuous_loop import close_loop_continuous
from pinn_dyn.control.effects import Sensor
from pinn_dyn.control.plants import SystemPlant
from tests.support.closed_loops import PD, Q0, V0, Vanishing, Wave, double, sampled, spring


def require_stopped(record, expected, copy, k, names):
    """Copy ``copy`` of ``record`` ends at instant k, where ``names`` are still known."""
    for name in ("q", "v", "u", "u_wanted"):
        found, whole = getattr(record, name), getattr(expected, name)
        end = k + 1 if name in names else k
        others = [i for i in range(len(found)) if i != copy]
        torch.testing.assert_close(found[copy, :end], whole[copy, :end], rtol=0, atol=1e-5)
        assert found[copy, end:].isnan().all(), name
        torch.testing.assert_close(found[others], whole[others], rtol=0, atol=1e-5)
    assert record.reference.q.isfinite().all()


@pytest.fixture(scope="module")
def undisturbed():
    return sampled()


def test_a_fault_of_the_law_stops_its_copy(undisturbed):
    law = PD(bad=lambda t, q: (torch.arange(3) == 1) & torch.tensor(t > 0.13))
    record = sampled(controller=law)
    require_stopped(record, undisturbed, 1, 7, ("q", "v", "u_wanted"))
    assert record.stopped == [None, "too far at t = 0.14 s", None]
    assert record.diagnostics["time"][1].isfinite().sum() == 8


def test_a_nan_of_the_law_stops_its_copy(undisturbed):
    class Broken(PD):
        def __call__(self, t, q, v, reference):
            u = super().__call__(t, q, v, reference)
            if t > 0.13:
                u[2, 1] = torch.nan
            return u

    record = sampled(controller=Broken())
    record.u_wanted[2, 7] = torch.nan  # one of its two entries was a number
    require_stopped(record, undisturbed, 2, 7, ("q", "v"))
    assert record.stopped == [None, None, "the law's input is not finite at t = 0.14 s"]


def test_a_nan_of_the_sensor_stops_its_copy(undisturbed):
    class Broken(Sensor):
        calls = 0

        def __call__(self, q, v):
            self.calls += 1
            v = v.clone()
            v[0, 1] = torch.nan if self.calls > 5 else v[0, 1]
            return q, v

    record = sampled(sensor=Broken(), delay=0)
    require_stopped(record, undisturbed, 0, 5, ("q", "v"))
    assert record.stopped == ["the measurement is not finite at t = 0.1 s", None, None]


def test_a_plant_that_diverges_stops_its_copy_even_while_its_input_is_delayed():
    plant = SystemPlant(Vanishing())
    still = Wave(double([0.0]))
    q0, v0 = double([[0.0], [0.0], [0.1]]), double([[0.1], [3.0], [0.0]])
    law = PD(size=1, k_p=1e-9, k_d=1e-9)
    record = sampled(plant, law, still, q0, v0, delay=2)
    # The mass is gone at t = 2 / (3 v0) = 0.222 s.
    assert record.stopped == [
        None,
        "the plant diverged: its state is not finite at t = 0.24 s",
        None,
    ]
    assert record.q[1, :12].isfinite().all()
    assert record.q[1, 12:].isnan().all()
    others = sampled(plant, law, still, q0[[0, 2]], v0[[0, 2]], delay=2)
    torch.testing.assert_close(record.q[[0, 2]], others.q, rtol=0, atol=1e-6)


def test_a_copy_beyond_its_bound_is_stopped(undisturbed, monkeypatch):
    bound = 1.02 * float(Q0[1].abs().max())
    monkeypatch.setattr(LoopRun, "q_bound", bound)
    runs = {"sampled": sampled(controller=PD(k_p=-300.0, k_d=0.0))}
    runs["continuous"] = close_loop_continuous(
        spring(),
        PD(k_p=-300.0, k_d=0.0),
        Wave(double([0.5, -1.0])),
        Q0,
        V0,
        duration=0.4,
        samples_rate=50.0,
    )
    for record in runs.values():
        assert all("|q| is beyond 1.02 at t = " in reason for reason in record.stopped)
        for q in record.q:
            kept = q.isfinite().all(-1)
            assert 0 < kept.sum() < 21
            assert (q[kept][:-1].abs() <= bound).all()


@pytest.mark.slow
def test_a_copy_that_a_continuous_loop_loses_leaves_the_others_unharmed(monkeypatch):
    monkeypatch.setattr(LoopRun, "q_bound", 50.0)
    still, law = Wave(double([0.0])), PD(size=1, k_p=1e-9, k_d=1e-9)
    q0, v0 = double([[0.0], [0.0], [0.1], [0.2], [0.3]]), double([[0.1], [3.0], [0], [-1], [0.4]])

    def run(q0, v0):
        return close_loop_continuous(
            Vanishing(), law, still, q0, v0, duration=0.4, samples_rate=50.0
        )

    record, rest = run(q0, v0), [0, 2, 3, 4]
    expected = 1 - (1 - 1.5 * 3.0 * record.t[:12]) ** (2 / 3)
    torch.testing.assert_close(record.q[1, :12, 0], expected, rtol=0, atol=1e-4)
    assert record.q[1, 12:].isnan().all()
    assert record.u[1, :12].isfinite().all()
    assert record.stopped[1].startswith("the plant diverged: the solver cannot follow the motion")
    assert float(record.stopped[1].split()[-2]) == pytest.approx(2 / 9, abs=1e-3)
    assert [record.stopped[i] for i in rest] == [None] * 4
    torch.testing.assert_close(record.q[rest], run(q0[rest], v0[rest]).q, rtol=0, atol=1e-5)
