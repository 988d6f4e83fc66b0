"""Simulate a mechanical system: many trajectories at once, by an adaptive solver."""

from __future__ import annotations

import numpy as np
import torch
from scipy.integrate import DOP853
from tqdm import tqdm

from pinn_dyn.data.excitation import Signal
from pinn_dyn.mechanics import MechanicalSystem


class SimulationError(RuntimeError):
    """The solver could not finish a simulation."""


def simulate(
    system: MechanicalSystem,
    q0: np.ndarray,
    v0: np.ndarray,
    signal: Signal,
    t: np.ndarray,
    *,
    rtol: float = 1e-8,
    atol: float = 1e-9,
    progress: str | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the equation of motion for K trajectories in one batch.

    The solver is SciPy's DOP853 (Runge-Kutta of order 8 with a dense output of order 7; Hairer,
    Norsett, Wanner 1993); all trajectories share its steps, whose error is controlled in the
    root mean square over the batch, and the samples come from its dense output.

    Args:
        system: the truth.
        q0: initial configurations, ``(K, N)``.
        v0: initial velocities, ``(K, N)``.
        signal: inputs as a function of time, ``(T,) -> (K, T, M)``; must be smooth.
        t: sample times, ``(T,)``, s, increasing.
        rtol: relative tolerance of the solver.
        atol: absolute tolerance of the solver.
        progress: label of a progress bar; no bar if None.

    Returns:
        q and v, both ``(K, T, N)``.

    Raises:
        ValueError: on a non-finite initial state.
        SimulationError: if the solver fails or the motion leaves the finite numbers; says when.
    """
    x0 = np.concatenate([q0, v0], axis=-1)
    if not np.isfinite(x0).all():
        k = int(np.argwhere(~np.isfinite(x0))[0][0])
        raise ValueError(f"initial state {k} is {x0[k].tolist()}: expected finite numbers")
    count, size = x0.shape

    def derivative(time: float, flat: np.ndarray) -> np.ndarray:
        x = torch.from_numpy(np.array(flat.reshape(count, size)))
        u = torch.from_numpy(signal(np.array([time]))[:, 0])
        with torch.inference_mode():
            return system.velocity_derivative(x, u).numpy().ravel()

    states = np.empty((count, len(t), size))
    solver = DOP853(derivative, t[0], x0.ravel(), t[-1], rtol=rtol, atol=atol)
    states[:, 0] = x0
    filled = 1
    with tqdm(
        total=float(t[-1] - t[0]),
        desc=progress,
        disable=progress is None,
        bar_format="{l_bar}{bar}| {n:.2f}/{total:.2f} s simulated [{elapsed}<{remaining}]",
    ) as bar:
        while solver.status == "running":
            try:
                message = solver.step()
            except torch.linalg.LinAlgError as error:
                raise SimulationError(
                    f"the mass matrix lost its positive definiteness near t = {solver.t:.4g} s: "
                    "the motion left the region where the system is defined; reduce the input or "
                    "the initial states"
                ) from error
            if solver.status == "failed" or not np.isfinite(solver.y).all():
                raise SimulationError(
                    f"the solver stopped at t = {solver.t:.4g} s of {t[-1]:.4g} s: "
                    f"{message or 'the state is no longer finite'}; reduce the input, or loosen "
                    f"rtol = {rtol:g} and atol = {atol:g}"
                )
            until = int(np.searchsorted(t, solver.t, side="right"))
            if until > filled:
                dense = solver.dense_output()(t[filled:until])
                states[:, filled:until] = dense.T.reshape(until - filled, count, size).swapaxes(
                    0, 1
                )
                filled = until
            bar.update(float(solver.t - solver.t_old))
    half = size // 2
    return states[..., :half], states[..., half:]
