"""Close the loop of control laws on a robot, and compare them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.atomic_files import whole
from pinn_dyn.control import (
    Actuator,
    ClosedLoopRecord,
    Pipeline,
    Plant,
    Reference,
    Sensor,
    SimulatorPlant,
    Stage,
    SystemPlant,
)
from pinn_dyn.control import close_loop as close_one_loop
from pinn_dyn.control.references import check_limits
from pinn_dyn.evaluation.control_metrics import ClosedLoopMetrics, closed_loop_metrics
from pinn_dyn.evaluation.tables import write_table
from pinn_dyn.mechanics import MechanicalSystem, double_copy
from pinn_dyn.systems import HasDomain, HasLimits, Stepped

RATE = 1000.0
"""Default control instants per second, 1/s."""


@dataclass(frozen=True)
class ControlResult:
    """Closed loops of some control laws on one robot.

    Attributes:
        records: K closed loops of each law, by the name of the law.
        metrics: metrics of each law, by its name.
    """

    records: dict[str, ClosedLoopRecord]
    metrics: dict[str, ClosedLoopMetrics]

    @property
    def table(self) -> pd.DataFrame:
        """One row per law: errors in the units of q, inputs in the units of u."""
        return pd.DataFrame([{"controller": name} | m.summary for name, m in self.metrics.items()])

    @property
    def coordinates(self) -> pd.DataFrame:
        """One row per law and coordinate."""
        tables = {name: m.coordinates for name, m in self.metrics.items()}
        table = pd.concat(tables, names=["controller"])
        return table.reset_index("controller").reset_index(drop=True)

    def save(self, folder: Path | str) -> None:
        """Write the tables as CSV files and the records as ``record_<law>.npz``."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_table(self.table, folder, "summary")
        write_table(self.coordinates, folder, "coordinates")
        for name, record in self.records.items():
            arrays: dict[str, Any] = {
                **{key: getattr(record, key).numpy() for key in ("t", "q", "v", "u", "u_wanted")},
                **{f"{key}_ref": x.numpy() for key, x in record.reference._asdict().items()},
                **{key: value.numpy() for key, value in record.diagnostics.items()},
                "stopped": np.array([reason or "" for reason in record.stopped]),
            }
            with whole(folder / f"record_{name}.npz") as partial, partial.open("wb") as file:
                np.savez_compressed(file, **arrays)


def close_loop(
    run: Any,
    law: Callable[[MechanicalSystem], Stage],
    reference: Reference,
    robot: MechanicalSystem,
    **settings: Any,
) -> ControlResult:
    """Control a robot by a law on a trained model, and by the same law on the robot's true terms.

    Both laws compensate the dead time of the run's data set, see :class:`.DeadTime`::

        law = functools.partial(Tracking, position_gain=100.0, velocity_gain=10.0)
        result = pinn_dyn.close_loop(run, law, Sines([0.2, 0.0, 0.1], 0.1, 0.5), SoftArm())

    Args:
        run: a loaded run, or a mechanical system, whose terms the law ``"learned"`` uses.
        law: builds the law on the terms of a system.
        reference: the desired motion.
        robot: the true system, which also gives the terms of the law ``"truth"``.
        settings: keyword arguments of :func:`close_loops`.
    """
    systems = {"learned": double_copy(getattr(run, "model", run)), "truth": robot}
    period, limits = 1 / settings.get("rate", RATE), settings.get("actuator")
    dead_time = getattr(run, "input_delay", 0.0)
    laws = {
        name: Pipeline(law(system), period, actuator=limits, dead_time=dead_time)
        for name, system in systems.items()
    }
    return close_loops(laws, reference, robot, **settings)


def close_loops(
    laws: Mapping[str, Stage | Pipeline],
    reference: Reference,
    robot: MechanicalSystem,
    *,
    duration: float = 2.0,
    rate: float = RATE,
    samples_rate: float | None = None,
    q0: Tensor | None = None,
    v0: Tensor | None = None,
    plant: Plant | None = None,
    actuator: Actuator | None = None,
    sensor: Sensor | None = None,
    dead_time: float = 0.0,
    settled_after: float | None = None,
    progress: bool = False,
) -> ControlResult:
    """Close the loop of each law on a robot and compare their errors and inputs.

    Args:
        laws: control laws by name, or their pipelines.
        reference: the desired motion.
        robot: the true system.
        duration: length of the runs, s.
        rate: control instants per second, 1/s.
        samples_rate: samples of the records per second, 1/s; None for all instants.
        q0, v0: initial states, ``(K, N)`` each; None starts on the reference.
        plant: the simulation of the robot at control instants; None takes the simulator of a
            :class:`~pinn_dyn.systems.Stepped` robot, and solves the equation of motion of others.
        actuator: limits of the input.
        sensor: noise of the measurement.
        dead_time: time after which the robot's inputs act, s.
        settled_after: see :func:`closed_loop_metrics`.
        progress: log lines of progress.

    Raises:
        ValueError: if the reference leaves the limits or the domain of the robot.
    """
    start = reference(0.0)
    if q0 is None or v0 is None:
        q0, v0 = (x.double().reshape(-1, reference.num_coordinates) for x in (start.q, start.v))
    _check_reference(reference, robot, q0, duration)
    if plant is None:
        plant = SimulatorPlant(robot) if isinstance(robot, Stepped) else SystemPlant(robot)
    records, metrics = {}, {}
    for name, law in laws.items():
        records[name] = close_one_loop(
            *(plant, law, reference, q0, v0),
            duration=duration,
            rate=rate,
            actuator=actuator if isinstance(law, Stage) else None,
            sensor=sensor,
            dead_time=dead_time,
            samples_rate=samples_rate,
            progress=f"closing the loop: {name}" if progress else None,
        )
        metrics[name] = closed_loop_metrics(
            records[name],
            settled_after=settled_after,
            u_low=None if actuator is None else actuator.low,
            u_high=None if actuator is None else actuator.high,
        )
    return ControlResult(records, metrics)


def _check_reference(
    reference: Reference, robot: MechanicalSystem, q0: Tensor, duration: float
) -> None:
    sizes = reference.num_coordinates, robot.num_coordinates
    if sizes[0] != sizes[1]:
        raise ValueError(f"the reference has {sizes[0]} coordinates, the robot {sizes[1]}")
    if isinstance(robot, HasLimits):
        check_limits(reference, robot.q_low, robot.q_high, duration, robot.v_max)
    if isinstance(robot, HasDomain):
        times = np.linspace(0.0, duration, 101).tolist()
        visited = torch.cat([q0, *(reference(t).q.reshape(-1, sizes[1]) for t in times)]).numpy()
        robot.check_domain(visited.min(0), visited.max(0))
