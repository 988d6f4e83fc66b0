"""Recordings of a torque-controlled robot in a simulator that steps by itself."""

from __future__ import annotations

import functools
import multiprocessing
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor
from tqdm import tqdm

from pinn_dyn.data.cache import Arrays, load_or_make
from pinn_dyn.data.fingerprint import describe
from pinn_dyn.data.robot_excitation import Robot, RobotExcitation
from pinn_dyn.data.simulation import SimulationError
from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.mechanics import MechanicalSystem, Signal, Trajectory
from pinn_dyn.workers import end_with_parent

# Part of the cache key: raise it when the same description would give other numbers.
_VERSION = 4
_DRAWS = 20


class RobotSource(DataSource):
    """Trajectories of a robot under motor torques, recorded once and cached on disk.

    Samples are q, v and the motor torque u, clipped to the robot's limits and without the joints'
    friction. The simulator steps semi-implicitly, v_k+1 = v_k + h a_k and q_k+1 = q_k + h v_k+1:
    the velocity that it reports with q_k belongs to half a step earlier, as in the leapfrog
    method (Hairer, Lubich, Wanner 2006, section I.3.1). Samples hold that at the time of q_k::

        v(t_k) = (v_k + v_k+1) / 2

    which leaves an error of second order in h; as they come, they are of first order, and after
    two seconds most of what separates a roll-out of the true equations from the record.

    Each trajectory has a generator of its own, seeded by the split and its number. One that
    reaches a position or velocity limit is drawn anew, as a real robot would not go on.

    Args:
        name: short name of the data set.
        system: the robot, a mechanical system that is a :class:`Robot` as well.
        excitations: kinds of motion; the k-th trajectory of a split is of kind k modulo their
            number.
        duration: length of each trajectory, s.
        step: time step of the simulator and sample time, s.
        train, validation, test: number of trajectories.
        seed: seed of all motions.
        workers: processes that record; None takes one per core.
        cache: folder of the cache; ``~`` is the home folder.
        configurations: named configurations at which learned terms are looked at, ``(N,)`` each;
            None takes the middle of the joint ranges.

    Raises:
        TypeError: if the system is no robot.
        ValueError: on a step longer than the duration, a joint without limits, or a configuration
            outside them.
    """

    def __init__(
        self,
        *,
        name: str,
        system: Robot,
        excitations: Annotated[Sequence[RobotExcitation], Field(min_length=1)],
        duration: PositiveFloat,
        step: PositiveFloat,
        train: PositiveInt,
        validation: PositiveInt,
        test: PositiveInt,
        seed: NonNegativeInt = 0,
        workers: PositiveInt | None = None,
        cache: str,
        configurations: Mapping[str, Sequence[float]] | None = None,
    ):
        if not (isinstance(system, MechanicalSystem) and isinstance(system, Robot)):
            raise TypeError(
                f"{name}: system is a {type(system).__name__}, expected a robot such as BulletArm"
            )
        if step > duration:
            raise ValueError(f"{name}: step is {step} s, expected at most duration, {duration} s")
        for joint, speed, torque in zip(
            system.joint_names, system.v_max, system.u_max, strict=True
        ):
            if not (speed > 0 and torque > 0):
                raise ValueError(
                    f"{name}: joint {joint!r} has velocity limit {speed:g} rad/s and torque limit "
                    f"{torque:g} Nm, expected positive ones: set <limit velocity=... effort=...> "
                    "in the URDF"
                )
        if configurations is None:
            configurations = {"middle": ((system.q_low + system.q_high) / 2).tolist()}
        for key, q in configurations.items():
            if len(q) != system.num_coordinates:
                raise ValueError(
                    f"{name}: configurations.{key} has {len(q)} entries, the system needs "
                    f"{system.num_coordinates}"
                )
            fault = _first_outside(system, np.array([q]), np.zeros((1, len(q))))
            if fault is not None:
                raise ValueError(f"{name}: configurations.{key}: {fault}")
        size = system.num_coordinates
        self.name = name
        self.robot: Robot = system
        self.system: MechanicalSystem = system
        self.excitations = list(excitations)
        self.duration = duration
        self.step = step
        self.counts = {"train": train, "validation": validation, "test": test}
        self.seed = seed
        self.workers = workers or os.cpu_count() or 1
        self.cache = Path(cache).expanduser()
        self.configurations = {key: list(q) for key, q in configurations.items()}
        self.angles = tuple(getattr(system, "angles", ()))
        self.labels = [f"q{i + 1} [rad]" for i in range(size)]
        self.input_labels = [f"τ{i + 1} [Nm]" for i in range(size)]

    def load(self) -> Splits:
        arrays = load_or_make(self.cache, self.name, self.describe(), self.simulate)
        t = torch.from_numpy(arrays["t"][:-1])
        splits: dict[str, list[Trajectory]] = {}
        for split in SPLITS:
            q, v, u = (torch.from_numpy(arrays[f"{split}_{key}"]) for key in "qvu")
            q, v, u = q[:, :-1], (v[:, :-1] + v[:, 1:]) / 2, u[:, :-1]
            splits[split] = [
                Trajectory(q[k], v[k], Signal(t, u[k]), momentum=self._momentum)
                for k in range(len(q))
            ]
        return Splits(**splits)

    def describe(self) -> dict[str, object]:
        """Return the settings that the trajectories depend on: the key of the cache."""
        return {
            "version": _VERSION,
            "robot": describe(self.robot),
            "excitations": describe(self.excitations),
            "duration": self.duration,
            "step": self.step,
            "counts": self.counts,
            "seed": self.seed,
        }

    def simulate(self) -> Arrays:
        """Record all trajectories anew: arrays ``<split>_<q, v, u>``, each ``(K, T + 1, .)``.

        They are as the simulator gives them, one sample longer than what :meth:`load` returns.

        Raises:
            SimulationError: if no draw of a trajectory stays within the limits.
            ValueError: from an excitation that the robot cannot follow.
        """
        tasks = [
            (index, k) for index, split in enumerate(SPLITS) for k in range(self.counts[split])
        ]
        t = np.arange(round(self.duration / self.step) + 2) * self.step
        record = functools.partial(_record, self.robot, self.excitations, t, self.seed)
        progress = functools.partial(
            tqdm, total=len(tasks), desc=f"recording {self.name}", unit="trajectory", disable=None
        )
        if self.workers == 1:
            records = list(progress(map(record, tasks)))
        else:
            # A fresh interpreter each: a fork would copy the threads' locks of this one.
            context = multiprocessing.get_context("spawn")
            count = min(self.workers, len(tasks))
            with ProcessPoolExecutor(count, context, end_with_parent) as pool:
                try:
                    records = list(progress(pool.map(record, tasks)))
                except BrokenProcessPool as error:
                    raise SimulationError(
                        f"{self.name}: a recording process ended early (out of memory, or a script "
                        "without `if __name__ == '__main__':`): use workers=1"
                    ) from error
        arrays = {"t": t}
        for index, split in enumerate(SPLITS):
            chosen = [part for task, part in zip(tasks, records, strict=True) if task[0] == index]
            q, v, u = (np.stack(parts) for parts in zip(*chosen, strict=True))
            arrays |= {f"{split}_q": q, f"{split}_v": v, f"{split}_u": u}
        return arrays

    def _momentum(self, q: Tensor, v: Tensor) -> Tensor:
        """p = M(q) v."""
        with torch.no_grad():
            return self.system.momentum(q, v)


