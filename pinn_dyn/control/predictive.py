"""Model predictive control with a mechanical system, analytic or learned."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.control.contracts import Motion, Stage, Step
from pinn_dyn.control.effects import Actuator, Values
from pinn_dyn.control.shooting import Limits, Plan, ShootingProblem, Weights
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import pseudo_inverse_times

log = logging.getLogger(__name__)

_FIRST_ITERATIONS = 20  # times as many iterations at the first instant, without a previous plan
_LARGEST_GAP = 0.1  # largest gap of a plan that counts as a solution
_LIMIT_WEIGHT = 1e3  # rho of a violated limit of the state
_Values = Values | None
Weight = NonNegativeFloat | Sequence[NonNegativeFloat]
"""Weight of all coordinates or inputs, or of each."""


class PredictiveControl(Stage):
    """Model predictive control with limits, through CasADi (``pip install 'pinn_dyn[mpc]'``).

    If a C compiler is installed, the model is compiled first. This takes some seconds.

    At each instant, the law plans a motion over the horizon by :class:`ShootingProblem`, starting
    from the previous plan, and applies the first input of the plan. The plan follows the reference
    at the times ``ahead``, or a constant reference, within limits of the state.

    u_ref is A^+ times the inverse dynamics of the reference, within the limits. It is zero if the
    force is not linear in the input. If the solver fails, for example at a state that is not
    finite, the law holds the last input.

    The report has ``solve_time`` in s, ``iterations``, ``solver_failed``, ``missed_deadline``
    (true for a call that takes longer than the period) and ``no_plan`` (true if the solver failed
    for longer than the horizon).

    Args:
        model: the mechanical system to plan with, in float64.
        horizon: length of a plan, s.
        step: step of a plan, s. It may differ from the period of the loop.
        position_weight, velocity_weight: Q, one number or N.
        input_weight, rate_weight: R of u - u_ref and S of du/dt, one number or M.
        terminal_weight: P in multiples of Q; None for P of the linear-quadratic regulator at the
            end of the reference.
        actuator: hard limits of the input and of its rate, in addition to the limits of the drives
            in the model.
        q_low, q_high, v_max: soft limits of the state, one number or N; None for no limit.
        iterations: quadratic programs per instant; the first instant may take 20 times as many.
        observer_bandwidth: bandwidth K_O in 1/s of an observer of the acceleration d that the model
            does not explain, d_k+1 = d_k + (1 - exp(-K_O T)) (measured - d_k); None for d = 0.

    Raises:
        ImportError: if CasADi is not installed.
        ValueError: if values do not match N or M, or the horizon is shorter than two steps.
    """

    needs_period, is_python = True, True

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
        self.model, self.step_size = model, float(step)
        steps = round(horizon / step)
        if steps < 2:
            raise ValueError(f"horizon is {horizon} s, expected at least two steps of {step} s")
        actuator = actuator or Actuator()
        largest = model.largest_input()
        u_max = np.full(m, np.inf) if largest is None else largest.detach().numpy()
        v_high = _row("v_max", v_max, n, np.inf)
        low, high = _row("q_low", q_low, n, -np.inf), _row("q_high", q_high, n, np.inf)
        self.limits = Limits(
            np.concatenate([low, -v_high]),
            np.concatenate([high, v_high]),
            np.maximum(_row("actuator.low", actuator.low, m, -np.inf), -u_max),
            np.minimum(_row("actuator.high", actuator.high, m, np.inf), u_max),
            _row("actuator.rate", actuator.rate, m, np.inf),
        )
        state_weight = [
            _row("position_weight", position_weight, n),
            _row("velocity_weight", velocity_weight, n),
        ]
        self.weights = Weights(
            np.diag(np.sqrt(np.concatenate(state_weight))),
            _row("input_weight", input_weight, m),
            _row("rate_weight", rate_weight, m),
            _LIMIT_WEIGHT,
        )
        self.problem = ShootingProblem(model, self.step_size, steps, self.weights, self.limits)
        self._terminal, self._iterations = terminal_weight, iterations
        self._bandwidth = observer_bandwidth
        self.ahead = tuple(self.step_size * k for k in range(steps + 1))
        # Memory: is started, x, d, consecutive failures, has a plan, and the plan (x and u).
        self._sizes = [1, 2 * n, n, 1, 1, 2 * n * steps, m * steps]
        self.memory_size = sum(self._sizes)
        self._references: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def step(
        self, q: Tensor, v: Tensor, reference: Motion, applied: Tensor, memory: Tensor
    ) -> Step:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch.

        Raises:
            ValueError: if the first state exceeds its limits, or the reference is not finite.
        """
        begin, batch = time.perf_counter(), q.shape[:-1]
        x, u, rows = (
            y.detach().double().cpu().reshape(-1, y.shape[-1]).numpy()
            for y in (torch.cat([q, v], -1), applied, memory)
        )
        parts = np.split(rows, np.cumsum(self._sizes)[:-1], axis=1)
        self._require_feasible(x, rows[:, 0] < 0.5)
        x_ref, u_ref, P = self._ahead(len(x), reference)
        shared = (time.perf_counter() - begin) / len(x)
        calls = []
        with np.errstate(invalid="ignore"):  # states that are not finite
            for k in range(len(x)):
                values = [part[k] for part in parts]
                calls.append(self._advance(k, values, x[k], u[k], x_ref[k], u_ref[k], P[k]))
        inputs, memories, reports = zip(*calls, strict=True)
        report = {}
        for key in reports[0]:
            report[key] = q.new_tensor([values[key] for values in reports]).reshape(batch)
        report["solve_time"] += shared
        report["no_plan"] = report.pop("failures") > self.problem.steps
        result, after = (
            torch.from_numpy(np.stack(y)).to(q).reshape(*batch, -1) for y in (inputs, memories)
        )
        return Step(result, after, report)

    def _require_feasible(self, states: np.ndarray, is_first: np.ndarray) -> None:
        """Raise an error if no plan is feasible from a first state."""
        limits, n = self.limits, self.num_coordinates
        outside = (states < limits.x_low - 1e-9) | (states > limits.x_high + 1e-9)
        outside &= is_first[:, None]
        if outside.any():
            run, i = (int(x) for x in np.argwhere(outside)[0])
            name = f"q[{i}]" if i < n else f"v[{i - n}]"
            raise ValueError(
                f"no feasible plan: {name} of run {run} starts at {states[run, i]:.4g}, expected "
                f"{limits.x_low[i]:.4g} to {limits.x_high[i]:.4g}: start inside, or widen the limit"
            )

    def _ahead(self, count: int, reference: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return x_ref ``(K, 2N, S)``, u_ref ``(K, M, S)`` and P ``(K, 2N, 2N)`` for the plans."""
        problem, n = self.problem, self.num_coordinates
        shape = count, problem.steps + 1, n
        motions = [x if x.ndim > 2 else x.unsqueeze(-2) for x in reference]
        q, v, a = (x.double().cpu().expand(shape) for x in motions)
        missing = (~torch.cat([q, v, a], -1).isfinite()).nonzero()
        if len(missing):
            _, step, k = missing[0].tolist()
            name = f"{'qva'[k // n]}[{k % n}]"
            raise ValueError(f"the reference of {name} {self.ahead[step]:g} s ahead is not finite")
        # A reference beyond a limit would outweigh the soft limit.
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
        """Return u_ref ``(K, S + 1, M)``, without limits, of a reference ``(K, S + 1, N)``."""
        if not self.model.input_affine:
            return np.zeros((*q.shape[:-1], self.num_inputs))
        with torch.no_grad():
            A = self.model.input_matrix(q)
            return pseudo_inverse_times(A, self.model.inverse_dynamics(q, v, a)).numpy()

    def _advance(
        self,
        k: int,
        memory: Sequence[np.ndarray],
        x: np.ndarray,
        last: np.ndarray,
        x_ref: np.ndarray,
        u_ref: np.ndarray,
        P: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
        """Plan the motion of copy k; return its input, memory and report."""
        begin, problem, n = time.perf_counter(), self.problem, self.num_coordinates
        (started,), x_last, d, (failures,), (has_plan,), *previous = memory
        if started:
            d = self._disturbance(x_last, last, d, x)
        if self._bandwidth is not None:
            slopes = problem.slopes(np.concatenate([x_ref[:, -1], u_ref[:, -1]])[None])[0]
            u_ref = u_ref - (np.linalg.pinv(slopes[:, 2 * n :]) @ d)[:, None]
        plan, u = None, last
        if has_plan:
            guess = self._shifted(previous)
        else:  # a straight line to the reference, or rest after every second failure
            share = np.linspace(1 / problem.steps, 1, problem.steps) * (failures % 2 == 0)
            guess = x[:, None] + share * (x_ref - x[:, None]), u_ref
        iterations = self._iterations * (1 if has_plan else _FIRST_ITERATIONS)
        try:
            plan = problem.solve(
                *(x, last, d, x_ref, u_ref, P, guess), period=self._time, iterations=iterations
            )
        except FloatingPointError:
            log.debug("no plan for run %d", k, exc_info=True)
        failed = plan is None or not plan.gap <= _LARGEST_GAP
        if plan is not None and not failed:
            u = plan.u[:, 0].clip(self.limits.u_low, self.limits.u_high)
            previous = [plan.x, plan.u]
            if not has_plan:
                self._warn_of_excess(k, plan)
        failures = failures + 1 if failed else 0
        marks = np.array([float(failures), float(not failed)])
        parts = [np.ones(1), x, d, marks, *(np.ravel(y) for y in previous)]
        duration = time.perf_counter() - begin
        report = {
            "solve_time": duration,
            "iterations": float(plan.iterations if plan else 0),
            "solver_failed": float(failed),
            "missed_deadline": float(duration > self._time and bool(has_plan)),
            "failures": failures,
        }
        return u, np.concatenate(parts), report

    @property
    def _time(self) -> float:
        """Period of the loop, or the step of the plan if the period is unknown, s."""
        return self.step_size if math.isnan(self.period) else self.period

    def _shifted(self, plan: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the states and inputs of a plan, shifted by a period."""
        steps = self.problem.steps
        shift = np.minimum(np.arange(steps) + round(self._time / self.step_size), steps - 1)
        x, u = (y.reshape(-1, steps)[:, shift] for y in plan)
        return x, u

    def _disturbance(
        self, x_last: np.ndarray, u: np.ndarray, d: np.ndarray, x: np.ndarray
    ) -> np.ndarray:
        if self._bandwidth is None:
            return d
        n = self.num_coordinates
        modeled = self.problem.accelerations(np.concatenate([(x_last + x) / 2, u]))
        measured = (x[n:] - x_last[n:]) / self._time - modeled
        d_next = d - math.expm1(-self._bandwidth * self._time) * (measured - d)
        return d_next if np.isfinite(d_next).all() else d

    def _warn_of_excess(self, k: int, plan: Plan) -> None:
        """Warn if the first plan violates a limit of the state."""
        i, step = np.unravel_index(int(plan.excess.argmax()), plan.excess.shape)
        if plan.excess[i, step] > 1e-2 * np.abs(plan.x[i]).max():
            n = self.num_coordinates
            name = f"q[{i}]" if i < n else f"v[{i - n}]"
            log.warning(
                f"the first plan of run {k} leaves the limits of {name} by "
                f"{plan.excess[i, step]:.3g} after {(step + 1) * self.step_size:.3g} s: no input "
                "within its limits avoids this"
            )


def _row(name: str, value: _Values, size: int, missing: float = 0.0) -> np.ndarray:
    array = np.asarray(missing if value is None else value, dtype=float)
    if array.shape not in ((), (size,)) or np.isnan(array).any():
        raise ValueError(f"{name} is {array.tolist()}, expected 1 or {size} numbers")
    return np.broadcast_to(array, (size,)).copy()
