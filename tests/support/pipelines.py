"""Every law with every stage around it: the closed loop beside the exported C file."""

import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from pinn_dyn.control import (
    Actuator,
    AdaptiveTracking,
    ComputedTorque,
    DataRegion,
    DisturbanceObserver,
    Guarded,
    LatentLaw,
    MotorPID,
    Pipeline,
    Plant,
    PredictiveControl,
    ProportionalDerivative,
    Regulation,
    Sines,
    SystemPlant,
    Tracking,
    close_loop,
    export_law,
)
from pinn_dyn.models import CoupledOscillators
from pinn_dyn.systems import RigidChain
from tests.models.builders import STEP, make_statistics
from tests.support.c_code import function_of
from tests.support.linear import Pendulums

URDF = str(Path(__file__).parents[2] / "examples" / "double_pendulum.urdf")
MASS, GRAVITY = np.array([[0.5, 0.1], [0.1, 0.2]]), np.diag([6.0, 2.0])
DAMPING, INPUTS = np.diag([0.2, 0.1]), np.array([[1.0, 0.0], [0.2, 0.9]])
REFERENCE = Sines([0.2, -0.1], [0.8, 0.6], [0.9, 1.3], rise_time=0.5)
STEPS = 200


def pendulums(factor=1.0):
    model = Pendulums(factor * MASS, factor * GRAVITY, DAMPING, INPUTS)
    return model.requires_grad_(False)


def oscillators(noise=0.0):
    """Return oscillators with two coordinates and two motors, nearly linear."""
    torch.manual_seed(2)
    model = CoupledOscillators(make_statistics(2, 2), oscillators=4, hidden=[6], force_hidden=[6])
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for layer in (model.output.layers[-1], model.force.layers[-1]):
            layer.weight.mul_(0.2)
        value = model.stiffness
        value.add_(noise * torch.randn(value.shape, generator=generator).tril())
    return model.double().requires_grad_(False)


class Oscillators(Plant):
    """Oscillators of other stiffness."""

    num_coordinates = num_inputs = 2

    def __init__(self):
        self.model = oscillators(0.05)

    def start(self, q0, v0):
        u = torch.zeros_like(q0)
        self.x = self.model.start(q0, v0, u, q0[:, :0], u[:, :0])[:, : 2 * len(self.model.bias)]

    def advance(self, u, duration):
        A, B = self.model.flow(duration / self.model.fixed_step)
        z = self.x[:, : len(self.model.bias)]
        force = self.model.latent_force(u) - self.model.coupling_force(z)
        self.x = self.x @ A.mT + force @ B.mT
        q = self.model.observe(self.x)
        return q, torch.zeros_like(q)


class Case(NamedTuple):
    """A law, its plant, its period in s and the limit of its inputs."""

    law: object
    plant: Plant
    period: float
    limit: float


def cases():
    """Return every law by its name."""
    heavier = SystemPlant(pendulums(1.3))
    arm, heavy = RigidChain(URDF, damping=0.1), RigidChain(URDF, damping=0.3)
    heavy.inertia[1] *= 1.5
    laws = {
        law.__name__: Case(law(pendulums(), 25.0, 4.0), heavier, 0.01, 10.0)
        for law in (ProportionalDerivative, Regulation, Tracking)
    }
    settings = {"rate": 2.0, "adapt": ["payload", "friction", "offset"]}
    pid = MotorPID(pendulums(), 0.3, 0.05, 2.0)
    latent = LatentLaw(oscillators(), 0.3, 0.3 * STEP, 0.1 / STEP)
    return laws | {
        "ComputedTorque": Case(ComputedTorque(pendulums(), 50.0, 10.0), heavier, 0.01, 10.0),
        "AdaptiveTracking": Case(
            AdaptiveTracking(arm, 5.0, 0.3, **settings), SystemPlant(heavy), 0.01, 4.0
        ),
        "MotorPID": Case(pid, heavier, 0.01, 0.4),
        "LatentLaw": Case(latent, Oscillators(), STEP, 1.0),
        "PredictiveControl": Case(PredictiveControl(pendulums(), 0.2, 0.02), heavier, 0.01, 4.0),
    }


