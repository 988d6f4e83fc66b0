"""Heads for dry friction. Each law adds an effect to the previous law, and all are passive."""

from __future__ import annotations

import abc

import torch
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.mechanics.mechanical_terms import MechanicalTerms
from pinn_dyn.models.known_constants import HasConstants, Named
from pinn_dyn.models.scales import Scales

_NO_LOSS = -8.0  # z of a loss by load that is all but zero
_SMALLEST_WIDTH = 0.01
"""Smallest width in units of the typical speed. A jump in the force could not be integrated."""


class Friction(HasConstants, abc.ABC):
    """A dissipative force F(v) ``(*batch, N)`` in addition to D(q) v, with v^T F(v) >= 0.

    If ``sticking`` is true, rollouts use :meth:`sliding` instead of F. If ``by_load`` is true, a
    part of the drive force is lost, see :meth:`transmitted`.
    """

    sticking: bool = False
    by_load: bool = False

    @abc.abstractmethod
    def forward(self, v: Tensor) -> Tensor:
        """Return F(v), ``(*batch, N)``, at v ``(*batch, N)``."""

    @abc.abstractmethod
    def slope(self, v: Tensor) -> Tensor:
        """Return dF_i/dv_i >= 0, ``(*batch, N)``. F_i depends only on v_i."""

    def sliding(self, v: Tensor, share: Tensor) -> Tensor:
        """Return the sliding friction at the speed |v|, ``(*batch, N)``.

        ``share`` (0 to 1) is the part of the time in which a coordinate slides forward. The default
        is F(v), without a jump at v = 0.
        """
        return self(v)

    def absent(self) -> dict[Tensor, float]:
        """Return the parameters z of optional effects, and the values that switch them off."""
        return {}

    def transmitted(self, v: Tensor, force: Tensor) -> Tensor:
        """Return the joint force after transmission losses, ``(*batch, N)``.

        The default transmits the full drive force.
        """
        return force


class HasFriction(MechanicalTerms):
    """Part of a mechanical system whose dry friction is that of its head ``friction``."""

    friction: Friction

    def friction_force(self, v: Tensor) -> Tensor:
        return self.friction(v)

    def friction_slope(self, v: Tensor) -> Tensor:
        return self.friction.slope(v)

    def sliding_force(self, v: Tensor, share: Tensor) -> Tensor:
        return self.friction.sliding(v, share)


class NoFriction(Friction):
    """F = 0: all dissipation is viscous, as in the paper."""

    def __init__(self, scales: Scales):
        super().__init__()

    def forward(self, v: Tensor) -> Tensor:
        return torch.zeros_like(v)

    def slope(self, v: Tensor) -> Tensor:
        return torch.zeros_like(v)