def _record(
    robot: Robot,
    excitations: Sequence[RobotExcitation],
    t: np.ndarray,
    seed: int,
    task: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, v and u of trajectory ``task`` = (split, number), the first draw within the limits."""
    excitation = excitations[task[1] % len(excitations)]
    # One generator per trajectory: neither more of them nor the number of workers changes one.
    rng = np.random.default_rng([seed, *task])
    for _ in range(_DRAWS):
        plan = excitation.draw(robot, t, rng)
        q, v, u = (np.empty((len(t), len(plan.q0))) for _ in range(3))
        q[0], v[0] = plan.q0, plan.v0
        robot.set_state(q[0], v[0])
        for k in range(len(t)):
            u[k] = np.clip(plan.torque(k, q[k], v[k]), -robot.u_max, robot.u_max)
            if k + 1 < len(t):
                q[k + 1], v[k + 1] = robot.step(u[k], float(t[1] - t[0]))
        fault = _first_outside(robot, q, v)
        if fault is None:
            return q, v, u
    raise SimulationError(
        f"trajectory {task[1]} of the {SPLITS[task[0]]} split: {fault}; the same in {_DRAWS} "
        f"draws: lower the reach, speed or amplitude of {type(excitation).__name__}"
    )


def _first_outside(robot: Robot, q: np.ndarray, v: np.ndarray) -> str | None:
    """Where q or v, ``(T, N)``, first leaves the robot's limits or the finite numbers."""
    for name, unit, value, low, high in (
        ("q", "rad", q, robot.q_low, robot.q_high),
        ("v", "rad/s", v, -robot.v_max, robot.v_max),
    ):
        bad = np.argwhere(~((value >= low) & (value <= high)))
        if len(bad):
            k, joint = bad[0]
            return (
                f"{name} of joint {robot.joint_names[joint]!r} is {value[k, joint]:.4g} {unit} at "
                f"sample {k}, expected {low[joint]:.4g} to {high[joint]:.4g} {unit}"
            )
    return None
