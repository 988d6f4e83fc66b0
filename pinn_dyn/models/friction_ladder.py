"""Laws of dry friction for drives, each with one rung more than the one before; all passive."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.models.friction import Friction
from pinn_dyn.models.known_constants import PositiveConstants
from pinn_dyn.models.scales import Scales

_SLOWEST = 0.01
"""Least width of the change of sign in typical speeds: a jump could not be integrated."""


class DriveCoulomb(Friction):
    """F_i(v) = c_i tanh(v_i / w_i): Coulomb's law with a smooth change of sign.

    c level, N or Nm; w the speed at which it has mostly set in, m/s or rad/s. Passive, v F >= 0, as
    the level is positive.

    Args:
        scales: of the data; the value is a typical generalized force, ``(N,)``.
        level: c starts at this part of the typical forces.
        width: w starts at this part of the typical speeds.
        spread: standard deviation of the logarithms a priori.
    """

    def __init__(
        self,
        scales: Scales,
        *,
        level: float = 0.1,
        width: float = 0.03,
        spread: float = 1.0,
    ):
        super().__init__()
        force, v_std = scales.value, scales.statistics.v_std.double()
        self.slowest = _SLOWEST * float(v_std.mean())
        joints = [str(k + 1) for k in range(scales.size)]
        self.level = PositiveConstants(
            level * force, spread, [f"Coulomb friction of joint {k}" for k in joints]
        )
        self.width = PositiveConstants(
            width * v_std, spread, [f"width of the friction of joint {k}" for k in joints]
        )
        self._add_constants(scales, joints)

    def _add_constants(self, scales: Scales, joints: list[str]) -> None:
        """What a law of a higher rung has besides level and width."""

    def forward(self, v: Tensor) -> Tensor:
        return self._level(v)[0] * torch.tanh(v / self._width())

    def slope(self, v: Tensor) -> Tensor:
        level, change = self._level(v)
        sign, width = torch.tanh(v / self._width()), self._width()
        return change * sign + level * (1 - sign**2) / width

    def _width(self) -> Tensor:
        return self.width() + self.slowest

    def _level(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """The level at v and its slope, ``(*batch, N)`` each."""
        return self.level().expand_as(v), torch.zeros_like(v)


class AsymmetricCoulomb(DriveCoulomb):
    """F_i(v) = c+_i tanh(v_i / w_i) for v_i > 0, c-_i tanh(v_i / w_i) for v_i < 0.

    A level for each direction, as worn and preloaded gears have. Arguments as of the rung below.
    """

    def _add_constants(self, scales: Scales, joints: list[str]) -> None:
        # c+ and c- are the level times e^r and e^-r.
        names = [f"asymmetry of the friction of joint {k}" for k in joints]
        self.ratio = PositiveConstants(torch.ones(scales.size), 0.5, names)

    def _level(self, v: Tensor) -> tuple[Tensor, Tensor]:
        level, ratio = self.level(), self.ratio()
        return torch.where(v > 0, level * ratio, level / ratio), torch.zeros_like(v)


class Stribeck(AsymmetricCoulomb):
    """F_i(v) = (c_i + s_i exp(-(v_i / b_i)^2)) tanh(v_i / w_i), c_i by the direction.

    Lubrication sets in with speed: friction is larger by s_i > 0 near rest, and falls off at the
    Stribeck speed b_i. Armstrong-Helouvry, Dupont and Canudas de Wit 1994, sec. 2. Arguments as of
    the rungs below.
    """

    def _add_constants(self, scales: Scales, joints: list[str]) -> None:
        super()._add_constants(scales, joints)
        rises = [f"Stribeck rise of joint {k}" for k in joints]
        speeds = [f"Stribeck speed of joint {k}" for k in joints]
        self.rise = PositiveConstants(0.03 * scales.value, 1.0, rises)
        self.speed = PositiveConstants(0.3 * scales.statistics.v_std, 1.0, speeds)

    def _level(self, v: Tensor) -> tuple[Tensor, Tensor]:
        level, _ = super()._level(v)
        speed = self.speed()
        rise = self.rise() * torch.exp(-((v / speed) ** 2))
        return level + rise, -2 * v / speed**2 * rise


class LoadDependent(Stribeck):
    """Stribeck friction, and a loss that grows with the force f_i of the drive::

        F_i(v) as below,     transmitted_i = f_i - l_i |f_i| tanh(v_i / w_i)

    Teeth that transmit more press harder on each other: l_i, between 0 and 1, is the part of the
    force that gets lost while the drive moves; driven backwards the gear takes as much more. Since
    v_i l_i |f_i| tanh(v_i / w_i) >= 0 it only takes energy. Models M3 to M6 of Duclusaud et al.
    2025, "Extended friction models for the physics simulation of servo actuators" (BAM). Arguments
    as of the rungs below.
    """

    by_load = True

    def _add_constants(self, scales: Scales, joints: list[str]) -> None:
        super()._add_constants(scales, joints)
        names = [f"loss by load of joint {k}" for k in joints]
        self.odds = PositiveConstants(torch.full((scales.size,), 0.05), 1.0, names)

    def transmitted(self, v: Tensor, force: Tensor) -> Tensor:
        """f - l |f| tanh(v / w), with l = odds / (1 + odds)."""
        odds = self.odds()
        return force - odds / (1 + odds) * force.abs() * torch.tanh(v / self._width())
