"""Run a closed loop whose law acts in continuous time."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from torch import Tensor

from pinn_dyn.control.closed_loop import LoopRun, finite_rows, motion_of_copies
from pinn_dyn.control.contracts import Controller, Motion, Reference
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.progress import Progress

_RTOL, _ATOL = 1e-6, 1e-8  # tolerances of the solver, relative and in the units of q and v


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
    progress: str | None = None,
) -> ClosedLoopRecord:
    """Run a closed loop whose law acts in continuous time, K copies at once::

        M(q) dv/dt + C(q, v) v + G(q) + D(q) v = A(q) u,   u = limits(law(t, q, v, reference(t)))

    High gains on small inertias make the loop stiff, so the solver is SciPy's implicit BDF
    (Shampine and Reichelt 1997). A copy that the solver cannot follow is stopped.

    Args:
        system: the system that is controlled.
        controller: the law; it must have no memory.
        reference, q0, v0, duration, progress: as for :func:`close_loop`.
        samples_rate: samples of the record per second, 1/s.
        actuator: limits of the input, without a rate.
    """
    if actuator is not None and actuator.rate is not None:
        raise ValueError("actuator.rate needs control instants: leave it out, or give a rate")
    q0, v0 = q0.double(), v0.double()
    run = LoopRun(system, controller, reference, q0, v0, duration, samples_rate, actuator)
    motion = _Motion(system, controller, reference, torch.cat([q0, v0], -1), actuator, run)
    with torch.no_grad():
        all_copies = torch.arange(len(q0))
        ends = [motion.integrate(all_copies, progress)] * len(q0)
        if ends[0][0] < np.inf and len(q0) > 1:
            ends = [motion.integrate(copy, progress) for copy in all_copies.split(1)]
        controller.reset()
        for k in range(len(run.t)):
            for copy, (time, reason) in enumerate(ends):
                if time <= float(run.t[k]):
                    run.stop(all_copies == copy, time, reason)
            q, v = motion.states[:, k].chunk(2, dim=-1)
            run.observe(k, q, v)
            run.measure(k, q, v)
            run.apply(k, run.ask(k))
            if not run.running.any():
                break
    return run.record(len(run.t))


class _Motion:
    """Motion of the loop from states ``(K, 2N)``; a copy that is lost has NaN from then on."""

    def __init__(
        self,
        system: MechanicalSystem,
        controller: Controller,
        reference: Reference,
        start: Tensor,
        actuator: Actuator | None,
        run: LoopRun,
    ):
        self.system, self.controller, self.reference = system, controller, reference
        self.actuator, self.t, self.q_bound = actuator, run.t, run.q_bound
        self.start = start
        self.states = start.new_full((len(start), len(run.t), start.shape[1]), torch.nan)
        self.states[:, 0] = start

    def slope(self, copies: Tensor, time: float, x: Tensor) -> Tensor:
        """Return dx/dt of states ``(batch, k, 2N)``."""
        motion = motion_of_copies(self.reference, time, self.start.chunk(2, dim=-1)[0])
        rows = [y[copies].expand(*x.shape[:-1], -1).flatten(0, 1) for y in motion]
        flat = x.flatten(0, 1)
        q, v = flat.chunk(2, dim=-1)
        u = self.controller(time, q, v, Motion(*rows))
        u = u if self.actuator is None else self.actuator.limit(u)
        return self.system.velocity_derivative(flat, u).reshape(x.shape)

    def integrate(self, copies: Tensor, progress: str | None) -> tuple[float, str]:
        """Fill in the states of some copies; return when and why one of them was lost."""
        count = len(copies)
        if not finite_rows(self.slope(copies, 0.0, self.start[None, copies])).all():
            return 0.0, "the plant diverged: the acceleration is not finite"
        solver = self._solver(copies)
        with Progress(progress, float(self.t[-1]), "s") as lines:
            while solver.status == "running":
                time = float(solver.t)
                try:
                    solver.step()
                except (RuntimeError, ValueError):  # the Jacobian is not finite
                    solver.status = "failed"
                if solver.status == "failed":
                    return time, "the plant diverged: the solver cannot follow the motion"
                now = ((self.t > time) & (self.t <= solver.t)).nonzero()[:, 0]
                if len(now):
                    x = torch.from_numpy(solver.dense_output()(self.t[now].numpy()))
                    self.states[copies[:, None], now] = x.unflatten(0, (count, -1)).transpose(1, 2)
                lines.update(float(solver.t))
                if np.abs(solver.y.reshape(count, 2, -1)[:, 0]).max() > self.q_bound:
                    reason = f"the plant diverged: |q| is beyond {self.q_bound:g}"
                    return float(solver.t), reason
        return np.inf, ""

    def _solver(self, copies: Tensor) -> scipy.integrate.BDF:
        count, size = len(copies), self.start.shape[1]

        def slope(time: float, flat: np.ndarray) -> np.ndarray:
            x = torch.from_numpy(np.ascontiguousarray(flat.T)).reshape(-1, count, size)
            rates = self.slope(copies, time, x).numpy()
            return rates.reshape(-1, count * size).T.reshape(flat.shape)

        share = count**-0.5  # SciPy takes the root mean square over all copies
        return scipy.integrate.BDF(
            slope,
            0.0,
            self.start[copies].numpy().ravel(),
            float(self.t[-1]),
            rtol=share * _RTOL,
            atol=share * _ATOL,
            jac_sparsity=scipy.sparse.block_diag([np.ones((size, size))] * count),
            vectorized=True,
        )