class CoulombFriction(Friction):
    """Smooth Coulomb law F_i(v) = c_i tanh(v_i / w_i) with learned c_i > 0 and w_i > 0.

    c_i is the friction level of coordinate i (N or Nm). At the speed w_i (m/s or rad/s), the force
    is 76 % of c_i. A ``sticking`` law is smooth only in control laws, torques and the
    identification. Rollouts use its limit w = 0, in which a coordinate at rest under a load below
    c_i does not move (:class:`~pinn_dyn.mechanics.sliding.Sliding`). Source:
    Armstrong-Helouvry, Dupont and Canudas de Wit (1994), "A survey of models, analysis tools and
    compensation methods for the control of machines with friction".

    Args:
        scales: scales of the data. The value is a typical generalized force, ``(N,)``.
        level: initial c in units of the typical forces.
        width: initial w in units of the typical speeds, without the added minimum of 0.01. The
            default is 0.1 for a network, and 0.03 for known mechanics.
        spread: prior standard deviation of log c and log w, for known mechanics only.
        sticking: true for rollouts with sticking. The default is true for known mechanics only.
    """

    def __init__(
        self,
        scales: Scales,
        *,
        level: PositiveFloat = 0.1,
        width: PositiveFloat | None = None,
        spread: PositiveFloat = 1.0,
        sticking: bool | None = None,
    ):
        super().__init__()
        if width is None:
            width = 0.03 if scales.prior else 0.1
        self.sticking = scales.prior if sticking is None else sticking
        v_std, floor = scales.statistics.v_std, _SMALLEST_WIDTH
        self.level = scales.positive("Coulomb friction", level, scales.value, spread, "force")
        self.width = scales.positive("friction width", width, v_std, spread, "speed", floor)
        self._add_constants(scales)

    def _add_constants(self, scales: Scales) -> None:
        """Add the constants of a subclass."""

    def physical_constants(self) -> list[Named]:
        """Return the constants of the law. Data give only an upper limit of the width.

        Stiction and low-pass filters have the same effect as a width.
        """
        width = self.width.named()._replace(lower=0.0, upper_limit=True)
        return [*self._levels(), width]

    def forward(self, v: Tensor) -> Tensor:
        return self._level(v) * torch.tanh(v / self.width())

    def sliding(self, v: Tensor, share: Tensor) -> Tensor:
        forward, backward = self._levels_at(v)
        return share * forward - (1 - share) * backward

    def slope(self, v: Tensor) -> Tensor:
        """Return c_i (1 - tanh(v_i / w_i)^2) / w_i + dc_i/dv_i tanh(v_i / w_i)."""
        width = self.width()
        sign = torch.tanh(v / width)
        return self._level(v) / width * (1 - sign**2) + self._level_slope(v) * sign

    def _levels(self) -> list[Named]:
        return [self.level.named()]

    def _levels_at(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return the levels of forward and backward motion at the speed |v|."""
        level = self.level()
        return level, level

    def _level(self, v: Tensor) -> Tensor:
        return torch.where(v > 0, *self._levels_at(v))

    def _level_slope(self, v: Tensor) -> Tensor:
        return torch.zeros_like(v)


class AsymmetricCoulomb(CoulombFriction):
    """Coulomb law with a level c+ for v > 0 and c- for v < 0, for worn gears."""

    def _add_constants(self, scales: Scales) -> None:
        # c+ is the level times the asymmetry, c- is the level divided by the asymmetry.
        ones = torch.ones(scales.size, dtype=scales.value.dtype)
        self.ratio = scales.positive("friction asymmetry", 1.0, ones, 0.5, "ratio")

    def _levels(self) -> list[Named]:
        level, ratio = self.level(), self.ratio()
        constants = []
        for sign, values in ((">", level * ratio), ("<", level / ratio)):
            names = [name.replace(" of ", f" (v {sign} 0) of ", 1) for name in self.level.names]
            constants.append(Named(names, self.level.units, values, lower=0.0))
        return constants

    def _levels_at(self, v: Tensor) -> tuple[Tensor, Tensor]:
        level, ratio = self.level(), self.ratio()
        return level * ratio, level / ratio


class Stribeck(AsymmetricCoulomb):
    """Stribeck law F_i(v) = (c_i + s_i exp(-(v_i / b_i)^2)) tanh(v_i / w_i), with c_i by direction.

    b_i is the Stribeck speed. Source: Armstrong-Helouvry, Dupont and Canudas de Wit (1994), sec. 2.
    """

    def _add_constants(self, scales: Scales) -> None:
        super()._add_constants(scales)
        v_std = scales.statistics.v_std
        self.rise = scales.positive("Stribeck rise", 0.03, scales.value, 1.0, "force")
        self.speed = scales.positive("Stribeck speed", 0.3, v_std, 1.0, "speed")

    def physical_constants(self) -> list[Named]:
        return [*super().physical_constants(), self.rise.named(), self.speed.named()]

    def _levels_at(self, v: Tensor) -> tuple[Tensor, Tensor]:
        forward, backward = super()._levels_at(v)
        return forward + self._rise(v), backward + self._rise(v)

    def _level_slope(self, v: Tensor) -> Tensor:
        return -2 * v / self.speed() ** 2 * self._rise(v)

    def _rise(self, v: Tensor) -> Tensor:
        return self.rise() * torch.exp(-((v / self.speed()) ** 2))


class LoadDependent(AsymmetricCoulomb):
    """Coulomb law by direction, and a loss that is proportional to the force f_i of the drive::

        transmitted_i = f_i - l_i |f_i| tanh(v_i / w_i),      0 < l_i < 1

    The friction of a moving joint is c_i + l_i |f_i|. At rest, only c_i holds the joint. Source:
    model M3 of Duclusaud et al. (2025), "Extended friction models for the physics simulation of
    servo actuators", with the force of the drive as the load.
    """

    by_load = True

    def _add_constants(self, scales: Scales) -> None:
        super()._add_constants(scales)
        ones = torch.ones(scales.size, dtype=scales.value.dtype)
        self.odds = scales.positive("loss by load", 0.05, ones, 1.0, "ratio")

    def physical_constants(self) -> list[Named]:
        loss = self.odds.named()._replace(values=self._loss())
        return [*super().physical_constants(), loss]

    def absent(self) -> dict[Tensor, float]:
        return {self.odds.z: _NO_LOSS}

    def transmitted(self, v: Tensor, force: Tensor) -> Tensor:
        return force - self._loss() * force.abs() * torch.tanh(v / self.width())

    def _loss(self) -> Tensor:
        """Return the loss l, ``(N,)``."""
        odds = self.odds()
        return odds / (1 + odds)
