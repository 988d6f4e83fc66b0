"""Plants of a closed loop: a mechanical system with an ODE solver, and a simulator."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.control.contracts import Plant
from pinn_dyn.exports.compiled import Compiled
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.systems import Stepped

# Far below any step that the motion of a robot needs, s.
_SMALLEST_STEP = 1e-6


class SystemPlant(Plant):
    """K copies of a mechanical system, integrated with a held input between control instants.

    The solver is SciPy's ``RK45`` (Dormand and Prince 1980). All copies share its steps, and each
    copy keeps the tolerance. The state of a copy that needs steps below a microsecond, or whose
    input is not finite, becomes and stays NaN.

    Args:
        system: the system that moves.
        rtol, atol: tolerances of the solver, relative and in the units of q and v.
    """

    def __init__(
        self, system: MechanicalSystem, *, rtol: PositiveFloat = 1e-6, atol: PositiveFloat = 1e-8
    ):
        self.num_coordinates = system.num_coordinates
        self.num_inputs = system.num_inputs
        self._system, self._compiled = system, Compiled(system)
        self._rtol, self._atol = rtol, atol

    def start(self, q0: Tensor, v0: Tensor) -> None:
        self._x = torch.cat([q0, v0], dim=-1)
        self._step = np.inf

    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        moving = self._x.isfinite().all(-1) & u.isfinite().all(-1)
        self._x[~moving] = torch.nan
        if moving.any():
            self._x[moving] = self._solve(self._x[moving], u[moving], duration)
        q, v = self._x.chunk(2, dim=-1)
        return q.clone(), v.clone()

    def _solve(self, x: Tensor, u: Tensor, duration: float) -> Tensor:
        """Return the states after a time in s, ``(k, 2N)``; NaN where the solver fails."""
        size = x.shape[-1]

        def rates(rows: Tensor) -> Tensor:
            return self._system.velocity_derivative(rows[..., :size], rows[..., size:])

        rows = torch.cat([x, u], dim=-1)

        def slope(time: float, flat: np.ndarray) -> np.ndarray:
            rows[:, :size] = torch.from_numpy(flat).view(x.shape)
            with torch.no_grad():
                return self._compiled.rows("velocity_derivative", rates, rows).numpy().ravel()

        share = len(x) ** -0.5  # SciPy compares the root mean square over all copies
        solver = scipy.integrate.RK45(
            slope,
            0.0,
            x.numpy().ravel(),
            duration,
            rtol=share * self._rtol,
            atol=share * self._atol,
            first_step=min(max(self._step, 10 * _SMALLEST_STEP), duration),
        )
        while solver.status == "running":
            solver.step()
            if solver.status == "running" and solver.step_size < _SMALLEST_STEP:
                break
        if solver.status == "finished":
            self._step = solver.h_abs
            return torch.from_numpy(solver.y).reshape(x.shape)
        if len(x) == 1:
            return torch.full_like(x, torch.nan)
        pairs = zip(x.split(1), u.split(1), strict=True)
        return torch.cat([self._solve(*pair, duration) for pair in pairs])


class SimulatorPlant(Plant):
    """K copies of a robot in a simulator such as MuJoCo, moved one after the other.

    Args:
        arm: the robot. Its :meth:`step` applies the damping.
        step: time step of the simulator, s.
    """

    def __init__(self, arm: Stepped, *, step: PositiveFloat = 0.001):
        self.num_coordinates = arm.num_coordinates
        self.num_inputs = arm.num_inputs
        self._arm, self._step = arm, step

    def start(self, q0: Tensor, v0: Tensor) -> None:
        self._x = torch.cat([q0, v0], dim=-1).double()

    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        """Hold the input for an integer multiple of the step, or raise ValueError."""
        steps = round(duration / self._step)
        if steps < 1 or abs(duration / self._step - steps) > 1e-6:
            raise ValueError(
                f"duration is {duration:g} s, expected an integer multiple of the simulator's step "
                f"of {self._step:g} s: change the rate or the step"
            )
        for k, torque in enumerate(u.double().numpy()):
            state = self._x[k].numpy()
            if np.isfinite(state).all() and np.isfinite(torque).all():
                self._arm.set_state(*np.split(state, 2))
                for _ in range(steps):
                    state = np.concatenate(self._arm.step(torque, self._step))
            finite = np.isfinite(state).all() and np.isfinite(torque).all()
            self._x[k] = torch.from_numpy(state) if finite else torch.nan
        q, v = self._x.chunk(2, dim=-1)
        return q.clone(), v.clone()
