"""The plants of a closed loop: a mechanical system by an adaptive solver, and a Bullet arm."""

from __future__ import annotations

import logging

import numpy as np
import torch
from scipy.integrate import RK45
from torch import Tensor

from pinn_dyn.control.contracts import Plant
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import require_finite
from pinn_dyn.systems import Stepped

log = logging.getLogger(__name__)

# Far below any step that the motion of a robot needs, s.
_SMALLEST_STEP = 1e-6

_NODES = torch.tensor(RK45.A)
_WEIGHTS = torch.tensor(RK45.B)
_ERROR_WEIGHTS = torch.tensor(RK45.E)
_ORDER_OF_ERROR = 5


class SystemPlant(Plant):
    """K copies of a mechanical system, solved between control instants with the input held.

    The solver is the Runge-Kutta pair of Dormand and Prince of order 5(4) (the tableau is SciPy's
    ``RK45``; Hairer, Norsett, Wanner 1993, II.4-5). All copies share its steps; a step is accepted
    if in every copy the root mean square of the error over the 2N components of (q, v), relative
    to atol + rtol |(q, v)|, is at most 1. The step is carried over to the next control instant.

    A copy that needs steps below a microsecond, as where its mass matrix is no longer positive
    definite, or whose input is not finite, becomes NaN and stays so.

    Args:
        system: what moves.
        rtol: relative tolerance of the solver.
        atol: absolute tolerance of the solver, in the units of q and v.
        compile: compile the equation of motion first; takes half a minute, and pays for long
            runs. Without a C++ compiler it runs uncompiled, and says so.
    """

    def __init__(
        self,
        system: MechanicalSystem,
        *,
        rtol: float = 1e-6,
        atol: float = 1e-8,
        compile: bool = False,
    ):
        self.num_coordinates = system.num_coordinates
        self.num_inputs = system.num_inputs
        self._equation = system.velocity_derivative
        self._rtol, self._atol = rtol, atol
        if compile and has_cpp_compiler():
            self._equation = torch.compile(system.velocity_derivative)
        elif compile:
            log.warning("no C++ compiler (g++ or clang++) on the path: running uncompiled, slower")

    def start(self, q0: Tensor, v0: Tensor) -> None:
        check_start(q0, v0, self.num_coordinates)
        self._x = torch.cat([q0, v0], dim=-1)
        self._step: float | None = None

    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        _check_advance(self, self._x, u, duration)
        self._x[~u.isfinite().all(-1)] = torch.nan
        time, step = 0.0, self._step or duration
        slopes: list[Tensor] = []
        with torch.no_grad():
            while duration - time > 1e-12 * duration and bool(
                (alive := self._x[:, 0].isfinite()).any()
            ):
                x, held = self._x[alive], u[alive]
                # Equal steps up to the next instant, rather than a short one at the end.
                h = (duration - time) / np.ceil((duration - time) / step * (1 - 1e-9))
                slopes = slopes or [self._equation(x, held)]
                x_new, last_slope, error = self._try_step(x, held, h, slopes[0])
                # An error that is not a number is a step that has to be smaller.
                error = error.nan_to_num(nan=torch.inf)
                worst = float(error.max())
                step = h * min(5.0, max(0.2, 0.9 * max(worst, 1e-9) ** (-1 / _ORDER_OF_ERROR)))
                if worst <= 1:
                    self._x[alive] = x_new
                    slopes = [last_slope]
                    time += h
                elif step < _SMALLEST_STEP:
                    lost = error > 1
                    self._x[alive.nonzero()[lost, 0]] = torch.nan
                    slopes = [slopes[0][~lost]]
        self._step = step
        q, v = self._x.chunk(2, dim=-1)
        return q.clone(), v.clone()

    def _try_step(
        self, x: Tensor, u: Tensor, h: float, slope: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The state after a step, the slope there, and the error of each copy, ``(K,)``."""
        stages = [slope]
        for row in range(1, len(_NODES)):
            stages.append(self._equation(x + h * _combine(_NODES[row], stages), u))
        x_new = x + h * _combine(_WEIGHTS, stages)
        stages.append(self._equation(x_new, u))
        scale = self._atol + self._rtol * torch.maximum(x.abs(), x_new.abs())
        error = h * _combine(_ERROR_WEIGHTS, stages) / scale
        return x_new, stages[-1], error.square().mean(-1).sqrt()


class BulletPlant(Plant):
    """K copies of a robot that a simulator such as Bullet moves in steps of its own, in turn.

    Args:
        arm: the robot, which applies its damping itself.
        step: time step of the simulator, s.

    Raises:
        TypeError: if the robot does not step by itself.
        ValueError: on a step that is not positive.
    """

    def __init__(self, arm: Stepped, *, step: float = 0.001):
        if not isinstance(arm, Stepped):
            raise TypeError(
                f"arm is a {type(arm).__name__}, expected a robot with set_state and step, such as "
                "a BulletArm: use plant=simulated for other systems"
            )
        if not step > 0:
            raise ValueError(f"step is {step} s, expected a positive number")
        self.num_coordinates = arm.num_coordinates
        self.num_inputs = arm.num_inputs
        self._arm, self._step = arm, step

    def start(self, q0: Tensor, v0: Tensor) -> None:
        check_start(q0, v0, self.num_coordinates)
        self._x = torch.cat([q0, v0], dim=-1)

    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        """As the contract; the duration must be an integer multiple of the step.

        Raises:
            ValueError: if it is not.
        """
        _check_advance(self, self._x, u, duration)
        steps = round(duration / self._step)
        if steps < 1 or abs(duration / self._step - steps) > 1e-6:
            raise ValueError(
                f"duration is {duration:g} s and the simulator's step {self._step:g} s: expected "
                "an integer multiple of it, change the rate of the controller or BulletPlant(step=)"
            )
        for k in range(len(u)):
            state = self._move(self._x[k].double().numpy(), u[k].double().numpy(), steps)
            self._x[k] = torch.from_numpy(state)
        q, v = self._x.chunk(2, dim=-1)
        return q.clone(), v.clone()

    def _move(self, state: np.ndarray, torque: np.ndarray, steps: int) -> np.ndarray:
        """(q, v) of one copy after some steps; NaN once it has left the finite numbers."""
        if np.isfinite(state).all() and np.isfinite(torque).all():
            self._arm.set_state(*np.split(state, 2))
            for _ in range(steps):
                state = np.concatenate(self._arm.step(torque, self._step))
                if not np.isfinite(state).all():
                    break
            else:
                return state
        return np.full_like(state, np.nan)


def _combine(weights: Tensor, stages: list[Tensor]) -> Tensor:
    """sum_i weights_i stages_i, over the stages there are."""
    return torch.tensordot(weights[: len(stages)].to(stages[0]), torch.stack(stages), dims=1)


def check_start(q0: Tensor, v0: Tensor, size: int) -> None:
    """Refuse initial states that are not ``(K, N)`` twice, or not finite.

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


def _check_advance(plant: Plant, x: Tensor, u: Tensor, duration: float) -> None:
    if u.shape != (len(x), plant.num_inputs):
        raise ValueError(
            f"u has shape {tuple(u.shape)}, expected {(len(x), plant.num_inputs)}: one row for "
            "each copy that was started"
        )
    if not duration > 0:
        raise ValueError(f"duration is {duration} s, expected a positive number")
