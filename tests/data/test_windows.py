"""Windows, and the data module that serves them in batches."""

import dataclasses

import numpy as np
import pytest
import scipy
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from pinn_dyn.data import DataSource, DynamicsData, LightningData, Splits, draw_windows
from pinn_dyn.mechanics import Signal, Trajectory
from tests.support.cart_pole import CartPole

STEP = 0.01


def make_trajectory(seed, samples=40, step=STEP, interpolation="linear", **extra):
    """Random samples, so that every one of them is recognized by its value."""
    generator = torch.Generator().manual_seed(seed)
    q, v, u = (
        torch.randn(samples, size, generator=generator, dtype=torch.float64) for size in (2, 2, 1)
    )
    t = torch.arange(samples, dtype=torch.float64) * step
    return Trajectory(q, v, Signal(t, u, interpolation), **extra)


def draw(trajectories, **changes):
    return draw_windows(
        trajectories, **{"count": 30, "steps": 2, "stride": 3, "seed": 0, **changes}
    )


def origin(trajectories, windows):
    """Which trajectory and sample each window starts at, found by its configuration."""
    found = []
    for q in windows.q:
        (hit,) = [
            (number, int(k))
            for number, item in enumerate(trajectories)
            for k in (item.q == q).all(-1).nonzero()
        ]
        found.append(hit)
    return found


@pytest.fixture
def trajectories():
    return [make_trajectory(0), make_trajectory(1, samples=25), make_trajectory(2)]


