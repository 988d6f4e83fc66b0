"""The plants of a closed loop: a mechanical system by an ODE solver, and a stepped simulator."""

from __future__ import annotations

import numpy as np
import torch
from pydantic import PositiveFloat
from scipy.integrate import RK45
from torch import Tensor

from pinn_dyn.control.contracts import Plant
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import require_finite
from pinn_dyn.systems import Stepped

# Far below any step that the motion of a robot needs, s.
_SMALLEST_STEP = 1e-6


class SystemPlant(Plant):
    """K copies of a mechanical system, solved between control instants with the input held.

    The solver is SciPy's ``RK45`` (Dormand and Prince 1980). All copies share its steps. The root
    mean square of the error over all copies is kept below 1/sqrt(K) of the tolerance, so that each
    copy keeps the tolerance. A copy that needs steps below a microsecond, such as one whose mass
    matrix is no longer positive definite, or whose input is not finite, becomes NaN and stays so.

    Args:
        system: the system that moves.
        rtol: relative tolerance of the solver.
        atol: absolute tolerance of the solver, in the units of q and v.
    """

    def __init__(
        self,
        system: MechanicalSystem,
        *,
        rtol: PositiveFloat = 1e-6,
        atol: PositiveFloat = 1e-8,
    ):
        self.num_coordinates = system.num_coordinates
        self.num_inputs = system.num_inputs
        self._system = system
        self._rtol, self._atol = rtol, atol

    def start(self, q0: Tensor, v0: Tensor) -> None:
        check_start(q0, v0, self.num_coordinates)
        self._x = torch.cat([q0, v0], dim=-1)
        self._step = np.inf

    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        moving = (self._x.isfinite() & u.isfinite().all(-1, keepdim=True)).all(-1)
        self._x[~moving] = torch.nan
        if moving.any():
            self._x[moving] = self._solve(self._x[moving], u[moving], duration)
        q, v = self._x.chunk(2, dim=-1)
        return q.clone(), v.clone()

    def _solve(self, x: Tensor, u: Tensor, duration: float) -> Tensor:
        """Return the states after a time, ``(k, 2N)``, NaN where the solver cannot follow."""

        def slope(time: float, flat: np.ndarray) -> np.ndarray:
            with torch.no_grad():
                states = torch.from_numpy(flat).reshape(x.shape)
                return self._system.velocity_derivative(states, u).numpy().ravel()

        share = len(x) ** -0.5
        solver = RK45(
            slope,
            0.0,
            x.numpy().ravel(),
            duration,
            rtol=share * self._rtol,
            atol=share * self._atol,
            first_step=min(self._step, duration),
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
    """K copies of a robot that a simulator such as PyBullet moves in time steps, in turn.

    Args:
        arm: the robot, which applies its damping itself.
        step: time step of the simulator, s.

    Raises:
        TypeError: if the robot does not step by itself.
    """

    def __init__(self, arm: Stepped, *, step: PositiveFloat = 0.001):
        if not isinstance(arm, Stepped):
            raise TypeError(
                f"arm is a {type(arm).__name__}, expected a robot with set_state and step, such as "
                "a BulletArm: use plant=simulated for other systems"
            )
        self.num_coordinates = arm.num_coordinates
        self.num_inputs = arm.num_inputs
        self._arm, self._step = arm, step

    def start(self, q0: Tensor, v0: Tensor) -> None:
        check_start(q0, v0, self.num_coordinates)
        self._x = torch.cat([q0, v0], dim=-1)

    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        """Hold the input for a duration that is an integer multiple of the step.

        Raises:
            ValueError: on another duration.
        """
        steps = round(duration / self._step)
        if steps < 1 or abs(duration / self._step - steps) > 1e-6:
            raise ValueError(
                f"duration is {duration:g} s and the simulator's step {self._step:g} s: expected "
                "an integer multiple of it, change the rate of the controller or plant.step"
            )
        for k in range(len(u)):
            state = self._move(self._x[k].double().numpy(), u[k].double().numpy(), steps)
            self._x[k] = torch.from_numpy(state)
        q, v = self._x.chunk(2, dim=-1)
        return q.clone(), v.clone()

    def _move(self, state: np.ndarray, torque: np.ndarray, steps: int) -> np.ndarray:
        """Return (q, v) of one copy after some steps, NaN once a number is not finite."""
        if np.isfinite(state).all() and np.isfinite(torque).all():
            self._arm.set_state(*np.split(state, 2))
            for _ in range(steps):
                state = np.concatenate(self._arm.step(torque, self._step))
            if np.isfinite(state).all():
                return state
        return np.full_like(state, np.nan)


def check_start(q0: Tensor, v0: Tensor, size: int) -> None:
    """Check that the initial states are finite and ``(K, N)``.

    Raises:
        ValueError: naming the argument.
    """
    for name, value in (("q0", q0), ("v0", v0)):
        if value.ndim != 2 or value.shape != (len(q0), size) or not len(q0):
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, expected (K, {size}): K copies, the "
                "same for q0 and v0"
            )
        require_finite(name, value)
