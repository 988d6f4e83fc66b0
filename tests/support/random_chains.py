"""Random chains of two to four bodies, noisy motions of them, and fits from generic bodies."""

from typing import NamedTuple

import numpy as np
import torch

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.identification.constants import constants_table
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import KnownMechanics
from pinn_dyn.training import LeastSquares
from tests.support.known import known_model
from tests.support.rigid_chains import robot

RATE = 200.0  # Hz
NOISE = 3e-3  # of the spread of q and of v


class Outcome(NamedTuple):
    """What a fit of one chain came to.

    Attributes:
        joints: of the chain.
        smallest_mass: of its bodies, kg.
        smallest_slack: how far the moments of a body keep to the triangle inequality, as a part of
            their sum; negative for what no body has.
        acceleration_error: on a motion that was not fitted, as a part of its norm.
        determined: constants of which the data took 99 % of the prior's variance.
        deviation: root mean square of their errors in standard deviations.
        worst: the largest of them.
        inside: the part of them in their 95 % intervals.
    """

    joints: int
    smallest_mass: float
    smallest_slack: float
    acceleration_error: float
    determined: int
    deviation: float
    worst: float
    inside: float


def random_chain(generator: np.random.Generator) -> str:
    """The URDF of blocks of 5 to 30 cm and 0.3 to 3 kg, anywhere and on any axis."""
    parts = ['<link name="base"/>']
    for k in range(generator.integers(2, 5)):
        mass, sides = generator.uniform(0.3, 3), generator.uniform(0.05, 0.3, 3)
        moments = mass / 12 * (sides @ sides - sides**2)
        centre, turn = generator.uniform(-0.2, 0.2, 3), generator.uniform(-3, 3, 3)
        place, twist = generator.uniform(-0.3, 0.3, 3), generator.uniform(-1.5, 1.5, 3)
        axis = generator.normal(size=3)
        parts.append(
            f'<link name="body{k}"><inertial><origin xyz="{_text(centre)}" rpy="{_text(turn)}"/>'
            f'<mass value="{mass}"/><inertia ixx="{moments[0]}" iyy="{moments[1]}" '
            f'izz="{moments[2]}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint{k}" type="continuous"><parent link="'
            f'{f"body{k - 1}" if k else "base"}"/><child link="body{k}"/>'
            f'<origin xyz="{_text(place)}" rpy="{_text(twist)}"/>'
            f'<axis xyz="{_text(axis / np.linalg.norm(axis))}"/></joint>'
        )
    return robot(*parts)


def _text(values: np.ndarray) -> str:
    return " ".join(map(str, values))


class Plan(NamedTuple):
    """A motion before it is simulated: u ``(T, N)``, start ``(2N,)``, white noise of q and v."""

    u: torch.Tensor
    start: torch.Tensor
    noise: tuple[torch.Tensor, torch.Tensor]


T = torch.arange(int(5 * RATE) + 1, dtype=torch.float64) / RATE


def drawn(model: KnownMechanics, generator: np.random.Generator) -> Plan:
    """5 s under sines of 0.3 to 2.4 Hz that outweigh gravity."""
    size = model.num_coordinates

    def draw(low: float, high: float, *shape: int) -> torch.Tensor:
        return torch.from_numpy(generator.uniform(low, high, (*shape, size)))

    with torch.no_grad():
        amplitude = 0.15 + 1.5 * model.potential_force(draw(-3, 3, 200)).abs().mean(0)
    u = torch.zeros(len(T), size, dtype=torch.float64)
    for k in range(1, 9):
        phase = 2 * torch.pi * 0.3 * k * T[:, None] + draw(0, 2 * np.pi)
        u += amplitude * draw(-1, 1) * torch.sin(phase)
    start = torch.cat([draw(-1, 1), torch.zeros(size, dtype=torch.float64)])
    noise = tuple(torch.from_numpy(generator.normal(size=u.shape)) for _ in "qv")
    return Plan(u, start, noise)


def simulated(model: KnownMechanics, plans: list[Plan]) -> list[Trajectory]:
    """The motions, all at once."""
    u, start = (torch.stack([plan[k] for plan in plans]) for k in (0, 1))
    with torch.no_grad():
        q, v = model.predict(start, T, Signal(T, u)).chunk(2, dim=-1)
    return [Trajectory(*one, Signal(T, plan.u)) for *one, plan in zip(q, v, plans, strict=True)]


def noisy(run: Trajectory, plan: Plan) -> Trajectory:
    """The same with white noise on q and v."""
    q, v = (
        x + NOISE * x.std(0) * white for x, white in zip((run.q, run.v), plan.noise, strict=True)
    )
    return Trajectory(q, v, run.input)


def fit_of_a_random_chain(seed: int) -> Outcome:
    """Fit one chain from three noisy motions, all bodies generic at the start."""
    generator = np.random.default_rng(seed)
    urdf = random_chain(generator)
    truth = known_model(urdf, (), friction=None, start="prior")
    with torch.no_grad():
        for part, middle in ((truth.viscous, 0.8), (truth.offset, 0.0)):
            part.z.copy_(torch.from_numpy(generator.normal(middle, 0.3, part.z.shape)))
    plans = [drawn(truth, generator) for _ in range(4)]
    *runs, unseen = simulated(truth, plans)
    runs = [noisy(run, plan) for run, plan in zip(runs, plans, strict=False)]
    model = known_model(urdf, (), friction=None, start="generic")
    windows = draw_windows(runs, count=100, steps=10, stride=4, seed=seed)
    table = constants_table(model, LeastSquares(cutoff=10.0).fit(model, runs, windows))
    true = torch.cat([item.values for item in truth.physical_constants()]).detach().numpy()
    error = (table.value - true) / ((table.high - table.value) / 1.96)
    error = error[table.known > 0.99]
    with torch.no_grad():
        found, expected = (
            one.forward_dynamics(unseen.q, unseen.v, unseen.u) for one in (model, truth)
        )
        bodies = model.bodies()
    mass, centre = bodies[:, 3, 3], bodies[:, :3, 3] / bodies[:, 3:, 3]
    spread = bodies[:, :3, :3] - mass[:, None, None] * centre[:, :, None] * centre[:, None]
    moments = torch.linalg.eigvalsh(
        spread.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] * torch.eye(3) - spread
    )
    slack = (moments[:, 0] + moments[:, 1] - moments[:, 2]) / moments.sum(-1)
    return Outcome(
        joints=model.num_coordinates,
        smallest_mass=float(mass.min()),
        smallest_slack=float(slack.min()),
        acceleration_error=float((found - expected).norm() / expected.norm()),
        determined=len(error),
        deviation=float((error**2).mean() ** 0.5),
        worst=float(error.abs().max()),
        inside=float((error.abs() < 1.96).mean()),
    )
