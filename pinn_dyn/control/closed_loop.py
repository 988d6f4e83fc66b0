"""A closed loop of a plant and a controller, and its record."""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import dataclass, field

import torch
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor

from pinn_dyn.control.contracts import Motion, Plant, Reference, Stage
from pinn_dyn.control.effects import Actuator, Sensor
from pinn_dyn.control.pipeline import STATUS, Pipeline
from pinn_dyn.progress import Progress


@dataclass(frozen=True)
class ClosedLoopRecord:
    """K copies of a closed loop, sampled at its control instants; NaN after a copy was stopped.

    Attributes:
        t: control instants, ``(T,)``, s.
        q, v: true state of the plant, ``(K, T, N)``.
        u: input applied to the plant, ``(K, T, M)``.
        u_wanted: input of the law before limits and delay, ``(K, T, M)``.
        reference: desired motion, ``(K, T, N)`` each.
        stopped: for each copy, the reason and time of a stop, or None.
        diagnostics: diagnostics of the controller, ``(K, T)`` each.
    """

    t: Tensor
    q: Tensor
    v: Tensor
    u: Tensor
    u_wanted: Tensor
    reference: Motion
    stopped: list[str | None]
    diagnostics: dict[str, Tensor] = field(default_factory=dict)


log = logging.getLogger(__name__)

STOPS = {
    "not_finite": "the law's input is not finite",
    "singular": "the input matrix A(q) is nearly singular: its condition number exceeds "
    "max_condition",
    "unreachable": "no input gives the force of the law, so the last input is held",
    "no_plan": "the solver found no plan for longer than the horizon",
}
"""Reasons to stop a copy, by the names of the bits in the status."""
Q_BOUND = 1e3
"""Largest |q| of a copy that has not diverged, in the units of q."""


def close_loop(
    plant: Plant,
    controller: Stage | Pipeline,
    reference: Reference,
    q0: Tensor,
    v0: Tensor,
    *,
    duration: float,
    rate: float,
    actuator: Actuator | None = None,
    sensor: Sensor | None = None,
    dead_time: NonNegativeFloat = 0.0,
    samples_rate: PositiveFloat | None = None,
    progress: str | None = None,
) -> ClosedLoopRecord:
    """Run K copies of a sampled closed loop, with the input held between control instants::

        u(t_k), memory = pipeline(q + noise, v + noise, reference(t_k), memory),    t_k = k / rate

    A copy is stopped if its state, measurement or input is not finite, if |q| exceeds 1000, or if
    the status of the pipeline has a bit of :data:`STOPS`. The other copies continue. Ctrl-C returns
    the record up to the current instant.

    Args:
        plant: the controlled plant.
        controller: the law, or its :class:`Pipeline`.
        reference: the desired motion.
        q0, v0: initial configurations and velocities, ``(K, N)`` each.
        duration: length of the run in s, an integer multiple of 1 / rate.
        rate: control instants per second, 1/s.
        actuator: limits of the input of a law.
        sensor: noise of the measurement.
        dead_time: delay of the plant's inputs, s. The first input acts during the first delay.
        samples_rate: samples of the record per second, 1/s; ``rate`` must be a multiple of it. None
            records all instants.
        progress: name of the task in lines of progress; None logs no progress.

    Raises:
        ValueError: if sizes do not agree, the duration is no multiple of 1 / rate, or the pipeline
            has another period.
    """
    q0, v0 = q0.double(), v0.double()
    if isinstance(controller, Stage):
        controller = Pipeline(controller, 1 / rate, actuator=actuator)
    elif actuator is not None:
        raise ValueError("actuator: the controller is a pipeline, pass the limits to Pipeline")
    _check(plant, controller, reference, q0, v0, rate)
    stride = 1 if samples_rate is None else max(1, round(rate / samples_rate))
    run = _Run(controller, reference, q0, _instants(duration, rate), stride)
    waiting = math.ceil(dead_time * rate - 1e-9)
    share = dead_time * rate - waiting + 1  # part of an interval before the next input acts
    queue = deque([controller.first_input.expand(len(q0), -1)] * waiting)
    if sensor is not None:
        sensor.reset()
    q, v, moving, k = q0.clone(), v0.clone(), run.running.clone(), 0
    pieces: list[tuple[Tensor, float]] = []
    try:
        with (
            torch.no_grad(),
            Progress(progress, len(run.t), "instants") as lines,
        ):
            plant.start(q0, v0)
            for k in range(len(run.t)):
                if k > 1:  # skip the first instants, which may compile code
                    lines.update(k)
                if not torch.equal(moving, run.running):
                    moving = run.running.clone()
                    plant.start(q[moving], v[moving])
                for acting, part in pieces:
                    q[moving], v[moving] = plant.advance(acting[moving], part / rate)
                run.observe(k, q, v)
                queue.append(run.ask(k, *((q, v) if sensor is None else sensor(q, v))))
                u = queue.popleft()
                run.write("u", k, u)
                pieces = [(u, share)]
                if share < 1 - 1e-9:
                    pieces.append((queue[0], 1 - share))
                if not run.running.any():
                    break
    except KeyboardInterrupt:
        run.stop(run.running, k, "interrupted")
        return run.record(k + 1)
    return run.record(len(run.t))


