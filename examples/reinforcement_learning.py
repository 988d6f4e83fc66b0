"""Search the gains of a policy on a learned model, and try the policy on the true robot.

python examples/reinforcement_learning.py runs/own_log    the folder of own_log.py

The policy is u = u_0 + A^T (K_P (goal - q) - K_D v), with u_0 and A of the model at the goal.
Random search finds the gains in episodes on the model. The same environment with the true arm in
the place of the model shows if the policy transfers.
"""

import argparse

import numpy as np

import pinn_dyn
from pinn_dyn.envs import RobotEnv

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("run", help="a run folder, of a one-segment soft arm")
parser.add_argument("--trials", type=int, default=8, help="gains that are tried")
parser.add_argument("--duration", type=float, default=1.0, help="length of an episode, s")
args = parser.parse_args()

run = pinn_dyn.load(args.run)
learned = RobotEnv(run, duration=args.duration)
true = RobotEnv(pinn_dyn.SoftArm(segments=1), data=run, duration=args.duration)


def mean_return(env: RobotEnv, gains: np.ndarray, seeds: range) -> float:
    """Sum of the rewards of an episode, mean over episodes."""
    total = 0.0
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        goal = observation[-3:]
        hold, transposed = run.input_for(goal, 0 * goal, 0 * goal), run.terms(goal).A.T
        terminated = truncated = False
        while not (terminated or truncated):
            q, v, _ = observation.reshape(3, -1)
            action = hold + transposed @ (gains[0] * (goal - q) - gains[1] * v)
            observation, reward, terminated, truncated, _ = env.step(action)
            total += reward
    return total / len(seeds)


rng = np.random.default_rng(0)
candidates = [np.zeros(2), *10 ** rng.uniform([-1, -2], [1, 0], size=(args.trials, 2))]
returns = [mean_return(learned, gains, range(2)) for gains in candidates]
best = candidates[int(np.argmax(returns))]
print("best gains:", best.round(3))
for name, env in (("model", learned), ("true arm", true)):
    before, after = (mean_return(env, gains, range(100, 102)) for gains in (candidates[0], best))
    print(f"mean return of new episodes on the {name}: {before:.2f} before, {after:.2f} after")
