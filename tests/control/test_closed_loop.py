"""Closed loops, against matrix exponentials, and what happens when something goes wrong."""

import sys

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from pinn_dyn.control import Controller, Motion, Plant, Reference
from pinn_dyn.control.closed_loop import close_loop, close_loop_continuous
from pinn_dyn.control.effects import Actuator, Sensor
from pinn_dyn.control.plants import SystemPlant
from tests.support.linear import LinearSystem
from tests.support.vanishing import Vanishing

K_P, K_D = 30.0, 4.0


def double(values):
    return torch.tensor(values, dtype=torch.float64)


Q0, V0 = double([[0.5, -0.2], [1.0, 0.4], [-0.3, 0.0]]), double([[0.0, 1.0], [-1.0, 0.3], [2, 0]])


class Wave(Reference):
    def __init__(self, amplitude):
        self.amplitude = amplitude
        self.num_coordinates = amplitude.shape[-1]

    def __call__(self, t):
        a = self.amplitude
        return Motion(a * np.sin(2 * t), 2 * a * np.cos(2 * t), -4 * a * np.sin(2 * t))


class PD(Controller):
    """PD with the time of each call as a diagnostic; copies for whom ``bad(t, q)`` are faulty."""

    def __init__(self, size=2, k_p=K_P, k_d=K_D, bad=None):
        super().__init__(size, size)
        self.k_p, self.k_d, self.bad = k_p, k_d, bad

    def __call__(self, t, q, v, reference):
        assert q.isfinite().all()
        assert v.isfinite().all()
        self.q, self.time = q, t
        return self.k_p * (reference.q - q) + self.k_d * (reference.v - v)

    def diagnostics(self):
        return {"time": torch.full(self.q.shape[:-1], self.time)}

    def faults(self):
        return {} if self.bad is None else {"too far": self.bad(self.time, self.q)}


def spring(inputs=((1.0, 0.0), (0.3, 0.8))):
    return LinearSystem(
        mass=[[1.0, 0.2], [0.2, 0.7]],
        stiffness=[[9.0, -2.0], [-2.0, 5.0]],
        damping=[[0.4, 0.1], [0.1, 0.3]],
        inputs=inputs,
    )


def sampled(plant=None, controller=None, reference=None, q0=Q0, v0=V0, **changes):
    plant = plant or SystemPlant(spring(), rtol=1e-9, atol=1e-11)
    reference = reference or Wave(double([0.5, -1.0]))
    settings = {"duration": 0.4, "rate": 50.0} | changes
    return close_loop(plant, controller or PD(), reference, q0, v0, **settings)


def feedback(x, t, amplitude):
    q, v = np.split(x, 2)
    return K_P * (amplitude * np.sin(2 * t) - q) + K_D * (2 * amplitude * np.cos(2 * t) - v)


# Against independent answers.


@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("amplitude", [[0.5, -1.0], [[0.5, -1.0], [0.0, 0.0], [1.0, 2.0]]])
def test_sampled_loop_is_the_exact_discrete_one(delay, amplitude):
    record = sampled(reference=Wave(double(amplitude)), delay=delay)
    f, b = spring().state_space()
    step = expm(np.block([[f, b], [np.zeros((2, 6))]]) * 0.02)
    amplitudes = np.broadcast_to(np.array(amplitude), (3, 2))
    assert record.t.shape == (21,)
    for copy in range(3):
        x, on_their_way = np.concatenate([Q0[copy], V0[copy]]), [np.zeros(2)] * delay
        for k in range(21):
            wanted = feedback(x, k / 50, amplitudes[copy])
            on_their_way.append(wanted)
            u = on_their_way.pop(0)
            for name, expected in (("q", x[:2]), ("v", x[2:]), ("u", u), ("u_wanted", wanted)):
                found = getattr(record, name)[copy, k]
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6, err_msg=name)
            x = (step @ np.concatenate([x, u]))[:4]
        np.testing.assert_allclose(
            record.reference.a[copy], -4 * amplitudes[copy] * np.sin(2 * record.t.numpy())[:, None]
        )
    assert record.stopped == [None] * 3
    torch.testing.assert_close(record.diagnostics["time"], record.t.expand(3, -1))