class _Run:
    """State of a closed loop: copies that still run, memory of the law, and record."""

    def __init__(
        self, pipeline: Pipeline, reference: Reference, q0: Tensor, t: Tensor, stride: int
    ):
        self._stride = stride
        self.t, self.running = t, torch.ones(len(q0), dtype=torch.bool, device=q0.device)
        self._pipeline, self._reference, self._like = pipeline, reference, q0
        self._memory = q0.new_zeros(len(q0), pipeline.memory_size)
        self._columns: dict[str, Tensor] = {}
        self._stopped: list[str | None] = [None] * len(q0)
        self._is_warned = False

    def stop(self, mask: Tensor, k: int, reason: str) -> None:
        """Stop the running copies in a mask ``(K,)``."""
        if mask.any():
            for copy in (mask & self.running).nonzero()[:, 0].tolist():
                self._stopped[copy] = f"{reason} at t = {float(self.t[k]):.6g} s"
            self.running &= ~mask

    def observe(self, k: int, q: Tensor, v: Tensor) -> None:
        """Record the true state at instant k; stop the copies that have diverged."""
        finite = torch.cat([q, v], dim=-1).isfinite().all(-1)
        self.stop(~finite, k, "the plant diverged: its state is not finite")
        self.write("q", k, q)
        self.write("v", k, v)
        beyond = (q.abs() > Q_BOUND).any(-1)
        self.stop(beyond, k, f"the plant diverged: |q| is beyond {Q_BOUND:g}")

    def ask(self, k: int, q: Tensor, v: Tensor) -> Tensor:
        """Return the input for a measurement at instant k; it has no meaning for stopped copies.

        Copies with a measurement that is not finite are stopped.
        """
        finite = torch.cat([q, v], dim=-1).isfinite().all(-1)
        self.stop(~finite, k, "the measurement is not finite")
        running, time = self.running.unsqueeze(-1), float(self.t[k])
        q, v = torch.where(running, q, self._like), torch.where(running, v, 0.0)
        motions = [motion_of_copies(self._reference, time + x, q) for x in self._pipeline.ahead]
        motion = motions[0]
        if len(motions) > 1:
            motion = Motion(*(torch.stack(x, dim=-2) for x in zip(*motions, strict=True)))
        u, status, self._memory, report = self._pipeline.run(q, v, motion, self._memory)
        for name, value in report.items():
            self.write(name, k, value)
        for name, reason in STOPS.items():
            self.stop((status.long() & STATUS[name]) > 0, k, reason)
        outside = (status.long() & STATUS["outside"]) > 0
        if outside.any() and not self._is_warned:
            self._is_warned = True
            log.warning(
                f"t = {time:.4g} s: {int(outside.sum())} of {len(outside)} states are outside the "
                f"training data, at distances up to {float(report['distance'].max()):.3g} (1 is "
                "the edge of the data)"
            )
        return u

    def write(self, name: str, k: int, value: Tensor) -> None:
        """Record a value ``(K, ...)`` of the running copies if instant k is recorded."""
        if k % self._stride:
            return
        shape = len(self.t[:: self._stride]), *value.shape[1:]
        if name not in self._columns:
            self._columns[name] = self._like.new_full((len(value), *shape), torch.nan)
        stopped = ~self.running.reshape(-1, *[1] * (value.ndim - 1))
        self._columns[name][:, k // self._stride] = value.masked_fill(stopped, torch.nan)

    def record(self, samples: int) -> ClosedLoopRecord:
        """Return the record of the first ``samples`` instants."""
        t = self.t[: samples : self._stride]
        motions = [motion_of_copies(self._reference, float(x), self._like) for x in t]
        reference = Motion(*(torch.stack(x, 1) for x in zip(*motions, strict=True)))
        columns = {name: x[:, : len(t)] for name, x in self._columns.items()}
        q, v, u, u_wanted = (columns.pop(name) for name in ("q", "v", "u", "u_wanted"))
        return ClosedLoopRecord(t, q, v, u, u_wanted, reference, self._stopped, columns)


def _instants(duration: float, rate: float) -> Tensor:
    steps = round(duration * rate)
    if steps < 1 or abs(duration * rate - steps) > 1e-6:
        raise ValueError(f"duration is {duration} s, expected a multiple of {1 / rate:g} s")
    return torch.arange(steps + 1, dtype=torch.float64) / rate


def _check(
    plant: Plant, pipeline: Pipeline, reference: Reference, q0: Tensor, v0: Tensor, rate: float
) -> None:
    n, m = plant.num_coordinates, plant.num_inputs
    for name, sizes, expected in (
        ("reference", (reference.num_coordinates,), (n,)),
        ("controller", (pipeline.num_coordinates, pipeline.num_inputs), (n, m)),
        ("q0", tuple(q0.shape), (len(q0), n)),
        ("v0", tuple(v0.shape), (len(q0), n)),
    ):
        if sizes != expected:
            raise ValueError(f"{name} has sizes {sizes}, expected {expected} of the plant")
    if abs(pipeline.period * rate - 1) > 1e-6:
        raise ValueError(
            f"the period of the pipeline is {pipeline.period:g} s, expected {1 / rate:g} s, the "
            "period of the loop"
        )


def motion_of_copies(reference: Reference, time: float, like: Tensor) -> Motion:
    """Return the reference at a time for all copies, with shape and type of ``like`` ``(K, N)``."""
    return Motion(*(value.to(like).expand_as(like) for value in reference(time)))
