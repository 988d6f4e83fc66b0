"""Robots as environments for reinforcement learning, with the interface of Gymnasium."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.app.run import Run
from pinn_dyn.app.run_folder import load
from pinn_dyn.control import DataRegion, Plant, SystemPlant
from pinn_dyn.data import DataSource
from pinn_dyn.evaluation.prediction import model_for_rollouts
from pinn_dyn.mechanics import MechanicalSystem, Signal, double_copy
from pinn_dyn.mechanics.rollout import path_between

try:
    import gymnasium
except ImportError as error:
    text = "pinn_dyn.envs needs Gymnasium: pip install 'pinn_dyn[envs]'"
    raise ImportError(text) from error

Reward = Callable[[np.ndarray, np.ndarray, np.ndarray], float]
"""Reward of a step, from q and v after it, ``(N,)`` each, and the input ``(M,)``."""

_SAMPLES = 200  # states per trajectory


class ModelPlant(Plant):
    """K copies of a learned robot, integrated as in its training; inputs are zero before the start.

    Args:
        model: the learned system.
        step: longest step of the integration, s.
        delay: time between an input and its action, ``(M,)``, s; None for none.
    """

    def __init__(
        self, model: MechanicalSystem, *, step: PositiveFloat, delay: Tensor | None = None
    ):
        self.num_coordinates, self.num_inputs = model.num_coordinates, model.num_inputs
        self._model, self._step = model, step
        self._delay = torch.zeros(model.num_inputs) if delay is None else delay

    def start(self, q0: Tensor, v0: Tensor) -> None:
        p0 = v0 if self._model.state == "qv" else self._model.momentum(q0, v0)
        self._x = torch.cat([q0, p0], dim=-1)
        self._inputs = [q0.new_zeros(len(q0), self.num_inputs)]

    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        model = self._model
        longest = max(self._delay.tolist(), default=0.0)
        self._inputs = [*self._inputs, u][-(math.ceil(longest / duration) + 1) :]
        starts = duration * torch.arange(1 - len(self._inputs), 1, dtype=torch.float64)
        signal = Signal(starts, torch.stack(self._inputs, dim=1), "hold").delayed(self._delay)
        # Steps of the integration end where a delayed input changes.
        count = math.ceil(duration / self._step - 1e-6)
        times = torch.linspace(0.0, duration, count + 1, dtype=torch.float64)
        times = torch.cat([times, signal.t.clamp(0.0, duration)]).unique()
        with torch.no_grad():
            path = path_between(model, model.integrator, self._x, times, signal)
            self._x = self._x + path[:, -1]
            q, v = self._x.chunk(2, dim=-1)
            return q, v if model.state == "qv" else model.velocity(q, v)


class RobotEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    r"""A robot, learned or true, under inputs u ``(M,)`` that are held for a step.

    An episode starts in a state of the training data. The observation is (q, v, goal), ``(3N,)``,
    with the default reward -\|q - goal\|^2 and a goal from the training data. It is (q, v),
    ``(2N,)``, with another reward.

    A motion that diverges ends the episode (``terminated``) in its last finite state, with the
    reward of that state for all remaining steps, as if the robot stayed there.
    ``info["distance"]`` is the distance from the training data
    (:class:`~pinn_dyn.control.DataRegion`), 1 at the edge. Far beyond, a learned model is wrong.

    Args:
        robot: a run or its folder, a mechanical system, or a plant such as
            :class:`~pinn_dyn.control.SimulatorPlant`. A run is integrated as in its training, a
            mechanical system by an adaptive solver.
        data: training data of start states, goals and limits, as a data set or a run; None for
            those of the run.
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
        robot = load(robot) if isinstance(robot, (str, Path)) else robot
        data = robot if data is None and isinstance(robot, Run) else data
        if data is None:
            raise TypeError("a robot that is not a run needs training data: set data")
        source = data.source if isinstance(data, Run) else data
        train = source.load().train
        sample_time = float(train[0].t[1] - train[0].t[0])
        self.dt = step or (data.statistics.step if isinstance(data, Run) else sample_time)
        if isinstance(robot, Run):
            delay, step_of_training = torch.from_numpy(robot.input_delay), robot.statistics.step
            robot = ModelPlant(model_for_rollouts(robot.system), step=step_of_training, delay=delay)
        elif isinstance(robot, MechanicalSystem):
            robot = SystemPlant(double_copy(robot))
        self.plant = robot
        self.reward, self.steps = reward, max(1, round(duration / self.dt))
        q, v = (
            [x[:: max(1, len(x) // _SAMPLES)].double() for x in values]
            for values in ([item.q for item in train], [item.v for item in train])
        )
        self.region = DataRegion(q, v, angles=source.angles)
        self._q, self._v, u = torch.cat(q), torch.cat(v), torch.cat([item.u for item in train])
        limits = u.amin(0) if u_low is None else u_low, u.amax(0) if u_high is None else u_high
        low, high = (np.asarray(limit, dtype=np.float32) for limit in limits)
        self.action_space = gymnasium.spaces.Box(low, high)
        size = self._q.shape[1] * (3 if reward is None else 2)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in a drawn state of the training data."""
        super().reset(seed=seed)
        start, goal = self.np_random.integers(len(self._q), size=2)
        self._goal = self._q[goal].numpy()
        self._state = self._q[start : start + 1], self._v[start : start + 1]
        self.plant.start(*self._state)
        self._count = 0
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold an input ``(M,)``, clipped to its limits, for one step."""
        space = self.action_space
        u = np.clip(action, space.low, space.high).astype(float)
        state = self.plant.advance(torch.from_numpy(u)[None], self.dt)
        diverged = not bool(torch.cat(state).isfinite().all())
        self._state = self._state if diverged else state
        self._count += 1
        q, v = (x[0].numpy() for x in self._state)
        reward = -np.square(q - self._goal).sum() if self.reward is None else self.reward(q, v, u)
        if diverged:
            reward *= self.steps - self._count + 1
        is_over = self._count >= self.steps
        return self._observation(), float(reward), diverged, is_over, self._info()

    def _observation(self) -> np.ndarray:
        parts = [x[0].numpy() for x in self._state]
        return np.concatenate([*parts, self._goal] if self.reward is None else parts)

    def _info(self) -> dict[str, Any]:
        return {"distance": float(self.region.distance(*self._state))}


gymnasium.register("pinn_dyn/Robot-v0", entry_point="pinn_dyn.envs:RobotEnv")