def test_continuous_loop_is_a_matrix_exponential():
    amplitude = np.array([0.5, -1.0])
    record = close_loop_continuous(
        spring(), PD(), Wave(double(amplitude.tolist())), Q0, V0, duration=2.0, samples_rate=10.0
    )
    f, b = spring().state_space()
    closed = f - b @ np.hstack([K_P * np.eye(2), K_D * np.eye(2)])
    # sin(2 t) and cos(2 t) are states of their own.
    forcing = b @ np.stack([K_P * amplitude, 2 * K_D * amplitude], 1)
    waves = np.array([[0.0, 2.0], [-2.0, 0.0]])
    matrix = np.block([[closed, forcing], [np.zeros((2, 4)), waves]])
    for copy in range(3):
        start = np.concatenate([Q0[copy], V0[copy], [0.0, 1.0]])
        expected = np.stack([expm(matrix * t) @ start for t in record.t.tolist()])
        np.testing.assert_allclose(record.q[copy], expected[:, :2], rtol=0, atol=2e-5)
        np.testing.assert_allclose(record.v[copy], expected[:, 2:4], rtol=0, atol=1e-4)
        u = [
            feedback(x[:4], t, amplitude) for x, t in zip(expected, record.t.tolist(), strict=True)
        ]
        np.testing.assert_allclose(record.u[copy], u, rtol=0, atol=1e-3)
    torch.testing.assert_close(record.u, record.u_wanted)


def test_continuous_loop_limits_the_input_all_the_time():
    record = close_loop_continuous(
        spring(),
        PD(),
        Wave(double([0.5, -1.0])),
        Q0[:1],
        V0[:1],
        duration=1.0,
        samples_rate=10.0,
        actuator=Actuator(low=-2.0, high=[3.0, 1.0]),
    )
    f, b = spring().state_space()

    def derivative(t, x):
        u = feedback(x, t, np.array([0.5, -1.0]))
        return f @ x + b @ np.clip(u, -2, [3, 1])

    start = np.concatenate([Q0[0], V0[0]])
    expected = solve_ivp(
        derivative, (0, 1), start, t_eval=record.t, rtol=1e-8, atol=1e-9, max_step=1e-3
    ).y.T
    np.testing.assert_allclose(record.q[0], expected[:, :2], rtol=0, atol=1e-4)
    torch.testing.assert_close(
        record.u[0], record.u_wanted[0].clamp(double([-2.0, -2.0]), double([3.0, 1.0]))
    )
    count = (record.u != record.u_wanted).sum(-1).double()
    assert count.max() > 0
    torch.testing.assert_close(record.diagnostics["saturated_inputs"], count)


def test_a_stiff_continuous_loop_is_solved_in_few_evaluations():
    calls = []

    class Counted(PD):
        def __call__(self, t, q, v, reference):
            calls.append(t)
            return super().__call__(t, q, v, reference)

    still = Wave(double([0.0, 0.0]))
    law = Counted(k_p=1e4, k_d=1e6)
    record = close_loop_continuous(spring(), law, still, Q0, V0, duration=1.0, samples_rate=5.0)
    assert len(calls) < 1000
    # What is left of the motion is q' = -K_P / K_D q, the springs are weak beside the gains.
    expected = Q0[:, None] * torch.exp(-0.01 * record.t)[:, None]
    torch.testing.assert_close(record.q, expected, rtol=0, atol=1e-4)


