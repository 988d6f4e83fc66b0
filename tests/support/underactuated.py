"""A cart-pole, a pendubot and an acrobot by their equations in textbooks, and noisy logs of them.

Rotary encoders have 4,096 counts, the cart's encoder 0.2 mm. Speeds and inputs have 2 % noise.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from tests.support.rigid_chains import joint, link, robot

GRAVITY, WIDTH = 9.81, 0.01
RATE, SECONDS, SUBSTEPS = 200, 8.0, 4
COUNT = 2 * np.pi / 4096


@dataclass
class Robot:
    """Two joints of which one has a motor.

    Attributes:
        urdf: kinematics, with bodies that are wrong.
        driven: name of the joint with the motor, and its number.
        constants: values that the motion determines, by their names.
        viscous, dry: friction of the joints.
        resolution: of the encoders.
        force: amplitude of the input.
    """

    urdf: str
    driven: str
    number: int
    constants: dict[str, float]
    viscous: np.ndarray
    dry: np.ndarray
    resolution: np.ndarray
    force: float


CART_POLE = Robot(
    robot(
        link("base"),
        link("cart", 1.0),
        link("pole", 1.0),
        joint("slide", "prismatic", "base", "cart", xyz="0 0 0", rpy="0 0 0", axis="1 0 0"),
        joint("hinge", "continuous", "cart", "pole", xyz="0 0 0", rpy="0 0 0", axis="0 1 0"),
    ),
    "slide",
    0,
    {"total": 1.23, "coupling": 0.0575, "inertia": 0.0192, "weight": 0.0575 * GRAVITY},
    np.array([2.0, 0.002]),
    np.array([0.8, 0.003]),
    np.array([2e-4, COUNT]),
    8.0,
)
_ARM = robot(
    link("base"),
    link("upper", 1.0),
    link("lower", 1.0),
    joint("shoulder", "continuous", "base", "upper", xyz="0 0 0", rpy="0 0 0", axis="0 1 0"),
    joint("elbow", "continuous", "upper", "lower", xyz="0 0 -0.3", rpy="0 0 0", axis="0 1 0"),
)
# Links of 0.6 and 0.5 kg, with centres 0.17 and 0.16 m behind their joints, 0.3 m apart.
_CONSTANTS = {
    "upper": 0.006 + 0.6 * 0.17**2 + 0.5 * 0.3**2,
    "lower": 0.005 + 0.5 * 0.16**2,
    "coupling": 0.5 * 0.3 * 0.16,
    "upper weight": GRAVITY * (0.6 * 0.17 + 0.5 * 0.3),
    "lower weight": GRAVITY * 0.5 * 0.16,
}
_FRICTION = np.array([0.008, 0.004]), np.array([0.02, 0.01]), np.array([COUNT, COUNT])
PENDUBOT = Robot(_ARM, "shoulder", 0, _CONSTANTS, *_FRICTION, 0.35)
ACROBOT = Robot(_ARM, "elbow", 1, _CONSTANTS, *_FRICTION, 0.35)


def mass_and_bias(arm: Robot, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M ``(K, 2, 2)``, and C v + G ``(K, 2)``."""
    c, one = arm.constants, np.ones(len(q))
    if "total" in c:
        side, pull = c["coupling"] * np.cos(q[:, 1]), c["coupling"] * np.sin(q[:, 1])
        mass = [[c["total"] * one, -side], [-side, c["inertia"] * one]]
        bias = [pull * v[:, 1] ** 2, c["weight"] * np.sin(q[:, 1])]
    else:
        bent = c["coupling"] * np.cos(q[:, 1])
        turn = c["coupling"] * np.sin(q[:, 1])
        lower = c["lower weight"] * np.sin(q.sum(1))
        mass = [
            [c["upper"] + c["lower"] + 2 * bent, c["lower"] + bent],
            [c["lower"] + bent, c["lower"] * one],
        ]
        upper = c["upper weight"] * np.sin(q[:, 0])
        bias = [
            -turn * v[:, 1] * (2 * v[:, 0] + v[:, 1]) + upper + lower,
            turn * v[:, 0] ** 2 + lower,
        ]
    return np.array(mass).transpose(2, 0, 1), np.array(bias).T


def log(arm: Robot, runs: int, seed: int = 0) -> pd.DataFrame:
    """Runs with the columns run, t, q1, q2, v1, v2 and u, whose input is held between samples."""
    generator = np.random.default_rng(seed)
    t, h = np.arange(0, SECONDS, 1 / RATE), 1 / RATE / SUBSTEPS
    frequency = 0.3 * np.arange(1, 7)[:, None, None]
    size, phase = generator.uniform(0.3, 1, (6, 1, runs)), generator.uniform(0, 6, (6, 1, runs))
    u = arm.force * (size * np.sin(2 * np.pi * frequency * t[:, None] + phase)).sum(0)
    x = np.zeros((runs, 4))
    x[:, 1] = generator.uniform(-1, 1, runs)

    def rate(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        q, v = x[:, :2], x[:, 2:]
        mass, bias = mass_and_bias(arm, q, v)
        force = -bias - arm.viscous * v - arm.dry * np.tanh(v / WIDTH)
        force[:, arm.number] += u
        return np.hstack([v, np.linalg.solve(mass, force[..., None])[..., 0]])

    states = []
    for k in range(len(t)):
        if "total" in arm.constants:  # a controller keeps the cart on its track
            u[k] -= 20 * x[:, 0] + 2 * x[:, 2]
        states.append(x)
        for _ in range(SUBSTEPS):
            k1 = rate(x, u[k])
            k2 = rate(x + h / 2 * k1, u[k])
            k3 = rate(x + h / 2 * k2, u[k])
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, u[k]))
    x = np.array(states)
    q = np.round(x[..., :2] / arm.resolution) * arm.resolution
    v, u = (y + 0.02 * y.std(0) * generator.normal(size=y.shape) for y in (x[..., 2:], u))
    columns = {"q1": q[..., 0], "q2": q[..., 1], "v1": v[..., 0], "v2": v[..., 1], "u": u}
    return pd.concat(
        pd.DataFrame({"run": f"run {k}", "t": t} | {name: y[:, k] for name, y in columns.items()})
        for k in range(runs)
    ).reset_index(drop=True)


def fitted_constants(arm: Robot, model) -> dict[str, float]:
    """The constants of a fitted model, from its M and G."""

    def at(*q: float) -> tuple[np.ndarray, np.ndarray]:
        terms = model.terms(model.bodies.z.new_tensor([q]))
        return terms.M[0].detach().numpy(), terms.G[0].detach().numpy()

    right = np.pi / 2
    (straight, _), (bent, pull) = at(0.0, 0.0), at(0.0, right)
    if "total" in arm.constants:
        return {
            "total": straight[0, 0],
            "coupling": -straight[0, 1],
            "inertia": straight[1, 1],
            "weight": pull[1] - at(0.0, 0.0)[1][1],
        }
    return {
        "upper": bent[0, 0] - bent[1, 1],
        "lower": bent[1, 1],
        "coupling": straight[0, 1] - bent[1, 1],
        "upper weight": at(right, -right)[1][0] - at(0.0, 0.0)[1][0],
        "lower weight": pull[1] - at(0.0, 0.0)[1][1],
    }
