"""The contracts of a control loop: reference, stage and plant."""

from __future__ import annotations

import abc
import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pinn_dyn.control.effects import Actuator, Values
from pinn_dyn.mechanics.arrays import listed

_ROUNDING = 1e-6  # relative; numbers of files may be of type float


class Motion(NamedTuple):
    """Desired configuration q, velocity v and acceleration a at one time, ``(*batch, N)`` each."""

    q: Tensor
    v: Tensor
    a: Tensor


class Reference(abc.ABC):
    """A desired motion q_ref(t) with its exact first and second derivatives."""

    num_coordinates: int

    @abc.abstractmethod
    def __call__(self, t: float) -> Motion:
        """Return the desired motion at time t in s, ``(N,)`` each or ``(K, N)`` for K runs."""


class Step(NamedTuple):
    """Result of a stage: input ``(*batch, M)``, memory ``(*batch, memory_size)`` and report.

    The report holds numbers and true or false marks by name, ``(*batch,)`` each. The marks in
    :data:`~.pipeline.STATUS` set the bits of the status; all other entries go into the record.
    """

    u: Tensor
    memory: Tensor
    report: Mapping[str, Tensor] = {}


def is_applied(u: Tensor, applied: Tensor) -> Tensor:
    """Return true where the applied input equals the output u of a stage, ``(*batch, 1)``.

    A stage with an integrator holds its memory where they differ, to avoid windup at limits.
    """
    equal = (applied - u).abs() <= _ROUNDING * u.abs()
    return equal.to(u).sum(-1, keepdim=True) > u.shape[-1] - 0.5


class Setting(NamedTuple):
    """Constants of a pipeline: period in s, longest dead time in s, limits and first input."""

    period: float
    dead_time: float
    actuator: Actuator
    first_input: Tensor


class Stage(abc.ABC):
    """A control law, or a stage around a law: a pure function of the measurement and its memory.

    :class:`~.pipeline.Pipeline` calls a stage once per period, in closed loops and in exported
    files. The operations in :meth:`step` must not depend on the values of the tensors, unless
    ``is_python`` is true.

    Attributes:
        num_coordinates, num_inputs: N and M.
        memory_size: length of the memory.
        period: time between two calls, s; NaN until :meth:`at`.
        needs_period: true for a stage whose memory depends on the period.
        ahead: times from the measurement to the references of a call, s.
        model: the model of the law, or None; its ``dead_time`` is the dead time of the pipeline.
        first_input: input before the first call, one number or M.
        is_python: true for a stage whose operations depend on values; it has no code in C.
        is_long: true for a stage whose code is too long to be compiled for a closed loop.
        predicts: true for a law that compensates the dead time itself.
    """

    memory_size = 0
    period = float("nan")
    needs_period = False
    ahead: tuple[float, ...] = (0.0,)
    model: Any = None
    first_input: Values = 0.0
    is_python = False
    is_long = False
    predicts = False

    def __init__(self, num_coordinates: int, num_inputs: int):
        self.num_coordinates = num_coordinates
        self.num_inputs = num_inputs

    def at(self, setting: Setting) -> Any:
        """Return a copy of the stage with the constants of a pipeline."""
        stage = copy.copy(self)
        stage.period = setting.period
        return stage

    def start(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor | None:
        """Return the memory before the first call, which measures q and v; None for zeros."""
        return None

    def stiffness(self) -> tuple[Tensor, Tensor] | None:
        """Return K_P (N/m or Nm/rad) and K_D (Ns/m or Nms/rad), or None if the law has neither."""
        return None

    def about(self) -> dict[str, Any]:
        """Return entries for the description in an exported file."""
        gains = ("position_gain", "velocity_gain")
        values = {name: listed(getattr(self, name, None)) for name in gains}
        return {"law": type(self).__name__, "observer": None, "guard": None, **values}

    @abc.abstractmethod
    def step(
        self, q: Tensor, v: Tensor, reference: Motion, applied: Tensor, memory: Tensor
    ) -> Step | tuple[Tensor, Tensor]:
        """Return the input and the memory for the next call.

        Args:
            q, v: measurement, ``(*batch, N)``.
            reference: desired motion, ``(*batch, N)`` each; ``(*batch, S, N)`` for S times ahead.
            applied: input since the previous call, after all limits, ``(*batch, M)``.
            memory: memory of the previous call or of :meth:`start`.
        """


class Wrapper(Stage):
    """A stage around a law. Its memory is followed by the memory of the law.

    Args:
        law: the law, which may have stages around it.
        own_size: length of the memory of this stage, without that of the law.
    """

    def __init__(self, law: Stage, own_size: int = 0):
        super().__init__(law.num_coordinates, law.num_inputs)
        self.law, self.own_size = law, own_size
        self.memory_size = own_size + law.memory_size
        self.needs_period = law.needs_period or own_size > 0
        for name in ("ahead", "model", "first_input", "is_python", "is_long", "predicts"):
            setattr(self, name, getattr(law, name))

    def at(self, setting: Setting) -> Any:
        stage = super().at(setting)
        stage.law = self.law.at(setting)
        stage.memory_size = self.own_size + stage.law.memory_size
        return stage

    def stiffness(self) -> tuple[Tensor, Tensor] | None:
        return self.law.stiffness()

    def start(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor | None:
        memory = self.law.start(q, v, u)
        zeros = q.new_zeros(*q.shape[:-1], self.own_size)
        return None if memory is None else torch.cat([zeros, memory], dim=-1)


class Plant(abc.ABC):
    """K copies of a robot with N coordinates and M inputs that start and move together."""

    num_coordinates: int
    num_inputs: int

    @abc.abstractmethod
    def start(self, q0: Tensor, v0: Tensor) -> None:
        """Put the K copies into their initial states, ``(K, N)`` each."""

    @abc.abstractmethod
    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        """Hold the input u ``(K, M)`` for a time in s; return q and v at its end, ``(K, N)`` each.

        The state of a copy that diverges becomes and stays NaN. Other copies are not affected.
        """
