"""Model predictive control on a mechanical system, true or learned."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion, Reference
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.shooting import Limits, Plan, ShootingProblem, Weights
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import pseudo_inverse_times

log = logging.getLogger(__name__)

_FIRST_ITERATIONS = 20  # times as many iterations at the first instant, without a previous plan
_LARGEST_GAP = 0.1  # largest gap of a plan that counts as a solution
_LIMIT_WEIGHT = 1e3  # rho of a violated limit of the state
_Values = float | Sequence[float] | None
Weight = NonNegativeFloat | Sequence[NonNegativeFloat]
"""Weight of all coordinates or inputs, or of each."""


class _Memory(NamedTuple):
    t: float
    x: np.ndarray
    u: np.ndarray
    d: np.ndarray
    plan: Plan | None
    failures: int


class PredictiveControl(Controller):
    """Model predictive control with limits, through CasADi (``pip install 'pinn_dyn[mpc]'``).

    With a C compiler, the model is compiled first, which takes some seconds.

    At each instant, the law plans a motion over the horizon by :class:`ShootingProblem`, starting
    from the previous plan, and applies its first input. The plan follows the future reference,
    within limits of the state, if the loop calls :meth:`follow`, as :func:`close_loop` does.

    u_ref is A^+ times the inverse dynamics of the reference, within the limits. It is zero for a
    force that is not linear in the input. If the solver fails, as for a state that is not finite,
    the law holds the last input.

    Args:
        model: the mechanical system to plan with, in float64.
        horizon: length of a plan, s.
        step: step of a plan, s. It may differ from the period of the loop.
        position_weight, velocity_weight: Q, one number or N.
        input_weight, rate_weight: R of u - u_ref and S of du/dt, one number or M.
        terminal_weight: P in multiples of Q; None for P of the linear-quadratic regulator at the
            end of the reference.
        actuator: hard limits of the input and of its rate. Limits of the drives in the model are
            limits, too.
        q_low, q_high, v_max: soft limits of the state, one number or N; None for no limit.
        iterations: quadratic programs per instant; the first instant may take 20 times as many.
        observer_bandwidth: K_O in 1/s of an observer of the acceleration d that the model does not
            explain, d_k+1 = d_k + (1 - exp(-K_O T)) (measured - d_k); None for d = 0.

    Attributes:
        plans: the latest plan of each run, None where the solver failed.

    Raises:
        ImportError: without CasADi.
        ValueError: on values that do not fit N or M, crossed limits, or a horizon below two steps.
    """

    def __init__(
        self,
        model: MechanicalSystem,
        horizon: PositiveFloat,
        step: PositiveFloat,
        *,
        position_weight: Weight = 1.0,
        velocity_weight: Weight = 0.1,
        input_weight: Annotated[float, Field(gt=0)] | Sequence[PositiveFloat] = 1e-3,
        rate_weight: Weight = 0.0,
        terminal_weight: NonNegativeFloat | None = None,
        actuator: Actuator | None = None,
        q_low: _Values = None,
        q_high: _Values = None,
        v_max: PositiveFloat | Sequence[PositiveFloat] | None = None,
        iterations: PositiveInt = 2,
        observer_bandwidth: PositiveFloat | None = None,
    ):
        n, m = model.num_coordinates, model.num_inputs
        super().__init__(n, m)
        self.model, self.step = model, float(step)
        steps = round(horizon / step)
        if steps < 2:
            raise ValueError(f"horizon is {horizon} s, expected two steps of {step} s or more")
        actuator = actuator or Actuator()
        largest = model.largest_input()
        most = np.full(m, np.inf) if largest is None else largest.detach().numpy()
        v_high = _row("v_max", v_max, n, np.inf)
        low, high = _row("q_low", q_low, n, -np.inf), _row("q_high", q_high, n, np.inf)
        if (low > high).any():
            i = int((low > high).argmax())
            raise ValueError(f"q_low[{i}] is {low[i]:g}, which exceeds q_high[{i}], {high[i]:g}")
        self.limits = Limits(
            np.concatenate([low, -v_high]),
            np.concatenate([high, v_high]),
            np.maximum(_row("actuator.low", actuator.low, m, -np.inf), -most),
            np.minimum(_row("actuator.high", actuator.high, m, np.inf), most),
            _row("actuator.rate", actuator.rate, m, np.inf),
        )
        self.weights = Weights(
            self._state_weight(position_weight, velocity_weight),
            _row("input_weight", input_weight, m),
            _row("rate_weight", rate_weight, m),
            _LIMIT_WEIGHT,
        )
        self.problem = ShootingProblem(model, self.step, steps, self.weights, self.limits)
        self._terminal, self._iterations = terminal_weight, iterations
        self._bandwidth = observer_bandwidth
        self._reference: Reference | None = None
        self.reset()

    def _state_weight(self, position: Weight, velocity: Weight) -> np.ndarray:
        """Return the factor of Q, see :class:`~.shooting.Weights`."""
        rows = (("position_weight", position), ("velocity_weight", velocity))
        values = [_row(name, value, self.num_coordinates) for name, value in rows]
        return np.diag(np.sqrt(np.concatenate(values)))

    def reset(self) -> None:
        self._memory: list[_Memory] = []
        self._diagnostics: dict[str, Tensor] = {}
        self._references: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def follow(self, reference: Reference) -> None:
        self._reference = reference

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch.

        Raises:
            ValueError: on a time before the previous call, a first state beyond its limits, or a
                time or reference that is not finite.
        """
        if not math.isfinite(t):
            raise ValueError(f"t is {t}, expected the time of the call in s")
        states = torch.cat([q, v], -1).reshape(-1, 2 * self.num_coordinates).double().cpu().numpy()
        if not self._memory:
            self._start(t, states)
        elif len(self._memory) != len(states) or t < self._memory[0].t:
            raise ValueError(
                f"t is {t:g} s for {len(states)} runs, after {self._memory[0].t:g} s for "
                f"{len(self._memory)}: reset() the law before new runs, and set a rate, since it "
                "cannot act in continuous time"
            )
        begin = time.perf_counter()
        ahead = self._ahead(t, len(states), reference)
        shared = (time.perf_counter() - begin) / len(states)
        with np.errstate(invalid="ignore"):  # of a state that is not finite
            values = [self._advance(k, t, x, *(y[k] for y in ahead)) for k, x in enumerate(states)]
        self._diagnostics = {
            key: q.new_tensor([value[key] for value in values]).reshape(q.shape[:-1])
            for key in values[0]
        }
        self._diagnostics["solve_time"] += shared
        u = np.stack([memory.u for memory in self._memory])
        return torch.from_numpy(u).to(q).reshape(*q.shape[:-1], self.num_inputs)

    @property
    def plans(self) -> list[Plan | None]:
        return [memory.plan for memory in self._memory]

    def diagnostics(self) -> dict[str, Tensor]:
        """Return ``solve_time`` in s, ``iterations``, ``solver_failed`` and ``missed_deadline``.

        Both marks are 0 or 1. A deadline is missed if a call takes longer than the loop's period.
        """
        return self._diagnostics

    def faults(self) -> dict[str, Tensor]:
        """Return, by reason, the runs whose solver failed for longer than the horizon."""
        if not self._diagnostics:
            return {}
        failed = self._diagnostics["solver_failed"]
        count = torch.tensor([x.failures for x in self._memory]).reshape(failed.shape)
        reason = "the solver found no plan for longer than the horizon"
        return {reason: count > self.problem.steps}

    def _start(self, t: float, states: np.ndarray) -> None:
        """Forget the past; refuse states from which no plan is feasible."""
        limits, n, m = self.limits, self.num_coordinates, self.num_inputs
        outside = (states < limits.x_low - 1e-9) | (states > limits.x_high + 1e-9)
        if outside.any():
            run, i = (int(x) for x in np.argwhere(outside)[0])
            name = f"q[{i}]" if i < n else f"v[{i - n}]"
            raise ValueError(
                f"no feasible plan: {name} of run {run} starts at {states[run, i]:.4g}, expected "
                f"{limits.x_low[i]:.4g} to {limits.x_high[i]:.4g}: start inside, or widen the limit"
            )
        u = np.zeros(m).clip(limits.u_low, limits.u_high)
        self._memory = [_Memory(t, x, u, np.zeros(n), None, 0) for x in states]

    def _ahead(
        self, t: float, count: int, now: Motion
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return x_ref ``(K, 2N, S)``, u_ref ``(K, M, S)`` and P ``(K, 2N, 2N)`` of the plans."""
        problem, n = self.problem, self.num_coordinates
        times = t + self.step * np.arange(problem.steps + 1)
        motions = [now if self._reference is None else self._reference(float(x)) for x in times]
        q, v, a = (
            torch.stack([x.double().cpu().expand(count, n) for x in values], -2)
            for values in zip(*motions, strict=True)
        )
        missing = (~torch.cat([q, v, a], -1).isfinite()).nonzero()
        if len(missing):
            _, step, k = missing[0].tolist()
            name = f"{'qva'[k // n]}[{k % n}]"
            raise ValueError(f"the reference of {name} at {times[step]:g} s is not finite")
        # Beyond a limit, the weight of the goal would exceed that of the limit.
        states = torch.cat([q, v], -1).clip(*map(torch.from_numpy, self.limits[:2]))
        (q, v), x = states.split(n, -1), states.numpy()
        x_ref = x[:, 1:].transpose(0, 2, 1)
        last = self._references
        if last is not None and np.array_equal(last[0], x_ref):
            return last
        u = self._feedforward(q, v, a).clip(self.limits.u_low, self.limits.u_high)
        if self._terminal is None:
            P = np.stack([problem.terminal_weight(x[k, -1], u[k, -1]) for k in range(count)])
        else:
            Q = self.weights.state.T @ self.weights.state
            P = np.broadcast_to(self._terminal * Q, (count, 2 * n, 2 * n))
        self._references = x_ref, u[:, :-1].transpose(0, 2, 1), P
        return self._references

    def _feedforward(self, q: Tensor, v: Tensor, a: Tensor) -> np.ndarray:
        """Return u_ref without limits at the reference ``(K, S + 1, N)``, ``(K, S + 1, M)``."""
        if not self.model.input_affine:
            return np.zeros((*q.shape[:-1], self.num_inputs))
        with torch.no_grad():
            A = self.model.input_matrix(q)
            return pseudo_inverse_times(A, self.model.inverse_dynamics(q, v, a)).numpy()

    def _advance(
        self, k: int, t: float, x: np.ndarray, x_ref: np.ndarray, u_ref: np.ndarray, P: np.ndarray
    ) -> dict[str, float]:
        """Plan for a copy, store its input, and return its diagnostics."""
        begin, problem, last = time.perf_counter(), self.problem, self._memory[k]
        first = last.plan is None
        period = t - last.t if t > last.t else self.step
        d = self._disturbance(last, t, x)
        if self._bandwidth is not None:
            slopes = problem.slopes(np.concatenate([x_ref[:, -1], u_ref[:, -1]])[None])[0]
            u_ref = u_ref - (np.linalg.pinv(slopes[:, 2 * self.num_coordinates :]) @ d)[:, None]
        iterations = self._iterations * (_FIRST_ITERATIONS if first else 1)
        u, plan = last.u, None
        try:
            plan = problem.solve(
                *(x, last.u, d, x_ref, u_ref, P, self._guess(last, period, x, x_ref, u_ref)),
                period=period,
                iterations=iterations,
            )
            failed = not plan.gap <= _LARGEST_GAP
        except FloatingPointError:
            failed = True
        if plan is not None and not failed:
            u = plan.u[:, 0].clip(self.limits.u_low, self.limits.u_high)
            if first:
                self._warn_of_excess(k, plan)
        failures = last.failures + 1 if failed else 0
        self._memory[k] = _Memory(t, x, u, d, None if failed else plan, failures)
        duration = time.perf_counter() - begin
        return {
            "solve_time": duration,
            "iterations": float(plan.iterations if plan else 0),
            "solver_failed": float(failed),
            "missed_deadline": float(duration > period and not first),
        }

    def _guess(
        self, last: _Memory, period: float, x: np.ndarray, x_ref: np.ndarray, u_ref: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the previous plan, shifted in time, or the first guess.

        The first guess is a straight line to the reference, or rest after every second failure.
        """
        steps = self.problem.steps
        if last.plan is None:
            share = np.linspace(1 / steps, 1, steps) * (last.failures % 2 == 0)
            return x[:, None] + share * (x_ref - x[:, None]), u_ref
        shift = np.minimum(np.arange(steps) + round(period / self.step), steps - 1)
        return last.plan.x[:, shift], last.plan.u[:, shift]

    def _disturbance(self, last: _Memory, t: float, x: np.ndarray) -> np.ndarray:
        if self._bandwidth is None or t <= last.t:
            return last.d
        n, period = self.num_coordinates, t - last.t
        modeled = self.problem.accelerations(np.concatenate([(last.x + x) / 2, last.u]))
        measured = (x[n:] - last.x[n:]) / period - modeled
        d = last.d - math.expm1(-self._bandwidth * period) * (measured - last.d)
        return d if np.isfinite(d).all() else last.d

    def _warn_of_excess(self, k: int, plan: Plan) -> None:
        """Warn if the first plan cannot keep a limit of the state."""
        i, step = np.unravel_index(int(plan.excess.argmax()), plan.excess.shape)
        if plan.excess[i, step] > 1e-2 * np.abs(plan.x[i]).max():
            n = self.num_coordinates
            log.warning(
                f"the first plan of run {k} leaves the limits of "
                f"{f'q[{i}]' if i < n else f'v[{i - n}]'} by {plan.excess[i, step]:.3g} after "
                f"{(step + 1) * self.step:.3g} s: no input within its limits avoids this"
            )


def _row(name: str, value: _Values, size: int, missing: float = 0.0) -> np.ndarray:
    array = np.asarray(missing if value is None else value, dtype=float)
    if array.shape not in ((), (size,)) or np.isnan(array).any():
        raise ValueError(f"{name} is {array.tolist()}, expected 1 or {size} numbers")
    return np.broadcast_to(array, (size,)).copy()
