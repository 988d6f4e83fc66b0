"""Robots as Gymnasium environments, against predictions of the model and exact solutions."""

import warnings

import numpy as np
import pytest
import torch

import pinn_dyn
from pinn_dyn.control import SimulatorPlant
from pinn_dyn.data import DataSource, Splits
from pinn_dyn.mechanics import Signal, Trajectory, double_copy
from pinn_dyn.testing import LinearSystem, damped_oscillators, exact_solution
from tests.models.builders import VARIANTS, make_structured
from tests.support.closed_loops import Vanishing
from tests.support.known import known_model
from tests.support.simulated_arms import SPATIAL, simulated_by

gymnasium = pytest.importorskip("gymnasium", reason="the envs extra is not installed")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402

from pinn_dyn.envs import ModelPlant, RobotEnv, RobotVectorEnv  # noqa: E402


class Recorded(DataSource):
    """Three random trajectories of N coordinates and M inputs, 0.1 s between samples."""

    name = "recorded"

    def __init__(self, size, inputs):
        rng = torch.Generator().manual_seed(0)
        self.labels, self.input_labels = [f"q{k}" for k in range(size)], ["u"] * inputs
        t = 0.1 * torch.arange(20, dtype=torch.float64)
        q, v = 0.5 * torch.rand(2, 3, 20, size, generator=rng, dtype=torch.float64)
        u = torch.rand(3, 20, inputs, generator=rng, dtype=torch.float64) - 0.5
        self.items = [Trajectory(q[k], v[k], Signal(t, u[k])) for k in range(3)]

    def load(self):
        return Splits(self.items, self.items, self.items)


def oscillators(**settings):
    return RobotEnv(damped_oscillators(), data=Recorded(2, 1), duration=1.0, **settings)


@pytest.fixture(params=["lnn_run", "hnn_run"])
def run(request):
    return pinn_dyn.load(request.getfixturevalue(request.param))


def rolled_out(env, actions, seed=0):
    """The start and the states (q, v) after each action."""
    size = env.plant.num_coordinates
    observations = [env.reset(seed=seed)[0], *(env.step(u)[0] for u in actions)]
    return np.stack(observations)[:, : 2 * size]


def actions_of(env, count):
    env.action_space.seed(0)
    return np.stack([env.action_space.sample() for _ in range(count)])


def test_the_environments_keep_the_interface_of_gymnasium(lnn_run):
    """A learned robot by its registered name and folder, and a true one with its data."""
    learned = gymnasium.make("pinn_dyn.envs:pinn_dyn/Robot-v0", robot=str(lnn_run), duration=0.1)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(symmetric and normalized|minimum|maximum).*")
        for env in (learned.unwrapped, oscillators(), oscillators(reward=lambda q, v, u: 1.0)):
            check_env(env, skip_render_check=True)


def test_a_learned_robot_moves_as_its_model_predicts(run):
    env = RobotEnv(run, duration=1.0)
    assert env.dt == run.statistics.step
    actions = actions_of(env, 4)
    states = torch.from_numpy(rolled_out(env, actions))
    t = env.dt * torch.arange(5, dtype=torch.float64)
    held = torch.from_numpy(np.append(actions, actions[-1:], 0).astype(float))
    q, v = states[0].chunk(2)
    start = states[0] if run.model.state == "qv" else torch.cat([q, run.model.momentum(q, v)])
    expected = run.model.predict(start, t, Signal(t, held, "hold"))
    if run.model.state == "qp":
        q, p = expected.chunk(2, -1)
        expected = torch.cat([q, run.model.velocity(q, p)], -1)
    torch.testing.assert_close(states, expected, rtol=0, atol=1e-10)


def test_the_delay_of_the_data_shifts_the_inputs(lnn_run):
    """A delay of two steps: the robot moves as without the delay and with two zeros before."""
    run = pinn_dyn.load(lnn_run)
    env = RobotEnv(run)
    actions = actions_of(env, 5)
    limits = [9.0] * actions.shape[1]
    env = RobotEnv(run, u_low=[-x for x in limits], u_high=limits)
    expected = rolled_out(env, [*np.zeros((2, actions.shape[1])), *actions])
    run.config["dataset"]["delay"] = 2 * env.dt
    delayed = RobotEnv(run)
    states = rolled_out(delayed, [*actions, *actions[:2]])
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-10)


def test_a_true_robot_moves_as_the_exact_solution():
    env = oscillators(step=0.3)
    actions = actions_of(env, 3)
    states = rolled_out(env, actions)
    t, u = 0.3 * torch.arange(4), torch.from_numpy(np.append(actions, actions[-1:], 0))
    start = torch.from_numpy(states[0])
    expected = exact_solution(damped_oscillators(), start, t, u, "hold")
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-5)


