"""All computations from measurement to motor as one pure function, for loops and files."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from pydantic import PositiveFloat
from torch import Tensor, nn

from pinn_dyn.control.contracts import Motion, Setting, Stage, Step
from pinn_dyn.control.effects import Actuator
from pinn_dyn.exports.compiled import Compiled
from pinn_dyn.exports.model_functions import held_step
from pinn_dyn.exports.program import is_traced
from pinn_dyn.exports.repeated import repeated, sharing
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import require_last_dim

STATUS = {
    "limited": 1,
    "outside": 2,
    "not_finite": 4,
    "singular": 8,
    "unreachable": 16,
    "no_plan": 32,
}
"""Bits of the status, by the names of the marks in the report of a stage."""


class Call(NamedTuple):
    """Result of a pipeline: input, status, memory, and the report of its stages."""

    u: Tensor
    status: Tensor
    memory: Tensor
    report: dict[str, Tensor]


class Pipeline(nn.Module):
    """The stages from measurement to motor at a fixed period, as one pure function::

        u, status, memory_out = pipeline(q, v, q_ref, v_ref, a_ref, memory_in)

    1. In the first call, where the memory is zero, the past inputs are ``first_input``, and the
       memories of the stages are computed from the measurement.
    2. The model predicts the state at the end of the dead time, see :class:`~.pipeline.DeadTime`.
    3. The law and the stages around it compute u.
    4. If u is not finite, the last u replaces it. If u was replaced, or the new memory of the
       stages is not finite, the stages keep their old memory.
    5. The actuator limits u.

    The status is the sum of 1 (the actuator changed u), 2 (outside the training data), 4 (not
    finite), 8 (A(q) is nearly singular), 16 (no input gives the force of the law) and 32 (no plan
    for longer than the horizon of predictive control).

    Args:
        law: a law, with or without stages around it.
        period: time between two calls, s; None if no stage needs the period.
        actuator: limits of the input.
        dead_time: delay of the inputs, s, one number or M; None for the dead time of the law's
            model.
        first_input: input before the first call, one number or M; None for that of the law.

    Attributes:
        dead_time: delay of the inputs as a tensor, s.
        memory_size: length of the memory: 1 for the mark of a started pipeline, the past inputs of
            the dead time (at least the last input), and the memory of the stages.
        ahead: times from the measurement to the references of a call, s; a single time for most
            laws.

    Raises:
        ValueError: if the period is missing, or there is a dead time and no model to predict it.
    """

    def __init__(
        self,
        law: Stage,
        period: PositiveFloat | None = None,
        *,
        actuator: Actuator | None = None,
        dead_time: ArrayLike | None = None,
        first_input: ArrayLike | None = None,
    ):
        super().__init__()
        self.actuator = actuator or Actuator()
        if dead_time is None:
            dead_time = getattr(law.model, "dead_time", 0.0)
        self.dead_time = times = torch.as_tensor(dead_time, dtype=torch.float64)
        has_delay = bool(times.any())
        if period is None and (law.needs_period or has_delay or self.actuator.rate is not None):
            raise ValueError(
                f"{type(law).__name__} with its limits and dead time needs a fixed period: give a "
                "rate"
            )
        self.period = float("nan") if period is None else float(period)
        first = torch.as_tensor(law.first_input if first_input is None else first_input)
        self.first_input = first.double().expand(law.num_inputs)
        setting = Setting(self.period, float(times.max()), self.actuator, self.first_input)
        self.law = law.at(setting)
        self.ahead, stored = law.ahead, 1
        self._dead_time: DeadTime | None = None
        if has_delay and not law.predicts:
            if law.model is None:
                raise ValueError(
                    f"{type(law).__name__} has no model that predicts over the dead time"
                )
            self._dead_time = DeadTime(law.model, times, self.period)
            self.ahead = tuple(self._dead_time.ahead + x for x in law.ahead)
            stored = self._dead_time.size
        self.num_coordinates, self.num_inputs = law.num_coordinates, law.num_inputs
        self._sizes = [1, stored * self.num_inputs, self.law.memory_size]
        self.memory_size = sum(self._sizes)
        self.model = law.model if isinstance(law.model, nn.Module) else nn.Module()
        self._shapes: dict[str, torch.Size] = {}
        roots = self.law, self.actuator, self._dead_time, self.first_input, self.period
        self._compiled = Compiled(roots)

    def forward(
        self, q: Tensor, v: Tensor, q_ref: Tensor, v_ref: Tensor, a_ref: Tensor, memory_in: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return u ``(*batch, M)``, the status ``(*batch,)`` and the memory for the next call."""
        return self.call(q, v, Motion(q_ref, v_ref, a_ref), memory_in)[:3]

    @torch.no_grad()
    def call(self, q: Tensor, v: Tensor, reference: Motion, memory_in: Tensor) -> Call:
        """Return the result for a measurement q, v ``(*batch, N)``, with the report."""
        names = ("q", "v", "reference.q", "reference.v", "reference.a")
        for name, value in zip(names, (q, v, *reference), strict=True):
            require_last_dim(name, value, self.num_coordinates, "N")
        started, inputs, memory = memory_in.split(self._sizes, dim=-1)
        is_later = started > 0.5
        past = inputs.unflatten(-1, (-1, self.num_inputs))
        past = torch.where(is_later.unsqueeze(-1), past, self.first_input)
        last = past[..., -1, :]
        if is_traced() or not is_later.all():
            start = self.law.start(q, v, last)
            memory = memory if start is None else torch.where(is_later, memory, start)
        if self._dead_time:
            q, v = self._dead_time.predict(q, v, past)
        u, after, report = Step(*self.law.step(q, v, reference, last, memory))
        is_finite = u.abs().sum(-1, keepdim=True) < torch.inf  # CasADi simplifies u - u to zero
        command = torch.where(is_finite, u, last)
        if self.law.memory_size:
            is_valid = is_finite & (after.abs().sum(-1, keepdim=True) < torch.inf)
            memory = torch.where(is_valid, after, memory)
        limited = self.actuator.limit(command, last, self.period)
        inputs = torch.cat([past, limited.unsqueeze(-2)], dim=-2)
        changed = (limited != command).to(u).sum(-1)
        marks = {**report, "limited": changed > 0, "not_finite": ~is_finite[..., 0]}
        status = torch.zeros_like(changed)
        for name, bit in STATUS.items():
            if name in marks:
                status = status + bit * marks[name].to(u)
        memory = torch.cat([torch.ones_like(started), inputs[..., 1:, :].flatten(-2), memory], -1)
        output = self._dead_time.held_back(inputs) if self._dead_time else limited
        numbers = {name: value.to(u) for name, value in report.items()}
        numbers |= {"u_wanted": u, "saturated_inputs": changed}
        return Call(output, status, memory, numbers)

    def run(self, q: Tensor, v: Tensor, reference: Motion, memory_in: Tensor) -> Call:
        """Return :meth:`call` for K rows ``(K, N)``, in C if compiling pays off."""
        if self.law.is_python or self.law.is_long:
            return self.call(q, v, reference, memory_in)
        rows = torch.cat([q, v, *reference, memory_in], dim=-1)
        if not self._shapes:
            self._shapes = {k: x.shape[1:] for k, x in self._columns(rows).items()}
        result = self._compiled.rows("pipeline", self._row, rows)
        parts = result.split([x.numel() for x in self._shapes.values()], dim=-1)
        values = {
            name: part.reshape(len(q), *shape)
            for (name, shape), part in zip(self._shapes.items(), parts, strict=True)
        }
        return Call(values.pop("u"), values.pop("status"), values.pop("memory"), values)

    def _columns(self, rows: Tensor) -> dict[str, Tensor]:
        q, v, *motion, memory = rows.split([self.num_coordinates] * 5 + [self.memory_size], dim=-1)
        u, status, memory, report = self.call(q, v, Motion(*motion), memory)
        return {"u": u, "status": status, "memory": memory, **report}

    def _row(self, rows: Tensor) -> Tensor:
        columns = self._columns(rows).values()
        return torch.cat([x.reshape(*rows.shape[:-1], -1) for x in columns], dim=-1)