def test_the_law_sees_the_noise_and_the_record_the_truth():
    record = sampled(sensor=Sensor(q_noise=0.05, v_noise=[0.1, 0.2], seed=4))
    sensor = Sensor(q_noise=0.05, v_noise=[0.1, 0.2], seed=4)
    for k in range(21):
        q, v = sensor(record.q[:, k], record.v[:, k])
        reference = record.reference
        expected = K_P * (reference.q[:, k] - q) + K_D * (reference.v[:, k] - v)
        torch.testing.assert_close(record.u_wanted[:, k], expected)


def test_the_plant_gets_the_limited_input():
    record = sampled(actuator=Actuator(low=-1.0, high=2.0, rate=50.0))
    u = record.u
    assert (u.min(), u.max()) == (-1.0, 2.0)
    assert u[:, 0].abs().max() <= 1.0  # 50 per s for one instant, from zero
    assert u.diff(dim=1).abs().max() <= 1.0 + 1e-12
    count = (u != record.u_wanted).sum(-1).double()
    torch.testing.assert_close(record.diagnostics["saturated_inputs"], count)
    f, b = spring().state_space()
    step = expm(np.block([[f, b], [np.zeros((2, 6))]]) * 0.02)
    x = torch.cat([record.q, record.v, u], -1)
    expected = x[:, :-1] @ torch.from_numpy(step.T)
    torch.testing.assert_close(x[:, 1:, :4], expected[..., :4], rtol=0, atol=1e-6)


def test_copies_at_rest_do_not_hide_the_error_of_one_that_moves_in_continuous_time():
    system = LinearSystem([[1.0]], [[0.0]], [[0.0]], [[1.0]])
    q0 = torch.zeros(5_000, 1, dtype=torch.float64)
    q0[0] = 1.0
    law, still = PD(size=1, k_p=100.0, k_d=1e-9), Wave(double([0.0]))
    record = close_loop_continuous(
        system, law, still, q0, 0 * q0, duration=1.0, samples_rate=10.0, rtol=1e-5
    )
    torch.testing.assert_close(record.q[0, :, 0], torch.cos(10 * record.t), rtol=0, atol=3e-3)


# What stops a copy, and only that one.


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


def test_a_copy_beyond_its_bound_is_stopped(undisturbed):
    bound = 1.02 * float(Q0[1].abs().max())
    runs = {"sampled": sampled(q_bound=bound, controller=PD(k_p=-300.0, k_d=0.0))}
    runs["continuous"] = close_loop_continuous(
        spring(),
        PD(k_p=-300.0, k_d=0.0),
        Wave(double([0.5, -1.0])),
        Q0,
        V0,
        duration=0.4,
        samples_rate=50.0,
        q_bound=bound,
    )
    for record in runs.values():
        assert all("|q| is beyond 1.02 at t = " in reason for reason in record.stopped)
        for q in record.q:
            kept = q.isfinite().all(-1)
            assert 0 < kept.sum() < 21
            assert (q[kept][:-1].abs() <= bound).all()


def test_the_loop_ends_when_all_copies_have_stopped():
    class Counted(SystemPlant):
        advanced = 0

        def advance(self, u, duration):
            self.advanced += 1
            return super().advance(u, duration)

    plant = Counted(spring())
    record = sampled(plant, PD(bad=lambda t, q: torch.tensor([t > 0.03, t > 0.05, t > 0.07])))
    assert plant.advanced == 4
    assert [reason[-4:] for reason in record.stopped] == ["04 s", "06 s", "08 s"]
    assert record.t.shape == (21,)
    assert record.q[:, 5:].isnan().all()


def test_ctrl_c_keeps_the_record_so_far(undisturbed):
    class Interrupted(PD):
        def __call__(self, t, q, v, reference):
            if t > 0.13:
                raise KeyboardInterrupt
            return super().__call__(t, q, v, reference)

    record = sampled(controller=Interrupted())
    assert record.stopped == ["interrupted at t = 0.14 s"] * 3
    assert record.t.shape == (8,)
    torch.testing.assert_close(record.q, undisturbed.q[:, :8])
    assert record.u.shape == record.reference.v.shape == (3, 8, 2)
    assert record.diagnostics["time"].shape == (3, 8)