def test_a_simulated_robot_is_moved_by_its_simulator():
    arm = simulated_by("MujocoArm")(SPATIAL)
    env = RobotEnv(SimulatorPlant(arm, step=0.01), data=Recorded(2, 2), step=0.02)
    (action,) = actions_of(env, 1)
    start, moved = rolled_out(env, [action])
    arm.set_state(*np.split(start, 2))
    steps = [arm.step(action, 0.01) for _ in range(2)]
    np.testing.assert_array_equal(moved, np.concatenate(steps[-1]))


def test_episodes_start_in_the_data_and_repeat_with_their_seed():
    env = oscillators()
    q, v = (torch.cat([getattr(x, k) for x in env_data()]) for k in "qv")
    starts = np.stack([env.reset(seed=seed)[0] for seed in (1, 2, 1)])
    assert (starts[0] == starts[2]).all()
    assert (starts[0] != starts[1]).any()
    for start in starts:
        state, goal = start[:4], start[4:]
        assert (np.abs(torch.cat([q, v], 1).numpy() - state).max(1) == 0).any()
        assert (np.abs(q.numpy() - goal).max(1) == 0).any()
    assert env.action_space.low == np.float32(min(x.u.min() for x in env_data()))


def env_data():
    return Recorded(2, 1).load().train


def test_reward_limits_and_end_of_an_episode():
    env, other = oscillators(), oscillators(reward=lambda q, v, u: q[0] + 10 * v[1] + 100 * u[0])
    env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(np.array([1e3]))
    assert reward == pytest.approx(-np.square(observation[:2] - observation[4:]).sum())
    assert info["distance"] >= 0
    assert not terminated
    assert not truncated
    other.reset(seed=0)
    q1, _, _, v2 = (seen := other.step(env.action_space.high))[0]
    np.testing.assert_array_equal(seen[0], observation[:4])  # the action was clipped
    assert seen[1] == pytest.approx(q1 + 10 * v2 + 100 * env.action_space.high[0])
    ends = [other.step(np.zeros(1))[3] for _ in range(9)]
    assert ends == [False] * 8 + [True]


def test_a_robot_that_diverges_gains_nothing():
    """Its mass vanishes at q = 1, which it reaches within a second; the goal is elsewhere."""
    env = RobotEnv(Vanishing(), data=Recorded(1, 1), duration=5.0, u_low=[0.0], u_high=[50.0])
    env.reset(seed=0)
    rewards, terminated = [], False
    while not terminated:
        observation, reward, terminated, truncated, _ = env.step(np.array([50.0]))
        rewards.append(reward)
        assert not truncated
    assert np.isfinite(observation).all()
    left = 50 - len(rewards) + 1
    assert rewards[-1] == pytest.approx(left * rewards[-2])


def moved(model, factor):
    model = double_copy(model)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(factor)
    return model


def draws_of(name):
    """Models of one class with different constants: of networks, or of a chain in C."""
    if name == "chain":
        model = known_model().double().eval().requires_grad_(False)
    else:
        settings = {**VARIANTS["constant-mass-fixed-damping-constant-input-3x3"]}
        model = make_structured(name, **settings).double().eval().requires_grad_(False)
    return [moved(model, factor) for factor in (0.0, 0.2, -0.1)]