class Combination(NamedTuple):
    """Stages around a law; the dead time is in periods, the period in that of the case."""

    law: str
    observer: bool
    guard: bool
    dead_time: float
    limits: str
    period: float


def combinations():
    """Return all combinations."""
    both = (False, True)
    limits = ("none", "value and rate")
    return [
        Combination(*x)
        for x in itertools.product(cases(), both, both, (0.0, 1.0, 1.4), limits, (1.0, 0.4))
    ]


def pipeline_of(combination, case):
    """Return the pipeline of a combination, or raise its refusal."""
    law, period = case.law, combination.period * case.period
    if combination.observer:
        law = DisturbanceObserver(law, 20.0, max_rate=50.0)
    if combination.guard:
        t = torch.linspace(0, 5, 400).double()[:, None]
        q, v = (torch.sin(t + torch.arange(2.0)) * x for x in (0.8, 3.0))
        region = DataRegion(q.split(40), v.split(40), samples=64)
        law = Guarded(law, region, threshold=3.0, fallback="hold")
    actuator = None
    if combination.limits != "none":
        rate = 20 * case.limit
        actuator = Actuator(low=-case.limit, high=[case.limit, 0.8 * case.limit], rate=rate)
    return Pipeline(law, period, actuator=actuator, dead_time=combination.dead_time * period)


def compared(combination, case, folder):
    """Compare a closed loop with the file; return the row of a table.

    ``difference`` is the largest of |u_loop - u_file| over 200 periods, relative to the largest
    |u_loop|. Without a file, ``refused`` has the message.
    """
    row = combination._asdict()
    try:
        pipeline = pipeline_of(combination, case)
        path = export_law(pipeline, folder / "law.c")
    except (TypeError, ValueError) as error:
        return {**row, "refused": f"{type(error).__name__}: {error}"}
    q0 = REFERENCE(0.0).q[None]
    period = pipeline.period
    record = close_loop(
        *(case.plant, pipeline, REFERENCE, q0, 0 * q0),
        duration=(STEPS - 1) * period,
        rate=1 / period,
        dead_time=combination.dead_time * period,
    )
    call, memory = function_of(path, "law_control"), np.zeros(pipeline.memory_size)
    largest, statuses = 0.0, set()
    measured = zip(record.t.tolist(), record.q[0].numpy(), record.v[0].numpy(), strict=True)
    outputs = record.u[0, np.ceil(combination.dead_time).astype(int) :].numpy()
    for (t, q, v), output in zip(measured, outputs, strict=False):
        goal = (x.numpy() for x in REFERENCE(t + pipeline.ahead[0]))
        u, memory, status = call(q, v, *goal, memory)
        largest = max(largest, float(np.abs(u - output).max()))
        statuses.add(status)
    return {
        **row,
        "difference": largest / float(record.u.abs().max()),
        "status": sorted(statuses),
        "kB": round(path.stat().st_size / 1000, 1),
        "stopped": record.stopped[0],
    }


def limited_and_free(case, reference, periods, share=0.5):
    """The errors of a loop with limits in its first third, and of a loop without, ``(2, T)``.

    The limits are a share of the largest input without limits in this third. The memory goes on
    when they end.
    """
    free, rows, limit = Pipeline(case.law, case.period), [], None
    for _ in range(2):
        tight = free
        if limit is not None:
            tight = Pipeline(case.law, case.period, actuator=Actuator(-limit, limit))
        q = reference(0.0).q[None]
        v, memory = 0 * q, torch.zeros(1, free.memory_size).double()
        case.plant.start(q, v)
        errors, inputs = [], []
        for k in range(3 * periods):
            pipeline, motion = (tight if k < periods else free), reference(k * case.period)
            u, _, memory = pipeline(q, v, *motion, memory)
            errors.append(float((q - motion.q).norm()))
            inputs.append(float(u.abs().max()))
            q, v = case.plant.advance(u, case.period)
        rows.append(errors)
        limit = share * max(inputs[:periods])
    return np.array(rows[::-1])
