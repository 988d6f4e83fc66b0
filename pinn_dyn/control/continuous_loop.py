"""Run a closed loop whose law acts in continuous time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.integrate import BDF
from scipy.sparse import block_diag
from torch import Tensor
from tqdm import tqdm

from pinn_dyn.control.closed_loop import LoopRun, finite_rows, motion_of_copies
from pinn_dyn.control.contracts import Controller, Motion, Reference
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.mechanics import MechanicalSystem

_Field = Callable[[Tensor, float, Tensor], Tensor]  # of copies (k,), time, states (k, 2N)


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

    High gains on small inertias make the loop stiff, so the solver is SciPy's BDF, implicit and of
    order 1 to 5 (Shampine and Reichelt 1997). All copies share its steps, whose error is controlled
    in each of them; where one copy fails, each copy is solved alone. A copy that the solver cannot
    follow is stopped, the others go on. Inputs, diagnostics and faults are those of the samples.

    Args:
        system: the system that is controlled.
        controller: the law; it must have no memory.
        reference, q0, v0, q_bound, progress: as for :func:`close_loop`.
        duration: length of the run in s, an integer multiple of 1 / samples_rate.
        samples_rate: samples of the record per second, 1/s.
        actuator: limits of the input, without a rate; None for no limits.
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
    q0, v0 = q0.double(), v0.double()
    run = LoopRun(system, controller, reference, q0, v0, duration, samples_rate, actuator, q_bound)

    def field(copies: Tensor, time: float, x: Tensor) -> Tensor:
        """Return dx/dt of states ``(batch, k, 2N)``."""
        motion = motion_of_copies(reference, time, q0)
        rows = [y[copies].expand(*x.shape[:-1], -1).flatten(0, 1) for y in motion]
        flat = x.flatten(0, 1)
        q, v = flat.chunk(2, dim=-1)
        u = controller(time, q, v, Motion(*rows))
        u = u if actuator is None else actuator.limit(u)
        return system.velocity_derivative(flat, u).reshape(x.shape)

    with torch.no_grad():
        states, ends = _solve(field, torch.cat([q0, v0], -1), run.t, rtol, atol, q_bound, progress)
        controller.reset()
        for k in range(len(run.t)):
            for copy, (time, reason) in enumerate(ends):
                if time <= float(run.t[k]):
                    run.stop(torch.arange(len(q0)) == copy, time, reason)
            q, v = states[:, k].chunk(2, dim=-1)
            run.observe(k, q, v)
            run.measure(k, q, v)
            run.apply(k, run.ask(k))
            if not run.running.any():
                break
    return run.record(len(run.t))


def _solve(
    field: _Field,
    x0: Tensor,
    t: Tensor,
    rtol: float,
    atol: float,
    q_bound: float,
    progress: str | None,
) -> tuple[Tensor, list[tuple[float, str]]]:
    """Return the states ``(K, T, 2N)``, and when and why each copy was lost, infinity if never."""
    states = x0.new_full((len(x0), len(t), x0.shape[-1]), torch.nan)
    states[:, 0] = x0
    copies = torch.arange(len(x0))
    settings = t, rtol, atol, q_bound, progress
    end = _integrate(field, copies, states, *settings)
    if end[0] < np.inf and len(x0) > 1:
        return states, [_integrate(field, copies[k : k + 1], states, *settings) for k in copies]
    return states, [end] * len(x0)


def _integrate(
    field: _Field,
    copies: Tensor,
    states: Tensor,
    t: Tensor,
    rtol: float,
    atol: float,
    q_bound: float,
    progress: str | None,
) -> tuple[float, str]:
    """Fill in the states of some copies; return when and why the first of them was lost."""
    count, size = len(copies), states.shape[-1]
    x0, end = states[copies, 0], float(t[-1])
    if not finite_rows(field(copies, 0.0, x0[None])).all():
        return 0.0, "the plant diverged: the acceleration is not finite"

    def slope(time: float, flat: np.ndarray) -> np.ndarray:
        x = torch.from_numpy(np.ascontiguousarray(flat.T)).reshape(-1, count, size)
        return field(copies, time, x).numpy().reshape(-1, count * size).T.reshape(flat.shape)

    # SciPy takes the root mean square over all copies; this share keeps each copy accurate.
    share = count**-0.5
    solver = BDF(
        slope,
        0.0,
        x0.numpy().ravel(),
        end,
        rtol=share * rtol,
        atol=share * atol,
        jac_sparsity=block_diag([np.ones((size, size))] * count),
        vectorized=True,
    )
    with tqdm(
        total=end,
        desc=progress,
        disable=progress is None or None,  # None: unless on a terminal
        bar_format="{l_bar}{bar}| {n:.2f}/{total:.2f} s simulated [{elapsed}<{remaining}]",
    ) as bar:
        while solver.status == "running":
            time = float(solver.t)
            try:
                solver.step()
            except (RuntimeError, ValueError):  # the Jacobian is not finite
                solver.status = "failed"
            if solver.status == "failed":
                return time, "the plant diverged: the solver cannot follow the motion"
            samples = ((t > time) & (t <= solver.t)).nonzero()[:, 0]
            if len(samples):
                dense = torch.from_numpy(solver.dense_output()(t[samples].numpy()))
                states[copies[:, None], samples] = dense.unflatten(0, (count, -1)).transpose(1, 2)
            bar.update(float(solver.t) - time)
            if np.abs(solver.y.reshape(count, 2, -1)[:, 0]).max() > q_bound:
                return float(solver.t), f"the plant diverged: |q| is beyond {q_bound:g}"
    return np.inf, ""