@pytest.mark.parametrize("name", ["chain", "lnn", "hnn"])
@pytest.mark.parametrize("delay", [0.0, 0.003])
def test_robots_with_other_constants_move_as_their_own_models(name, delay):
    """Eleven robots of three models, two of which start again, beside some robots alone."""
    models = draws_of(name)
    n, m = models[0].num_coordinates, models[0].num_inputs
    settings = {"step": 0.005, "delay": torch.full((m,), delay).double()}
    rng = torch.Generator().manual_seed(1)
    q, v, u = (torch.rand(3, 11, size, generator=rng).double() - 0.5 for size in (n, n, m))
    chosen = (torch.arange(11) == 1) | (torch.arange(11) == 8)
    together = ModelPlant(models[0], draws=models, threads=2, **settings)
    together.start(q[0], v[0])
    found = [together.advance(u[0], 0.01)]
    together.restart(chosen, q[1][chosen], v[1][chosen])
    found += [together.advance(u[k], 0.01) for k in (1, 2)]
    for k in (0, 1, 5, 8, 9):
        alone = ModelPlant(models[k % 3], **settings)
        alone.start(q[0, k : k + 1], v[0, k : k + 1])
        expected = [alone.advance(u[0, k : k + 1], 0.01)]
        if chosen[k]:
            alone.start(q[1, k : k + 1], v[1, k : k + 1])
        expected += [alone.advance(u[j, k : k + 1], 0.01) for j in (1, 2)]
        for (a, b), (c, d) in zip(found, expected, strict=True):
            torch.testing.assert_close(a[k], c[0], rtol=0, atol=1e-10)
            torch.testing.assert_close(b[k], d[0], rtol=0, atol=1e-10)
    more = torch.cat([q[0], q[1]]), torch.cat([v[0], v[1]])
    together.start(*more)  # more copies than before
    found = together.advance(torch.cat([u[0], u[0]]), 0.01)
    last = len(more[0]) - 1
    alone = ModelPlant(models[last % 3], **settings)
    alone.start(more[0][last:], more[1][last:])
    expected = alone.advance(u[0, -1:], 0.01)
    torch.testing.assert_close(found[0][last], expected[0][0], rtol=0, atol=1e-10)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_episodes_of_a_vector_end_and_start_as_those_of_gymnasium(mode):
    """Against SyncVectorEnv: a robot restarts by mask, one diverges, also in its last step."""
    count, limits = 3, {"u_low": [-9.0], "u_high": [9.0]}
    settings = {"data": Recorded(2, 1), "step": 0.1, "duration": 0.4, **limits}

    def plant():
        return ModelPlant(damped_oscillators(), step=0.1)

    def single():
        env = RobotEnv(plant(), **settings)
        starts = tuple(x[:1] for x in env._robots._starts)
        env._robots._starts = starts  # all episodes have the same start and goal
        return env

    ours = RobotVectorEnv(plant(), count, autoreset=mode.value, **settings)
    ours._starts = tuple(x[:1] for x in ours._starts)
    theirs = SyncVectorEnv([single] * count, autoreset_mode=mode)
    np.testing.assert_array_equal(ours.reset()[0], theirs.reset()[0])
    ours.action_space.seed(0)
    ends = []
    for k in range(12):
        actions = ours.action_space.sample()
        if k in (3, 6):  # the last step of the first two episodes
            actions[1] = np.nan
        found, expected = ours.step(actions), theirs.step(actions)
        for a, b in zip(found[:4], expected[:4], strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
        ends.append(np.stack(found[2:4]))
        assert ("final_obs" in found[4]) == ("final_obs" in expected[4])
        if "final_obs" in found[4]:
            mask = found[4]["_final_obs"]
            np.testing.assert_array_equal(mask, expected[4]["_final_obs"])
            last = np.stack(list(expected[4]["final_obs"][mask]))
            np.testing.assert_allclose(found[4]["final_obs"][mask], last, rtol=0, atol=1e-12)
        is_over = ends[-1].any(0)
        mask = is_over if mode == AutoresetMode.DISABLED else np.zeros(count, dtype=bool)
        if mask.any():  # gymnasium refuses this step by an assertion
            with pytest.raises(gymnasium.error.ResetNeeded, match="have ended"):
                ours.step(actions)
        mask = mask | (np.arange(count) == 0) & (k == 1)
        if mask.any():
            started = [env.reset(options={"reset_mask": mask})[0] for env in (ours, theirs)]
            np.testing.assert_allclose(*started, rtol=0, atol=1e-12)
    assert (np.array(ends).all(1).sum(0) > [-1, 0, -1]).all()  # diverged in the last step
    assert ends[3].any(0).tolist() == [False, True, True]


def test_actions_and_masks_of_another_shape_are_refused():
    arm, settings = damped_oscillators(), {"data": Recorded(2, 2)}
    plant = ModelPlant(LinearSystem(*(torch.eye(2).tolist() for _ in range(4))), step=0.1)
    for env, shape in (
        (RobotEnv(arm, data=Recorded(2, 1)), (2,)),
        (RobotEnv(plant, **settings), (1,)),
        (RobotVectorEnv(plant, 3, **settings), (3, 1)),
        (RobotVectorEnv(plant, 3, **settings), (2,)),
    ):
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"action has the shape .*, expected"):
            env.step(np.zeros(shape))
    for mask in (np.zeros(3, dtype=bool), np.ones(2, dtype=bool), np.ones(3)):
        with pytest.raises(ValueError, match="reset_mask is"):
            env.reset(options={"reset_mask": mask})


def test_a_changed_model_counts_from_the_next_start_on():
    model = LinearSystem(*(torch.eye(2).tolist() for _ in range(4)))
    plant, u = ModelPlant(model, step=0.1), torch.ones(1, 2).double()

    def end(plant):
        plant.start(u, 0 * u)
        return plant.advance(3 * u, 1.0)[0]

    before = end(plant)
    for parameter in model.parameters():
        parameter.data[0, 0] *= 1.5
    assert torch.equal(end(plant), end(ModelPlant(model, step=0.1)))
    assert not torch.equal(end(plant), before)
