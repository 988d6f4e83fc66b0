"""What stops a copy of a closed loop, and only that one."""

import pytest
import torch

from pinn_dyn.control import closed_loop
from pinn_dyn.control.closed_loop import STOPS
from pinn_dyn.control.effects import Sensor
from pinn_dyn.control.plants import SystemPlant
from tests.support.closed_loops import PD, Q0, Vanishing, Wave, double, sampled


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


def test_a_nan_of_the_law_stops_its_copy(undisturbed):
    """Copy 1 is the only one that comes below q = 0.35."""
    q = undisturbed.q[1, :, 0]
    k = int((q < 0.35).nonzero()[0])
    law = PD(bad=lambda q: (torch.arange(3) == 1) & (q[:, 0] < 0.35))
    record = sampled(controller=law)
    record.u_wanted[1, k] = torch.nan
    require_stopped(record, undisturbed, 1, k, ("q", "v"))
    assert record.stopped == [None, f"the law's input is not finite at t = {k / 50:.6g} s", None]
    assert record.diagnostics["distance"][1].isfinite().sum() == k + 1


@pytest.mark.parametrize(("mark", "reason"), STOPS.items())
def test_a_mark_of_a_stage_stops_its_copy(undisturbed, mark, reason):
    class Marked(PD):
        def step(self, q, *state):
            u, memory, _ = super().step(q, *state)
            return u, memory, {mark: (q == Q0).all(-1) & (torch.arange(3) == 2)}

    if mark == "not_finite":
        return
    record = sampled(controller=Marked())
    require_stopped(record, undisturbed, 2, 0, ("q", "v", "u_wanted"))
    assert record.stopped == [None, None, f"{reason} at t = 0 s"]


def test_a_nan_of_the_sensor_stops_its_copy(undisturbed):
    class Broken(Sensor):
        calls = 0

        def __call__(self, q, v):
            self.calls += 1
            v = v.clone()
            v[0, 1] = torch.nan if self.calls > 5 else v[0, 1]
            return q, v

    record = sampled(sensor=Broken())
    require_stopped(record, undisturbed, 0, 5, ("q", "v"))
    assert record.stopped == ["the measurement is not finite at t = 0.1 s", None, None]


def test_a_plant_that_diverges_stops_its_copy_even_while_its_input_is_delayed():
    plant = SystemPlant(Vanishing())
    still = Wave(double([0.0]))
    q0, v0 = double([[0.0], [0.0], [0.1]]), double([[0.1], [3.0], [0.0]])
    law = PD(size=1, k_p=1e-9, k_d=1e-9)
    record = sampled(plant, law, still, q0, v0, dead_time=0.04)
    # The mass is gone at t = 2 / (3 v0) = 0.222 s.
    assert record.stopped == [
        None,
        "the plant diverged: its state is not finite at t = 0.24 s",
        None,
    ]
    assert record.q[1, :12].isfinite().all()
    assert record.q[1, 12:].isnan().all()
    others = sampled(plant, law, still, q0[[0, 2]], v0[[0, 2]], dead_time=0.04)
    torch.testing.assert_close(record.q[[0, 2]], others.q, rtol=0, atol=1e-6)


def test_a_copy_beyond_its_bound_is_stopped(undisturbed, monkeypatch):
    bound = 1.02 * float(Q0[1].abs().max())
    monkeypatch.setattr(closed_loop, "Q_BOUND", bound)
    record = sampled(controller=PD(k_p=-300.0, k_d=0.0))
    assert all("|q| is beyond 1.02 at t = " in reason for reason in record.stopped)
    for q in record.q:
        kept = q.isfinite().all(-1)
        assert 0 < kept.sum() < 21
        assert (q[kept][:-1].abs() <= bound).all()