@pytest.mark.slow
def test_a_copy_that_a_continuous_loop_loses_leaves_the_others_unharmed():
    still, law = Wave(double([0.0])), PD(size=1, k_p=1e-9, k_d=1e-9)
    q0, v0 = double([[0.0], [0.0], [0.1], [0.2], [0.3]]), double([[0.1], [3.0], [0], [-1], [0.4]])

    def run(q0, v0):
        return close_loop_continuous(
            Vanishing(), law, still, q0, v0, duration=0.4, samples_rate=50.0, q_bound=50.0
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


def test_a_fault_at_a_sample_ends_a_copy_of_a_continuous_loop():
    record = close_loop_continuous(
        spring(),
        PD(bad=lambda t, q: (torch.arange(3) == 1) & torch.tensor(t > 0.13)),
        Wave(double([0.5, -1.0])),
        Q0,
        V0,
        duration=0.4,
        samples_rate=50.0,
    )
    assert record.stopped == [None, "too far at t = 0.14 s", None]
    assert record.q[1, :8].isfinite().all()
    assert record.q[1, 8:].isnan().all()
    assert record.u[1, 7:].isnan().all()
    assert record.u[[0, 2]].isfinite().all()


def test_a_progress_bar_is_shown_only_with_a_label_and_on_a_terminal(capsys, monkeypatch):
    sampled()
    assert capsys.readouterr().err == ""
    sampled(progress="three springs")
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    sampled(progress="three springs")
    assert "three springs: 100%" in capsys.readouterr().err


# Bad arguments.


class OneInput(Controller):
    def __init__(self):
        super().__init__(2, 1)

    def __call__(self, t, q, v, reference):
        return q[:, :1]


class Wide(PD):
    def __call__(self, t, q, v, reference):
        return torch.zeros(3, 5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q0": Q0[:2]}, r"v0 has shape \(3, 2\), expected \(K, 2\)"),
        ({"q0": Q0[:, :1]}, r"q0 has shape \(3, 1\)"),
        ({"q0": Q0[0], "v0": V0[0]}, r"q0 has shape \(2,\)"),
        ({"v0": V0.float()}, "v0 is torch.float32, expected float64"),
        ({"q0": Q0 * torch.inf}, "q0 has"),
        ({"rate": 0.0}, "rate 0.0"),
        ({"duration": 0.41, "rate": 50.0}, "integer multiple of 0.02 s"),
        ({"controller": PD(size=3)}, "controller has 3 coordinates and the plant 2"),
        ({"controller": OneInput()}, "controller has 1 inputs and the plant 2"),
        ({"controller": Wide()}, r"input has shape \(3, 5\), expected \(3, 2\)"),
        ({"reference": Wave(double([1.0]))}, "reference has 1 coordinates and the plant 2"),
        ({"reference": Wave(Q0[:2])}, r"reference's q has shape \(2, 2\), expected \(2,\) or"),
        ({"delay": -1}, "samples is -1"),
        ({"delay": 1.5}, "samples is 1.5, expected a whole number"),
        ({"delay": 21}, "delay is 21 instants, and the run has 21"),
    ],
)
def test_bad_arguments_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        sampled(**changes)


def test_continuous_time_knows_no_rate_limit():
    with pytest.raises(ValueError, match=r"actuator has rate = 5.0.*use close_loop"):
        close_loop_continuous(
            spring(),
            PD(),
            Wave(double([0.0, 0.0])),
            Q0,
            V0,
            duration=1.0,
            samples_rate=10.0,
            actuator=Actuator(rate=5.0),
        )


def test_any_plant_will_do():
    class Still(Plant):
        num_coordinates = num_inputs = 2

        def start(self, q0, v0):
            self.q, self.v = q0, v0

        def advance(self, u, duration):
            return self.q, self.v

    record = sampled(Still())
    assert (record.q == Q0[:, None]).all()
