"""The region of the training data, and the guard of a law outside it."""

import logging

import numpy as np
import pytest
import torch

from pinn_dyn.control import Motion, Pipeline, SetPoint, SystemPlant, close_loop
from pinn_dyn.control.laws import Regulation
from pinn_dyn.control.region import DataRegion, Guarded
from pinn_dyn.testing import ControllerContract, LinearSystem
from pinn_dyn.testing.controller import states
from tests.support.contracts import one_case
from tests.support.linear import double

LOGGER = "pinn_dyn.control.closed_loop"


def comb(count=50):
    """Two trajectories at rest: q = 0, 2, 4, ... and q = 1, 3, 5, ...; each 1 from the other."""
    q = [torch.arange(2 * count, dtype=torch.float64)[k::2, None] for k in (0, 1)]
    return q, [torch.zeros_like(x) for x in q]


def loops(count, seed, size=2):
    """Slow random Fourier motions, sampled so often that neighbours in time almost coincide."""
    random = np.random.default_rng(seed)
    t = np.linspace(0, 20, 4000)
    amplitude, phase = (
        random.uniform(0.2, 0.6, (count, size, 3)),
        random.uniform(0, 2 * np.pi, (count, size, 3)),
    )
    rate = random.uniform(0.5, 2.0, (count, size, 3))
    angle = t[:, None, None] * rate[:, None] + phase[:, None]
    q = (amplitude[:, None] * np.sin(angle)).sum(-1)
    v = (amplitude[:, None] * rate[:, None] * np.cos(angle)).sum(-1)
    return torch.from_numpy(q), torch.from_numpy(v)


# The distance.


def test_the_distance_on_a_line_is_that_of_the_nearest_point_in_units_of_the_spacing():
    region = DataRegion(*comb())
    q = double([[0.0], [50.25], [60.5], [99.0], [102.0], [-7.5]])
    expected = double([0.0, 0.25, 0.5, 0.0, 3.0, 7.5])
    assert region.distance(q, 0 * q) == pytest.approx(expected, abs=1e-12)
    assert region.distance(q[4], q[4] * 0).shape == ()
    assert float(region.distance(q[4], q[4] * 0)) == pytest.approx(3.0)


def test_the_distance_is_euclidean_in_standard_deviations():
    """q and v alternate between -1 and 1, and -10 and 10: standard deviations 1 and 10."""
    q = [double([[-1.0], [1.0]]), double([[-1.0], [1.0]])]
    v = [double([[-10.0], [-10.0]]), double([[10.0], [10.0]])]
    region = DataRegion(q, v)
    assert region.radius == pytest.approx(2.0)  # from v = -10 to v = 10 at the same q
    distance = region.distance(double([1.0 + 3.0]), double([10.0 + 40.0]))
    assert float(distance) == pytest.approx(np.hypot(3.0, 4.0) / 2)


def test_new_trajectories_of_the_same_kind_are_inside_and_far_states_outside():
    region = DataRegion(*loops(40, seed=1))
    q, v = loops(10, seed=2)
    distance = region.distance(q[:, ::50], v[:, ::50])
    assert distance.shape == (10, 80)
    assert float((distance <= 1).double().mean()) > 0.97
    assert float(distance.quantile(0.9)) > 0.2  # else the edge would be far too wide
    assert bool((region.distance(q[:, ::50] + 20, v[:, ::50]) > 10).all())
    assert bool((region.distance(q[:, ::50], v[:, ::50] - 20) > 10).all())


def test_one_trajectory_is_cut_into_ten():
    """q = 0, 1 ... 999: a state of a piece is up to 50 from the next, at either end up to 100.

    So 990 of the 1000 distances are at most 95 and the next larger is 96.
    """
    q = torch.arange(1000, dtype=torch.float64)[:, None]
    region = DataRegion([q], [0 * q])
    assert float(region.distance(double([-95.01]), double([0.0]))) == pytest.approx(1)


def test_an_angle_may_wind_and_another_coordinate_may_not():
    q, v = loops(10, seed=1)
    turn = double([2 * np.pi, 0.0])
    region = DataRegion(q, v, angles=[0])
    inside = region.distance(q[:, ::50], v[:, ::50])
    assert region.distance(q[:, ::50] + 3 * turn, v[:, ::50]) == pytest.approx(inside, abs=1e-9)
    assert bool((region.distance(q[:, ::50] + turn.flip(0), v[:, ::50]) > 2).all())


@pytest.mark.parametrize("angles", [[], [0], [0, 1]])
def test_the_distance_of_one_state_is_that_of_the_search_tree(angles):
    """Near the data, on a state of the data, and far away."""
    q, v = loops(5, seed=1)
    region = DataRegion(q, v, angles=angles)
    rows = torch.cat([torch.stack(list(x)).flatten(0, 1)[::97] for x in (q, v)], dim=-1)
    rows = torch.cat([rows, rows + 0.3, 50 - 2 * rows])
    q, v = rows.chunk(2, dim=-1)
    found = [region.distance_of_state(*x) for x in zip(q.numpy(), v.numpy(), strict=True)]
    np.testing.assert_allclose(found, region.distance(q, v), rtol=1e-12, atol=1e-7)
    assert np.isnan(region.distance_of_state(np.array([np.nan, 0.0]), np.zeros(2)))


# The guard.


def spring():
    return LinearSystem([[1.0]], [[2.0]], [[0.1]], [[4.0]])


def guard(threshold=2.0):
    return Guarded(Regulation(spring(), 3.0, 1.0), DataRegion(*comb()), threshold=threshold)


MIXED = double([[10.0], [103.5], [100.5], [-9.0]])  # distances 0, 4.5, 1.5 and 9
REST = Motion(*(torch.zeros(1, dtype=torch.float64) for _ in range(3)))


def test_the_law_is_unchanged_and_the_distance_recorded():
    pipeline = Pipeline(guard())
    result = pipeline.call(MIXED, 0 * MIXED, REST, torch.zeros(4, pipeline.memory_size).double())
    assert result.u == pytest.approx(0.5 * MIXED - 12 * MIXED, rel=1e-12)  # 2 q / 4 - 4 * 3 q
    assert result.report["distance"] == pytest.approx(double([0.0, 4.5, 1.5, 9.0]))
    assert result.report["outside"].tolist() == [0, 1, 0, 1]
    assert result.status.tolist() == [0, 2, 0, 2]
    assert result.report["input_condition"].tolist() == [1, 1, 1, 1]


def test_one_warning_in_each_run(caplog):
    """Two of four copies start outside, at rest, and the law pulls them in."""
    for run in (1, 2):
        with caplog.at_level(logging.WARNING, LOGGER):
            close_loop(
                SystemPlant(spring()), guard(), SetPoint([5.0]), MIXED, 0 * MIXED, duration=0.1,
                rate=100,
            )  # fmt: skip
        assert len(caplog.messages) == run
    assert "t = 0 s: 2 of 4 states are outside" in caplog.messages[-1]
    assert "up to 9 (" in caplog.messages[-1]


@pytest.mark.parametrize("threshold", [1.0], ids=["both"])
@one_case
class TestGuarded(ControllerContract):
    @pytest.fixture
    def controller(self, threshold):
        system = LinearSystem(np.eye(2), np.eye(2), np.eye(2), [[1.0, 0.5], [0.0, 2.0]])
        q, v, _ = states(2, batch=60, seed=1)
        region = DataRegion(0.5 * q.unflatten(0, (6, 10)), 0.5 * v.unflatten(0, (6, 10)))
        return Guarded(Regulation(system, 2.0, 1.0), region, threshold=threshold)
