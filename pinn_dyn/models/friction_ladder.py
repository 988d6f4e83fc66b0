"""Laws of dry friction for drives, each with one rung more than the one before; all passive."""

from __future__ import annotations

import torch
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.models.friction import Friction
from pinn_dyn.models.known_constants import Named
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
        level: PositiveFloat = 0.1,
        width: PositiveFloat = 0.03,
        spread: PositiveFloat = 1.0,
    ):
        super().__init__()
        force, v_std = scales.value, scales.statistics.v_std.double()
        self.slowest = _SLOWEST * float(v_std.mean())
        forces = [joint.force for joint in scales.joints]
        speeds = [joint.speed for joint in scales.joints]
        self.level = scales.positive("Coulomb friction", level * force, spread, forces)
        self.width = scales.positive("friction width", width * v_std, spread, speeds)
        self._add_constants(scales)

    def _add_constants(self, scales: Scales) -> None:
        """What a law of a higher rung has besides level and width."""

    def physical_constants(self) -> list[Named]:
        """The level or levels, and the width that acts: with the least one in it."""
        width = self.width.named()
        return [*self._levels(), width._replace(values=self._width(), lower=self.slowest)]

    def _levels(self) -> list[Named]:
        return [self.level.named()]

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

    def _add_constants(self, scales: Scales) -> None:
        # c+ and c- are the level times the asymmetry, and divided by it.
        start = torch.ones(scales.size)
        self.ratio = scales.positive("friction asymmetry", start, 0.5, ["1"] * scales.size)

    def _levels(self) -> list[Named]:
        level, ratio = self.level(), self.ratio()
        found = []
        for sign, values in ((">", level * ratio), ("<", level / ratio)):
            names = [name.replace(" of ", f" (v {sign} 0) of ", 1) for name in self.level.names]
            found.append(Named(names, self.level.units, values, lower=0.0))
        return found

    def _level(self, v: Tensor) -> tuple[Tensor, Tensor]:
        level, ratio = self.level(), self.ratio()
        return torch.where(v > 0, level * ratio, level / ratio), torch.zeros_like(v)


class Stribeck(AsymmetricCoulomb):
    """F_i(v) = (c_i + s_i exp(-(v_i / b_i)^2)) tanh(v_i / w_i), c_i by the direction.

    Lubrication sets in with speed: friction is larger by s_i > 0 near rest, and falls off at the
    Stribeck speed b_i. Armstrong-Helouvry, Dupont and Canudas de Wit 1994, sec. 2. Arguments as of
    the rungs below.
    """

    def _add_constants(self, scales: Scales) -> None:
        super()._add_constants(scales)
        v_std = scales.statistics.v_std
        self.rise = scales.positive("Stribeck rise", 0.03 * scales.value, 1.0, self.level.units)
        self.speed = scales.positive("Stribeck speed", 0.3 * v_std, 1.0, self.width.units)

    def physical_constants(self) -> list[Named]:
        return [*super().physical_constants(), self.rise.named(), self.speed.named()]

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
    v_i l_i |f_i| tanh(v_i / w_i) >= 0 it only takes energy. Model M3 of Duclusaud et al. 2025,
    "Extended friction models for the physics simulation of servo actuators" (BAM), with the rise
    of M2; their load is the force of the drive less that of the arm, here that of the drive.
    Arguments as of the rungs below.
    """

    by_load = True

    def _add_constants(self, scales: Scales) -> None:
        super()._add_constants(scales)
        start = torch.full((scales.size,), 0.05)
        self.odds = scales.positive("loss by load", start, 1.0, ["1"] * scales.size)

    def physical_constants(self) -> list[Named]:
        loss = self.odds.named()
        return [*super().physical_constants(), loss._replace(values=_part(self.odds()))]

    def transmitted(self, v: Tensor, force: Tensor) -> Tensor:
        """f - l |f| tanh(v / w)."""
        return force - self._loss(v) * force.abs() * torch.tanh(v / self._width())

    def _loss(self, v: Tensor) -> Tensor:
        """l at v, from its odds."""
        return _part(self.odds())


class LoadDependentStribeck(LoadDependent):
    """As the rung below, with a loss that is larger near rest, as the friction is::

        l_i(v) = o_i / (1 + o_i),     o_i = odds_i + rise_i exp(-(v_i / b_i)^2)

    b_i is the Stribeck speed. 0 < l_i < 1 at every v, so it only takes energy. Model M4 of the same
    source. Arguments as of the rungs below.
    """

    def _add_constants(self, scales: Scales) -> None:
        super()._add_constants(scales)
        start = torch.full((scales.size,), 0.02)
        what = "loss by load near rest"
        self.odds_rise = scales.positive(what, start, 1.0, ["1"] * scales.size)

    def physical_constants(self) -> list[Named]:
        rest = self.odds_rise.named()._replace(values=_part(self.odds() + self.odds_rise()))
        return [*super().physical_constants(), rest]

    def _loss(self, v: Tensor) -> Tensor:
        return _part(self.odds() + self.odds_rise() * torch.exp(-((v / self.speed()) ** 2)))


def _part(odds: Tensor) -> Tensor:
    """Of the whole, between 0 and 1."""
    return odds / (1 + odds)
