"""Run a closed loop: a control law on a plant, at control instants or in continuous time."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from pinn_dyn.control.contracts import Controller, Motion, Plant, Reference
from pinn_dyn.control.effects import Actuator, Delay, Sensor
from pinn_dyn.control.plants import check_start
from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.control.stiff_loop import StiffLoop, finite_rows, motion_of_copies
from pinn_dyn.mechanics import MechanicalSystem


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
    delay: int = 0,
    q_bound: float = 1e3,
    progress: str | None = None,
) -> ClosedLoopRecord:
    """Run a sampled closed loop, K copies at once, with the input held between instants::

        u_wanted(t_k) = law(t_k, q + noise, v + noise, reference(t_k))
        u(t_k) = actuator(u_wanted(t_k-d)),    t_k = k / rate,  k = 0 ... duration * rate

    A copy is stopped, and the others go on, once its state is not finite or q leaves its bound,
    the sensor or the law give something that is not finite, or the controller reports a fault.
    What was known at that instant is recorded: all of the plant after it is NaN. The law sees a
    stopped copy at rest where it was last measured, and the plant is started afresh without it.
    Ctrl-C ends the run early and gives the record so far.

    Args:
        plant: what is controlled.
        controller: the law; it is reset first.
        reference: the desired motion.
        q0: initial configurations, ``(K, N)``, float64.
        v0: initial velocities, ``(K, N)``, float64.
        duration: length of the run in s, an integer multiple of 1 / rate.
        rate: control instants per second, 1/s.
        actuator: limits of the input; none if None.
        sensor: noise of the measurement; none if None.
        delay: dead time of the input in control instants; zero input arrives before the first.
        q_bound: a copy with an entry of |q| beyond it has diverged, in the units of q.
        progress: label of a progress bar; no bar if None.

    Raises:
        ValueError: on sizes that do not agree, initial states that are not finite, a duration that
            is no multiple of 1 / rate, or a delay that is longer.
    """
    run = _Run(plant, controller, reference, q0, v0, duration, rate, actuator, q_bound)
    queue = Delay(delay)
    if delay >= len(run.t):
        raise ValueError(
            f"delay is {delay} instants, and the run has {len(run.t)}: no input would ever arrive; "
            f"expected less than that, in instants of {1 / rate:g} s"
        )
    if sensor is not None:
        sensor.reset()
    q, v, moving = q0.clone(), v0.clone(), run.running.clone()
    k, u = 0, torch.empty(0)
    try:
        with torch.no_grad():
            plant.start(q0, v0)
            quiet = progress is None or None  # None: unless on a terminal
            for k in tqdm(range(len(run.t)), desc=progress, disable=quiet):
                if not torch.equal(moving, run.running):
                    moving = run.running.clone()
                    plant.start(q[moving], v[moving])
                if k > 0:
                    q[moving], v[moving] = plant.advance(u[moving], 1 / rate)
                run.observe(k, q, v)
                run.measure(k, *((q, v) if sensor is None else sensor(q, v)))
                u = run.apply(k, queue(run.ask(k)))
                if not run.running.any():
                    break
    except KeyboardInterrupt:
        run.stop(run.running, float(run.t[k]), "interrupted")
        return run.record(k + 1)
    return run.record(len(run.t))


def close_loop_continuous(
    system: MechanicalSystem,
    controller: Controller,
    reference: Reference,
    q0: Tensor,
    v0: Tensor,
    *,
    duration: float,
    samples_rate: float,
    actuator: Actuator | None = None,
    rtol: float = 1e-6,
    atol: float = 1e-8,
    q_bound: float = 1e3,
    progress: str | None = None,
) -> ClosedLoopRecord:
    """Run a closed loop whose law acts in continuous time, K copies at once::

        M(q) dv/dt + C(q, v) v + G(q) + D(q) v = A(q) u,   u = limits(law(t, q, v, reference(t)))

    High gains on small inertias make it stiff, so the solver is SciPy's BDF, implicit and of order
    1 to 5 (Shampine, Reichelt 1997), with a block-diagonal Jacobian by finite differences. The
    copies share its steps, whose error is controlled in each of them. A copy that the solver
    cannot follow is stopped there, the others go on. Inputs, diagnostics and faults are those of
    the samples.

    Args:
        system: what is controlled.
        controller: the law; it must not remember what it was called with.
        reference, q0, v0, q_bound, progress: as of :func:`close_loop`.
        duration: length of the run in s, an integer multiple of 1 / samples_rate.
        samples_rate: samples of the record per second, 1/s.
        actuator: limits of the input, without a rate; none if None.
        rtol: relative tolerance of the solver.
        atol: absolute tolerance of the solver, in the units of q and v.

    Raises:
        ValueError: as :func:`close_loop`, or on an actuator with a rate limit.
    """
    if actuator is not None and actuator.rate is not None:
        raise ValueError(
            f"actuator has rate = {actuator.rate}, but in continuous time there is no instant "
            "before to limit the rate from: leave it out, or use close_loop"
        )
    run = _Run(system, controller, reference, q0, v0, duration, samples_rate, actuator, q_bound)

    def law_and_system(t: float, x: Tensor, *motion: Tensor) -> Tensor:
        q, v = x.chunk(2, dim=-1)
        u = controller(t, q, v, Motion(*motion))
        return system.velocity_derivative(x, u if actuator is None else actuator.limit(u))

    with torch.no_grad():
        x0 = torch.cat([q0, v0], dim=-1)
        loop = StiffLoop(law_and_system, reference, x0, run.t, q_bound)
        loop.solve(rtol, atol, progress)
        controller.reset()
        for k in range(len(run.t)):
            for copy, (time, reason) in enumerate(loop.ends):
                if time <= float(run.t[k]):
                    run.stop(torch.arange(len(q0)) == copy, time, reason)
            q, v = loop.states[:, k].chunk(2, dim=-1)
            run.observe(k, q, v)
            run.measure(k, q, v)
            run.apply(k, run.ask(k))
            if not run.running.any():
                break
    return run.record(len(run.t))


class _Run:
    """The state of a run: who is still running, what the law sees, and the record so far."""

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
        q_bound: float,
    ):
        n, m = plant.num_coordinates, plant.num_inputs
        _check_sizes(plant, controller, reference)
        check_start(q0, v0, n)
        for name, value in (("q0", q0), ("v0", v0)):
            if value.dtype != torch.float64:
                raise ValueError(f"{name} is {value.dtype}, expected float64: {name}.double()")
        self.t = _instants(duration, rate)
        self.running = torch.ones(len(q0), dtype=torch.bool, device=q0.device)
        self._shape_of_u = (len(q0), m)
        self._controller, self._actuator = controller, actuator
        self._interval, self._q_bound = 1 / rate, q_bound
        self._seen = q0.clone(), v0.clone()
        self._motions = [motion_of_copies(reference, float(t), q0) for t in self.t]
        samples = (len(q0), len(self.t))
        self._q, self._v = (q0.new_full((*samples, n), torch.nan) for _ in range(2))
        self._u, self._u_wanted = (q0.new_full((*samples, m), torch.nan) for _ in range(2))
        self._diagnostics: dict[str, Tensor] = {}
        self._stopped: list[str | None] = [None] * len(q0)
        controller.reset()
        if actuator is not None:
            actuator.reset()

    def stop(self, who: Tensor, time: float, reason: str) -> None:
        """Stop those of ``who`` that still run."""
        for copy in (who & self.running).nonzero()[:, 0].tolist():
            self._stopped[copy] = f"{reason} at t = {time:.6g} s"
        self.running &= ~who

    def observe(self, k: int, q: Tensor, v: Tensor) -> None:
        """Take note of the true state at instant k; stops who has diverged."""
        finite = finite_rows(q) & finite_rows(v)
        self.stop(~finite, float(self.t[k]), "the plant diverged: its state is not finite")
        self._q[self.running, k] = q[self.running]
        self._v[self.running, k] = v[self.running]
        beyond = (q.abs() > self._q_bound).any(-1)
        reason = f"the plant diverged: |q| is beyond {self._q_bound:g}"
        self.stop(beyond, float(self.t[k]), reason)

    def measure(self, k: int, q: Tensor, v: Tensor) -> None:
        """Take what the sensor says at instant k; stops whose measurement is not finite."""
        lost = ~(finite_rows(q) & finite_rows(v))
        self.stop(lost, float(self.t[k]), "the measurement is not finite")
        for seen, new in zip(self._seen, (q, v), strict=True):
            seen[self.running] = new[self.running]

    def ask(self, k: int) -> Tensor:
        """The input that the law wants at instant k; it means nothing for who has stopped."""
        time = float(self.t[k])
        q, v = self._seen
        u = self._controller(time, q, v, self._motions[k])
        if u.shape != self._shape_of_u:
            raise ValueError(
                f"the controller's input has shape {tuple(u.shape)}, expected {self._shape_of_u}"
            )
        self._u_wanted[self.running, k] = u[self.running]
        self._diagnose(k, self._controller.diagnostics())
        for reason, who in self._controller.faults().items():
            self.stop(who, time, reason)
        self.stop(~finite_rows(u), time, "the law's input is not finite")
        return u

    def apply(self, k: int, u: Tensor) -> Tensor:
        """The input that the actuator lets through at instant k."""
        if self._actuator is not None:
            u, changed = self._actuator(u, self._interval)
            self._diagnose(k, {"saturated_inputs": changed.sum(-1)})
        self._u[self.running, k] = u[self.running]
        return u

    def record(self, samples: int) -> ClosedLoopRecord:
        """What happened at the first instants."""
        motions = self._motions[:samples]
        q_ref, v_ref, a_ref = (torch.stack(values, 1) for values in zip(*motions, strict=True))
        q, v, u, u_wanted = (x[:, :samples] for x in (self._q, self._v, self._u, self._u_wanted))
        diagnostics = {name: values[:, :samples] for name, values in self._diagnostics.items()}
        reference = Motion(q_ref, v_ref, a_ref)
        t = self.t[:samples]
        return ClosedLoopRecord(t, q, v, u, u_wanted, reference, self._stopped, diagnostics)

    def _diagnose(self, k: int, values: dict[str, Tensor]) -> None:
        for name, value in values.items():
            if name not in self._diagnostics:
                self._diagnostics[name] = self._q.new_full(self._q.shape[:2], torch.nan)
            self._diagnostics[name][self.running, k] = value[self.running].to(self._q)


def _check_sizes(
    plant: Plant | MechanicalSystem, controller: Controller, reference: Reference
) -> None:
    for part, name in ((controller, "controller"), (reference, "reference")):
        if part.num_coordinates != plant.num_coordinates:
            raise ValueError(
                f"the {name} has {part.num_coordinates} coordinates and the plant "
                f"{plant.num_coordinates}: they must be for the same robot"
            )
    if controller.num_inputs != plant.num_inputs:
        raise ValueError(
            f"the controller has {controller.num_inputs} inputs and the plant "
            f"{plant.num_inputs}: they must be for the same robot"
        )


def _instants(duration: float, rate: float) -> Tensor:
    if not (0 < rate < np.inf and 0 < duration < np.inf):
        raise ValueError(
            f"duration is {duration} s and the rate {rate} 1/s, expected positive numbers"
        )
    steps = round(duration * rate)
    if steps < 1 or abs(duration * rate - steps) > 1e-6:
        raise ValueError(
            f"duration is {duration} s, expected an integer multiple of {1 / rate:g} s, the time "
            f"between instants at {rate:g} Hz"
        )
    return torch.arange(steps + 1, dtype=torch.float64) / rate
