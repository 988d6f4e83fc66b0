"""A learned input delay: what it shifts, its gradient, what it finds, and where it is refused."""

from functools import partial

import pytest
import torch

from pinn_dyn.data.logs import SavitzkyGolayVelocity
from pinn_dyn.data.windows import draw_windows
from pinn_dyn.ensembles import Ensemble
from pinn_dyn.evaluation import predict_trajectories
from pinn_dyn.mechanics import RK4, Rosenbrock, Signal, Sum, Trajectory
from pinn_dyn.models import (
    AccelerationMLP,
    ConstantCholesky,
    ConstantInput,
    HamiltonianNetwork,
    LagrangianNetwork,
    LearnedDelay,
    NetworkPotential,
)
from pinn_dyn.testing import assert_near
from pinn_dyn.training.losses import IncrementLoss
from tests.models.builders import STEP, make_statistics, perturb
from tests.support.delayed_robots import log

PAST, AHEAD = 8, 6
CLOCK = STEP * torch.arange(-PAST, AHEAD + 1, dtype=torch.float64)
T = CLOCK[PAST:]


def make_model(kind="lnn", delay=None, integrator=None):
    torch.manual_seed(3)
    scales = make_statistics(2, 2)
    if kind == "acceleration":
        model = AccelerationMLP(scales, [6], integrator=integrator, delay=delay)
    else:
        network = {"lnn": LagrangianNetwork, "hnn": HamiltonianNetwork}[kind]
        model = network(
            scales,
            ConstantCholesky,
            partial(NetworkPotential, hidden=[6]),
            ConstantCholesky,
            ConstantInput,
            integrator=integrator,
            delay=delay,
        )
    return perturb(model.double())


def set_delay(model, seconds):
    with torch.no_grad():
        model.delay.share.fill_(seconds / model.delay.longest)
    return model


def start_and_input(interpolation="linear", batch=3):
    generator = torch.Generator().manual_seed(5)
    x0 = torch.randn(batch, 4, generator=generator, dtype=torch.float64)
    u = torch.randn(batch, len(CLOCK), 2, generator=generator, dtype=torch.float64)
    return x0, Signal(CLOCK, u, interpolation)


@pytest.mark.parametrize("kind", ["lnn", "hnn", "acceleration"])
@pytest.mark.parametrize("samples", [0, 1, 5])
def test_a_delay_of_whole_samples_is_the_input_of_so_many_samples_before(kind, samples):
    x0, signal = start_and_input()
    model = set_delay(make_model(kind, LearnedDelay(0.15)), samples * STEP)
    earlier = Signal(T, signal.u[:, PAST - samples : PAST - samples + len(T)])
    expected = set_delay(model, 0.0).increments(x0, T, earlier)
    actual = set_delay(model, samples * STEP).increments(x0, T, signal)
    assert_near(actual, expected, 1e-9)
    if samples:
        unshifted = set_delay(model, 0.0).increments(x0, T, signal)
        assert float((actual - unshifted).detach().abs().max()) > 1e-3


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize(
    "integrator", [RK4(), RK4(3), Rosenbrock(), Rosenbrock(2)], ids=["rk4", "3", "ros", "2"]
)
def test_the_gradient_is_that_of_finite_differences(interpolation, integrator):
    x0, signal = start_and_input(interpolation)
    model = make_model("lnn", LearnedDelay(0.15), integrator)

    def loss(seconds):
        return set_delay(model, seconds).increments(x0, T, signal).square().sum()

    at, h = 0.0437, 1e-6  # no stage at a sample, where lines have a corner
    (gradient,) = torch.autograd.grad(loss(at), model.delay.share)
    with torch.no_grad():
        difference = float(loss(at + h) - loss(at - h)) / (2 * h)
    assert abs(difference) > 1e-3
    assert float(gradient) / model.delay.longest == pytest.approx(difference, rel=1e-6)


def test_it_is_never_negative_nor_beyond_the_longest_and_comes_back():
    delay = LearnedDelay(0.1, initial=0.02)
    assert float(delay.seconds().detach()) == pytest.approx(0.02)
    optimizer = torch.optim.SGD(delay.parameters(), lr=1.0)
    for push in (10.0, -20.0, 10.0):  # down to 0, up to the longest, back
        optimizer.zero_grad()
        (push * delay.seconds()).backward()
        optimizer.step()
        assert 0 <= float(delay.seconds().detach()) <= delay.longest + 1e-8
    assert float(delay.seconds().detach()) == pytest.approx(0.02, abs=1e-6)


