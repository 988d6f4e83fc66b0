"""Simulate a mechanical system: many trajectories at once, by an adaptive solver."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from torch import Tensor

from pinn_dyn.data.excitation import InputSignal
from pinn_dyn.exports.compiled import Compiled
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.progress import Progress

# In units of the whole duration: far below any step that a smooth motion needs.
_SMALLEST_STEP = 1e-7


class SimulationError(RuntimeError):
    """The solver could not finish a simulation."""


def momentum(system: MechanicalSystem, q: Tensor, v: Tensor) -> Tensor:
    """Return p = M(q) v, computed in pieces that fit into the cache of the processor."""
    size = q.shape[-1]
    pieces = zip(q.reshape(-1, size).split(2048), v.reshape(-1, size).split(2048), strict=True)
    with torch.no_grad():
        return torch.cat([system.momentum(*piece) for piece in pieces]).reshape(q.shape)


def simulate(
    system: MechanicalSystem,
    q0: np.ndarray,
    v0: np.ndarray,
    signal: InputSignal,
    t: np.ndarray,
    *,
    rtol: float = 1e-8,
    atol: float = 1e-9,
    compile: bool = False,
    q_limits: np.ndarray | None = None,
    progress: str | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the equation of motion for K trajectories in one batch.

    The solver is SciPy's DOP853 (Hairer, Norsett, Wanner 1993). All trajectories share its steps,
    with an error control of the root mean square over the batch. The samples are taken from its
    dense output.

    Args:
        q0, v0: initial configurations and velocities, ``(K, N)``.
        signal: inputs as a function of time, ``(T,) -> (K, T, M)``; must be smooth.
        t: increasing sample times, ``(T,)``, s.
        rtol, atol: tolerances of the solver.
        compile: compile the equation of motion, if there is a C compiler, see :class:`Compiled`.
        q_limits: limits of q, ``(2, N)``; samples after a motion has left its limits are NaN.
        progress: name of the task in lines of progress; None logs none.

    Returns:
        q and v, both ``(K, T, N)``.

    Raises:
        SimulationError: if the solver fails or the motion is not finite. The message names the
            time.
    """
    x0 = np.concatenate([q0, v0], axis=-1)
    count, size = x0.shape
    half = size // 2
    low, high = (-np.inf, np.inf) if q_limits is None else q_limits

    def outside(x: np.ndarray) -> np.ndarray:
        q = x[..., :half]
        return np.asarray(((q < low) | (q > high)).any(-1))

    left = outside(x0)
    code = Compiled(system)

    def equation(rows: Tensor) -> Tensor:
        return system.velocity_derivative(rows[..., :size], rows[..., size:])

    def derivative(time: float, flat: np.ndarray) -> np.ndarray:
        u = signal(np.array([time]))[:, 0]
        rows = torch.from_numpy(np.hstack([flat.reshape(count, size), u]))
        with torch.no_grad():
            slope = code.rows("velocity_derivative", equation, rows) if compile else equation(rows)
        return np.where(left[:, None], 0.0, slope.numpy()).ravel()

    def give_up(time: float) -> SimulationError:
        return SimulationError(
            f"the simulation stopped at t = {time:.4g} s of {t[-1]:.4g} s: the mass matrix is no "
            "longer positive definite, or the input is not finite; reduce the input or the initial "
            f"states, or loosen rtol = {rtol:g}, atol = {atol:g}"
        )

    if not np.isfinite(derivative(t[0], x0.ravel())).all():
        raise give_up(t[0])
    states = np.full((count, len(t), size), np.nan)
    states[:, 0] = x0
    filled = 1
    solver = scipy.integrate.DOP853(derivative, t[0], x0.ravel(), t[-1], rtol=rtol, atol=atol)
    with Progress(progress, float(t[-1] - t[0]), "s") as lines:
        while solver.status == "running" and not left.all():
            solver.step()
            # The last step may be short, since it ends at the last time.
            stuck = solver.status == "running" and solver.step_size < _SMALLEST_STEP * t[-1]
            if stuck or solver.status == "failed":
                raise give_up(solver.t)
            until = int(np.searchsorted(t, solver.t, side="right"))
            if until > filled:
                dense = solver.dense_output()(t[filled:until]).reshape(count, size, -1)
                states[~left, filled:until] = dense.swapaxes(1, 2)[~left]
                left |= outside(states[:, filled:until]).any(-1)
                filled = until
            left |= outside(solver.y.reshape(count, size))
            solver.f[np.repeat(left, size)] = 0.0  # the slope at the start of the next step
            lines.update(float(solver.t - t[0]))
    return states[..., :half], states[..., half:]
