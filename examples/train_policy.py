"""Train a policy on an identified robot with Stable-Baselines3, and try it on the true robot.

python examples/train_policy.py [--steps 200000]       pip install stable-baselines3

The robot is a double pendulum of 1.5 times the masses of its URDF. PPO learns in 64 robots with
constants drawn from the identification. The reward of an episode of 2 s is -|q - goal|^2 for every
step of 20 ms.
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

import pinn_dyn
from pinn_dyn.envs import RobotEnv, RobotVectorEnv
from pinn_dyn.models import KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=200_000, help="steps of all robots together")
parser.add_argument("--robots", type=int, default=64)
args = parser.parse_args()
torch.set_num_threads(1)
urdf = str(Path(__file__).with_name("double_pendulum.urdf"))
arm, true_arm = RigidChain(urdf), RigidChain(urdf, mass_scale=1.5)

# A log: sines and the torques of the true arm.
t = np.arange(0, 30, 0.01)
phase = np.outer(t, [0.71, 1.13, 1.97]) * 2 * np.pi
q = 0.5 * np.stack([np.sin(phase).sum(1), np.cos(phase).sum(1)], axis=1)
v, a = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
tau = true_arm.rigid_force(*map(torch.from_numpy, (q, v, a))).numpy()
tau += np.random.default_rng(0).normal(size=q.shape) * 0.01
names = {name: [f"{name}_{joint}" for joint in arm.joint_names] for name in ("q", "v", "tau")}
columns = [column for signal in names.values() for column in signal]
log = pd.DataFrame(np.hstack([q, v, tau]), columns=columns).assign(t=t)
model = partial(KnownMechanics, structure=arm)
solver = LeastSquares(cutoff=6.0, rollouts=False)
run = pinn_dyn.fit(log, q=names["q"], v=names["v"], u=names["tau"], model=model, optimizer=solver)


class Robots(VecEnv):
    """The robots with the interface of Stable-Baselines3, and actions from -1 to 1."""

    def __init__(self, env):
        self.env, space = env, env.single_action_space
        self.middle, self.half = (space.high + space.low) / 2, (space.high - space.low) / 2
        super().__init__(env.num_envs, env.single_observation_space, Box(-1, 1, space.shape))

    def reset(self):
        return self.env.reset(seed=0)[0]

    def step_async(self, actions):
        self.actions = self.middle + self.half * actions

    def step_wait(self):
        observations, rewards, terminated, truncated, infos = self.env.step(self.actions)
        over = terminated | truncated
        details = [{} for _ in over]
        for k in np.flatnonzero(over):
            details[k] = {"terminal_observation": infos["final_obs"][k]}
            details[k]["TimeLimit.truncated"] = bool(truncated[k] and not terminated[k])
        return observations, rewards, over, details

    def close(self):
        pass

    def get_attr(self, name, indices=None):
        return [None] * self.num_envs

    def set_attr(self, name, value, indices=None):
        raise NotImplementedError  # PPO does not call it

    env_method = set_attr

    def env_is_wrapped(self, kind, indices=None):
        return [False] * self.num_envs


settings = {"step": 0.02, "duration": 2.0, "u_low": [-12, -5], "u_high": [12, 5]}
draws = run.sample(args.robots, seed=0)
robots = RobotVectorEnv(
    run, args.robots, draws=draws, autoreset=AutoresetMode.SAME_STEP, **settings
)
policy = PPO("MlpPolicy", Robots(robots), n_steps=50, batch_size=640, gamma=0.95, seed=0)
policy.learn(args.steps)


def mean_return(env, act):
    total = 0.0
    for seed in range(20):
        observation, _ = env.reset(seed=seed)
        over = False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, over = total + reward, terminated or truncated
    return total / 20


adapter = Robots(robots)
learned = lambda x: adapter.middle + adapter.half * policy.predict(x, deterministic=True)[0]  # noqa: E731
for name, env in (
    ("model", RobotEnv(run, **settings)),
    ("true arm", RobotEnv(true_arm, data=run, **settings)),
):
    rest = mean_return(env, lambda x: np.zeros(2))
    print(f"mean return on the {name}: {rest:.1f} without input, {mean_return(env, learned):.1f}")
