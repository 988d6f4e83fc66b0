"""Simulated data sets: what is combined, what is unseen, what the cache key knows."""

import pytest
import torch

from pinn_dyn.data import (
    InitialStates,
    Mixture,
    MultiSine,
    SimulatedSource,
    SimulationError,
    Steps,
)
from pinn_dyn.data.cache import cache_key
from pinn_dyn.mechanics import RK4, Signal
from pinn_dyn.mechanics.rollout import path_between
from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import LinearSystem

SINE = dict(offset=[0.0, 0.0, -1.15], amplitude=[1.2, 1.2, 0.1], frequency=[1.0, 4.0])
STEPS = dict(offset=[0.0, 0.0, -1.15], amplitude=[1.2, 1.2, 0.1], hold=[0.06, 0.1])
BOX = dict(q_low=[-1.0, -1.0, 0.1], q_high=[1.0, 1.0, 0.4], v_max=[1.0, 1.0, 0.1])


# Of tests that compare no motions, or with a far wider tolerance.
ROUGH = dict(rtol=1e-5, atol=1e-6)


def excitation(sine=None, steps=None):
    return Mixture(
        [
            MultiSine(**{**SINE, **(sine or {})}),
            Steps(**STEPS, **{"rise_time": 0.05, **(steps or {})}),
        ]
    )


def make_source(cache, **changes):
    arguments = dict(
        name="tiny_arm",
        system=SoftArm(),
        excitation=excitation(),
        initial_states=InitialStates(**BOX),
        duration=0.2,
        step=0.01,
        train_initial_states=3,
        train_inputs=2,
        validation=2,
        test=3,
        seed=0,
        rtol=1e-8,
        atol=1e-9,
        cache=str(cache),
        labels=["x", "y", "l"],
        input_labels=["a", "b", "c"],
        configurations={"bent": [0.8, 0.2, 0.3]},
    )
    return SimulatedSource(**{**arguments, **changes})


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def splits(cache):
    return make_source(cache).load()


def test_the_system_follows_the_recorded_input_after_the_dead_time(cache):
    prompt, late = (
        make_source(cache, excitation=MultiSine(**SINE), duration=0.4, dead_time=x).load().test[0]
        for x in (0.0, 0.03)
    )
    assert torch.equal(late.u, prompt.u)
    assert float((late.q - prompt.q).abs().max()) > 1e-3
    acting = Signal(late.t, torch.cat([late.u[:3], late.u[:-3]]), "cubic")
    a = (late.v[5:] - late.v[3:-2]) / 0.02  # at samples 4 to T - 2
    expected = SoftArm().forward_dynamics(late.q[4:-1], late.v[4:-1], acting.u[4:-1])
    prompt_a = SoftArm().forward_dynamics(late.q[4:-1], late.v[4:-1], late.u[4:-1])
    assert (a - expected).norm() < 0.2 * (a - prompt_a).norm()


def starts(trajectories):
    return {tuple(torch.cat([x.q[0], x.v[0]]).tolist()) for x in trajectories}


def inputs(trajectories):
    return {tuple(x.u.flatten().tolist()) for x in trajectories}


def test_training_combines_every_initial_state_with_every_input(splits):
    assert len(splits.train) == 6
    assert len(starts(splits.train)) == 3
    assert len(inputs(splits.train)) == 2
    pairs = {(*starts([x]), *inputs([x])) for x in splits.train}
    assert len(pairs) == 6


def test_matched_training_gives_each_state_an_input_of_its_own(cache):
    three = dict(train_initial_states=3, train_inputs=3, pairing="matched")
    source = make_source(cache, **three, **ROUGH)
    train = source.load().train
    assert len(train) == len(starts(train)) == len(inputs(train)) == 3


def test_a_lower_rate_keeps_every_nth_sample_of_one_simulation(cache, splits, monkeypatch):
    monkeypatch.setattr(SimulatedSource, "simulate", None)  # the cache has it
    slow = make_source(cache, keep_every=4).load()
    for name in ("train", "validation", "test"):
        for fast_one, slow_one in zip(getattr(splits, name), getattr(slow, name), strict=True):
            for key in ("t", "q", "v", "u"):
                assert torch.equal(getattr(slow_one, key), getattr(fast_one, key)[::4])


@pytest.mark.parametrize(("split", "count"), [("validation", 2), ("test", 3)])
def test_validation_and_test_have_states_and_inputs_of_their_own(splits, split, count):
    unseen = getattr(splits, split)
    others = [
        x
        for name in ("train", "validation", "test")
        if name != split
        for x in getattr(splits, name)
    ]
    assert len(unseen) == len(starts(unseen)) == len(inputs(unseen)) == count
    assert not starts(unseen) & starts(others)
    assert not inputs(unseen) & inputs(others)
    # No coordinate of a start and no single input signal is shared either.
    for x in unseen:
        for y in others:
            assert (x.q[0] != y.q[0]).all()
            assert (x.u != y.u).any(0).all()


# Limits of the configuration.

LIMITS = [[-1.05, -1.05, 0.08], [1.05, 1.05, 0.42]]
SIX = dict(train_initial_states=6, train_inputs=6, pairing="matched", **ROUGH)


@pytest.fixture(scope="module")
def free(cache):
    return make_source(cache, **SIX).load()


@pytest.fixture(scope="module")
def limited(cache):
    return make_source(cache, **SIX, q_limits=LIMITS).load()


def stays(x):
    low, high = torch.tensor(LIMITS, dtype=torch.float64)
    return bool(((x.q >= low) & (x.q <= high)).all())