@given(
    lengths=st.lists(st.integers(20, 40), min_size=1, max_size=3),
    steps=st.integers(1, 4),
    stride=st.integers(1, 3),
    past=st.integers(0, 4),
    coverage=st.sampled_from([0.0, 0.7]),
    interpolation=st.sampled_from(["hold", "linear", "cubic"]),
    seed=st.integers(0, 3),
)
@settings(max_examples=60, deadline=None)
def test_windows_are_distinct_slices_of_their_trajectories(
    lengths, steps, stride, past, coverage, interpolation, seed
):
    items = [make_trajectory(k, n, interpolation=interpolation) for k, n in enumerate(lengths)]
    span = steps * stride
    count = sum(n - span for n in lengths)
    windows = draw(
        items,
        count=count,
        steps=steps,
        stride=stride,
        seed=seed,
        coverage=coverage,
        history=past * STEP,
    )
    starts = origin(items, windows)
    assert len({*starts}) == len(windows) == count  # all starts, each once
    # The windows themselves, a batch of them, and the windows that a curriculum cuts short.
    index = torch.arange(count).flip(0)[: max(count // 2, 1)]
    for part, origins, length in (
        (windows, starts, steps),
        (next(windows[index[None]].unbind()), [starts[k] for k in index], steps),
        (windows.first(1), starts, 1),
    ):
        assert part.past == past
        assert part.input.interpolation == interpolation
        torch.testing.assert_close(part.t, STEP * stride * torch.arange(length + 1).double())
        assert float(part.input.t[past]) == 0
        assert len(part.input.t) == past + length * stride + 1
        for row, (number, k) in enumerate(origins):
            item, knots = items[number], slice(k + stride, k + length * stride + 1, stride)
            assert torch.equal(part.v[row], item.v[k])
            assert torch.equal(part.dq[row], item.q[knots] - item.q[k])
            assert torch.equal(part.dv[row], item.v[knots] - item.v[k])
            samples = torch.arange(k - past, k + length * stride + 1).clamp(min=0)
            assert torch.equal(part.input.u[row], item.u[samples])
            steps_back = (k - stride * torch.arange(1, past // stride + 1)).clamp(min=0)
            assert torch.equal(part.past_q[row], item.q[steps_back])
            start = torch.cat([item.q[k], item.v[k], item.q[steps_back].flatten()])
            assert torch.equal(part.start("qv", past // stride)[row], start)
            assert torch.equal(part.u[row], item.u[k : k + length * stride + 1])


def with_momenta(trajectories, system):
    return [dataclasses.replace(item, momentum=system.momentum) for item in trajectories]


def test_momenta_come_from_the_mass_matrix_at_the_start_and_at_every_step(trajectories):
    system = CartPole().requires_grad_(False)
    windows = draw(with_momenta(trajectories, system))

    def momentum(q, v):
        return (system.mass_matrix(q) @ v.unsqueeze(-1)).squeeze(-1)

    start = momentum(windows.q, windows.v)
    q = windows.q[:, None] + windows.dq
    v = windows.v[:, None] + windows.dv
    torch.testing.assert_close(windows.p, start, rtol=0, atol=1e-12)
    torch.testing.assert_close(windows.dp, momentum(q, v) - start[:, None], rtol=0, atol=1e-12)


def test_increments_stay_precise_in_single_precision():
    """Increments of 1e-6 on states near 1: subtracted in float32 they would be 6 % off."""
    t = torch.arange(40, dtype=torch.float64) * STEP
    q = 1 + 1e-6 * torch.sin(t)[:, None].repeat(1, 2)
    slow = Trajectory(q, q, Signal(t, torch.zeros(40, 1, dtype=torch.float64)))
    windows = draw([slow])
    single = windows.to(torch.device("cpu"), torch.float32)
    assert single.dq.dtype == single.q.dtype == single.t.dtype == torch.float32
    torch.testing.assert_close(single.dq.double(), windows.dq, rtol=1e-6, atol=0)
    torch.testing.assert_close(single.dv.double(), windows.dv, rtol=1e-6, atol=0)


def test_statistics_are_those_of_the_windows(trajectories):
    system = CartPole().requires_grad_(False)
    windows = draw(with_momenta(trajectories, system))
    statistics = windows.statistics()
    expected = {
        "q_mean": windows.q.mean(0),
        "q_std": windows.q.std(0, correction=0),
        "q_low": windows.q.min(0).values,
        "q_high": windows.q.max(0).values,
        "v_std": windows.v.std(0, correction=0),
        "p_std": windows.p.std(0, correction=0),
        "u_mean": windows.u.reshape(-1, 1).mean(0),
        "u_std": windows.u.reshape(-1, 1).std(0, correction=0),
        "qv_increment_std": torch.cat([windows.dq, windows.dv], -1).std(0, correction=0),
        "qp_increment_std": torch.cat([windows.dq, windows.dp], -1).std(0, correction=0),
    }
    for name, value in expected.items():
        torch.testing.assert_close(getattr(statistics, name), value, rtol=1e-12, atol=0)
    assert statistics.step == pytest.approx(3 * STEP)


@pytest.mark.parametrize("where", ["within", "between"])
def test_a_clock_that_is_not_uniform_is_refused(trajectories, where):
    odd = make_trajectory(3, step=0.02)
    if where == "within":
        t = trajectories[1].t.clone()
        t[7:] += 0.001
        odd = Trajectory(trajectories[1].q, trajectories[1].v, Signal(t, trajectories[1].u))
    with pytest.raises(ValueError, match="training trajectory 1 has sample times"):
        draw([trajectories[0], odd])


# The data module.


class Stored(DataSource):
    """Trajectories in memory; counts how often they are asked for."""

    name = "stored"
    labels = ("x", "y")
    input_labels = ("u",)
    system = None
    configurations = {}  # noqa: RUF012

    def __init__(self):
        self.loads = 0
        self.splits = Splits(
            [make_trajectory(k) for k in range(3)],
            [make_trajectory(k) for k in (10, 11)],
            [make_trajectory(k) for k in (20, 21)],
        )

    def load(self):
        self.loads += 1
        return self.splits


def make_data(**changes):
    arguments = dict(pairs=90, steps=2, stride=3, batch_size=16, batches_per_epoch=9, seed=0)
    return DynamicsData(Stored(), **{**arguments, **changes})


def test_batches_are_picked_on_the_device_that_trains():
    """The windows are moved once; a batch is where they are."""
    data = LightningData(make_data())

    class Strategy:
        root_device = torch.device("meta")

    class Trainer:
        strategy, global_rank, world_size = Strategy(), 0, 1

    data.trainer = Trainer()
    loader = data.train_dataloader()
    assert loader.windows.q.device.type == "meta"
    batch = next(iter(loader))
    assert batch.q.device.type == "meta"
    assert batch.q.shape == (16, 2)


def test_windows_come_from_training_trajectories_alone():
    data = make_data()
    splits = data.source.splits
    found = origin([*splits.train, *splits.validation, *splits.test], data.windows)
    assert {number for number, _ in found} == {0, 1, 2}
    served = torch.cat([batch.q for batch in LightningData(data).train_dataloader()])
    train = torch.cat([x.q for x in splits.train]).float()
    assert (served[:, None] == train).all(-1).any(-1).all()


def test_validation_is_one_batch_of_whole_trajectories():
    data = make_data()
    (batch,) = LightningData(data).val_dataloader()
    assert torch.equal(batch.q, torch.stack([x.q for x in data.source.splits.validation]))
    assert batch.q.shape == (2, 40, 2)


def test_all_pairs_are_all_starts_once():
    data = make_data(pairs="all")
    assert len(data.windows) == 102
    assert len(torch.unique(data.windows.q, dim=0)) == 102
    single = make_data(pairs="all", batch_size=200)
    assert len(single.windows) == single.batch_size == 102


@pytest.mark.parametrize(("samples", "count"), [(40, 102), (700, 350), (2000, 600)])
def test_automatic_pairs_cover_the_motions_once(samples, count):
    """Between 150 and 600 windows of six samples, or all of a short log, whatever the seed."""
    runs = [make_trajectory(k, samples=samples) for k in range(3)]
    both = [make_data(pairs="auto", batch_size=128, seed=seed) for seed in (0, 1)]
    for data in both:
        data.source.splits = Splits(runs, runs[:1], runs[:1])
    first, second = (data.windows for data in both)
    assert len(first) == count
    assert torch.equal(first.q, second.q)
    numbers = [samples * run + k for run, k in origin(runs, first)]
    gaps = np.diff(numbers)
    assert gaps.max() <= 3 * samples / count + 7  # the last six samples of a run start no window
    assert gaps.min() >= int(3 * (samples - 6) / count)


def test_a_stride_in_time_is_the_same_at_any_rate():
    assert torch.equal(make_data(stride=f"{3e3 * STEP:g} ms").windows.t, make_data().windows.t)
    with pytest.raises(ValueError, match=r"stride is 0.001 s and the sample time"):
        make_data(stride="1ms").windows  # noqa: B018
    with pytest.raises(ValueError, match=r"stride is '3 samples', expected .* such as '20 ms'"):
        make_data(stride="3 samples").windows  # noqa: B018


@pytest.mark.parametrize("rate", [40, 1000])
@pytest.mark.parametrize(("fastest", "step"), [(1.5, 0.1), (8.0, 0.02)])
def test_an_automatic_stride_is_a_tenth_of_a_period_at_any_rate(rate, fastest, step):
    """In round times: 66.7, 33.3 and 12.5 ms."""
    t = torch.arange(20 * rate, dtype=torch.float64) / rate
    q = (2 * torch.pi * t[:, None] * torch.tensor([0.3, fastest])).sin()
    white = torch.randn(q.shape, generator=torch.Generator().manual_seed(0)).double()
    data = make_data(stride="auto")
    data.splits = dataclasses.replace(data.splits, train=[Trajectory(q, q, Signal(t, white))])
    assert data.step == pytest.approx(step, abs=0.3 / rate)


def automatic_step(q, u, step):
    data = make_data(stride="auto")
    t = step * torch.arange(len(q), dtype=torch.float64)
    item = Trajectory(torch.from_numpy(q), torch.from_numpy(q), Signal(t, torch.from_numpy(u)))
    data.splits = dataclasses.replace(data.splits, train=[item])
    return data.step


@pytest.mark.parametrize("noise", [0.0, 0.03])
@pytest.mark.parametrize("hold", [1, 8])
@pytest.mark.parametrize(("fastest", "step"), [(1.5, 0.1), (3.0, 0.05)])
def test_an_automatic_stride_ignores_noise_and_held_inputs(fastest, step, hold, noise):
    rng, t = np.random.default_rng(0), np.arange(6000) / 100
    waves = np.linspace(0.1, fastest, 8)[:, None]
    u = np.sin(2 * np.pi * t[:, None, None] * waves + rng.uniform(0, 6, (8, 2))).sum(axis=1)
    q = u + 0.1 * u**2
    q = q + noise * q.std(axis=0) * rng.normal(size=q.shape)
    assert automatic_step(q, u[np.arange(6000) // hold * hold], 0.01) == pytest.approx(step)


def test_commands_that_jump_leave_the_step_to_the_motion():
    """Random positions, each held for 2 s, move an oscillator of 2 Hz."""
    u = np.random.default_rng(0).normal(size=(30, 1)).repeat(200, axis=0)
    w = 2 * np.pi * 2.0
    q = scipy.signal.lsim(([w**2], [1, 0.4 * w, w**2]), u[:, 0], np.arange(6000) / 100)[1]
    assert automatic_step(q[:, None], u, 0.01) == pytest.approx(0.05)


def slow_in_the_middle(samples=60_000):
    """q = s^3 over s = -1 to 1: the density of the samples, ~ |q|^(-2/3), peaks at q = 0."""
    s = torch.linspace(-1, 1, samples, dtype=torch.float64).unsqueeze(-1)
    return Trajectory(s**3, 0 * s, Signal(torch.arange(samples, dtype=torch.float64) * STEP, 0 * s))


def test_coverage_draws_starts_evenly_over_the_configurations():
    trajectory = slow_in_the_middle()
    q = {
        c: draw([trajectory], count=3000, steps=1, stride=1, coverage=c).q.flatten().numpy()
        for c in (0.0, 0.5, 1.0)
    }
    # Largest distance to the distribution function of the uniform density on -1 to 1.
    distance = {c: kstest(value, "uniform", args=(-1, 2)).statistic for c, value in q.items()}
    # It is |a^(1/3) - a| / 2 at q = a without coverage, largest where a^(2/3) = 1/3.
    assert distance[0.0] == pytest.approx(27**-0.5, abs=0.03)
    assert distance[1.0] < 0.06
    assert distance[1.0] < distance[0.5] < distance[0.0]


def test_coverage_counts_the_coordinates():
    """The density of two independent coordinates is the square of that of the distance."""
    s = 2 * torch.rand(60_000, 2, generator=torch.Generator().manual_seed(0)).double() - 1
    t = torch.arange(len(s), dtype=torch.float64) * STEP
    windows = draw(
        [Trajectory(s**3, 0 * s, Signal(t, s))], count=3000, steps=1, stride=1, coverage=1.0
    )
    for value in windows.q.T.numpy():
        assert kstest(value, "uniform", args=(-1, 2)).statistic < 0.06