_ROUNDING = 1e-6  # error of a number of periods


class DeadTime:
    """Compensation of a dead time d of the inputs by the predicted state at its end::

        x(t_k + d) = x(t_k) + integral from t_k to t_k + d of f(x, u(s - d)) ds
        u_k = law(x(t_k + d), reference(t_k + d))

    For the predicted state, the plant has no dead time: gains, observer, guard and predictive
    control are designed for the plant without it. A disturbance acts for the time d before the law
    can react. If it causes the acceleration a, the predicted state is wrong by a d^2 / 2.

    If the inputs have different dead times, d is the longest. Inputs with a shorter dead time are
    held back by the difference, interpolated between two periods.

    Source: Smith 1957, Closer control of loops with dead time; Manitius and Olbrot 1979, Finite
    spectrum assignment problem for systems with delays.

    Args:
        model: the model that predicts, in float64.
        dead_time: d, s, one number or M.
        period: time between two calls, s.

    Attributes:
        ahead: the longest d, s.
        size: number n of past inputs that act during the dead time.
    """

    def __init__(self, model: MechanicalSystem, dead_time: ArrayLike, period: float):
        self.model = model
        times = np.resize(np.asarray(dead_time, dtype=float), model.num_inputs)
        self.ahead = float(times.max())
        self.size = n = math.ceil(self.ahead / period - _ROUNDING)
        self._position = torch.from_numpy(n - (self.ahead - times) / period)
        # From now on, past input k acts between the times ends[k] and ends[k + 1].
        ends = np.maximum(self.ahead + period * np.arange(-n, 1), 0.0)
        self._lengths = torch.from_numpy(np.diff(ends))

    def predict(self, q: Tensor, v: Tensor, past: Tensor) -> tuple[Tensor, Tensor]:
        """Return q and v at the end of the dead time, from the last n inputs ``(*batch, n, M)``."""
        model = sharing(self.model)
        substeps = model.integrator.substeps
        lengths = (self._lengths / substeps).unsqueeze(-1).expand(*past.shape[:-1], 1)
        rows = torch.cat([past, lengths], dim=-1).repeat_interleave(substeps, dim=-2)

        def step(x: Tensor, row: Tensor) -> Tensor:
            h = row.reshape(-1, row.shape[-1])[0, -1]  # the same for all states
            q, v = x.chunk(2, dim=-1)
            return torch.cat(held_step(model, q, v, row[..., :-1], h), dim=-1)

        q, v = repeated("step", step, torch.cat([q, v], dim=-1), rows).chunk(2, dim=-1)
        return q, v

    def held_back(self, inputs: Tensor) -> Tensor:
        """Return the input to apply ``(*batch, M)``, from the last n inputs and the new input."""
        number = torch.arange(inputs.shape[-1])
        before, after = self._position.floor().long(), self._position.ceil().long()
        return inputs[..., before, number].lerp(inputs[..., after, number], self._position - before)