def test_a_motion_that_leaves_the_limits_is_drawn_anew_and_the_others_are_kept(free, limited):
    replaced = 0
    for name in ("train", "validation", "test"):
        for x, y in zip(getattr(free, name), getattr(limited, name), strict=True):
            assert stays(y)
            same = torch.equal(x.u, y.u) and torch.equal(x.q[0], y.q[0])
            assert same == stays(x)
            replaced += not same
    assert 0 < replaced < 11


def test_motions_within_limits_obey_the_equation_of_motion(limited):
    """From their own starts under their own inputs, by steps of fixed length."""
    motions = [*limited.train, *limited.validation, *limited.test]
    start, u, q = (
        torch.stack([part(x) for x in motions])
        for part in (lambda x: torch.cat([x.q[0], x.v[0]]), lambda x: x.u, lambda x: x.q)
    )
    t = motions[0].t
    path = path_between(SoftArm(), RK4(substeps=2), start, t, Signal(t, u))
    found = start[:, None, :3] + path[..., :3]
    # Linear in place of the smooth input between samples 0.01 s apart.
    torch.testing.assert_close(q, found, rtol=0, atol=0.01)


def test_limits_that_every_motion_leaves_are_refused(tmp_path):
    narrow = dict(q_limits=[[-4, -4, 0.2499], [4, 4, 0.2501]])
    box = InitialStates([-1.0, -1.0, 0.25], [1.0, 1.0, 0.25], [1.0, 1.0, 0.1])
    source = make_source(tmp_path, **SIX, **narrow, initial_states=box, duration=0.05)
    with pytest.raises(SimulationError, match=r"motions leave q_limits of l in each"):
        source.load()
    assert not list(tmp_path.glob("*.npz"))


class Oscillator(SoftArm):
    """An arm whose length may pass through zero: constant terms, of a mass on a spring."""

    def _acceleration(self, q, v, force):
        return 100 * (force - q)


def test_a_motion_out_of_the_systems_domain_is_refused_with_advice(tmp_path):
    source = make_source(tmp_path, system=Oscillator())
    with pytest.raises(ValueError, match="segment 1 shortens"):
        source.load()


# The cache.


def test_a_second_load_does_not_simulate(cache, splits, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("simulated again")

    monkeypatch.setattr("pinn_dyn.data.simulated.simulate", refuse)
    again = make_source(cache).load()
    for name in ("train", "validation", "test"):
        for x, y in zip(getattr(splits, name), getattr(again, name), strict=True):
            for key in ("t", "q", "v", "u"):
                assert torch.equal(getattr(x, key), getattr(y, key))


CHANGES = {
    "mass": lambda: dict(system=SoftArm(mass=0.31)),
    "seed": lambda: dict(seed=1),
    "rtol": lambda: dict(rtol=1e-7),
    "step": lambda: dict(step=0.02),
    "train_initial_states": lambda: dict(train_initial_states=2, train_inputs=3),
    "amplitude": lambda: dict(excitation=excitation(sine={"amplitude": [1.2, 1.3, 0.1]})),
    "kind": lambda: dict(excitation=MultiSine(**SINE)),
    "limits": lambda: dict(**SIX, q_limits=LIMITS),
    "q_low": lambda: dict(initial_states=InitialStates(**{**BOX, "q_low": [-1.0, -1.0, 0.2]})),
}


def test_each_change_of_the_data_is_another_entry_of_the_cache(tmp_path):
    sources = [make_source(tmp_path, **change()) for change in CHANGES.values()]
    keys = {cache_key(source.describe()) for source in [make_source(tmp_path), *sources]}
    assert len(keys) == len(CHANGES) + 1


def test_settings_beside_the_data_leave_the_entry(tmp_path):
    changed = make_source("/elsewhere", labels=["a", "b", "c"], configurations={})
    assert changed.describe() == make_source(tmp_path).describe()


GRAVITY = 1.0


class Ball(LinearSystem):
    """A system that reads an attribute of its class, a global number and another function."""

    gravity = 1.0

    def _potential_force(self, q):
        return super()._potential_force(q) + self.gravity * GRAVITY * self.law(q)

    @staticmethod
    def law(q):
        return torch.sin(q)


class Scaled(MultiSine):
    """An excitation with a number that is no setting."""

    factor = 1.0

    def draw(self, count, duration, rng):
        signal = super().draw(count, duration, rng)
        return lambda times: self.factor * signal(times)


PRESENT = {
    "global": lambda patch: patch.setitem(Ball._potential_force.__globals__, "GRAVITY", 2.0),
    "class": lambda patch: patch.setattr(Ball, "gravity", 2.0),
    "function": lambda patch: patch.setattr(Ball, "law", staticmethod(torch.cos)),
    "excitation": lambda patch: patch.setattr(Scaled, "factor", 2.0),
    "nothing": lambda patch: patch.setattr(Ball, "__doc__", "A ball."),
}


@pytest.mark.parametrize("change", PRESENT)
def test_a_recording_of_other_code_is_made_again_with_a_message(
    tmp_path, monkeypatch, caplog, change
):
    def load(folder):
        return make_source(
            folder,
            system=Ball([[1.0]], [[4.0]], [[0.1]], [[1.0]]).double().requires_grad_(False),
            excitation=Scaled([0.0], [1.0], frequency=[1.0, 4.0]),
            initial_states=InitialStates([-1.0], [1.0], [0.1]),
            labels=["q"],
            input_labels=["u"],
            configurations={},
        ).load()

    before = load(tmp_path).train[0].q
    PRESENT[change](monkeypatch)
    found, expected = load(tmp_path).train[0].q, load(tmp_path / "other").train[0].q
    assert torch.equal(found, expected)
    is_same = change == "nothing"
    assert torch.equal(found, before) == is_same
    assert ("made again" in caplog.text) == (not is_same)
    caplog.clear()
    load(tmp_path)
    assert "made again" not in caplog.text
