"""Drives between inputs and joints, and their terms in the equation of motion."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat
from torch import Tensor

from pinn_dyn.models.drive_limits import DriveLimits
from pinn_dyn.models.input_matrix import InputMatrix
from pinn_dyn.models.known_constants import Constants, HasConstants
from pinn_dyn.models.scales import Scales


class Drives(HasConstants, InputMatrix):
    """Drives of n joints. A subclass adds forces, springs and damping to the equation of motion.

    Attributes:
        selection: rows of the identity matrix for the driven joints, ``(n, N)``.
        gain: learned drive gains, or None.
        identified_by_forces: true if filtering the input has the same effect as filtering the
            force, which allows a fit of filtered forces.
        takes_targets: true if the inputs are target positions instead of forces.
        initial_strength: :meth:`strength` at the start, ``(n,)``.

    Args:
        scales: scales of the data.
        joints: coordinates with a drive, in the order of the inputs. The default is all.
    """

    gain: Constants | None
    identified_by_forces: bool = True
    takes_targets: bool = False
    selection: Tensor
    initial_strength: Tensor

    def __init__(self, scales: Scales, joints: Sequence[NonNegativeInt] | None = None):
        super().__init__(scales)
        self.joints = list(range(scales.size)) if joints is None else list(joints)
        self.register_buffer("selection", torch.eye(scales.size)[self.joints], persistent=False)
        self.gain = None

    @abc.abstractmethod
    def strength(self) -> Tensor:
        """Return the typical force per input, ``(n,)``."""

    @abc.abstractmethod
    def motor_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the force of the drives at the joints, ``(*batch, N)``."""

    @abc.abstractmethod
    def largest_force(self) -> Tensor:
        """Return the largest force of each drive at rest, ``(n,)``."""

    def largest_input(self) -> Tensor | None:
        """Return the input of the largest force at rest, ``(n,)``, or None without limits."""
        return None

    def force_range(self, v: Tensor) -> tuple[Tensor, Tensor] | None:
        """Return the smallest and largest force at v, ``(*batch, N)``, or None without limits."""
        return None

    def saturated(self, v: Tensor, u: Tensor) -> Tensor:
        """Return true where a drive does not reach its command, ``(*batch, N)``, bool."""
        return torch.zeros_like(v, dtype=torch.bool)


class TorqueDrives(Drives):
    """Drives with the force ``l(k u, v)``, with gains k and limits l.

    Args:
        scales: scales of the data. The value is the typical force, ``(N,)``.
        gain: initial k, ``(n,)``, such as in Nm/A.
        gain_spread: prior standard deviation of log k; 0 if the input is a force.
        limits: builder of the limits.
        joints: see :class:`Drives`.
    """

    def __init__(
        self,
        scales: Scales,
        *,
        gain: Tensor | PositiveFloat = 1.0,
        gain_spread: NonNegativeFloat = 0.0,
        limits: Callable[..., DriveLimits] | None = None,
        joints: Sequence[NonNegativeInt] | None = None,
    ):
        super().__init__(scales, joints)
        motors = scales.restricted(self.joints)
        self._force = scales.value
        start = torch.as_tensor(gain, dtype=torch.float64).expand(len(self.joints))
        if gain_spread > 0:
            self.gain = motors.positive("drive gain", 1.0, start, gain_spread, "gain")
        self.register_buffer("initial_strength", start.clone())
        self.limits: DriveLimits | None = None
        if limits is not None:
            self.limits = limits(replace(motors, value=scales.value[self.joints]))
            self.affine = False
            # A fit of filtered forces with learned limits would find zero limits and zero bodies.
            self.identified_by_forces = not self.limits.learned

    def strength(self) -> Tensor:
        return self.initial_strength if self.gain is None else self.gain()

    def forward(self, q: Tensor) -> Tensor:
        return (self.strength() * self.selection.mT).expand(*q.shape, -1)

    def force(self, q: Tensor, u: Tensor) -> Tensor:
        return (self.strength() * u) @ self.selection

    def motor_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        if self.limits is None:
            return self.force(q, u)
        return self.limits(self.strength() * u, v @ self.selection.mT) @ self.selection

    def applied(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return self.motor_force(q, v, u)

    def typical_force(self, u_rms: Tensor) -> Tensor:
        return self._force.to(u_rms)

    def largest_force(self) -> Tensor:
        if self.limits is None:
            return torch.full_like(self.strength(), torch.inf)
        return self.limits.at_rest()

    def largest_input(self) -> Tensor | None:
        return None if self.limits is None else self.limits.at_rest() / self.strength()

    def force_range(self, v: Tensor) -> tuple[Tensor, Tensor] | None:
        if self.limits is None:
            return None
        smallest, largest = self.limits.reachable(v @ self.selection.mT)
        return smallest @ self.selection, largest @ self.selection

    def saturated(self, v: Tensor, u: Tensor) -> Tensor:
        if self.limits is None:
            return super().saturated(v, u)
        limited = self.limits.saturated(self.strength() * u, v @ self.selection.mT)
        return (limited.to(v) @ self.selection) > 0
