"""Recordings of a torque-controlled robot in a physics simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

import numpy as np
from pydantic import Field, PositiveInt
from torch import Tensor

from pinn_dyn.data.cache import Arrays, describe
from pinn_dyn.data.robot_excitation import DrawnMotion, RobotExcitation
from pinn_dyn.data.simulated import RecordedSource, split_recordings, spread_samples
from pinn_dyn.data.source import SPLITS
from pinn_dyn.progress import Progress
from pinn_dyn.systems import SimulatedArm

# Part of the cache key: raise it when the same description would give other numbers.
_VERSION = 6
_DRAWS = 20


@dataclass(kw_only=True, eq=False)
class RobotSource(RecordedSource):
    """Trajectories of a robot under motor torques, recorded once and cached on disk.

    Samples are q, v and the motor torque u, clipped to the robot's limits and before the friction
    of the joints. The simulator takes semi-implicit steps, v_k+1 = v_k + h a_k and
    q_k+1 = q_k + h v_k+1. The velocity that the simulator reports with q_k belongs to the time half
    a step earlier (leapfrog; Hairer, Lubich, Wanner 2006, section I.3.1). Samples therefore hold
    v(t_k) = (v_k + v_k+1) / 2, which is of second order in h.

    A trajectory that reaches a position or velocity limit is drawn again.

    Args:
        name: short name of the data set.
        system: the robot.
        excitations: kinds of motion. The trajectories of a split use them in turn.
        duration: length of each trajectory, s.
        step: time step of the simulator and sample time, s.
        train, validation, test: number of trajectories.
        seed: seed of all motions.
        cache: folder of the cache; ``~`` is the home folder.
        configurations: named configurations at which learned terms are evaluated, ``(N,)`` each;
            None for the middle of the joint ranges.

    Attributes:
        may_simulate: false for an untrusted run folder, whose robot must not be loaded by a
            simulator.

    Raises:
        ValueError: if a joint has no limits.
    """

    system: SimulatedArm
    excitations: Annotated[Sequence[RobotExcitation], Field(min_length=1)]
    train: PositiveInt
    configurations: Mapping[str, Sequence[float]] | None = None  # type: ignore[assignment]
    may_simulate: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        arm = self.system
        limits = zip(arm.joint_names, arm.v_max, arm.u_max, strict=True)
        if unlimited := [joint for joint, speed, torque in limits if not min(speed, torque) > 0]:
            raise ValueError(
                f"{self.name}: the joints {', '.join(unlimited)} have no velocity or torque limit: "
                "set v_max and u_max of the robot, or <limit velocity=... effort=...> in the URDF"
            )
        self.configurations = self.configurations or {
            "middle": ((arm.q_low + arm.q_high) / 2).tolist()
        }
        self.angles = arm.angles
        self.labels = [f"q{i + 1} [rad]" for i in range(arm.num_coordinates)]
        self.input_labels = [f"τ{i + 1} [Nm]" for i in range(arm.num_coordinates)]

    def _samples(
        self, t: Tensor, q: Tensor, v: Tensor, u: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return t[:-1], q[:, :-1], (v[:, :-1] + v[:, 1:]) / 2, u[:, :-1]

    def describe(self) -> dict[str, object]:
        keys = ("excitations", "duration", "step", "seed", "counts")
        settings = {key: describe(getattr(self, key)) for key in keys}
        return {"version": _VERSION, "robot": describe(self.system), **settings}

    @property
    def counts(self) -> dict[str, int]:
        """Number of trajectories of each split."""
        return {split: getattr(self, split) for split in SPLITS}

    def simulate(self) -> Arrays:
        """Record all motions again, with an additional sample per trajectory.

        Raises:
            SimulationError: if no draw of a trajectory stays within the limits.
            ValueError: if the robot cannot follow an excitation, or comes from an untrusted run
                folder.
        """
        if not self.may_simulate:
            system = f"pinn_dyn.systems.{type(self.system).__name__}"
            raise ValueError(
                f"{self.name}: the trajectories are not in {self.cache}, and no simulator is "
                f"started for a run folder: if you trust its author, add trust={system}"
            )
        t = np.arange(round(self.duration / self.step) + 2) * self.step
        tasks = [(i, k) for i, count in enumerate(self.counts.values()) for k in range(count)]
        # A generator per trajectory, so that more trajectories do not change existing ones.
        rngs = [np.random.default_rng([self.seed, *task]) for task in tasks]
        kinds = np.array([k for _, k in tasks]) % len(self.excitations)
        motions = np.full((3, len(tasks), len(t), self.system.num_coordinates), np.nan)

        def record(excitation: RobotExcitation, rows: np.ndarray) -> np.ndarray:
            return self._record(excitation.draw(self.system, t, [rngs[i] for i in rows]), t)

        for kind, excitation in enumerate(self.excitations):
            self._draw_within_limits(
                motions,
                np.flatnonzero(kinds == kind),
                partial(record, excitation),
                self._inside,
                draws=_DRAWS,
                message=f"motions of {type(excitation).__name__} leave the position or velocity "
                "limits of {} in each of {} draws: lower its reach, speed or amplitude",
            )
        return split_recordings(t, motions, self.counts)

    def prove(self, arrays: Arrays) -> np.ndarray:
        if not self.may_simulate:
            return np.asarray(arrays["proof"])
        numbers: list[np.ndarray] = []
        for q, v, u in zip(*spread_samples(arrays), strict=True):
            self.system.set_state(q, v)
            numbers += self.system.step(u, self.step)
        for k, excitation in enumerate(self.excitations):
            rng = np.random.default_rng([self.seed, k])
            plan = excitation.draw(self.system, arrays["t"], [rng])
            numbers += [plan.q0, plan.v0, plan.torque(0, plan.q0, plan.v0)]
        return np.concatenate([np.ravel(x) for x in numbers])

    def _record(self, plan: DrawnMotion, t: np.ndarray) -> np.ndarray:
        """Record q, v and u of K motions, all step by step at once, ``(3, K, T, N)``."""
        arm = self.system
        q, v, u = motions = np.empty((3, len(plan.q0), len(t), arm.num_coordinates))
        q[:, 0], v[:, 0] = plan.q0, plan.v0
        with Progress(f"recording {self.name}", len(t), "steps") as lines:
            for k in range(len(t)):
                lines.update(k)
                u[:, k] = np.clip(plan.torque(k, q[:, k], v[:, k]), -arm.u_max, arm.u_max)
                if k + 1 < len(t):
                    for i in range(len(q)):
                        arm.set_state(q[i, k], v[i, k])
                        q[i, k + 1], v[i, k + 1] = arm.step(u[i, k], self.step)
        return motions

    def _inside(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        arm = self.system
        inside = (q >= arm.q_low) & (q <= arm.q_high) & (np.abs(v) <= arm.v_max)
        return np.asarray(inside.all(1))
