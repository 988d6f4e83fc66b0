"""Run a sampled closed loop: a control law on a plant, at control instants."""

from __future__ import annotations

import math
from collections import defaultdict, deque

import torch
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion, Plant, Reference
from pinn_dyn.control.effects import Actuator, Sensor
from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import require_finite
from pinn_dyn.progress import Progress


def close_loop(
    plant: Plant,
    controller: Controller,
    reference: Reference,
    q0: Tensor,
    v0: Tensor,
    *,
    duration: float,
    rate: float,
    actuator: Actuator | None = None,
    sensor: Sensor | None = None,
    delay: float = 0.0,
    progress: str | None = None,
) -> ClosedLoopRecord:
    """Run a sampled closed loop, K copies at once, with the input held between instants::

        u_wanted(t_k) = law(t_k, q + noise, v + noise, reference(t_k))
        u(t_k) = actuator(u_wanted(t_k-d)),    t_k = k / rate,  k = 0 ... duration * rate

    A copy is stopped if its state, measurement or input is not finite, |q| exceeds 1000, or the
    controller reports a fault. The other copies go on. Ctrl-C returns the record up to then.

    Args:
        plant: the plant that is controlled.
        controller: the law; it is reset first.
        reference: the desired motion.
        q0, v0: initial configurations and velocities, ``(K, N)`` each.
        duration: length of the run in s, an integer multiple of 1 / rate.
        rate: control instants per second, 1/s.
        actuator: limits of the input.
        sensor: noise of the measurement.
        delay: dead time of the input in control instants, also 1.5, with zero input before.
        progress: name of the task in lines of progress; None logs none.

    Raises:
        ValueError: on sizes that do not agree, or a duration that is no multiple of 1 / rate.
    """
    q0, v0 = q0.double(), v0.double()
    run = LoopRun(plant, controller, reference, q0, v0, duration, rate, actuator)
    waiting = math.ceil(delay)
    share = delay - waiting + 1  # of an interval, before the next input in the queue acts
    queue = deque([q0.new_zeros(len(q0), plant.num_inputs)] * waiting)
    if sensor is not None:
        sensor.reset()
    q, v, moving = q0.clone(), v0.clone(), run.running.clone()
    k, pieces = 0, list[tuple[Tensor, float]]()
    try:
        with (
            torch.no_grad(),
            Progress(progress, len(run.t), "instants") as lines,
        ):
            plant.start(q0, v0)
            for k in range(len(run.t)):
                if k > 1:  # the first instants may build code, which would spoil the estimate
                    lines.update(k)
                if not torch.equal(moving, run.running):
                    moving = run.running.clone()
                    plant.start(q[moving], v[moving])
                for acting, part in pieces:
                    q[moving], v[moving] = plant.advance(acting[moving], part / rate)
                run.observe(k, q, v)
                run.measure(k, *((q, v) if sensor is None else sensor(q, v)))
                queue.append(run.ask(k))
                u = run.apply(k, queue.popleft())
                pieces = [(u, share)]
                if share < 1:
                    following = (actuator or Actuator()).limit(queue[0], u, 1 / rate)
                    pieces.append((following, 1 - share))
                if not run.running.any():
                    break
    except KeyboardInterrupt:
        run.stop(run.running, float(run.t[k]), "interrupted")
        return run.record(k + 1)
    return run.record(len(run.t))


