"""The input between its samples, against NumPy and SciPy."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import CubicHermiteSpline

from pinn_dyn.mechanics import RK4, Signal
from pinn_dyn.mechanics.signal import stacked

KINDS = ("hold", "linear", "cubic")


def make_signal(kind, count=7, batch=(2,), size=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    u = torch.randn(*batch, count, size, generator=generator, dtype=torch.float64)
    t = (0.2 + torch.rand(count, generator=generator, dtype=torch.float64)).cumsum(0)
    return Signal(t, u, kind)


def expected_value(signal, time, side="right"):
    """By the definition, in NumPy; the end samples hold outside."""
    t, u = signal.t.numpy(), signal.u.numpy()
    inside = np.clip(time, t[0], t[-1])
    if signal.interpolation == "hold":
        index = np.searchsorted(t, time, side=side) - 1
        return u[..., np.clip(index, 0, len(t) - 1), :]
    if signal.interpolation == "linear" or len(t) == 1:
        flat = u.swapaxes(-1, -2).reshape(-1, len(t))
        values = np.array([np.interp(inside, t, row) for row in flat])
        return values.reshape(*u.shape[:-2], u.shape[-1])
    slopes = np.gradient(u, t, axis=-2, edge_order=2 if len(t) > 2 else 1)
    return CubicHermiteSpline(t, u, slopes, axis=-2)(inside)


@pytest.mark.parametrize("kind", KINDS)
def test_values_are_those_of_the_definition(kind):
    """At random times, at the samples, and beyond both ends."""
    for count in (1, 2, 7):
        signal = make_signal(kind, count)
        times = [*np.linspace(-0.3, float(signal.t[-1]) + 0.4, 12), *signal.t.tolist()]
        values = signal.at(torch.tensor(times, dtype=torch.float64)).numpy()
        for time, value in zip(times, values, strict=True):
            np.testing.assert_allclose(value, expected_value(signal, time), atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("kind", "count"), [("hold", 2), ("linear", 1), ("cubic", 2), *((kind, 7) for kind in KINDS)]
)
def test_the_stages_of_a_step_see_the_signal_from_within_it(kind, count):
    signal = make_signal(kind, count)
    grid = torch.linspace(-0.3, float(signal.t[-1]) + 0.4, 12, dtype=torch.float64)
    grid[5] = signal.t[-1]  # a step that ends at a sample
    grid = grid.sort().values
    found = signal.stages(grid, RK4.nodes)
    assert found.shape == (11, 4, 2, 3)
    for k in range(11):
        for stage, node in enumerate(RK4.nodes):
            side = "left" if node == 1 else "right"
            time = float(torch.lerp(grid[k], grid[k + 1], node))
            expected = expected_value(signal, time, side)
            np.testing.assert_allclose(found[k, stage], expected, atol=1e-10, rtol=0)


@pytest.mark.parametrize(
    ("kind", "count"), [("hold", 2), ("linear", 1), ("cubic", 2), *((kind, 9) for kind in KINDS)]
)
def test_means_over_steps_are_integrals_by_quadrature(kind, count):
    """Steps of many samples, within one, and beyond both ends."""
    signal = make_signal(kind, count, batch=(), size=1)
    grid = torch.linspace(-0.3, float(signal.t[-1]) + 0.4, 6, dtype=torch.float64)
    found = signal.means(grid)[:, 0]
    for k in range(5):
        start, end = float(grid[k]), float(grid[k + 1])
        knots = [float(t) for t in signal.t if start < t < end]
        edges = [start, *knots, end]
        area = sum(
            quad(lambda s: expected_value(signal, s)[0], a, b)[0]
            for a, b in itertools.pairwise(edges)
        )
        assert float(found[k]) == pytest.approx(area / (end - start), abs=1e-9)


def test_stacked_cubics_keep_their_rates():
    signals = [make_signal("cubic", count=9, seed=k).part(slice(2, 5)) for k in range(2)]
    t = torch.arange(3, dtype=torch.float64)
    both = stacked(signals, t)
    assert both.u.shape == (2, 2, 3, 3)
    for k, one in enumerate(signals):
        assert torch.equal(both.rate[k], one.rate)
    assert both.interpolation == "cubic"


@settings(max_examples=60, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    count=st.integers(2, 8),
    seed=st.integers(0, 1000),
    shift=st.floats(-100, 100),
    cut=st.integers(0, 6),
)
def test_shifts_parts_and_means_are_those_of_the_same_function(kind, count, seed, shift, cut):
    """u(t - d), a part, a stack and the means over adjacent steps agree with the signal itself."""
    signal = make_signal(kind, count, seed=seed)
    grid = torch.linspace(float(signal.t[0]), float(signal.t[-1]), 9, dtype=torch.float64)
    values = signal.at(grid)
    delayed = signal.since(torch.tensor(-shift, dtype=torch.float64))
    if kind != "hold":  # a held input jumps at a sample that a shift may round
        torch.testing.assert_close(delayed.at(grid + shift), values, rtol=0, atol=1e-9)
    torch.testing.assert_close(signal.at(signal.t), signal.u.movedim(-2, 0))
    part = signal.part(slice(min(cut, count - 2), None))
    inside = grid[grid >= part.t[0]]
    torch.testing.assert_close(part.at(inside), signal.at(inside), rtol=0, atol=1e-12)
    doubled = signal.mapped(lambda u: 2 * u)
    torch.testing.assert_close(doubled.at(grid), 2 * values)
    means, length = signal.means(grid), grid.diff()[:, None, None]
    whole = signal.means(grid[[0, -1]])[0]
    torch.testing.assert_close((means * length).sum(0), whole * (grid[-1] - grid[0]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"u": torch.zeros(5, 1)}, r"u has shape \(5, 1\), expected \(\*batch, 4, M\)"),
        ({"t": torch.tensor([0.0, 2.0, 1.0, 3.0])}, r"t\[1\] = 2.0 is followed by t\[2\] = 1.0"),
        ({"interpolation": "spline"}, "interpolation is 'spline', expected 'hold', 'linear'"),
    ],
)
def test_bad_input_is_refused_by_name(change, message):
    values = {"t": torch.arange(4.0), "u": torch.zeros(4, 1), "interpolation": "linear"} | change
    with pytest.raises(ValueError, match=message):
        Signal(**values)


@pytest.mark.parametrize("kind", ["hold", "linear"])
def test_each_input_is_delayed_by_its_own_time(kind):
    """One delay is a whole number of samples, so some of the shifted times coincide."""
    signal = make_signal(kind, 8, seed=1)
    step = float(signal.t[1] - signal.t[0])
    delays = torch.tensor([0.0, 2 * step, 0.7 * step, 0.3][: signal.num_inputs]).double()
    late = signal.delayed(delays)
    grid = torch.linspace(0.01, 1, 50).double() * (signal.t[-1] - signal.t[0]) + signal.t[0]
    for i, delay in enumerate(delays):
        expected = signal.at(grid - delay)[..., i]
        torch.testing.assert_close(late.at(grid)[..., i], expected, rtol=0, atol=1e-9)
