"""Robots as Gymnasium environments for reinforcement learning."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.control import DataRegion, Plant, SystemPlant
from pinn_dyn.data import DataSource
from pinn_dyn.evaluation.prediction import model_for_rollouts
from pinn_dyn.exports.c_loop import CLoop
from pinn_dyn.exports.compiled import Function
from pinn_dyn.exports.watch import Watch
from pinn_dyn.mechanics import MechanicalSystem, Signal, double_copy
from pinn_dyn.mechanics.rollout import path_between
from pinn_dyn.run.run import Run
from pinn_dyn.run.run_folder import load

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode
except ImportError as error:
    text = "pinn_dyn.envs needs Gymnasium: pip install 'pinn_dyn[envs]'"
    raise ImportError(text) from error

Reward = Callable[[np.ndarray, np.ndarray, np.ndarray], float]
"""Reward of a step, from q and v ``(N,)`` at its end, and the input ``(M,)``."""
Rewards = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Rewards ``(K,)`` of K robots, from q and v ``(K, N)`` at the end of a step, and u ``(K, M)``."""

_SAMPLES = 200  # states per trajectory


class ModelPlant(Plant):
    """K copies of a learned robot, integrated as in its training.

    Inputs are zero before the start. A loop in C is used when it pays off, see
    :class:`~pinn_dyn.exports.c_loop.CLoop`. Changes of the model have an effect at the next start.

    Args:
        model: the learned system.
        step: longest step of the integration, s.
        delay: dead time of the inputs, ``(M,)``, s; None for no dead time.
        draws: models of the same class with other constants: copy k is draw ``k % len(draws)``.
            None for copies of the model.
        threads: number of threads that share the copies.
    """

    def __init__(
        self,
        model: MechanicalSystem,
        *,
        step: PositiveFloat,
        delay: Tensor | None = None,
        draws: Sequence[MechanicalSystem] | None = None,
        threads: PositiveInt = 1,
    ):
        self.num_coordinates, self.num_inputs = model.num_coordinates, model.num_inputs
        self._originals = [*(draws or [model])]
        self._step, self._threads = step, threads
        self._delay = torch.zeros(model.num_inputs) if delay is None else delay
        self._longest = max(self._delay.tolist(), default=0.0)
        self._copy()

    def _copy(self) -> None:
        """Copy the models with their current numbers and attributes."""
        self._watch = Watch(*self._originals)
        self._models = [model_for_rollouts(x) for x in self._originals]
        self._model = self._models[0]
        self._loop: Function | None = None

    def start(self, q0: Tensor, v0: Tensor) -> None:
        if self._watch.changed():
            self._copy()
        self._x = torch.cat([q0, self._converted("momentum", q0, v0)], dim=-1)
        self._inputs = [q0.new_zeros(len(q0), self.num_inputs)]
        self._loop = self._ready()

    def restart(self, chosen: Tensor, q0: Tensor, v0: Tensor) -> None:
        """Set new states ``(k, N)`` of the chosen copies ``(K,)``. Inputs before are zero."""
        q, v = (x.clone() for x in self._motion())
        q[chosen], v[chosen] = q0, v0
        started = torch.cat([q, self._converted("momentum", q, v)], dim=-1)
        self._x = torch.where(chosen[:, None], started, self._x)
        self._inputs = [torch.where(chosen[:, None], 0.0, u) for u in self._inputs]

    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        count = math.ceil(duration / self._step - 1e-6)
        self._loop = self._loop or self._ready()
        if self._loop is None or self._longest > 0:
            self._inputs = [*self._inputs, u][-(math.ceil(self._longest / duration) + 1) :]
            self._x = self._x + self._path(duration, count)
        else:
            stages = len(self._model.integrator.nodes)
            inputs = u.view(len(self._x), 1, 1, self.num_inputs).expand(-1, count, stages, -1)
            lengths = self._x.new_full((count,), duration / count)
            zero = torch.zeros_like(self._x)
            self._x = self._x + self._loop(zero, self._x, inputs, lengths, self._threads)[:, -1]
        return self._motion()

    def _path(self, duration: float, count: int) -> Tensor:
        """Return the increments ``(K, 2N)`` after ``duration`` s under the latest inputs."""
        starts = duration * torch.arange(1 - len(self._inputs), 1, dtype=torch.float64)
        signal = Signal(starts, torch.stack(self._inputs, dim=1), "hold").delayed(self._delay)
        # Steps of the integration end at the times at which a delayed input changes.
        times = torch.linspace(0.0, duration, count + 1, dtype=torch.float64)
        times = torch.cat([times, signal.t.clamp(0.0, duration)]).unique()
        increments = torch.empty_like(self._x)
        with torch.no_grad():
            for k, model in enumerate(self._models[: len(self._x)]):
                rows = slice(k, None, len(self._models))
                part = signal.with_samples(signal.u[rows])
                path = path_between(model, model.integrator, self._x[rows], times, part)
                increments[rows] = path[:, -1]
        return increments

    def _motion(self) -> tuple[Tensor, Tensor]:
        q, second = self._x.chunk(2, dim=-1)
        return q, self._converted("velocity", q, second)

    def _converted(self, function: str, q: Tensor, second: Tensor) -> Tensor:
        """Return the momentum of v or the velocity of p, ``(K, N)``; v itself in states (q, v)."""
        if self._model.state == "qv":
            return second
        result = torch.empty_like(second)
        with torch.no_grad():
            for k, model in enumerate(self._models[: len(q)]):
                rows = slice(k, None, len(self._models))
                result[rows] = getattr(model, function)(q[rows], second[rows])
        return result

    def _ready(self) -> Function | None:
        if len(self._models) > 1:
            return None
        integrator = cast(CLoop, self._model.integrator)
        return integrator.ready(self._model, self._x, self._step)


class RobotEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    r"""A learned or true robot under inputs u ``(M,)`` that are held for a step.

    An episode starts in a state of the training data. With the default reward -\|q - goal\|^2, the
    goal is drawn from the training data, and the observation is (q, v, goal), ``(3N,)``. With any
    other reward, the observation is (q, v), ``(2N,)``.

    If the motion diverges, the episode ends (``terminated``) in the last finite state. The reward
    of this state is given for all remaining steps, as if the robot stayed there.
    ``info["distance"]`` is the distance from the training data
    (:class:`~pinn_dyn.control.DataRegion`), 1 at the edge. Far beyond the edge, a learned model is
    wrong.

    Args:
        robot: a run or its folder, a mechanical system, or a plant such as
            :class:`~pinn_dyn.control.SimulatorPlant`. A run is integrated as in its training, a
            mechanical system by an adaptive solver.
        data: training data for start states, goals and limits, as a data set or a run; None for
            the data of the run.
        reward: reward of a step; None for the distance to a goal.
        step: time between actions, s; None for the step of the training, or of the data.
        duration: length of an episode, s.
        u_low, u_high: limits of the inputs, ``(M,)``; None for the range of the training data.

    Raises:
        TypeError: if the model is not a mechanical system, or ``data`` is missing.
    """

    action_space: gymnasium.spaces.Box

    def __init__(
        self,
        robot: Run | MechanicalSystem | Plant | str | Path,
        *,
        data: Run | DataSource | None = None,
        reward: Reward | None = None,
        step: PositiveFloat | None = None,
        duration: PositiveFloat = 5.0,
        u_low: Sequence[float] | None = None,
        u_high: Sequence[float] | None = None,
    ):
        rewards: Rewards | None = None
        if reward is not None:
            rewards = lambda q, v, u: np.array([reward(q[0], v[0], u[0])])  # noqa: E731
        self._robots = RobotVectorEnv(
            robot,
            1,
            data=data,
            reward=rewards,
            step=step,
            duration=duration,
            u_low=u_low,
            u_high=u_high,
            autoreset=AutoresetMode.DISABLED,
        )
        self.plant, self.dt, self.steps = self._robots.plant, self._robots.dt, self._robots.steps
        self.action_space = self._robots.single_action_space
        self.observation_space = self._robots.single_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in a random state of the training data."""
        super().reset(seed=seed)
        self._robots.np_random = self.np_random
        observations, _ = self._robots.reset()
        return observations[0], self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold an input ``(M,)``, clipped to its limits, for a step."""
        seen, rewards, terminated, truncated, _ = self._robots.step(np.asarray(action)[None])
        return seen[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), self._info()

    def _info(self) -> dict[str, Any]:
        q, v = self._robots._q[0], self._robots._v[0]
        return {"distance": self._robots.region.distance_of_state(q, v)}


class RobotVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    r"""Gymnasium vector environment of K robots that are integrated together.

    Each robot has the observations, rewards and ends of episodes of :class:`RobotEnv`. Episodes end
    at different times. By default, a robot starts a new episode in the step after the last step of
    an episode. With ``AutoresetMode.SAME_STEP``, the robot starts in the same step, and
    ``infos["final_obs"]`` holds the last observation. With ``AutoresetMode.DISABLED``, the robot
    starts at a call of ``reset(options={"reset_mask": mask})``. ``distances()`` returns the
    distances from the training data.

    Args:
        robot: a run or its folder, or a :class:`ModelPlant`; for K = 1, any robot of
            :class:`RobotEnv`.
        num_envs: K.
        data, step, duration, u_low, u_high: see :class:`RobotEnv`.
        reward: rewards of a step for arrays of K robots; None for the distance to a goal.
        draws: models with other constants, such as ``run.sample`` returns: robot k is draw
            ``k % len(draws)``. Draws need a run. None for K copies of the model.
        threads: number of threads that share the robots of a run.
        autoreset: time at which a robot starts a new episode.

    Raises:
        TypeError: if the robot has another type, ``data`` is missing, or there are ``draws``
            without a run.
    """

    action_space: gymnasium.spaces.Box
    single_action_space: gymnasium.spaces.Box
    _is_over: np.ndarray

    def __init__(
        self,
        robot: Run | MechanicalSystem | Plant | str | Path,
        num_envs: PositiveInt,
        *,
        data: Run | DataSource | None = None,
        reward: Rewards | None = None,
        step: PositiveFloat | None = None,
        duration: PositiveFloat = 5.0,
        u_low: Sequence[float] | None = None,
        u_high: Sequence[float] | None = None,
        draws: Sequence[MechanicalSystem] | None = None,
        threads: PositiveInt = 1,
        autoreset: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        robot = load(robot) if isinstance(robot, (str, Path)) else robot
        if draws is not None and not isinstance(robot, Run):
            raise TypeError("draws need a run: pass the draws to the ModelPlant")
        data = robot if data is None and isinstance(robot, Run) else data
        if data is None:
            raise TypeError("the robot is not a run, so training data are missing: set data")
        source = data.source if isinstance(data, Run) else data
        train = source.load().train
        sample_time = float(train[0].t[1] - train[0].t[0])
        self.dt = step or (data.statistics.step if isinstance(data, Run) else sample_time)
        if isinstance(robot, Run):
            robot = ModelPlant(
                robot.system,
                step=robot.statistics.step,
                delay=torch.from_numpy(robot.input_delay),
                draws=draws,
                threads=threads,
            )
        elif isinstance(robot, MechanicalSystem):
            robot = SystemPlant(double_copy(robot))
        if num_envs > 1 and not isinstance(robot, ModelPlant):
            raise TypeError(
                "RobotVectorEnv needs a run or a ModelPlant: use gymnasium.make_vec for any other "
                "robot"
            )
        self.plant: Plant = robot
        self.num_envs, self.reward = num_envs, reward
        self.steps = max(1, round(duration / self.dt))
        strides = [max(1, len(item.q) // _SAMPLES) for item in train]
        q = [item.q[::stride].double() for item, stride in zip(train, strides, strict=True)]
        v = [item.v[::stride].double() for item, stride in zip(train, strides, strict=True)]
        self.region = DataRegion(q, v, angles=source.angles)
        self._starts = torch.cat(q).numpy(), torch.cat(v).numpy()
        u = torch.cat([item.u for item in train])
        low = np.asarray(u.amin(0) if u_low is None else u_low, dtype=np.float32)
        high = np.asarray(u.amax(0) if u_high is None else u_high, dtype=np.float32)
        self._ones = np.ones(q[0].shape[1])
        inputs = self.single_action_space = gymnasium.spaces.Box(low, high)
        size = (3 if reward is None else 2) * q[0].shape[1]
        observations = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)
        self.single_observation_space = observations
        spaces = gymnasium.vector.utils.batch_space(inputs, num_envs)
        self.action_space = cast(gymnasium.spaces.Box, spaces)
        self._low, self._high = (x.astype(float) for x in (low, high))
        self.observation_space = gymnasium.vector.utils.batch_space(observations, num_envs)
        self.metadata = {"autoreset_mode": AutoresetMode(autoreset)}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode of each robot in a random state of the training data.

        With ``options={"reset_mask": mask}``, only the robots in the mask ``(K,)`` start.
        """
        super().reset(seed=seed)
        mask = None if options is None else options.get("reset_mask")
        if mask is not None:
            if np.shape(mask) != (self.num_envs,) or mask.dtype != bool or not mask.any():
                raise ValueError(
                    f"reset_mask is {mask}, expected a bool array ({self.num_envs},) that is not "
                    "all False"
                )
            self._restart(mask)
            self._is_over = self._is_over & ~mask
            return self._observations(), {}
        self._q, self._v, self._goal = self._drawn(self.num_envs)
        self.plant.start(torch.from_numpy(self._q), torch.from_numpy(self._v))
        self._count = np.zeros(self.num_envs, dtype=int)
        self._is_over = np.zeros(self.num_envs, dtype=bool)
        return self._observations(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Hold inputs ``(K, M)``, clipped to their limits, for a step."""
        mode, ended = self.metadata["autoreset_mode"], self._is_over
        has_ended = np.count_nonzero(ended)  # faster than any()
        if has_ended and mode == AutoresetMode.DISABLED:
            raise gymnasium.error.ResetNeeded(
                f"the episodes of {ended.sum()} robots have ended: start them again by "
                'reset(options={"reset_mask": terminated | truncated})'
            )
        if np.shape(actions) != self.action_space.shape:
            raise ValueError(
                f"the action has the shape {np.shape(actions)}, expected {self.action_space.shape}"
            )
        u = np.minimum(np.maximum(actions, self._low), self._high)
        q, v = (x.numpy() for x in self.plant.advance(torch.from_numpy(u), self.dt))
        self._count += 1
        finite, diverged = np.isfinite(q + v), np.zeros(self.num_envs, dtype=bool)
        if np.count_nonzero(finite) < finite.size:
            diverged = ~finite.all(1) & ~ended
            q, v = (np.where(diverged[:, None], *x) for x in ((self._q, q), (self._v, v)))
        self._q, self._v = q, v
        if self.reward is None:
            rewards = -np.square(q - self._goal) @ self._ones
        else:
            rewards = self.reward(q, v, u)
        if np.count_nonzero(diverged):
            rewards = np.where(diverged, rewards * (self.steps - self._count + 1), rewards)
        if has_ended:
            rewards = np.where(ended, 0.0, rewards)
            self._restart(ended)
        truncated = self._count >= self.steps
        self._is_over = diverged | truncated
        infos: dict[str, Any] = {}
        if mode == AutoresetMode.SAME_STEP and self._is_over.any():
            infos = {"final_obs": self._observations(), "_final_obs": self._is_over}
            self._restart(self._is_over)
            self._is_over = np.zeros_like(diverged)
        return self._observations(), rewards, diverged, truncated, infos

    def distances(self) -> np.ndarray:
        """Return the distances ``(K,)`` of the states from the training data, 1 at the edge."""
        return self.region.distance(torch.from_numpy(self._q), torch.from_numpy(self._v)).numpy()

    def _restart(self, ended: np.ndarray) -> None:
        self._q, self._v = self._q.copy(), self._v.copy()  # views of states of the plant
        self._q[ended], self._v[ended], self._goal[ended] = self._drawn(int(ended.sum()))
        starts = (torch.from_numpy(x[ended]) for x in (self._q, self._v))
        if isinstance(self.plant, ModelPlant):
            self.plant.restart(torch.from_numpy(ended), *starts)
        else:  # a single robot
            self.plant.start(*starts)
        self._count[ended] = 0

    def _drawn(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, v and goals ``(count, N)`` of the training data."""
        q, v = self._starts
        start, goal = self.np_random.integers(len(q), size=(2, count))
        return q[start], v[start], q[goal]

    def _observations(self) -> np.ndarray:
        parts = [self._q, self._v, self._goal] if self.reward is None else [self._q, self._v]
        return np.concatenate(parts, axis=1)


gymnasium.register("pinn_dyn/Robot-v0", entry_point="pinn_dyn.envs:RobotEnv")