# On the log of a pendulum.


def pendulum_trajectory(delay=0.03, noise=0.0, seed=0, interpolation="linear"):
    ((recording,), _) = SavitzkyGolayVelocity().apply(log("pendulum", seed, delay, noise=noise))
    t, q, v, u = (
        torch.from_numpy(x.copy()) for x in (recording.t, recording.q, recording.v, recording.u)
    )
    return Trajectory(q, v, Signal(t, u, interpolation))


def pendulum_windows(*, steps, history, count, **options):
    return draw_windows(
        [pendulum_trajectory(**options)],
        count=count,
        steps=steps,
        stride=1,
        seed=0,
        history=history,
    )


def pendulum_model(scales, delay=None):
    torch.manual_seed(0)
    return LagrangianNetwork(
        scales,
        ConstantCholesky,
        partial(NetworkPotential, hidden=[16], activation="tanh"),
        ConstantCholesky,
        ConstantInput,
        angles=[0],
        delay=delay or LearnedDelay(0.1),
    )


def test_training_finds_the_delay_of_a_pendulum_from_zero():
    windows = pendulum_windows(steps=3, history=0.1, count=800).to(
        torch.device("cpu"), torch.float32
    )
    scales = windows.statistics()
    model = pendulum_model(scales).float()
    loss = IncrementLoss(scales, model)
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.01)
    generator = torch.Generator().manual_seed(0)
    assert model.learned_figures() == {"input_delay_seconds": 0.0}
    for _ in range(100):
        optimizer.zero_grad()
        loss(model, windows[torch.randint(800, (128,), generator=generator)]).backward()
        optimizer.step()
        assert model.learned_figures()["input_delay_seconds"] >= 0
    assert model.learned_figures()["input_delay_seconds"] == pytest.approx(0.03, abs=0.01)


def test_windows_keep_the_input_before_their_start():
    trajectory = pendulum_trajectory()
    windows = draw_windows([trajectory], count=400, steps=4, stride=2, seed=1, history=0.075)
    assert windows.past == 8
    assert windows.input.u.shape == (400, 8 + 8 + 1, 1)
    assert windows.u.shape == (400, 9, 1)
    assert_near(windows.input.t, 0.01 * torch.arange(-8, 9, dtype=torch.float64), 1e-12)
    for k in (0, 7, 399):
        start = int((trajectory.q == windows.q[k]).all(-1).nonzero()[0])
        samples = torch.arange(start - 8, start + 9).clamp(min=0)  # held before the first sample
        assert torch.equal(windows.input.u[k], trajectory.u[samples])
    short = windows.first(3)
    assert torch.equal(short.input.u, windows.input.u[:, :15])


def test_windows_of_held_inputs_are_refused_by_name():
    with pytest.raises(ValueError, match=r"interpolation is 'hold'.*InputDelay"):
        pendulum_trajectory(interpolation="hold").input.delayed(torch.tensor(0.01))


def test_rollouts_see_the_input_before_their_start():
    whole = pendulum_trajectory()
    model = set_delay(pendulum_model(make_scales(), LearnedDelay(0.1)), 0.05)
    cut = {name: getattr(whole, name)[None, 300:421] for name in ("q", "v")}
    signal = Signal(whole.t[300:421] - whole.t[300], whole.u[None, 300:421])
    known = Trajectory(**cut, input=signal, past=whole.u[None, 280:300])
    assert_near(known.since(0.1).input.u, whole.u[None, 290:421], 0)
    seen = predict_trajectories(model, known).q_hat
    # The same piece as a window of the whole, and one whose past is not known.
    again = predict_trajectories(
        model,
        Trajectory(
            whole.q[None, :1201], whole.v[None, :1201], whole.input.mapped(lambda u: u[None])
        ),
        window=1.0,
    )
    assert_near(seen[:, 1:101], again.q_hat[:, 301:401], 1e-9)
    held = predict_trajectories(model, Trajectory(**cut, input=signal)).q_hat
    assert float((held - seen).abs().max()) > 1e-3


def make_scales():
    return pendulum_windows(steps=1, history=0.0, count=100).statistics()


def test_sums_and_ensembles_refuse_it_by_name():
    model = make_model("lnn", LearnedDelay(0.1))
    with pytest.raises(ValueError, match=r"the part late of a sum learns a delay.*~late.delay"):
        Sum({"late": model, "other": make_model("lnn")})
    with pytest.raises(ValueError, match=r"model/delay=learned.*one by one"):
        Ensemble([model, make_model("lnn", LearnedDelay(0.1))])