class LoopRun:
    """The state of a run: the copies that still run, the law's measurements, and the record.

    A copy with |q| beyond ``q_bound`` has diverged, in the units of q.
    """

    q_bound = 1e3

    def __init__(
        self,
        plant: Plant | MechanicalSystem,
        controller: Controller,
        reference: Reference,
        q0: Tensor,
        v0: Tensor,
        duration: float,
        rate: float,
        actuator: Actuator | None,
    ):
        n, m = plant.num_coordinates, plant.num_inputs
        for name, sizes, expected in (
            ("reference", (reference.num_coordinates,), (n,)),
            ("controller", (controller.num_coordinates, controller.num_inputs), (n, m)),
            ("q0", tuple(q0.shape), (len(q0), n)),
            ("v0", tuple(v0.shape), (len(q0), n)),
        ):
            if sizes != expected:
                raise ValueError(f"{name} has sizes {sizes}, expected {expected} of the plant")
        require_finite("q0", q0)
        require_finite("v0", v0)
        steps = round(duration * rate)
        if steps < 1 or abs(duration * rate - steps) > 1e-6:
            raise ValueError(f"duration is {duration} s, expected a multiple of {1 / rate:g} s")
        self.t = torch.arange(steps + 1, dtype=torch.float64) / rate
        self.running = torch.ones(len(q0), dtype=torch.bool, device=q0.device)
        self._shape_of_u = (len(q0), m)
        self._controller, self._actuator = controller, actuator
        self._interval = 1 / rate
        self._measured = q0.clone(), v0.clone()
        self._motions = [motion_of_copies(reference, float(t), q0) for t in self.t]
        samples = (len(q0), len(self.t))
        self._q, self._v = (q0.new_full((*samples, n), torch.nan) for _ in range(2))
        self._u, self._u_wanted = (q0.new_full((*samples, m), torch.nan) for _ in range(2))
        self._diagnostics: dict[str, Tensor] = defaultdict(lambda: self._q[..., 0] * torch.nan)
        self._stopped: list[str | None] = [None] * len(q0)
        controller.reset()
        controller.follow(reference)
        if actuator is not None:
            actuator.reset()

    def stop(self, mask: Tensor, time: float, reason: str) -> None:
        """Stop the copies of a mask ``(K,)`` that still run."""
        if not mask.any():
            return
        for copy in (mask & self.running).nonzero()[:, 0].tolist():
            self._stopped[copy] = f"{reason} at t = {time:.6g} s"
        self.running &= ~mask

    def observe(self, k: int, q: Tensor, v: Tensor) -> None:
        """Record the true state at instant k; stop the copies that have diverged."""
        time = float(self.t[k])
        finite = finite_rows(q) & finite_rows(v)
        self.stop(~finite, time, "the plant diverged: its state is not finite")
        self._write(self._q[:, k], q)
        self._write(self._v[:, k], v)
        beyond = (q.abs() > self.q_bound).any(-1)
        self.stop(beyond, time, f"the plant diverged: |q| is beyond {self.q_bound:g}")

    def measure(self, k: int, q: Tensor, v: Tensor) -> None:
        """Store the measurement at instant k; stop the copies where it is not finite."""
        finite = finite_rows(q) & finite_rows(v)
        self.stop(~finite, float(self.t[k]), "the measurement is not finite")
        for stored, value in zip(self._measured, (q, v), strict=True):
            self._write(stored, value)

    def ask(self, k: int) -> Tensor:
        """Return the law's input at instant k; meaningless for a stopped copy."""
        time = float(self.t[k])
        u = self._controller(time, *self._measured, self._motions[k])
        if u.shape != self._shape_of_u:
            raise ValueError(
                f"the controller's input has shape {tuple(u.shape)}, expected {self._shape_of_u}"
            )
        self._write(self._u_wanted[:, k], u)
        self._diagnose(k, self._controller.diagnostics())
        for reason, mask in self._controller.faults().items():
            self.stop(mask, time, reason)
        self.stop(~finite_rows(u), time, "the law's input is not finite")
        return u

    def apply(self, k: int, u: Tensor) -> Tensor:
        """Return the input that passes the actuator at instant k."""
        if self._actuator is not None:
            u, changed = self._actuator(u, self._interval)
            self._diagnose(k, {"saturated_inputs": changed.sum(-1)})
        self._write(self._u[:, k], u)
        return u

    def record(self, samples: int) -> ClosedLoopRecord:
        """Return the record of the first instants."""
        motions = zip(*self._motions[:samples], strict=True)
        reference = Motion(*(torch.stack(values, 1) for values in motions))
        q, v, u, u_wanted = (x[:, :samples] for x in (self._q, self._v, self._u, self._u_wanted))
        diagnostics = {name: values[:, :samples] for name, values in self._diagnostics.items()}
        t = self.t[:samples]
        return ClosedLoopRecord(t, q, v, u, u_wanted, reference, self._stopped, diagnostics)

    def _diagnose(self, k: int, values: dict[str, Tensor]) -> None:
        for name, value in values.items():
            self._write(self._diagnostics[name][:, k], value.to(self._q))

    def _write(self, target: Tensor, values: Tensor) -> None:
        """Copy the values of the running copies, ``(K, ...)``, into a part of the record."""
        if not any(self._stopped):
            target.copy_(values)
        else:
            target[self.running] = values[self.running]


def finite_rows(x: Tensor) -> Tensor:
    """Return true for each row of ``(*batch, n)`` with finite numbers only, ``(*batch,)``."""
    return x.isfinite().all(-1)


def motion_of_copies(reference: Reference, time: float, like: Tensor) -> Motion:
    """Return the reference at one time for each copy: ``(K, N)`` like another tensor."""
    return Motion(*(value.to(like).expand_as(like) for value in reference(time)))
